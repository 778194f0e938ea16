"""The command line interface, `eomc`."""
