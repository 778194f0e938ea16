"""Equations to straight-line programs: ordered, shared, counted, each by its cheapest route."""
