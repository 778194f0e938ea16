"""Independent answers, and built modules compared with them; how these are made is unknown here."""
