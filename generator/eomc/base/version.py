"""The version of eomc: the one place."""

__version__ = "0.1.0"
