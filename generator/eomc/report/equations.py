"""Symbolic equations of motion in textbook form: L, the scalar equations, D, C, g and tau."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import sympy
from sympy import Expr, ImmutableMatrix, MatrixBase, Symbol, cos, sin
from sympy.core.function import Application
from sympy.printing.str import StrPrinter

from eomc import pipeline
from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.model.hybrid import with_constant_parameters
from eomc.model.symbols import resolve_definitions, symbol
from eomc.model.system import Constraint, System, t
from eomc.pipeline import ScenePath
from eomc.report.typeset import (
    CONTINUATION,
    WIDE,
    Typesetter,
    distribute_decimal,
    latex_sum,
    named_lines,
    section,
    shorten_fractions,
    wrap,
)
from eomc.runtime.labels import tex
from eomc.scene.formulas import suggest
from eomc.verify import symbolic
from eomc.verify.trig_simplify import coefficients, simplify_trig

Terms = list[tuple[Expr, Expr]]  # a product of accelerations or rates, and its coefficient

MAX_EXPANDED_SIZE = 30_000  # size by symbolic.is_small; simplification then takes seconds
MAX_DERIVED_OPERATIONS = 8_000  # in D, C and bias before simplification
MAX_WRITTEN_OPERATIONS = 1_000  # in the printed equations, which then fill a page or two
MAX_ENVIRONMENT_LENGTH = 3_000  # characters of LaTeX: KaTeX accepts about a page


@dataclass(frozen=True, repr=False)
class Equations:
    """D q̈ + C q̇ + g = τ and its parts, as SymPy expressions over the scene's names.

    Attributes
    ----------
    system : System
        The mechanical system.
    D, C : Matrix (nq, nq)
        Mass matrix and Coriolis matrix (Christoffel form).
    g, tau : Matrix (nq, 1)
        Potential forces and generalized forces, tau = forces - friction.
    zero, A : Matrix (m, 1) and (m, nq)
        Constraints zero = 0 and their Jacobian. With constraints, the right-hand side is tau + A^T
        lambda.
    forces : Matrix (nq, 1)
        Generalized forces without friction, which is on the left of the scalar equations.
    left : tuple of lists of pairs
        Left-hand side of each scalar equation: pairs of a product of velocities or accelerations,
        and its coefficient.
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
    left: tuple[Terms, ...]
    named: tuple[tuple[sympy.Symbol, Expr], ...] = ()  # each over earlier ones
    symbols: Mapping[str, Expr] = field(default_factory=dict)
    _internal: Equations | None = None  # equations over the system's own symbols, for printing

    @property
    def multipliers(self) -> tuple[Expr, ...]:
        """Symbols of the Lagrange multipliers λ, one for each constraint equation."""
        names = (f"lambda_{c.name}" for c in self.system.constraints)
        return tuple(self.symbols.get(name, symbol(name)) for name in names)

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

    @cached_property
    def set_out(self) -> Equations:
        """The equations as they are printed: long ones with names for shared subexpressions."""
        if self.named:
            return self
        if self._internal is not None:
            return self._internal.set_out.with_user_symbols()
        long = _operations(self) > MAX_WRITTEN_OPERATIONS
        return abbreviate(self) if long else self

    def substitute(self, values: Mapping[Expr, Expr], form: Callable[[Expr], Expr]) -> Equations:
        """Return a copy of the equations in which symbols are replaced by `values`.

        values: expressions by symbol. form: function, such as a simplification, that is applied to
        each resulting expression.
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
        return self._internal.substitute(new, shorten_fractions).with_user_symbols()

    def __repr__(self) -> str:
        s = self.system
        return f"<Equations of {s.name}: {s.size}; print() shows them>"

    def __str__(self) -> str:
        return write_text((self._internal or self).set_out)

    def _repr_latex_(self) -> str:
        return write_latex((self._internal or self).set_out)


def equations(scene: System | ScenePath) -> Equations:
    """Derive and simplify the equations of motion of a scene file or a System.

    Parameters
    ----------
    scene : str, path or System
        Path of a scene file, or a system.

    Returns
    -------
    Equations
        SymPy expressions. For a scene file, their symbols are plain symbols of the scene's names;
        for a System, they are the symbols that were passed to `System.make`.

    Raises
    ------
    SceneError
        If the scene is invalid.
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
        return shorten_fractions(simplify_trig(e, system.qd))

    D, C, g, tau, friction = (
        getattr(plain, name).applyfunc(short) for name in ("D", "C", "g", "tau", "friction")
    )
    conserved = sympy.expand(plain.jacobi - plain.energy) == 0
    jacobi, power = None if conserved else short(plain.jacobi), short(plain.power)
    linear = shorten_fractions(_energy(plain.linear_potential, system))
    left = tuple(_left_side(system, D, plain.bias[i], friction[i], i) for i in range(len(system.q)))
    result = Equations(
        system=system,
        D=D,
        C=C,
        g=g,
        tau=tau,
        forces=(plain.tau + plain.friction).applyfunc(shorten_fractions),
        zero=plain.constraints.applyfunc(shorten_fractions),
        A=plain.constraint_jacobian.applyfunc(shorten_fractions),
        kinetic=shorten_fractions(_energy(plain.kinetic, system)),
        potential=shorten_fractions(_energy(plain.potential, system)),
        jacobi=jacobi,
        power=power if power != 0 else None,
        linear_potential=linear if linear != 0 else None,
        left=left,
    )
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
            c = shorten_fractions(c)
            (last if rates == 1 else terms).append((rates, c))
    return terms + [(rates, c) for rates, c in last if c != 0]


# --- abbreviations --------------------------------------------------------------------------------

MIN_OPERATIONS = 4  # operations and sines: shorter sums get no name
LETTERS = ("s", "h", "w", "z", "sigma")  # for names of subexpressions, in order of preference
MAX_NAMED_COORDINATES = 9  # with more coordinates, entries of D get no names D_ij


def abbreviate(equations: Equations) -> Equations:
    """Return a copy of the equations in which repeated subexpressions are replaced by names.

    A subexpression that occurs twice or more gets a name; the field `named` of the copy contains
    the pairs (name, expression). In the scalar equations, long entries of the mass matrix D are
    also replaced by names such as D_12.
    """
    entries = _entries_of_D(equations)
    left = tuple([(rates, entries.get(c, c)) for rates, c in terms] for terms in equations.left)
    n = range(equations.D.rows)
    half = [equations.D[i, j] for i in n for j in n[i:]]
    matrices = [getattr(equations, name) for name in ("C", "g", "tau", "forces", "zero", "A")]
    scalars = [
        equations.kinetic, equations.potential, equations.jacobi, equations.power,
        equations.linear_potential,
    ]  # fmt: skip
    coefficients = [c for terms in left for _, c in terms]
    formulas = [*coefficients, *half, *(e for m in matrices for e in m)]
    formulas += [e for e in scalars if e is not None]
    named, reduced = extract_common_subexpressions(formulas, _unused_letter(equations.system))
    new = iter(reduced)
    left = tuple([(rates, next(new)) for rates, _ in terms] for terms in left)
    upper = {(i, j): next(new) for i in n for j in n[i:]}
    D = ImmutableMatrix(len(n), len(n), lambda i, j: upper[min(i, j), max(i, j)])
    C, g, tau, forces, zero, A = (
        ImmutableMatrix(m.rows, m.cols, [next(new) for _ in m]) for m in matrices
    )
    K, P, jacobi, power, U = (None if e is None else next(new) for e in scalars)
    return replace(
        equations, D=D, C=C, g=g, tau=tau, forces=forces, zero=zero, A=A, kinetic=K, potential=P,
        jacobi=jacobi, power=power, linear_potential=U, left=left, named=tuple(named),
    )  # fmt: skip


def extract_common_subexpressions(
    formulas: Sequence[Expr], letter: str
) -> tuple[list[tuple[Symbol, Expr]], list[Expr]]:
    """Replace subexpressions that occur repeatedly in `formulas` by names.

    letter: beginning of the names, which are `letter`_1, `letter`_2, ... Returns two lists: the
    definitions (name, expression over earlier names), and the rewritten formulas in their order.
    """
    temporary = sympy.numbered_symbols("_", real=True)
    subexpressions, reduced = sympy.cse(formulas, order="none", symbols=temporary)
    uses = Counter(s for e in (*(e for _, e in subexpressions), *reduced) for s in _symbols(e))
    inside: dict[Symbol, Expr] = {}
    named: list[tuple[Symbol, Expr]] = []
    for name, e in subexpressions:
        expanded = e.xreplace(inside)
        if uses[name] < 2 or not _deserves_name(expanded):
            inside[name] = expanded
        else:
            inside[name] = symbol(f"{letter}_{len(named) + 1}")
            named.append((inside[name], expanded))
    return named, [e.xreplace(inside) for e in reduced]


def _deserves_name(e: Expr) -> bool:
    """True if `e` contains a sum and enough operations, those inside angles not counted."""
    bare = e.xreplace({f: f.func(sympy.Dummy()) for f in e.atoms(sin, cos)})
    return bool(bare.has(sympy.Add)) and bool(bare.count_ops() >= MIN_OPERATIONS)


def _symbols(e: Expr) -> Iterator[Expr]:
    """Iterate over all occurrences of symbols in `e`."""
    return (part for part in sympy.preorder_traversal(e) if part.is_Symbol)


def _entries_of_D(equations: Equations) -> dict[Expr, Symbol]:
    """Map long entries of D to their names D_ij, unless the scene uses the name."""
    n = equations.D.rows
    if n > MAX_NAMED_COORDINATES:
        return {}
    names: dict[Expr, Symbol] = {}
    for i in range(n):
        for j in range(i, n):
            name, entry = f"D_{i + 1}{j + 1}", equations.D[i, j]
            if _deserves_name(entry) and name not in equations.system.names:
                names.setdefault(entry, symbol(name))
    return names


def _unused_letter(system: System) -> str:
    """Return a letter for names such as s_1 that no name of the scene begins with."""
    for letter in LETTERS:
        if not any(re.fullmatch(rf"{letter}(_?\d+)?", name) for name in system.names):
            return letter
    return "abbreviation"


# --- printing -------------------------------------------------------------------------------------

_MEANING = {
    "kinetic": "kinetic energy",
    "potential": "potential energy",
    "linear_potential": "potential linear in the velocities",
    "L": "Lagrangian K - P",
    "D": "mass matrix",
    "C": "Coriolis matrix, Christoffel form",
    "g": "potential forces",
    "tau": "generalized forces",
    "A": "derivatives of the constraints along q, or q̇ where they are of rates",
    "jacobi": "Jacobi integral, conserved in place of K + P",
    "power": "power into the system",
}
_SYMBOL = {
    "kinetic": "K", "potential": "P", "linear_potential": "U", "jacobi": "h", "power": "power",
    "tau": "τ",
}  # fmt: skip
_LATEX = {**_SYMBOL, "tau": r"\tau", "power": r"\dot h"}


def _values(equations: Equations) -> dict[str, Expr | MatrixBase]:
    """Return the expressions to be printed, by name."""
    values = {name: getattr(equations, name) for name in _MEANING}
    if equations.named:
        values["L"] = sympy.Symbol("K") - sympy.Symbol("P")
        if equations.linear_potential is not None:
            values["L"] -= sympy.Symbol("U")
    if not equations.system.constraints:
        del values["A"]
    if all(e == 0 for e in equations.tau):
        del values["tau"]
    return {name: value for name, value in values.items() if value is not None}


# --- text -----------------------------------------------------------------------------------------


def write_text(equations: Equations) -> str:
    """Return the equations as Unicode text for a terminal, in lines of at most WIDE + 4 columns."""
    system, write = equations.system, Typesetter(equations.system)
    values, section_lines = _values(equations), list[str]()
    parts = [wrap(f"{title_line(system)}: {equation_form('tau' in values, system)}")]
    lines = []
    for left, force in zip(equations.left, equations.right, strict=True):
        lines += [
            *write.text_lines([write.term(a, b) for a, b in _flat(left)], _terms(write, force)),
            "",
        ]
    parts.append(section("equations of motion", lines[:-1]))
    if system.constraints:
        section_lines = []
        for c, zero in zip(system.constraints, equations.zero, strict=True):
            section_lines += [*write.text_lines(write.terms(zero), []), *constraint_note(c)]
        parts.append(section("constraints", section_lines))
    if equations.named:
        section_lines = [line for s, e in equations.named for line in named_lines(write, s.name, e)]
        parts.append(section("where, here and below", section_lines))
    for name, value in values.items():
        head = f"{_SYMBOL.get(name, name)}, {_MEANING[name]}"
        if name == "L" and equations.linear_potential is not None:
            head += " - U"
        parts.append(section(head, list(_value_lines(write, name, value))))
    if system.outputs:
        section_lines = []
        for name, formula in _outputs(system):
            section_lines += named_lines(write, name, formula)
        parts.append(section("outputs", section_lines))
    return "\n\n".join(parts)


def title_line(system: System) -> str:
    """Return the title of a system, or its name if it has no title, on one line."""
    return texts.line(system.title or system.name)


def equation_form(driven: bool, system: System) -> str:
    """Return the form of the equations and the order of the coordinates q, as one line.

    An example is "D q̈ + C q̇ + g = τ, q = (x, theta)". driven: True if the right-hand side has
    generalized forces τ.
    """
    return f"D q̈ + C q̇ + g = {right_hand_side(driven, system)}, q = ({_order(system)})"


def right_hand_side(driven: bool, system: System) -> str:
    """Return the right-hand side of D q̈ + C q̇ + g as text: "τ", "Aᵀλ", "τ + Aᵀλ" or "0".

    driven: True if there are generalized forces τ. Aᵀλ is present if the system has constraints.
    """
    return " + ".join([*(["τ"] * driven), *(["Aᵀλ"] * bool(system.constraints))]) or "0"


def constraint_note(c: Constraint) -> list[str]:
    """Return one line, in a list: a constraint's name and kind, and whether it is redundant.

    The kind is "positions" if the constraint is holonomic, else "rates".
    """
    parts = [f"{c.name}: of {'positions' if c.holonomic else 'rates'}"]
    parts += ["implied by others, its multiplier 0"] if c.redundant else []
    return [f"    {', '.join(parts)}"]


def _order(system: System) -> str:
    return ", ".join(c.name for c in system.coordinates)


def _flat(terms: Terms) -> Iterator[tuple[Expr, Expr]]:
    """Yield the terms of an equation, with sums without velocities split into their terms."""
    for monomial, c in terms:
        if monomial == 1:
            yield from ((sympy.S.One, part) for part in sympy.Add.make_args(distribute_decimal(c)))
        else:
            yield monomial, c


def _terms(write: Typesetter, e: Expr) -> list[tuple[bool, Expr]]:
    return [] if e == 0 else write.terms(e)


def _value_lines(write: Typesetter, name: str, value: Expr | MatrixBase) -> Iterator[str]:
    """Yield the lines of an energy or matrix; of a matrix that is too wide, the nonzero entries."""
    if not isinstance(value, MatrixBase):
        yield from _sum_lines(write, value)
        return
    block = write.text(write.sort_expression(value))
    if block.width() <= WIDE:
        yield from (line.rstrip() for line in str(block).splitlines())
        return
    for (i, j), entry in _entries(name, value):
        yield from named_lines(write, f"{_SYMBOL.get(name, name)}_{i}{j}", entry)


def _sum_lines(write: Typesetter, e: Expr) -> list[str]:
    return write.text_lines(write.terms(e))


def _entries(name: str, value: MatrixBase) -> Iterator[tuple[tuple[str, str], Expr]]:
    """Yield ((row, column), entry) of the nonzero entries, from 1; of D the upper half only."""
    comma = "," if value.rows > 9 else ""
    for i in range(value.rows):
        for j in range(value.cols):
            if value[i, j] != 0 and not (name == "D" and j < i):
                yield (str(i + 1), f"{comma}{j + 1}" if value.cols > 1 else ""), value[i, j]


def _outputs(system: System) -> list[tuple[str, Expr]]:
    """Return the outputs as (name, formula) with all definitions substituted."""
    known = resolve_definitions(system.definitions)
    known |= {c.multiplier: sympy.Symbol(f"lambda_{c.name}", real=True) for c in system.constraints}
    return [(o.name, o.formula.xreplace(known)) for o in system.outputs]


# --- LaTeX ----------------------------------------------------------------------------------------


def write_latex(equations: Equations) -> str:
    """Return the equations as LaTeX: align* environments of the package amsmath.

    The equations of motion come first, then the energies, matrices and outputs.
    """
    return "\n".join(
        r"\begin{align*}" + f"\n{body}\n" + r"\end{align*}"
        for body in _environment_bodies(equations)
    )


def _environment_bodies(equations: Equations) -> list[str]:
    r"""Return the LaTeX between \begin{align*} and \end{align*} of each environment.

    Each text has about MAX_ENVIRONMENT_LENGTH characters at most.
    """
    results: list[str] = []
    for lines in latex_lines(equations):
        results.append("")
        for line in lines:
            if len(results[-1]) > MAX_ENVIRONMENT_LENGTH and not line.startswith(CONTINUATION):
                results.append("")
            results[-1] += (" \\\\\n" if results[-1] else "") + line
    return results


def latex_lines(equations: Equations) -> tuple[list[str], list[str]]:
    """Return the equations as a pair of lists of LaTeX lines.

    The first list contains the equations of motion with constraints and abbreviations. The second
    contains all other formulas: energies, matrices and outputs. A line that continues the previous
    one begins with CONTINUATION.
    """
    system, write = equations.system, Typesetter(equations.system)
    motion = []
    for left, force in zip(equations.left, equations.right, strict=True):
        terms = [write.term(a, b) for a, b in _flat(left)]
        first, *more = write.latex_lines(terms, _terms(write, force))
        motion += [f"  & {first}", *(CONTINUATION + line for line in more)]
    for zero in equations.zero:
        first, *more = write.latex_lines(write.terms(zero), [])
        motion += [f"  & {first}", *(CONTINUATION + line for line in more)]
    for name, value in equations.named:
        motion += latex_sum(write, tex(name.name), value)
    lines = []
    for name, value in _values(equations).items():
        symbol = _LATEX.get(name, name)
        if isinstance(value, MatrixBase):
            if write.text(write.sort_expression(value)).width() <= WIDE:
                lines.append(f"  {symbol} &= {write.latex(write.sort_expression(value))}")
                continue
            for (i, j), entry in _entries(name, value):
                lines += latex_sum(write, f"{symbol}_{{{i}{j}}}", entry)
        else:
            lines += latex_sum(write, symbol, value)
    for name, formula in _outputs(system):
        lines += latex_sum(write, tex(name), formula)
    return motion, lines


# --- Python ---------------------------------------------------------------------------------------


class _Exact(StrPrinter):  # type: ignore[misc]
    """Prints rational numbers as Rational(1, 10), since 1/10 is a float in Python.

    `names` maps symbols that are named like functions to the names of their variables.
    """

    def __init__(self, names: Mapping[str, str]) -> None:
        super().__init__()
        self.names = names

    def _print_Rational(self, value: sympy.Rational) -> str:
        return str(value) if value.is_Integer else f"Rational({value.p}, {value.q})"

    _print_Half = _print_Rational

    def _print_Exp1(self, _: Expr) -> str:
        return "exp(1)"  # a parameter may be called E

    def _print_Symbol(self, one: sympy.Symbol) -> str:
        return self.names.get(one.name, one.name)


def write_python(equations: Equations) -> str:
    """Return Python source code that defines the equations as SymPy matrices and expressions.

    Numbers are written as exact fractions.
    """
    system = equations.system
    symbols = [
        *system.q,
        *system.qd,
        *system.qdd,
        *system.u,
        *equations.multipliers,
        *(p.symbol for p in system.parameters),
        t,
    ]
    values = _values(equations)
    called = {f.func.__name__ for e in (*values.values(), *equations.right) for f in _functions(e)}
    reserved = {"Matrix", "Eq", "Rational", "symbols", "exp", "sqrt", *called}
    variables = {s.name: s.name for s in symbols}
    for name in variables.keys() & reserved:
        while variables[name] in reserved | (variables.keys() - {name}):
            variables[name] += "_"
    written = _Exact(variables).doprint
    names, title = ", ".join(s.name for s in symbols), texts.docstring(title_line(system))
    force = "tau + A^T lambda" if system.constraints else "tau"
    lines = [
        f'"""{title}: D qdd + C qd + g = {force}, as SymPy matrices."""',
        "",
        "from sympy import *",
        "",
        f'{", ".join(variables.values())} = symbols("{names}", real=True)',
    ]
    taken = {*variables.values()}
    for name, value in values.items():
        is_matrix = isinstance(value, MatrixBase)
        printed = written(value.tolist() if is_matrix else value)
        printed = f"Matrix({printed})" if is_matrix else printed
        lines.append(f"{name + '_' if name in taken else name} = {printed}")
    pairs = ", ".join(f"Eq({written(e.lhs)}, {written(e.rhs)})" for e in equations.scalar)
    lines.append(f"{'scalar_' if 'scalar' in taken else 'scalar'} = [{pairs}]")
    return "\n".join(lines)


def _functions(value: Expr | MatrixBase) -> set[Expr]:
    return value.atoms(Application)  # type: ignore[no-any-return]
