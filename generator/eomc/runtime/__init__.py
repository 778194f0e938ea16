"""What is copied next to a built module, batch*.py for batches only. Imports NumPy, and no eomc."""
