"""A state, and comparison of runs."""

from __future__ import annotations

from typing import Any

import numpy as np

Q, QD = [0.3, 1.1], [-0.4, 0.7]  # a state of the cart-pole


def runs_are_equal(run: Any, other: Any) -> bool:
    """Return True if two runs have equal bits."""
    pairs = ((run.t, other.t), (run.q, other.q), (run.qd, other.qd), (run.energy, other.energy))
    return all(np.array_equal(a, b) for a, b in pairs)


def assert_close(actual: Any, expected: Any) -> None:
    """Compare up to the rounding of some hundred steps."""
    np.testing.assert_allclose(actual, expected, rtol=1e-13, atol=1e-13)
