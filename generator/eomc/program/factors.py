"""Detection of products of powers without factoring."""

from __future__ import annotations

import random
from collections.abc import Set
from typing import Any

from sympy import QQ, Expr, ring

MAX_RANDOM = 10**6  # of the random numbers that replace variables and functions
MAX_DEGREE = 60  # of a polynomial that is factored


def has_only_repeated_factors(formula: Expr, moving: Set[Expr]) -> bool:
    """Return True if every factor of a formula occurs at least twice, as in (x - y)^2.

    Factors that do not depend on the variables `moving` are ignored. The formula is a polynomial in
    the variables and in function values such as sin(x), which count as variables. All are set to
    points of a random line, which gives a polynomial in one variable. Different factors remain
    different with probability 1 (Hilbert's irreducibility theorem). Expanded sums of squares and
    polynomials of high degree are not detected.
    """
    try:
        _, factors = _Line(moving).restrict(formula).sqf_list()
    except OverflowError:
        return False
    return bool(factors) and all(times > 1 for _, times in factors)


def _bounded(degree: int) -> None:
    """Raise OverflowError if the degree of a polynomial is too high."""
    if degree > MAX_DEGREE:
        raise OverflowError


class _Line:
    """Polynomials in the parameter s of a random line."""

    def __init__(self, moving: Set[Expr]) -> None:
        self.moving, self.draw = moving, random.Random(11)
        self.ring, self.s = ring("s", QQ)
        self.known: dict[Expr, Any] = {}

    def restrict(self, e: Expr) -> Any:
        """Return the restriction of an expression to the line."""
        if e not in self.known:
            self.known[e] = self._compute(e)
        return self.known[e]

    def _compute(self, e: Expr) -> Any:
        """Compute the restriction of an expression to the line."""
        if e.is_Rational:
            return self.ring(QQ.from_sympy(e))
        if e.is_Add:
            return sum((self.restrict(x) for x in e.args), self.ring(0))
        if e.is_Mul:
            product, factors = self.ring(1), [self.restrict(x) for x in e.args]
            _bounded(sum(f.degree() for f in factors if f))
            for x in factors:
                product *= x
            return product
        if e.is_Pow and e.exp.is_Integer and e.exp > 0:
            base = self.restrict(e.base)
            _bounded(max(base.degree(), 1) * int(e.exp))
            return base ** int(e.exp)
        start, slope = (self.draw.randint(1, MAX_RANDOM) for _ in range(2))
        return start + (slope * self.s if e.free_symbols & self.moving else self.ring(0))
