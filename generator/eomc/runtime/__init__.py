"""What is copied beside a built module. Imports NumPy, and nothing of eomc."""
