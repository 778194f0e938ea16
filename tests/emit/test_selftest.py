"""Which angles a self-test takes: those in which reduction by pi/2 shows."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

from eomc.emit.selftest import _lost


@pytest.mark.parametrize("real", [np.float64, np.float32])
def test_what_a_multiple_of_half_pi_loses(real: type) -> None:
    """Powers of two nothing, others up to half a unit in the last place of n pi/2."""
    double, half_pi = real is np.float64, real(math.pi / 2)
    for n in (1, 2, 64, 4096):
        assert _lost(n * math.pi / 2 + 0.3, double) == 0
    found = []
    for n in range(1000, 1100):
        product = real(n) * half_pi
        lost = abs(Fraction(float(product)) - n * Fraction(float(half_pi)))
        assert _lost(n * math.pi / 2 - 0.3, double) == float(lost)
        found.append(lost / Fraction(float(np.spacing(product))))
    assert 0.4 < max(found) <= 0.5
