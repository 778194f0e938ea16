"""Vectors in space with atoms of a tape as entries."""

from __future__ import annotations

from collections.abc import Sequence

from sympy import Expr, S

from eomc.derive.tape import Tape

Vector = tuple[Expr, Expr, Expr]

ZERO: Vector = (S.Zero, S.Zero, S.Zero)
AXES = ((1, 2), (2, 0), (0, 1))  # for each axis, the other two in cyclic order


class Vectors:
    """Sums and products of numbers and vectors on a tape; terms that are zero are left out.

    A tape is a list of elementary operations, each with a named result. The arguments and results
    of the methods are atoms of the tape: numbers, names, or numbers times a name.
    """

    def __init__(self, tape: Tape) -> None:
        self.tape = tape

    def define(self, e: Expr) -> Expr:
        """Add an expression to the tape and return it as a number, a name, or a number times it."""
        return self.tape.define(e)

    def add(self, *terms: Expr) -> Expr:
        """Return the sum of the terms, 0 without terms."""
        return self.tape.total([x for x in terms if x is not S.Zero])

    def times(self, a: Expr, b: Expr) -> Expr:
        """Return the product a b of two atoms."""
        return S.Zero if a is S.Zero or b is S.Zero else self.tape.times(a, b)

    def minus(self, a: Expr) -> Expr:
        """Return -a, the negative of an atom."""
        return self.tape.scaled(S.NegativeOne, a)

    def vector(self, v: Sequence[Expr]) -> Vector:
        """Return the vector whose entries are the atoms of the three expressions v."""
        x, y, z = map(self.define, v)
        return (x, y, z)

    def plus(self, *vectors: Sequence[Expr]) -> Vector:
        """Return the sum of vectors, entry by entry."""
        x, y, z = (self.add(*parts) for parts in zip(*vectors, strict=True))
        return (x, y, z)

    def dot(self, a: Sequence[Expr], b: Sequence[Expr]) -> Expr:
        """Return the scalar product a . b."""
        return self.add(*(self.times(x, y) for x, y in zip(a, b, strict=True)))

    def cross(self, a: Sequence[Expr], b: Sequence[Expr]) -> Vector:
        """Return the vector product a x b."""
        x, y, z = (
            self.add(self.times(a[i], b[j]), self.minus(self.times(a[j], b[i]))) for i, j in AXES
        )
        return (x, y, z)

    def apply(self, R: Sequence[Sequence[Expr]], v: Sequence[Expr]) -> Vector:
        """Return the product R v of a 3 x 3 matrix, given by rows, and a vector."""
        x, y, z = (self.dot(row, v) for row in R)
        return (x, y, z)

    def scaled(self, v: Sequence[Expr], x: Expr) -> Vector:
        """Return the product x v of a vector and an atom."""
        a, b, c = (self.times(e, x) for e in v)
        return (a, b, c)
