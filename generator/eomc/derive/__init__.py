"""Euler and Lagrange, Newton and Euler over a tape of small definitions."""
