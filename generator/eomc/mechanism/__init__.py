"""Mechanisms with constraints: assembly, ranks, singular positions, mobility."""
