"""Hand-written C that generated code takes in."""
