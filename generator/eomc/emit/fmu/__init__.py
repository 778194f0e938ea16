"""A scene as a unit of FMI: variables, description, C below the hand-written layer."""
