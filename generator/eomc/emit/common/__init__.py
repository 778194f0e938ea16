"""What both forms of C, the FMU and the Python package share."""
