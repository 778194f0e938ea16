"""Scene text to checked data. No SymPy, no C."""
