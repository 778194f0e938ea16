"""The equations of a system as they are taught: L, the scalar equations, D, C, g and tau."""

from __future__ import annotations

from functools import cache, cached_property

import sympy
from sympy import Expr, ImmutableMatrix

from eomc import pipeline
from eomc.base.errors import EomcError
from eomc.model.discrete import constant
from eomc.model.system import System
from eomc.pipeline import ScenePath
from eomc.report import abbreviations, equations_text, large_system
from eomc.report.derived import Derived, Terms
from eomc.report.typeset import readable
from eomc.verify import symbolic
from eomc.verify.shorter import coefficients, shorter

EXPANDED = 30_000  # as symbolic.is_small counts: seconds for K without definitions
DERIVED = 8_000  # operations of D, C and bias as they are derived, up to which they are simplified
WRITTEN_OUT = 1_000  # operations of what is set out, which then fills a page or two


class Equations(Derived):
    """D q̈ + C q̇ + g = tau and what it comes from, as SymPy expressions over the scene's names.

    With constraints, zero = 0 (m, 1), it is tau + A^T lambda, A (m, nq) and lambda (m,) symbols.
    D, C: (nq, nq); g, tau: (nq, 1), tau = forces - friction. kinetic, potential: K and P;
    jacobi, power: Jacobi's integral and its rate, None where they say nothing more. `str` prints
    them, at most 100 columns wide; a notebook shows them typeset; long ones with names for what
    they share, `named` in those that are `set_out`.

    >>> import eomc
    >>> eomc.equations("scenes/simple_pendulum.toml").scalar    # doctest: +SKIP
    (Eq(g*l*m*sin(theta) + l**2*m*theta_ddot, 0),)
    """

    @cached_property
    def set_out(self) -> Equations:
        """The same as they are printed: long ones by abbreviations."""
        long = not self.named and _operations(self) > WRITTEN_OUT
        return abbreviations.of(self) if long else self

    def __repr__(self) -> str:
        s = self.system
        return f"<Equations of {s.name}: {s.size}; print() shows them>"

    def __str__(self) -> str:
        return equations_text.text(self.set_out)

    def _repr_latex_(self) -> str:
        return equations_text.latex(self.set_out)


def equations(scene: System | ScenePath) -> Equations:
    """The equations of motion of a scene file or a System, simplified, as SymPy expressions.

    Raises SceneError for a faulty scene, EomcError where they would fill many pages.
    """
    return of(scene if isinstance(scene, System) else pipeline.read(scene))


def of(system: System) -> Equations:
    """The equations of a system, simplified. Raises EomcError where they would fill many pages."""
    system = constant(system)
    if not symbolic.is_small(system, EXPANDED):
        raise too_long(system)
    plain = symbolic.derive(symbolic.written_out(system))
    if sum(e.count_ops() for name in ("D", "C", "bias") for e in getattr(plain, name)) > DERIVED:
        raise too_long(system)

    @cache
    def short(e: Expr) -> Expr:
        return readable(shorter(e, system.qd))

    D, C, g, tau, friction = (
        getattr(plain, name).applyfunc(short) for name in ("D", "C", "g", "tau", "friction")
    )
    conserved = sympy.expand(plain.jacobi - plain.energy) == 0
    jacobi, power = None if conserved else short(plain.jacobi), short(plain.power)
    left = tuple(_left(system, D, plain.bias[i], friction[i], i) for i in range(len(system.q)))
    made = Equations(
        system, D, C, g, tau, (plain.tau + plain.friction).applyfunc(readable),
        plain.constraints.applyfunc(readable), plain.constraint_jacobian.applyfunc(readable),
        readable(_energy(plain.kinetic, system)), readable(_energy(plain.potential, system)),
        jacobi, power if power != 0 else None, left,
    )  # fmt: skip
    if _operations(made.set_out) > WRITTEN_OUT:
        raise too_long(system)
    return made


def _operations(found: Equations) -> int:
    """Of the scalar equations, and of what is named in them."""
    rows = sum(b.count_ops() + 2 for terms in found.left for _, b in terms)
    return int(rows + sum(e.count_ops() for _, e in found.named))


def written(system: System, form: str = "text") -> str:
    """L, the scalar equations, D, C, g and what else there is of D qdd + C qd + g = tau.

    form: "text" (Unicode), "latex" or "python". The equations are the reference's, simplified, as
    a textbook has them: written out, or by abbreviations. Those of a large system would be of no
    use to anyone: what they come from is shown; "python" raises EomcError.
    """
    try:
        found = of(system)
    except EomcError:
        if form == "python":
            raise
        system = constant(system)
        return large_system.latex(system) if form == "latex" else large_system.text(system)
    if form == "python":
        return equations_text.python(found)
    return found._repr_latex_() if form == "latex" else str(found)


def too_long(system: System) -> EomcError:
    """What to say of a system whose equations nobody would read."""
    return EomcError(
        f"{system.name}: written out, its equations would fill many pages: 'eomc show' without "
        "--python says what they come from and how they are computed"
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
            c = readable(c)
            (last if rates == 1 else terms).append((rates, c))
    return terms + [(rates, c) for rates, c in last if c != 0]
