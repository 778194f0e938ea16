"""The equations of a system as SymPy expressions: K, P, scalar equations, D, C, g and tau."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import sympy
from sympy import Expr, ImmutableMatrix

from eomc.model.system import System, symbol

Terms = list[tuple[Expr, Expr]]  # a product of accelerations or rates, and its coefficient


@dataclass(frozen=True)
class Derived:
    """The equations of motion D q̈ + C q̇ + g = τ + Aᵀλ of a system as SymPy expressions.

    The subclass `equations.Equations` documents the fields. `symbols` maps names to the symbols
    that the expressions contain instead of the system's own.
    """

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
    linear_potential: Expr | None
    left: tuple[Terms, ...]  # left-hand side of each scalar equation
    named: tuple[tuple[sympy.Symbol, Expr], ...] = ()  # abbreviations, each over earlier ones
    symbols: Mapping[str, Expr] = field(default_factory=dict)

    @property
    def multipliers(self) -> tuple[Expr, ...]:
        """Symbols of the Lagrange multipliers λ, one for each constraint equation."""
        names = (f"lambda_{c.name}" for c in self.system.constraints)
        return tuple(self.symbols.get(name, symbol(name)) for name in names)

    def substitute(self, values: Mapping[Expr, Expr], form: Callable[[Expr], Expr]) -> Self:
        """Return a copy of the equations in which symbols are replaced by `values`.

        `form` is a function from an expression to an expression, such as a simplification, that is
        applied to each resulting expression.
        """

        def substituted(e: Expr) -> Expr:
            return form(e.xreplace(values))

        matrices = ("D", "C", "g", "tau", "forces", "zero", "A")
        scalars = ("kinetic", "potential", "linear_potential", "jacobi", "power")
        changed: dict[str, Any] = {
            name: getattr(self, name).applyfunc(substituted) for name in matrices
        }
        changed |= {
            name: substituted(e) for name in scalars if (e := getattr(self, name)) is not None
        }
        return replace(
            self,
            **changed,
            left=tuple(
                [(e.xreplace(values), substituted(c)) for e, c in terms] for terms in self.left
            ),
            named=tuple((s.xreplace(values), substituted(e)) for s, e in self.named),
        )

    @property
    def right(self) -> ImmutableMatrix:
        """Right-hand sides of the scalar equations, (nq, 1): generalized forces plus Aᵀλ."""
        if not self.multipliers:
            return self.forces
        return self.forces + self.A.T * sympy.Matrix(self.multipliers)

    @property
    def L(self) -> Expr:
        """The Lagrangian K - P - U, where U is the part of the potential linear in velocities."""
        return self.kinetic - self.potential - (self.linear_potential or 0)

    @cached_property
    def scalar(self) -> tuple[sympy.Eq, ...]:
        """Scalar equations d/dt ∂L/∂q̇ - ∂L/∂q + friction = forces, one per coordinate.

        L is the Lagrangian. SymPy does not simplify the two sides (evaluate=False). In a system
        with constraints, the right-hand side also contains Aᵀλ.
        """
        sides = zip(self.left, self.right, strict=True)
        return tuple(
            sympy.Eq(sympy.Add(*(a * b for a, b in terms)), right, evaluate=False)
            for terms, right in sides
        )
