"""Text to a compiled module: compiler, extension, cache."""
