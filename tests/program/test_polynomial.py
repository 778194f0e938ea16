"""Polynomials of expressions on a tape have a bounded size."""

from __future__ import annotations

from fractions import Fraction

import pytest
from sympy import S

from eomc.program.routes import MAX_BITS, MAX_EXPONENT, TooLargeError, _bounded


def test_large_exponents_and_numbers_are_not_expanded() -> None:
    """Beyond a bound the expansion would take minutes and gigabytes."""
    most, one = Fraction(MAX_EXPONENT), Fraction(1)
    fits = {(("x", -most), ("y", most)): S(2) ** (MAX_BITS - 2)}
    assert _bounded(fits) == fits
    for monomial, number in (
        ((("x", most + 1), ("y", one)), S.One),
        ((("x", one), ("y", -most - 1)), S.One),
        ((("x", one),), S(2) ** MAX_BITS),
    ):
        with pytest.raises(TooLargeError):
            _bounded({monomial: number})
