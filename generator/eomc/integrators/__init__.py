"""Tableaux: the methods of integration as exact coefficients."""
