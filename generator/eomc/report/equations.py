"""The equations of a system as they are taught: L, the scalar equations, D, C, g and tau."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import sympy
from sympy import Expr, ImmutableMatrix

from eomc import pipeline
from eomc.base.errors import EomcError
from eomc.model.system import System, symbol
from eomc.pipeline import ScenePath
from eomc.report import equations_text
from eomc.verify import symbolic
from eomc.verify.shorter import coefficients

EXPANDED = 30_000  # as symbolic.is_small counts: seconds for K without definitions
DERIVED = 4_000  # operations of D, C and bias as they are derived, up to which they are simplified
WRITTEN_OUT = 1_000  # operations of the scalar equations, which then fill a page or two
LONG = 10**12  # above or below the line of a fraction, which is then shown as a decimal
TINY = 1e-25  # a factor below it is what rounding left of a zero

Terms = list[tuple[Expr, Expr]]  # a product of accelerations or rates, and its coefficient


@dataclass(frozen=True)
class Equations:
    """D q̈ + C q̇ + g = tau and what it comes from, as SymPy expressions over the scene's names.

    With constraints, zero = 0 (m, 1), it is tau + A^T lambda, A (m, nq) and lambda (m,) symbols.
    D, C: (nq, nq); g, tau: (nq, 1), tau = forces - friction. kinetic, potential: K and P;
    jacobi, power: Jacobi's integral and its rate, None where they say nothing more. `str` prints
    them, at most 100 columns wide; a notebook shows them typeset.

    >>> import eomc
    >>> eomc.equations("scenes/simple_pendulum.toml").scalar    # doctest: +SKIP
    (Eq(g*l*m*sin(theta) + l**2*m*theta_ddot, 0),)
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
    left: tuple[Terms, ...]  # of each scalar equation

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

    def __str__(self) -> str:
        return equations_text.text(self)

    def _repr_latex_(self) -> str:
        return equations_text.latex(self)


def equations(scene: System | ScenePath) -> Equations:
    """The equations of motion of a scene file or a System, simplified, as SymPy expressions.

    Raises SceneError for a faulty scene, EomcError where they would fill many pages.
    """
    return of(scene if isinstance(scene, System) else pipeline.read(scene))


def of(system: System) -> Equations:
    """The equations of a system, simplified. Raises EomcError where they would fill many pages."""
    if not symbolic.is_small(system, EXPANDED):
        raise too_long(system)
    plain = symbolic.derive(symbolic.written_out(system))
    if sum(e.count_ops() for name in ("D", "C", "bias") for e in getattr(plain, name)) > DERIVED:
        raise too_long(system)
    found = plain.simplified
    D, C, g, tau, friction, bias = (
        getattr(found, name).applyfunc(readable)
        for name in ("D", "C", "g", "tau", "friction", "bias")
    )
    left = tuple(_left(system, D, bias[i], friction[i], i) for i in range(len(system.q)))
    if sum(b.count_ops() + 2 for terms in left for _, b in terms) > WRITTEN_OUT:
        raise too_long(system)
    return Equations(
        system, D, C, g, tau, (plain.tau + plain.friction).applyfunc(readable),
        plain.constraints.applyfunc(readable), plain.constraint_jacobian.applyfunc(readable),
        readable(_energy(plain.kinetic, system)), readable(_energy(plain.potential, system)),
        readable(found.jacobi) if found.jacobi != found.energy else None,
        readable(found.power) if found.power != 0 else None, left,
    )  # fmt: skip


def written(system: System, form: str = "text") -> str:
    """L, the scalar equations, D, C, g and what else there is of D qdd + C qd + g = tau.

    form: "text" (Unicode), "latex" or "python". The equations are the reference's, simplified:
    written out, as a textbook has them. Those of a large system would be of no use to anyone: as
    text what they come from is shown, and what computes them; other forms raise EomcError.
    """
    try:
        found = of(system)
    except EomcError:
        if form != "text":
            raise
        return equations_text.large(system)
    forms = {"text": equations_text.text, "latex": equations_text.latex}
    return forms.get(form, equations_text.python)(found)


def too_long(system: System) -> EomcError:
    """What to say of a system whose equations nobody would read."""
    return EomcError(
        f"{system.name}: written out, its equations would fill many pages: 'eomc show' without "
        "--latex or --python says what they come from and how they are computed"
    )


def _energy(e: Expr, system: System) -> Expr:
    """A sum of products of rates, each with its own coefficient; what has none is a sum itself."""
    terms = coefficients(e, system.qd)
    return e if terms is None else sympy.Add(*(a * b for a, b in terms))


def _left(system: System, D: ImmutableMatrix, bias: Expr, friction: Expr, i: int) -> Terms:
    """Row i of D q̈ + bias + friction, in terms: accelerations first, then by rates."""
    terms = [(qdd, D[i, j]) for j, qdd in enumerate(system.qdd) if D[i, j] != 0]
    last: Terms = []
    for part in (bias, friction):
        for rates, c in coefficients(part, system.qd) or [(sympy.S.One, part)]:
            (last if rates == 1 else terms).append((rates, c))
    return terms + [(rates, c) for rates, c in last if c != 0]


def readable(value: Expr) -> Expr:
    """With decimals for fractions that nobody reads, as those of 50 digits of slanted axes.

    At 30 digits more of them fall together, and what rounding left of zeros is gone.
    """
    if not _long(value):
        return value
    short = _rounded(sympy.expand(value))
    plain = _rounded(sympy.expand(short))  # each factor whole again
    return plain.xreplace({x: sympy.Float(x, 15) for x in _long(plain)})


def _rounded(e: Expr) -> Expr:
    return e.xreplace(
        {x: sympy.Rational(str(sympy.Float(x, 30))) if abs(x) > TINY else 0 for x in _long(e)}
    )


def _long(e: Expr) -> set[sympy.Rational]:
    return {x for x in e.atoms(sympy.Rational) if max(abs(x.p), x.q) >= LONG}
