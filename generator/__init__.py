"""eomc, the equations-of-motion compiler."""

__version__ = "0.1.0"
