"""The equations of a system as they are taught: L, the scalar equations, D, C, g and tau."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import sympy
from sympy import Expr, ImmutableMatrix

from eomc import pipeline
from eomc.base.errors import EomcError
from eomc.model.discrete import constant
from eomc.model.symbols import symbol
from eomc.model.system import System
from eomc.pipeline import ScenePath
from eomc.report import abbreviations, equations_text, large_system
from eomc.report.derived import Derived, Terms
from eomc.report.typeset import readable
from eomc.scene.formulas import suggest
from eomc.verify import symbolic
from eomc.verify.shorter import coefficients, shorter

EXPANDED = 30_000  # as symbolic.is_small counts: seconds for K without definitions
DERIVED = 8_000  # operations of D, C and bias as they are derived, up to which they are simplified
WRITTEN_OUT = 1_000  # operations of what is set out, which then fills a page or two


@dataclass(frozen=True, repr=False)
class Equations(Derived):
    """D q̈ + C q̇ + g = tau and what it comes from, as SymPy expressions over the scene's names.

    With constraints, zero = 0 (m, 1), it is tau + A^T lambda, A (m, nq) and lambda (m,) symbols.
    D, C: (nq, nq); g, tau: (nq, 1), tau = forces - friction. kinetic, potential: K and P;
    linear_potential: the part of a generalized potential that is linear in the velocities, or None;
    jacobi, power: Jacobi's integral and its rate, None where they say nothing more. `str` prints
    them, at most 100 columns wide; a notebook shows them typeset; long ones with names for what
    they share, `named` in those that are `set_out`.

    The symbols of a scene's equations are plain ones, `sympy.Symbol("m_c")`; those of a System are
    the symbols and functions of time that `System.make` was given. `symbols` has them by name.

    >>> import eomc
    >>> found = eomc.equations("scenes/simple_pendulum.toml")   # doctest: +SKIP
    >>> found.scalar                                            # doctest: +SKIP
    (Eq(g*l*m*sin(theta) + l**2*m*theta_ddot, 0),)
    >>> found.D.subs({"m": 2, "l": 0.5})                        # doctest: +SKIP
    Matrix([[0.5]])
    """

    _internal: Equations | None = None  # the same over the system's own symbols, which are printed

    @cached_property
    def set_out(self) -> Equations:
        """The same as they are printed: long ones by abbreviations."""
        if self._internal is not None:
            return self._internal.set_out.in_symbols_of_the_user()
        long = not self.named and _operations(self) > WRITTEN_OUT
        return abbreviations.of(self) if long else self

    def in_symbols_of_the_user(self) -> Equations:
        """Return the equations over the symbols that the user has or can make by name."""
        s = self.system
        names = [x.name for x in (*s.q, *s.qd, *s.qdd, *s.u, *(p.symbol for p in s.parameters))]
        names += [*(x.name for x in self.multipliers), *(x.name for x, _ in self.named), "t"]
        plain = {name: sympy.Symbol(name) for name in names}
        symbols = {name: s.own_symbols.get(name, plain[name]) for name in names}
        changed = self.replaced({symbol(n): new for n, new in symbols.items()}, lambda e: e)
        return replace(changed, symbols=symbols, _internal=self)

    def with_values(self, values: Mapping[Any, Any] | None = None, /, **by_name: Any) -> Equations:
        """Return the equations with numbers in place of parameters.

        Parameters
        ----------
        values : mapping, optional
            From parameters, as names or as the symbols of `symbols`, to numbers.
        **by_name
            The same by keyword, ``with_values(m=2)``.

        Returns
        -------
        Equations
            Decimal numbers are taken as exact fractions, as in a scene.

        Raises
        ------
        EomcError
            If a name is not one of a parameter, or a value not a finite real number.
        """
        if self._internal is None:
            return self.in_symbols_of_the_user().with_values(values, **by_name)
        parameters = {p.name: p.symbol for p in self.system.parameters}
        names = {self.symbols[name]: name for name in parameters}
        new = dict[Expr, Expr]()
        for key, value in {**(values or {}), **by_name}.items():
            name = names.get(key, key)
            if name not in parameters:
                known = [*parameters]
                raise EomcError(
                    f"with_values: {name!s} is not a parameter{suggest(str(name), known)}: "
                    + (f"there are {', '.join(known)}" if known else "there are none")
                )
            new[parameters[name]] = _exact(value, f"with_values: {name}")
        return self._internal.replaced(new, readable).in_symbols_of_the_user()

    def __repr__(self) -> str:
        s = self.system
        return f"<Equations of {s.name}: {s.size}; print() shows them>"

    def __str__(self) -> str:
        return equations_text.text((self._internal or self).set_out)

    def _repr_latex_(self) -> str:
        return equations_text.latex((self._internal or self).set_out)


def equations(scene: System | ScenePath) -> Equations:
    """Derive the equations of motion of a scene file or a System, simplified.

    Parameters
    ----------
    scene : str, path or System

    Returns
    -------
    Equations
        SymPy expressions over plain symbols of the scene's names, or over the symbols that
        `System.make` was given.

    Raises
    ------
    SceneError
        If the scene is faulty.
    EomcError
        If the equations would fill many pages.
    """
    system = scene if isinstance(scene, System) else pipeline.read(scene)
    return of(system).in_symbols_of_the_user()


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
    linear = readable(_energy(plain.linear_potential, system))
    left = tuple(_left(system, D, plain.bias[i], friction[i], i) for i in range(len(system.q)))
    made = Equations(
        system, D, C, g, tau, (plain.tau + plain.friction).applyfunc(readable),
        plain.constraints.applyfunc(readable), plain.constraint_jacobian.applyfunc(readable),
        readable(_energy(plain.kinetic, system)), readable(_energy(plain.potential, system)),
        jacobi, power if power != 0 else None, linear if linear != 0 else None, left,
    )  # fmt: skip
    if _operations(made.set_out) > WRITTEN_OUT:
        raise too_long(system)
    return made


def _exact(value: Any, what: str) -> Expr:
    """Return a number as SymPy has it, a decimal one as a fraction. Raises EomcError."""
    try:
        number = sympy.Rational(repr(float(value))) if not isinstance(value, Expr) else value
        number = sympy.nsimplify(number, rational=True) if number.has(sympy.Float) else number
    except (TypeError, ValueError, OverflowError):
        number = None
    if number is None or not (number.is_number and number.is_real and number.is_finite):
        raise EomcError(f"{what} must be a finite real number, here {value!r}")
    return number


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
