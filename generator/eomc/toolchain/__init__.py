"""From generated text to a compiled module: compiler, extension module, cache."""
