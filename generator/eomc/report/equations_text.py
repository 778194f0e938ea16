"""Equations and operation counts as text for terminals, LaTeX and Python."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping

import sympy
from sympy import Expr, MatrixBase
from sympy.core.function import Application
from sympy.printing.str import StrPrinter

from eomc.base import texts
from eomc.derive import lagrange
from eomc.model.symbols import resolved
from eomc.model.system import Constraint, System, t
from eomc.program import program
from eomc.program.routes import ROUTES
from eomc.report.derived import Derived, Terms
from eomc.report.typeset import WIDE, Typesetter, distribute_decimal
from eomc.runtime.labels import tex

MAX_ENVIRONMENT_LENGTH = 3_000  # characters: KaTeX accepts about a page
CONTINUATION = r"  & \quad "  # prefix of a line that continues the previous one

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


def _values(equations: Derived) -> dict[str, Expr | MatrixBase]:
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


def text(equations: Derived) -> str:
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


def section(head: str, lines: list[str]) -> str:
    """Return `head` and a colon, followed by `lines` indented by four spaces, as one text."""
    return "\n".join([f"{head}:", *("    " + line if line else "" for line in lines)])


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
    """Return a list of one line: the name of a constraint, its kind, and if it is redundant.

    The kind is "positions" for a holonomic constraint, else "rates".
    """
    parts = [f"{c.name}: of {'positions' if c.holonomic else 'rates'}"]
    parts += ["implied by others, its multiplier 0"] if c.redundant else []
    return [f"    {', '.join(parts)}"]


def _order(system: System) -> str:
    return ", ".join(c.name for c in system.coordinates)


def wrap(words: str) -> str:
    """Return text wrapped to lines of WIDE columns; all lines but the first are indented."""
    return "\n    ".join(textwrap.wrap(words, WIDE, break_on_hyphens=False))


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
    block = write.text(write.ordered(value))
    if block.width() <= WIDE:
        yield from (line.rstrip() for line in str(block).splitlines())
        return
    for (i, j), entry in _entries(name, value):
        yield from named_lines(write, f"{_SYMBOL.get(name, name)}_{i}{j}", entry)


def _sum_lines(write: Typesetter, e: Expr) -> list[str]:
    return write.text_lines(write.terms(e))


def named_lines(write: Typesetter, name: str, e: Expr) -> list[str]:
    """Return the text lines of the equation `name` = `e`."""
    return write.text_lines([(False, sympy.Symbol(name))], write.terms(e))


def _entries(name: str, value: MatrixBase) -> Iterator[tuple[tuple[str, str], Expr]]:
    """Yield ((row, column), entry) of the nonzero entries, from 1; of D the upper half only."""
    comma = "," if value.rows > 9 else ""
    for i in range(value.rows):
        for j in range(value.cols):
            if value[i, j] != 0 and not (name == "D" and j < i):
                yield (str(i + 1), f"{comma}{j + 1}" if value.cols > 1 else ""), value[i, j]


def _outputs(system: System) -> list[tuple[str, Expr]]:
    """Return the outputs as (name, formula) with all definitions substituted."""
    known = resolved(system.definitions)
    known |= {c.multiplier: sympy.Symbol(f"lambda_{c.name}", real=True) for c in system.constraints}
    return [(o.name, o.formula.xreplace(known)) for o in system.outputs]


# --- LaTeX ----------------------------------------------------------------------------------------


def latex(equations: Derived) -> str:
    """Return the equations as LaTeX: align* environments of the package amsmath.

    The equations of motion come first, then the energies, matrices and outputs.
    """
    return "\n".join(
        r"\begin{align*}" + f"\n{body}\n" + r"\end{align*}"
        for body in environment_bodies(equations)
    )


def environment_bodies(equations: Derived) -> list[str]:
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


def latex_lines(equations: Derived) -> tuple[list[str], list[str]]:
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
            if write.text(write.ordered(value)).width() <= WIDE:
                lines.append(f"  {symbol} &= {write.latex(write.ordered(value))}")
                continue
            for (i, j), entry in _entries(name, value):
                lines += latex_sum(write, f"{symbol}_{{{i}{j}}}", entry)
        else:
            lines += latex_sum(write, symbol, value)
    for name, formula in _outputs(system):
        lines += latex_sum(write, tex(name), formula)
    return motion, lines


def latex_sum(write: Typesetter, symbol: str, value: Expr) -> list[str]:
    """Return the LaTeX lines of the equation `symbol` = `value`; `symbol` is LaTeX already."""
    first, *more = write.latex_lines(write.terms(value))
    return [f"  {symbol} &= {first}", *(CONTINUATION + line for line in more)]


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


def python(equations: Derived) -> str:
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


# --- costs ----------------------------------------------------------------------------------------


def cost(system: System) -> str:
    """Return a table, as text, of the floating-point operations of each generated function.

    A function that can be computed by several routes (algorithms) has one count for each of them.
    """
    head = f"{title_line(system)}: operations of one call, those on parameters alone left out"
    return f"{head}\n\n{costs(system)}"


def costs(system: System) -> str:
    """Return the table of operation counts that `cost` returns, without its heading."""
    lowered = program.build(lagrange.derive(system))
    lines = []
    wide = max(map(len, lowered.functions))
    routes: dict[str, None] = {}
    for name, function in lowered.functions.items():
        others = [f"{r} {c.flops}" for r, c in function.routes if r != function.route]
        others += [f"{r} {why}" for r, why in lowered.passed_over.items() if name == "acceleration"]
        lines.append(f"{name:{wide}}  {function.cost.flops:5d} flops: {function.cost}")
        if others:
            choice = f"({function.route}; {', '.join(others)})"
            lines += textwrap.wrap(choice, WIDE - wide, initial_indent=" " * (wide + 2),
                                   subsequent_indent=" " * (wide + 3))  # fmt: skip
        routes |= dict.fromkeys(r for r, _ in function.routes)
    if len(routes) > 1:
        lines += ["", "Of each function the route of least weight is taken that loses no digits:"]
        lines.append("a division weighs as 8 additions, a sine or other call as 25.")
        lines += [f"    {r:{max(map(len, routes))}}  {ROUTES[r].sentence}" for r in routes]
    return "\n".join(lines)
