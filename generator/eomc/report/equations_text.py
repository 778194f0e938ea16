"""Equations and costs as text: for a terminal, for LaTeX, for Python."""

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
from eomc.report.typeset import WIDE, Typesetter, spread
from eomc.runtime.labels import tex

LENGTH = 3_000  # characters of one environment, about: KaTeX takes no more than a page
GOES_ON = r"  & \quad "  # how a line begins that goes on with the last

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


def _values(found: Derived) -> dict[str, Expr | MatrixBase]:
    """What is shown, by its name."""
    values = {name: getattr(found, name) for name in _MEANING}
    if found.named:
        values["L"] = sympy.Symbol("K") - sympy.Symbol("P")
        if found.linear_potential is not None:
            values["L"] -= sympy.Symbol("U")
    if not found.system.constraints:
        del values["A"]
    if all(e == 0 for e in found.tau):
        del values["tau"]
    return {name: value for name, value in values.items() if value is not None}


# --- text -----------------------------------------------------------------------------------------


def text(found: Derived) -> str:
    """For a terminal, WIDE columns and an indent."""
    system, write = found.system, Typesetter(found.system)
    values, made = _values(found), list[str]()
    parts = [wrapped(f"{title_of(system)}: {form_of('tau' in values, system)}")]
    lines = []
    for left, force in zip(found.left, found.right, strict=True):
        lines += [
            *write.text_lines([write.term(a, b) for a, b in _flat(left)], _terms(write, force)),
            "",
        ]
    parts.append(section("equations of motion", lines[:-1]))
    if system.constraints:
        made = []
        for c, zero in zip(system.constraints, found.zero, strict=True):
            made += [*write.text_lines(write.terms(zero), []), *told(c)]
        parts.append(section("constraints", made))
    if found.named:
        made = [line for s, e in found.named for line in named_lines(write, s.name, e)]
        parts.append(section("where, here and below", made))
    for name, value in values.items():
        head = f"{_SYMBOL.get(name, name)}, {_MEANING[name]}"
        if name == "L" and found.linear_potential is not None:
            head += " - U"
        parts.append(section(head, list(_value_lines(write, name, value))))
    if system.outputs:
        made = []
        for name, formula in _outputs(system):
            made += named_lines(write, name, formula)
        parts.append(section("outputs", made))
    return "\n\n".join(parts)


def section(head: str, lines: list[str]) -> str:
    """A heading and what stands under it."""
    return "\n".join([f"{head}:", *("    " + line if line else "" for line in lines)])


def title_of(system: System) -> str:
    """Of one line."""
    return texts.line(system.title or system.name)


def form_of(driven: bool, system: System) -> str:
    """The form of the equations, and the order of q."""
    return f"D q̈ + C q̇ + g = {right_of(driven, system)}, q = ({_order(system)})"


def right_of(driven: bool, system: System) -> str:
    """What stands on their right side."""
    return " + ".join([*(["τ"] * driven), *(["Aᵀλ"] * bool(system.constraints))]) or "0"


def told(c: Constraint) -> list[str]:
    """What is to be said of a constraint beside its formula."""
    said = [f"{c.name}: of {'positions' if c.holonomic else 'rates'}"]
    said += ["implied by others, its multiplier 0"] if c.redundant else []
    return [f"    {', '.join(said)}"]


def _order(system: System) -> str:
    return ", ".join(c.name for c in system.coordinates)


def wrapped(words: str) -> str:
    """In lines of WIDE columns."""
    return "\n    ".join(textwrap.wrap(words, WIDE, break_on_hyphens=False))


def _flat(terms: Terms) -> Iterator[tuple[Expr, Expr]]:
    """Sums that stand alone as terms of their own."""
    for monomial, c in terms:
        if monomial == 1:
            yield from ((sympy.S.One, part) for part in sympy.Add.make_args(spread(c)))
        else:
            yield monomial, c


def _terms(write: Typesetter, e: Expr) -> list[tuple[bool, Expr]]:
    return [] if e == 0 else write.terms(e)


def _value_lines(write: Typesetter, name: str, value: Expr | MatrixBase) -> Iterator[str]:
    """An energy, or a matrix: by its entries that are not 0, where it is too wide."""
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
    """name = sum, its lines broken."""
    return write.text_lines([(False, sympy.Symbol(name))], write.terms(e))


def _entries(name: str, value: MatrixBase) -> Iterator[tuple[tuple[str, str], Expr]]:
    """Entries that are not 0, by row and column from 1; of a symmetric matrix a half."""
    comma = "," if value.rows > 9 else ""
    for i in range(value.rows):
        for j in range(value.cols):
            if value[i, j] != 0 and not (name == "D" and j < i):
                yield (str(i + 1), f"{comma}{j + 1}" if value.cols > 1 else ""), value[i, j]


def _outputs(system: System) -> list[tuple[str, Expr]]:
    """The outputs' formulas over coordinates, without definitions."""
    known = resolved(system.definitions)
    known |= {c.multiplier: sympy.Symbol(f"lambda_{c.name}", real=True) for c in system.constraints}
    return [(o.name, o.formula.xreplace(known)) for o in system.outputs]


# --- LaTeX ----------------------------------------------------------------------------------------


def latex(found: Derived) -> str:
    """Environments of amsmath: the equations of motion, then what is in them."""
    return "\n".join(r"\begin{align*}" + f"\n{body}\n" + r"\end{align*}" for body in bodies(found))


def bodies(found: Derived) -> list[str]:
    """What stands in each environment: equations of motion, or of the rest, as many as fit."""
    made: list[str] = []
    for lines in latex_lines(found):
        made.append("")
        for line in lines:
            if len(made[-1]) > LENGTH and not line.startswith(GOES_ON):
                made.append("")
            made[-1] += (" \\\\\n" if made[-1] else "") + line
    return made


def latex_lines(found: Derived) -> tuple[list[str], list[str]]:
    """The lines of the equations of motion; those of energies, matrices and outputs."""
    system, write = found.system, Typesetter(found.system)
    motion = []
    for left, force in zip(found.left, found.right, strict=True):
        terms = [write.term(a, b) for a, b in _flat(left)]
        first, *more = write.latex_lines(terms, _terms(write, force))
        motion += [f"  & {first}", *(GOES_ON + line for line in more)]
    for zero in found.zero:
        first, *more = write.latex_lines(write.terms(zero), [])
        motion += [f"  & {first}", *(GOES_ON + line for line in more)]
    for name, value in found.named:
        motion += latex_sum(write, tex(name.name), value)
    lines = []
    for name, value in _values(found).items():
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
    """The lines of symbol = sum."""
    first, *more = write.latex_lines(write.terms(value))
    return [f"  {symbol} &= {first}", *(GOES_ON + line for line in more)]


# --- Python ---------------------------------------------------------------------------------------


class _Exact(StrPrinter):  # type: ignore[misc]
    """Fractions that stand alone as Rational(1, 10): for Python 1/10 is 0.1.

    names: the variables of symbols whose own names are those of functions.
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


def python(found: Derived) -> str:
    """Source that makes them again, exactly."""
    system = found.system
    symbols = [
        *system.q,
        *system.qd,
        *system.qdd,
        *system.u,
        *found.multipliers,
        *(p.symbol for p in system.parameters),
        t,
    ]
    values = _values(found)
    called = {f.func.__name__ for e in (*values.values(), *found.right) for f in _functions(e)}
    reserved = {"Matrix", "Eq", "Rational", "symbols", "exp", "sqrt", *called}
    variables = {s.name: s.name for s in symbols}
    for name in variables.keys() & reserved:
        while variables[name] in reserved | (variables.keys() - {name}):
            variables[name] += "_"
    written = _Exact(variables).doprint
    names, title = ", ".join(s.name for s in symbols), texts.docstring(title_of(system))
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
        made = written(value.tolist() if is_matrix else value)
        made = f"Matrix({made})" if is_matrix else made
        lines.append(f"{name + '_' if name in taken else name} = {made}")
    pairs = ", ".join(f"Eq({written(e.lhs)}, {written(e.rhs)})" for e in found.scalar)
    lines.append(f"{'scalar_' if 'scalar' in taken else 'scalar'} = [{pairs}]")
    return "\n".join(lines)


def _functions(value: Expr | MatrixBase) -> set[Expr]:
    return value.atoms(Application)  # type: ignore[no-any-return]


# --- costs ----------------------------------------------------------------------------------------


def cost(system: System) -> str:
    """The operations of each generated function, by each route, and why one was taken."""
    head = f"{title_of(system)}: operations of one call, those on parameters alone left out"
    return f"{head}\n\n{costs(system)}"


def costs(system: System) -> str:
    """The table of `cost`, without its heading."""
    made = program.build(lagrange.derive(system))
    lines = []
    wide = max(map(len, made.functions))
    routes: dict[str, None] = {}
    for name, function in made.functions.items():
        others = [f"{r} {c.flops}" for r, c in function.routes if r != function.route]
        others += [f"{r} {why}" for r, why in made.passed_over.items() if name == "acceleration"]
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
