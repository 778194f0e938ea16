"""Whether a formula is a product of powers, seen without factoring it."""

from __future__ import annotations

import random
from collections.abc import Set
from typing import Any

from sympy import QQ, Expr, ring

LARGEST = 10**6  # of the numbers that stand for what is no sum, product or power
MOST = 60  # the degree of a polynomial that is looked at


def powers_alone(formula: Expr, moving: Set[Expr]) -> bool:
    """Whether each factor of a formula that depends on `moving` is there more than once.

    Looked at on a random line through all that it is a polynomial in, coordinates and functions of
    them: there the factors of one and another are alike, but for lines that chance hardly finds
    (Hilbert's irreducibility), and a polynomial in one variable tells by its derivative. A sum of
    squares that is written out is no product, and is not seen; nor is one of a high degree.
    """
    try:
        _, factors = _Line(moving).of(formula).sqf_list()
    except OverflowError:
        return False
    return bool(factors) and all(times > 1 for _, times in factors)


def _bounded(degree: int) -> None:
    """Raise OverflowError where a polynomial would take long."""
    if degree > MOST:
        raise OverflowError


class _Line:
    """Polynomials along a random line, in its parameter."""

    def __init__(self, moving: Set[Expr]) -> None:
        self.moving, self.draw = moving, random.Random(11)
        self.ring, self.s = ring("s", QQ)
        self.known: dict[Expr, Any] = {}

    def of(self, e: Expr) -> Any:
        """What an expression is on the line."""
        if e not in self.known:
            self.known[e] = self._made(e)
        return self.known[e]

    def _made(self, e: Expr) -> Any:
        if e.is_Rational:
            return self.ring(QQ.from_sympy(e))
        if e.is_Add:
            return sum((self.of(x) for x in e.args), self.ring(0))
        if e.is_Mul:
            product, factors = self.ring(1), [self.of(x) for x in e.args]
            _bounded(sum(f.degree() for f in factors if f))
            for x in factors:
                product *= x
            return product
        if e.is_Pow and e.exp.is_Integer and e.exp > 0:
            base = self.of(e.base)
            _bounded(max(base.degree(), 1) * int(e.exp))
            return base ** int(e.exp)
        start, slope = (self.draw.randint(1, LARGEST) for _ in range(2))
        return start + (slope * self.s if e.free_symbols & self.moving else self.ring(0))
