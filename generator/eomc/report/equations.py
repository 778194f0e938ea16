"""Symbolic equations of motion in textbook form: L, the scalar equations, D, C, g and tau."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import sympy
from sympy import Expr, Float, ImmutableMatrix, MatrixBase, Rational, Symbol, cos, sin
from sympy.core.function import Application
from sympy.printing.str import StrPrinter

from eomc import pipeline
from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.model.algebra import DefinedFunction
from eomc.model.hybrid import with_constant_parameters
from eomc.model.symbols import resolve_definitions, symbol
from eomc.model.system import Constraint, System, t
from eomc.pipeline import ScenePath
from eomc.report.typeset import (
    Equation,
    TypesetMatrix,
    Typesetter,
    shorten_fractions,
    simple_fraction,
    wrap,
    write_latex,
    write_text,
)
from eomc.scene.formulas import suggest
from eomc.verify import symbolic
from eomc.verify.symbolic import coefficients, simplify_trig

Terms = list[tuple[Expr, Expr]]  # a product of accelerations or rates, and its coefficient

MAX_EXPANDED_SIZE = 30_000  # size by symbolic.is_small; simplification then takes seconds
MAX_DERIVED_OPERATIONS = 8_000  # in D, C and bias before simplification
MAX_WRITTEN_OPERATIONS = 1_000  # in the printed equations, which then fill a page or two


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
    `str` returns text at most 100 columns wide, and a notebook shows the equations typeset, and so
    each of `equations`. Long equations are printed with names for shared subexpressions.

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

        changed = self.map(lambda e: form(e.xreplace(values)))
        return replace(
            changed,
            left=tuple([(e.xreplace(values), c) for e, c in terms] for terms in changed.left),
            named=tuple((s.xreplace(values), form(e.xreplace(values))) for s, e in self.named),
        )

    def map(self, function: Callable[[Expr], Expr]) -> Equations:
        """Return a copy with `function` of each coefficient, entry of a matrix, energy and power.

        The function is called in a fixed order, and of the symmetric D only for the upper triangle.
        """
        left = tuple([(rates, function(c)) for rates, c in terms] for terms in self.left)
        n = range(self.D.rows)
        upper = {(i, j): function(self.D[i, j]) for i in n for j in n[i:]}
        changed: dict[str, Any] = {
            "D": ImmutableMatrix(len(n), len(n), lambda i, j: upper[min(i, j), max(i, j)])
        }
        for name in ("C", "g", "tau", "forces", "zero", "A"):
            matrix = getattr(self, name)
            changed[name] = ImmutableMatrix(*matrix.shape, [function(e) for e in matrix])
        for name in ("kinetic", "potential", "jacobi", "power", "linear_potential"):
            if (e := getattr(self, name)) is not None:
                changed[name] = function(e)
        return replace(self, left=left, **changed)

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
        changed = replace(changed, symbols=symbols, _internal=self)
        quantities = list_quantities(changed).items()
        matrices = {n: TypesetMatrix.define(e) for n, e in quantities if e.right.is_Matrix}
        return replace(changed, **matrices)

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

    @cached_property
    def typesetter(self) -> Typesetter:
        """Printer of expressions over `symbols`."""
        return Typesetter(self.system, self.symbols)

    @cached_property
    def groups(self) -> tuple[tuple[Equation, ...], tuple[Equation, ...]]:
        """The equations of motion with constraints and abbreviations, and all other formulas."""
        quantities = list_quantities(self).values()
        return (*list_motion(self),), (*quantities, *list_outputs(self))

    @property
    def equations(self) -> tuple[Equation, ...]:
        """All equations: those of motion, constraints, energies, matrices and outputs.

        Each has a title and two sides, and a notebook shows it typeset.
        """
        motion, others = self.groups
        return (*motion, *others)

    def __repr__(self) -> str:
        s = self.system
        return f"<Equations of {s.name}: {s.size}; print() shows them>"

    def __str__(self) -> str:
        s, shown = self.system, self.set_out
        form = equation_form(any(e != 0 for e in shown.tau), s)
        return "\n\n".join([wrap(f"{title_line(s)}: {form}"), *write_text(shown.equations)])

    def _repr_latex_(self) -> str:
        return write_latex(self.set_out.groups)


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
    """Return a real, finite number in SymPy, a decimal as a fraction. Raises EomcError.

    A float such as 2.6666666666666665 is the fraction of few digits that rounds to it, if there is
    one, and else the decimal of its text.
    """
    try:
        number = sympy.sympify(value) if isinstance(value, Expr) else sympy.Float(float(value))
        rational = {x: simple_fraction(x) or Rational(repr(float(x))) for x in number.atoms(Float)}
        number = number.xreplace(rational)
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
    equations = replace(equations, left=left)
    formulas: list[Expr] = []

    def collect(e: Expr) -> Expr:
        formulas.append(e)
        return e

    equations.map(collect)
    named, reduced = extract_common_subexpressions(formulas, _unused_letter(equations.system))
    new = iter(reduced)
    return replace(equations.map(lambda _: next(new)), named=tuple(named))


def extract_common_subexpressions(
    formulas: Sequence[Expr], letter: str
) -> tuple[list[tuple[Symbol, Expr]], list[Expr]]:
    """Replace subexpressions that occur repeatedly in `formulas` by names.

    letter: beginning of the names, which are `letter`_1, `letter`_2, ... Returns two lists: the
    definitions (name, expression over earlier names), and the rewritten formulas in their order.
    """
    temporary = sympy.numbered_symbols("_", real=True)
    subexpressions, reduced = sympy.cse(formulas, order="none", symbols=temporary)
    rewritten = (*(e for _, e in subexpressions), *reduced)
    uses = Counter(s for e in rewritten for s in sympy.preorder_traversal(e) if s.is_Symbol)
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


# --- the list of equations ------------------------------------------------------------------------

QUANTITIES = {  # symbol and title of each quantity, by its name among the attributes of Equations
    "kinetic": ("K", "kinetic energy"),
    "potential": ("P", "potential energy"),
    "linear_potential": ("U", "potential linear in the velocities"),
    "L": ("L", "Lagrangian K - P"),
    "D": ("D", "mass matrix"),
    "C": ("C", "Coriolis matrix, Christoffel form"),
    "g": ("g", "potential forces"),
    "tau": ("tau", "generalized forces"),
    "A": ("A", "derivatives of the constraints along q, or q̇ where they are of rates"),
    "jacobi": ("h", "Jacobi integral, conserved in place of K + P"),
    "power": ("power", "power into the system"),
}


def list_motion(equations: Equations) -> Iterator[Equation]:
    """Yield the scalar equations of motion, the constraints, and the definitions of names."""
    write = equations.typesetter
    for e in equations.scalar:
        yield Equation("equations of motion", e.lhs, e.rhs, write)
    for c, zero in zip(equations.system.constraints, equations.zero, strict=True):
        yield Equation("constraints", zero, sympy.S.Zero, write, constraint_note(c))
    for name, e in equations.named:
        yield Equation("where, here and below", name, e, write)


def list_quantities(equations: Equations) -> dict[str, Equation]:
    """Return the definitions of the energies and matrices, by the names of QUANTITIES."""
    values = {name: getattr(equations, name) for name in QUANTITIES}
    has_linear = equations.linear_potential is not None
    if equations.named:
        values["L"] = Symbol("K") - Symbol("P") - Symbol("U") * int(has_linear)
    if not equations.system.constraints:
        del values["A"]
    if all(e == 0 for e in equations.tau):
        del values["tau"]
    return {
        name: Equation(
            title + " - U" * (has_linear and name == "L"),
            Symbol(letter),
            values[name],
            equations.typesetter,
        )
        for name, (letter, title) in QUANTITIES.items()
        if values.get(name) is not None
    }


def list_outputs(equations: Equations) -> Iterator[Equation]:
    """Yield the definitions of the outputs, with all definitions of the scene substituted."""
    system = equations.system
    known = resolve_definitions(system.definitions)
    known |= {c.multiplier: symbol(f"lambda_{c.name}") for c in system.constraints}
    own = {symbol(name): s for name, s in equations.symbols.items()}
    for o in system.outputs:
        formula = o.formula.xreplace(known).xreplace(own)
        yield Equation("outputs", Symbol(o.name), formula, equations.typesetter)


def title_line(system: System) -> str:
    """Return the title of a system, or its name if it has no title, on one line."""
    return texts.line(system.title or system.name)


def equation_form(driven: bool, system: System) -> str:
    """Return the form of the equations and the order of the coordinates q, as one line.

    An example is "D q̈ + C q̇ + g = τ, q = (x, theta)". driven: True if the right-hand side has
    generalized forces τ.
    """
    order = ", ".join(c.name for c in system.coordinates)
    return f"D q̈ + C q̇ + g = {right_hand_side(driven, system)}, q = ({order})"


def right_hand_side(driven: bool, system: System) -> str:
    """Return the right-hand side of D q̈ + C q̇ + g as text: "τ", "Aᵀλ", "τ + Aᵀλ" or "0".

    driven: True if there are generalized forces τ. Aᵀλ is present if the system has constraints.
    """
    return " + ".join([*(["τ"] * driven), *(["Aᵀλ"] * bool(system.constraints))]) or "0"


def constraint_note(c: Constraint) -> str:
    """Return a constraint's name and kind, and whether it is redundant, as one line.

    The kind is "positions" if the constraint is holonomic, else "rates".
    """
    implied = ", implied by others, its multiplier 0" * c.redundant
    return f"{c.name}: of {'positions' if c.holonomic else 'rates'}{implied}"


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

    def _print_Function(self, call: Expr) -> str:
        if isinstance(call, DefinedFunction):  # SymPy does not have it
            return f"({self._print(call.exact)})"
        return str(super()._print_Function(call))


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
    values = {name: each.right for name, each in list_quantities(equations).items()}
    formulas = (*values.values(), *equations.right)
    called = {f.func.__name__ for e in formulas for f in e.atoms(Application)}
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
