"""Optimised C: for gcc and clang, with vector registers and measured optimisations."""
