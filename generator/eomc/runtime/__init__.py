"""What is copied beside a built module, batch*.py for batches only. Imports NumPy, and no eomc."""
