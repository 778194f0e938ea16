"""Independent reference values, and the comparison of compiled modules with them (`eomc check`)."""
