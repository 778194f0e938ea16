"""Equations and costs as text: for a terminal, for LaTeX, for Python."""

from __future__ import annotations

import sympy
from sympy import Expr
from sympy.printing.str import StrPrinter

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.derive import lagrange
from eomc.emit import c_expression
from eomc.model.symbols import ALONG
from eomc.model.system import System, t
from eomc.program import program
from eomc.program.routes import ROUTES
from eomc.verify import symbolic

WRITTEN_OUT = 400  # operations of D, C and bias up to which a person may want them written out
LONG = 10**12  # above or below the line of a fraction, which is then shown as a decimal
TINY = 1e-25  # a factor below it is what rounding left of a zero

_MATRICES = ("D", "C", "g", "tau")
_SCALARS = ("kinetic", "potential", "jacobi", "power")
_MEANING = {
    "D": "mass matrix",
    "C": "Coriolis matrix, Christoffel form",
    "g": "potential forces",
    "tau": "generalized forces",
    "kinetic": "kinetic energy",
    "potential": "potential energy",
    "jacobi": "Jacobi integral, conserved in place of K + P",
    "power": "power into the system",
}
_SYMBOL = {"kinetic": "K", "potential": "P", "jacobi": "h", "power": "power", "tau": "tau"}


def equations(system: System, form: str = "text") -> str:
    """D, C, g and what else there is of D qdd + C qd + g = tau.

    form: "text" (Unicode), "latex" or "python". The equations are the reference's, simplified:
    written out, as a textbook has them. Written out, those of a large system are no use to anyone:
    as text it is shown as the assignments that compute it, and refused otherwise.
    """
    made = program.build(lagrange.derive(system))
    shown = [made[name].cost.flops for name in ("D", "C", "bias") if name in made]
    long = len(shown) < 3 or sum(shown) > WRITTEN_OUT
    if long or not symbolic.is_small(system):
        if form != "text":
            raise EomcError(
                f"{system.name}: its equations would fill pages: 'eomc show' without --{form} "
                "prints them as the assignments that compute them"
            )
        return _assignments(made)
    plain = symbolic.derive(system)
    found = plain.simplified
    values = {name: _readable(getattr(found, name)) for name in (*_MATRICES, *_SCALARS)}
    if sympy.expand(plain.jacobi - plain.energy) == 0:
        del values["jacobi"]
    values = {
        name: value
        for name, value in values.items()
        if name in ("D", "C", "g", "kinetic", "potential") or not _nothing(value)
    }
    return {"text": _text, "latex": _latex, "python": _python}[form](system, values)


def _readable(value: Expr | sympy.MatrixBase) -> Expr | sympy.MatrixBase:
    """With decimals for fractions that nobody reads, as those of 50 digits of slanted axes.

    At 30 digits more of them fall together, and what rounding left of zeros is gone.
    """
    if isinstance(value, sympy.MatrixBase):
        return value.applyfunc(_readable)
    if not _long(value):
        return value
    short = sympy.trigsimp(_rounded(sympy.expand(value)))
    plain = _rounded(sympy.expand(short))  # each factor whole again
    return plain.xreplace({x: sympy.Float(x, 15) for x in _long(plain)})


def _rounded(e: Expr) -> Expr:
    return e.xreplace(
        {x: sympy.Rational(str(sympy.Float(x, 30))) if abs(x) > TINY else 0 for x in _long(e)}
    )


def _long(e: Expr) -> set[sympy.Rational]:
    return {x for x in e.atoms(sympy.Rational) if max(abs(x.p), x.q) >= LONG}


def _nothing(value: Expr | sympy.MatrixBase) -> bool:
    return all(e == 0 for e in value) if isinstance(value, sympy.MatrixBase) else value == 0


def _text(system: System, values: dict[str, Expr]) -> str:
    names = {c.qd: sympy.Symbol(_dotted(c.name)) for c in system.coordinates}
    order = ", ".join(c.name for c in system.coordinates)
    title = texts.line(system.title)
    parts = [f"{title}: D q̈ + C q̇ + g = {'τ' if 'tau' in values else '0'},  q = ({order})"]
    for name, value in values.items():
        shown = sympy.pretty(value.xreplace(names), use_unicode=True, wrap_line=False)
        head = f"{_SYMBOL.get(name, name)}, {_MEANING[name]}:"
        parts.append(head + "\n" + "\n".join("    " + line for line in shown.splitlines()))
    if system.outputs:
        lines = (f"    {name} = {formula}" for name, formula in _outputs(system))
        parts.append("outputs, dot(...) the rate:\n" + "\n".join(lines))
    return "\n\n".join(parts)


def _outputs(system: System) -> list[tuple[str, Expr]]:
    """The outputs' formulas over coordinates, without definitions."""
    known: dict[sympy.Symbol, Expr] = {}
    for name, formula in system.definitions:
        known[name] = formula.xreplace(known)
    return [(o.name, o.formula.xreplace(known)) for o in system.outputs]


def _dotted(name: str) -> str:
    """theta2 -> thetadot2, which SymPy prints as a dotted theta with a subscript 2."""
    base = name.split("_")[0].rstrip("0123456789") or name
    return f"{base}dot{name[len(base) :]}"


def _latex(system: System, values: dict[str, Expr]) -> str:
    names = {s: rf"\dot{{{sympy.latex(q)}}}" for s, q in zip(system.qd, system.q, strict=True)}
    symbols = {"tau": r"\tau", "kinetic": "K", "potential": "P", "jacobi": "h", "power": r"\dot h"}
    lines = [
        rf"  {symbols.get(name, name)} &= {sympy.latex(value, symbol_names=names)} \\"
        for name, value in values.items()
    ]
    names |= {c.qdd: rf"\ddot{{{sympy.latex(c.q)}}}" for c in system.coordinates}
    lines += [
        rf"  \mathrm{{{_escaped(name)}}} &= {sympy.latex(value, symbol_names=names)} \\"
        for name, value in _outputs(system)
    ]
    return "\n".join([r"\begin{align*}", *lines, r"\end{align*}"])


def _escaped(name: str) -> str:
    return name.replace("_", r"\_")


class _Exact(StrPrinter):  # type: ignore[misc]
    """Fractions that stand alone as Rational(1, 10): for Python 1/10 is 0.1."""

    def _print_Rational(self, value: sympy.Rational) -> str:
        return str(value) if value.is_Integer else f"Rational({value.p}, {value.q})"

    _print_Half = _print_Rational


def _python(system: System, values: dict[str, Expr]) -> str:
    symbols = [*system.q, *system.qd, *system.u, *(p.symbol for p in system.parameters), t]
    names = ", ".join(s.name for s in symbols)
    title = texts.docstring(texts.line(system.title))
    lines = [
        f'"""{title}: D qdd + C qd + g = tau, as SymPy matrices."""',
        "",
        "from sympy import *",
        "",
        f'{names} = symbols("{names}", real=True)',
    ]
    for name, value in values.items():
        is_matrix = isinstance(value, sympy.MatrixBase)
        text = _Exact().doprint(value.tolist() if is_matrix else value)
        text = f"Matrix({text})" if is_matrix else text
        lines.append(f"{name + '_' if name in {s.name for s in symbols} else name} = {text}")
    return "\n".join(lines)


def _assignments(made: program.Program) -> str:
    """D, C, g and tau as short lists of assignments, the form in which they are computed."""
    names = [c.name for c in made.system.coordinates]
    parts = [f"{texts.line(made.system.title)}: D qdd + C qd + g = tau, q = ({', '.join(names)})"]
    for name in (n for whole in _MATRICES for n in (whole, f"{whole}_column") if n in made):
        body = c_expression.body(made[name], made.system.name, {})
        lines = [line.removeprefix("const double ").rstrip(";") for line in body.lines]
        n = len(names)
        for k, result in enumerate(body.results):
            place = f"{names[k // n]}, {names[k % n]}" if name in ("D", "C") else names[k]
            lines.append(f"{name}[{place}] = {result}")
        meaning = _MEANING.get(name) or f"{name[0]} e for a direction e = ({names[0]}{ALONG}, ...)"
        parts.append(f"{name}, {meaning}:\n" + c_expression.indent(lines))
    return "\n\n".join(parts)


def cost(system: System) -> str:
    """The operations of each generated function, by each route, and why one was taken."""
    made = program.build(lagrange.derive(system))
    lines = [
        f"{texts.line(system.title)}: operations of one call, those on parameters alone left out",
        "",
    ]
    wide = max(map(len, made.functions))
    routes: dict[str, None] = {}
    for name, function in made.functions.items():
        others = [f"{r} {c.flops}" for r, c in function.routes if r != function.route]
        others += [f"{r} {why}" for r, why in made.passed_over.items() if name == "acceleration"]
        choice = f"  ({function.route}; {', '.join(others)})" if others else ""
        lines.append(f"{name:{wide}}  {function.cost.flops:5d} flops: {function.cost}{choice}")
        routes |= dict.fromkeys(r for r, _ in function.routes)
    if len(routes) > 1:
        lines += ["", "Of each function the route of least weight is taken that loses no digits:"]
        lines.append("a division weighs as 8 additions, a sine or other call as 25.")
        lines += [f"    {r:{max(map(len, routes))}}  {ROUTES[r].sentence}" for r in routes]
    return "\n".join(lines)
