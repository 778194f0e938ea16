"""A state, and runs compared."""

from __future__ import annotations

from typing import Any

import numpy as np

Q, QD = [0.3, 1.1], [-0.4, 0.7]  # a state of the cart-pole


def same(run: Any, other: Any) -> bool:
    """Whether two runs agree to the last bit."""
    pairs = ((run.t, other.t), (run.q, other.q), (run.qd, other.qd), (run.energy, other.energy))
    return all(np.array_equal(a, b) for a, b in pairs)


def close(found: Any, expected: Any) -> None:
    """To the rounding of some hundred steps."""
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)
