"""eomc, the equations-of-motion compiler."""
