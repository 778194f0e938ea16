"""Programs to text: C and the Python package around it."""
