"""A scene as an FMU (FMI unit): variables, model description, and C for the hand-written code."""
