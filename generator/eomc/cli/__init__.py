"""The command eomc."""
