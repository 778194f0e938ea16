"""Symbolic equations of motion in textbook form: L, the scalar equations, D, C, g and tau."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import sympy
from sympy import Expr, ImmutableMatrix

from eomc import pipeline
from eomc.base.errors import EomcError
from eomc.model.hybrid import with_constant_parameters
from eomc.model.symbols import symbol
from eomc.model.system import System
from eomc.pipeline import ScenePath
from eomc.report import abbreviations, equations_text, large_system
from eomc.report.derived import Derived, Terms
from eomc.report.typeset import readable
from eomc.scene.formulas import suggest
from eomc.verify import symbolic
from eomc.verify.trig_simplify import coefficients, simplify_trig

MAX_EXPANDED_SIZE = 30_000  # size by symbolic.is_small; simplification then takes seconds
MAX_DERIVED_OPERATIONS = 8_000  # in D, C and bias before simplification
MAX_WRITTEN_OPERATIONS = 1_000  # in the printed equations, which then fill a page or two


@dataclass(frozen=True, repr=False)
class Equations(Derived):
    """D q̈ + C q̇ + g = τ and its parts, as SymPy expressions over the scene's names.

    Attributes
    ----------
    D, C : Matrix (nq, nq)
        Mass matrix and Coriolis matrix (Christoffel form).
    g, tau : Matrix (nq, 1)
        Potential forces and generalized forces, tau = forces - friction.
    zero, A : Matrix (m, 1) and (m, nq)
        Constraints zero = 0 and their Jacobian. With constraints, the right-hand side is tau + A^T
        lambda.
    kinetic, potential : Expr
        Energies K and P.
    linear_potential : Expr or None
        Part of a generalized potential that is linear in the velocities.
    jacobi, power : Expr or None
        Jacobi's integral and its rate, None if equal to the energy or zero.
    symbols : mapping from names to symbols
        For a scene these are plain symbols, `sympy.Symbol("m_c")`; for a System they are the
        symbols and functions of time that were passed to `System.make`.
    named : tuple of (symbol, Expr)
        Abbreviations; only equations that are `set_out` have any.

    Notes
    -----
    `str` returns text at most 100 columns wide, and a notebook shows the equations typeset. Long
    equations are printed with names for shared subexpressions.

    Examples
    --------
    >>> import eomc
    >>> equations = eomc.equations("scenes/simple_pendulum.toml")  # doctest: +SKIP
    >>> equations.scalar                                           # doctest: +SKIP
    (Eq(g*l*m*sin(theta) + l**2*m*theta_ddot, 0),)
    >>> equations.D.subs({"m": 2, "l": 0.5})                       # doctest: +SKIP
    Matrix([[0.5]])
    """

    _internal: Equations | None = None  # equations over the system's own symbols, for printing

    @cached_property
    def set_out(self) -> Equations:
        """The equations as they are printed: long ones with names for shared subexpressions."""
        if self.named:
            return self
        if self._internal is not None:
            return self._internal.set_out.with_user_symbols()
        long = _operations(self) > MAX_WRITTEN_OPERATIONS
        return abbreviations.abbreviate(self) if long else self

    def with_user_symbols(self) -> Equations:
        """Return the equations over the user's symbols instead of the internal ones.

        These are the symbols that were passed to `System.make`; any other name becomes a plain
        symbol, such as sympy.Symbol("m"), which the user can create.
        """
        s = self.system
        names = [x.name for x in (*s.q, *s.qd, *s.qdd, *s.u, *(p.symbol for p in s.parameters))]
        names += [*(x.name for x in self.multipliers), *(x.name for x, _ in self.named), "t"]
        if self.named:  # entries of D stand for themselves in the scalar equations
            inside = {x.name for terms in self.left for _, c in terms for x in c.free_symbols}
            names += sorted(inside.difference(names))
        symbols = {name: s.own_symbols.get(name, sympy.Symbol(name)) for name in names}
        changed = self.substitute({symbol(n): new for n, new in symbols.items()}, lambda e: e)
        return replace(changed, symbols=symbols, _internal=self)

    def with_values(self, values: Mapping[Any, Any] | None = None, /, **by_name: Any) -> Equations:
        """Return a copy of the equations with numbers in place of some or all parameters.

        Parameters
        ----------
        values : mapping, optional
            Numbers by parameter. A parameter is given by its name or by its symbol in `symbols`.
        **by_name
            Numbers by the names of parameters as keywords, ``with_values(m=2)``.

        Returns
        -------
        Equations
            With decimal numbers converted to exact fractions, as in a scene.

        Raises
        ------
        EomcError
            If a name is not one of a parameter, or a value not a finite real number.
        """
        if self._internal is None:
            return self.with_user_symbols().with_values(values, **by_name)
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
        return self._internal.substitute(new, readable).with_user_symbols()

    def __repr__(self) -> str:
        s = self.system
        return f"<Equations of {s.name}: {s.size}; print() shows them>"

    def __str__(self) -> str:
        return equations_text.text((self._internal or self).set_out)

    def _repr_latex_(self) -> str:
        return equations_text.latex((self._internal or self).set_out)


def equations(scene: System | ScenePath) -> Equations:
    """Derive and simplify the equations of motion of a scene file or a System.

    Parameters
    ----------
    scene : str, path or System

    Returns
    -------
    Equations
        SymPy expressions. For a scene file, their symbols are plain symbols of the scene's names;
        for a System, they are the symbols that were passed to `System.make`.

    Raises
    ------
    SceneError
        If the scene is faulty.
    EomcError
        If the equations would fill many pages.
    """
    system = scene if isinstance(scene, System) else pipeline.read(scene)
    return derive(system).with_user_symbols()


def derive(system: System) -> Equations:
    """Derive and simplify the equations of motion of a system, over its internal symbols.

    Raises EomcError if the printed equations would fill many pages.
    """
    system = with_constant_parameters(system)
    if not symbolic.is_small(system, MAX_EXPANDED_SIZE):
        raise too_long_error(system)
    plain = symbolic.derive(symbolic.without_definitions(system))
    if (
        sum(e.count_ops() for name in ("D", "C", "bias") for e in getattr(plain, name))
        > MAX_DERIVED_OPERATIONS
    ):
        raise too_long_error(system)

    @cache
    def short(e: Expr) -> Expr:
        return readable(simplify_trig(e, system.qd))

    D, C, g, tau, friction = (
        getattr(plain, name).applyfunc(short) for name in ("D", "C", "g", "tau", "friction")
    )
    conserved = sympy.expand(plain.jacobi - plain.energy) == 0
    jacobi, power = None if conserved else short(plain.jacobi), short(plain.power)
    linear = readable(_energy(plain.linear_potential, system))
    left = tuple(_left_side(system, D, plain.bias[i], friction[i], i) for i in range(len(system.q)))
    result = Equations(
        system, D, C, g, tau, (plain.tau + plain.friction).applyfunc(readable),
        plain.constraints.applyfunc(readable), plain.constraint_jacobian.applyfunc(readable),
        readable(_energy(plain.kinetic, system)), readable(_energy(plain.potential, system)),
        jacobi, power if power != 0 else None, linear if linear != 0 else None, left,
    )  # fmt: skip
    if _operations(result.set_out) > MAX_WRITTEN_OPERATIONS:
        raise too_long_error(system)
    return result


def _exact(value: Any, what: str) -> Expr:
    """Return a real, finite number in SymPy, a decimal as a fraction. Raises EomcError."""
    try:
        number = sympy.Rational(repr(float(value))) if not isinstance(value, Expr) else value
        number = sympy.nsimplify(number, rational=True) if number.has(sympy.Float) else number
    except (TypeError, ValueError, OverflowError):
        number = None
    if number is None or not (number.is_number and number.is_real and number.is_finite):
        raise EomcError(f"{what} must be a finite real number, here {value!r}")
    return number


def _operations(derived: Equations) -> int:
    """Return the number of operations in the scalar equations and their abbreviations."""
    rows = sum(b.count_ops() + 2 for terms in derived.left for _, b in terms)
    return int(rows + sum(e.count_ops() for _, e in derived.named))


def write_equations(system: System, form: str = "text") -> str:
    """Derive the equations of motion of a system and return them as text.

    The Lagrangian L, the scalar equations, D, C, g and all other parts are simplified and printed
    as in a textbook. If they would fill many pages, the text instead describes how they are
    computed and how many operations this takes.

    Parameters
    ----------
    system : System
    form : {"text", "latex", "python"}
        "text" is Unicode text for a terminal; "python" is source code with SymPy matrices.

    Raises
    ------
    EomcError
        If the form is "python" and the equations would fill many pages.
    """
    try:
        derived = derive(system)
    except EomcError:
        if form == "python":
            raise
        system = with_constant_parameters(system)
        return large_system.latex(system) if form == "latex" else large_system.text(system)
    if form == "python":
        return equations_text.python(derived)
    return derived._repr_latex_() if form == "latex" else str(derived)


def too_long_error(system: System) -> EomcError:
    """Return the exception for a system whose printed equations would fill many pages."""
    return EomcError(
        f"{system.name}: written out, its equations would fill many pages: 'eomc show' without "
        "--python says what they come from and how they are computed"
    )


def _energy(e: Expr, system: System) -> Expr:
    """Return `e` as a sum of products of velocities, each with its collected coefficient."""
    terms = coefficients(e, system.qd)
    return e if terms is None else sympy.Add(*(a * b for a, b in terms))


def _left_side(system: System, D: ImmutableMatrix, bias: Expr, friction: Expr, i: int) -> Terms:
    """Return row i of D q̈ + bias + friction: terms in accelerations, in velocities, the rest."""
    terms = [(qdd, D[i, j]) for j, qdd in enumerate(system.qdd) if D[i, j] != 0]
    last: Terms = []
    for part in (bias, friction):
        for rates, c in coefficients(part, system.qd) or [(sympy.S.One, part)]:
            c = readable(c)
            (last if rates == 1 else terms).append((rates, c))
    return terms + [(rates, c) for rates, c in last if c != 0]
