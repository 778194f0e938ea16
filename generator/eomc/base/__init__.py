"""Base layer: errors, names, texts, resources."""
