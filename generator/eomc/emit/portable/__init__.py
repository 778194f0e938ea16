"""Portable C: strict C99 for any compiler."""
