"""The plain form of C: strict C99, any compiler, no tricks."""
