"""What several test files share, and commands that try random scenes and mutants."""
