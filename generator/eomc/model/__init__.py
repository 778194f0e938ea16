"""A scene or SymPy expressions to a mechanical system in symbols."""
