"""What is derived of a system, as SymPy expressions: K, P, scalar equations, D, C, g and tau."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import sympy
from sympy import Expr, ImmutableMatrix

from eomc.model.system import System, symbol

Terms = list[tuple[Expr, Expr]]  # a product of accelerations or rates, and its coefficient


@dataclass(frozen=True)
class Derived:
    """The expressions of `equations.Equations`, which says what each is."""

    system: System
    D: ImmutableMatrix
    C: ImmutableMatrix
    g: ImmutableMatrix
    tau: ImmutableMatrix
    forces: ImmutableMatrix
    zero: ImmutableMatrix
    A: ImmutableMatrix
    kinetic: Expr
    potential: Expr
    jacobi: Expr | None
    power: Expr | None
    left: tuple[Terms, ...]  # of each scalar equation
    named: tuple[tuple[sympy.Symbol, Expr], ...] = ()  # abbreviations, in their order

    @property
    def multipliers(self) -> tuple[sympy.Symbol, ...]:
        """Of the constraints."""
        return tuple(symbol(f"lambda_{c.name}") for c in self.system.constraints)

    @property
    def right(self) -> ImmutableMatrix:
        """The right sides of the scalar equations: forces, and A^T lambda."""
        if not self.multipliers:
            return self.forces
        return self.forces + self.A.T * sympy.Matrix(self.multipliers)

    @property
    def L(self) -> Expr:
        """K - P, the Lagrangian."""
        return self.kinetic - self.potential

    @cached_property
    def scalar(self) -> tuple[sympy.Eq, ...]:
        """d/dt dL/dqd - dL/dq + friction = forces, one equation a coordinate, unevaluated.

        Under constraints the right side has A^T lambda besides.
        """
        sides = zip(self.left, self.right, strict=True)
        return tuple(
            sympy.Eq(sympy.Add(*(a * b for a, b in terms)), right, evaluate=False)
            for terms, right in sides
        )
