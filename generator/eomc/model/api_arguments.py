"""Checks and conversion of the arguments of System.make, with the rules of scenes."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import sympy
from sympy import Expr, Symbol
from sympy.core.function import AppliedUndef

from eomc.base import names
from eomc.base.errors import EomcError
from eomc.integrators.tableaux import METHODS
from eomc.model import algebra, digit_bound
from eomc.model.mechanics import in_words_of_python
from eomc.model.symbols import dot, symbol
from eomc.scene import formulas
from eomc.scene.formulas import FormulaError
from eomc.scene.messages import is_in_degrees
from eomc.scene.scene import Run
from eomc.scene.schema import (
    DEFAULT_TOLERANCE,
    MAX_TOLERANCE,
    MIN_FLOAT_TOLERANCE,
    MIN_TOLERANCE,
    REALS,
)

_FUNCTIONS = (
    *(sympy.sin, sympy.cos, sympy.tan, sympy.asin, sympy.acos, sympy.atan, sympy.atan2),
    *(sympy.sinh, sympy.cosh, sympy.tanh, sympy.exp, sympy.log, sympy.Abs, sympy.sign),
    *(sympy.Heaviside, sympy.Min, sympy.Max, dot),
)
_KNOWN = (sympy.Add, sympy.Mul, sympy.Pow, Symbol, sympy.Number, sympy.NumberSymbol, *_FUNCTIONS)
_REPLACEMENTS = {
    "asinh": "log(x + sqrt(x**2 + 1))",
    "acosh": "log(x + sqrt(x**2 - 1))", "atanh": "log((1 + x)/(1 - x))/2", "acot": "atan(1/x)",
    "ITE": "Heaviside(x), Min or Max",
    "floor": "a smooth function", "ceiling": "a smooth function", "Mod": "a smooth function",
    "Integral": "its value, by .doit()", "Sum": "its terms, by .doit()",
    "Product": "its factors, by .doit()", "sinc": "sin(x)/x",
}  # fmt: skip


def fault(role: str, message: str) -> EomcError:
    """Return the error to raise for an argument."""
    return EomcError(f"System.make: {role}: {message}")


def called(name: object, role: str) -> str:
    """Return a name as text. Raises EomcError where it is not a valid name in C and Python."""
    if not isinstance(name, (str, Symbol)):
        raise fault(role, f"{name!r} is not a name")
    if why := names.fault(str(name)):
        raise fault(role, why)
    return str(name)


# other names of the arguments of System.make, in scenes, runs and textbooks
_ALIASES = {
    "method": "methods", "start": "coordinates", "K": "kinetic", "T": "kinetic", "P": "potential",
    "V": "potential", "params": "parameters", "loads": "forces", "tol": "tolerance",
    "event": "events",
}  # fmt: skip


LAGRANGIAN = (
    "give the Lagrangian L = K - P as kinetic=K and potential=P, where the potential can have "
    "terms linear in the velocities"
)


def check_arguments(unknown: Iterable[str], known: Iterable[str]) -> None:
    """Raise TypeError for an argument that System.make does not have, with the closest name."""
    for name in unknown:
        known = [*known]
        if name in ("L", "lagrangian", "Lagrangian"):
            raise TypeError(f"System.make has no argument '{name}': {LAGRANGIAN}")
        near = formulas.suggest(_ALIASES.get(name, name), known)
        raise TypeError(
            f"System.make has no argument '{name}'{near or ': it has ' + ', '.join(known)}"
        )


def check_units(units: Mapping[str, str], known: Iterable[str], outputs: Collection[str]) -> None:
    """Raise EomcError for the unit of an unknown name, or in degrees for what is no output."""
    known = [*known]
    for name, unit in units.items():
        if name not in known:
            raise fault(
                "units",
                f"{name} is no coordinate, parameter, input, constraint or output"
                f"{formulas.suggest(name, known)}",
            )
        if name not in outputs and is_in_degrees(unit):
            raise fault(
                "units",
                f"{name}: '{unit}': angles are in radians, nothing is converted: give values "
                "in radians and the unit in rad",
            )


def from_text(text: str, role: str, known: Mapping[str, Symbol], rule: str = "") -> Expr:
    """Parse a formula as in scenes. rule: allowed names, for the message. Raises EomcError."""
    try:
        formula = formulas.parse(text)
        if strange := [n.id for n in formula.names() if n.id not in known]:
            raise undeclared(role, strange, known, rule)
        digit_bound.bound(formula, {})
        return algebra.expression(formula, known)
    except FormulaError as wrong:
        shown = text if len(text) <= 80 else text[:79] + "…"
        raise fault(role, f"'{shown}' {in_words_of_python(str(wrong))}") from None


def undeclared(
    role: str, strange: Sequence[str], known: Iterable[str], rule: str = ""
) -> EomcError:
    """Return the error for names that are not declared, or that a rule forbids."""
    known = [*known]
    suggestion = formulas.suggest(strange[0], known)
    if strange[0] in known:
        suggestion = f"; the '{strange[0]}' declared there is another symbol: take the same one"
    why = "not declared: name it among coordinates, parameters, inputs or definitions"
    if rule:
        why = f"can't be used here: {rule}"
    return fault(role, f"{', '.join(strange)} {why}{suggestion}")


def expression(value: Any, role: str) -> Expr:
    """Return the value as a SymPy expression. Raises EomcError where that is not possible."""
    try:
        expr = sympy.sympify(value)
    except (sympy.SympifyError, TypeError, AttributeError, ValueError, RecursionError):
        expr = None
    if isinstance(expr, (sympy.MatrixBase, sympy.MatrixExpr)):
        rows, columns = expr.shape
        raise fault(role, f"give one expression, not a matrix of {rows} by {columns}: its entry")
    if not isinstance(expr, Expr):
        raise fault(role, f"{value!r} is not an expression")
    return expr


def check_functions(expr: Expr, role: str) -> None:
    """Raise EomcError where `expr` has a function that C code cannot evaluate."""
    queue, visited = [expr], {expr}
    while queue:
        part = queue.pop()
        if not isinstance(part, _KNOWN):
            name = type(part).__name__
            if name in formulas.NOT_ELEMENTARY:
                why = in_words_of_python(formulas.NOT_ELEMENTARY[name])
                raise fault(role, f"{name} can't be used: {why}")
            instead = f": write {_REPLACEMENTS[name]}" if name in _REPLACEMENTS else ""
            known = ", ".join(f.__name__ for f in _FUNCTIONS)
            raise fault(role, f"{name} can't be used{instead}; functions are {known}")
        if isinstance(part, sympy.Heaviside) and part.args[1] != sympy.S.Half:
            raise fault(role, f"{part}: Heaviside(x) is 1/2 at 0, without another value")
        more = [arg for arg in part.args if arg not in visited]
        visited.update(more)
        queue += more


def check_smooth(
    expr: Expr, role: str, definitions: Mapping[Symbol, Expr], fixed: Any, what: str
) -> None:
    """Raise EomcError where `expr`, which is differentiated, has a function that jumps.

    fixed: constant symbols, of which such functions are constant. what: a name of the expression
    for the message.
    """
    queue, visited = [expr], {expr}
    while queue:
        part = queue.pop()
        for jump in part.atoms(sympy.sign, sympy.Heaviside):
            if jump.free_symbols - fixed:
                name = type(jump).__name__
                raise fault(
                    role,
                    f"{name}(...) jumps, and {what} is differentiated: use Abs, Min or "
                    "Max (Max(x, 0)**2 for a stop), a smooth tanh(x/width), or give the force "
                    "itself in forces",
                )
        more = [definitions[s] for s in part.free_symbols if s in definitions]
        queue += [e for e in more if e not in visited]
        visited.update(more)


def number(value: Any, role: str, rule: str = "it is made of numbers") -> float:
    """Return a finite number, also from a formula of numbers. Raises EomcError."""
    if isinstance(value, str):
        value = from_text(value, role, {}, rule)
    if isinstance(value, Expr) and value.free_symbols:
        raise undeclared(role, sorted(map(str, value.free_symbols)), (), rule)
    try:
        result = float(value)
    except (TypeError, ValueError, OverflowError, IndexError):  # SymPy raises each of these
        raise fault(role, f"must be a number, here {value!r}") from None
    if not math.isfinite(result):
        raise fault(role, f"must be a finite number, here {result}")
    return result


def start(value: Any, role: str) -> tuple[Any, Any]:
    """Return the initial value and velocity; None where none is given."""
    pair = value if isinstance(value, (tuple, list)) else (value, None)
    if len(pair) != 2:
        raise fault(role, f"give a start, or a pair (start, rate), here {value!r}")
    return pair[0], pair[1]


def mapping(value: Any, role: str, example: str) -> Mapping[Any, Any]:
    """Return a mapping with symbols as keys. Raises EomcError."""
    if not isinstance(value, Mapping):
        raise fault(role, f"give a dict, such as {example}, here {value!r}")
    return {symbol_of(key, role): entry for key, entry in value.items()}


def by_name(value: Any, role: str, example: str) -> dict[str, Any]:
    """Return a mapping with the names of its symbols as keys. Raises EomcError."""
    return {name_of(one): entry for one, entry in mapping(value, role, example).items()}


def name_of(one: Any) -> str:
    """Return the name of a symbol or of a function of time."""
    return str(one.func.__name__ if isinstance(one, AppliedUndef) else one)


def or_empty(value: Any) -> Any:
    """Return the value, or an empty dict in place of None."""
    return {} if value is None else value


def symbols(value: Any, role: str, default: Any) -> dict[Any, Any]:
    """Return a dict with symbols as keys; a list of symbols gives each the default."""
    if isinstance(value, Mapping):
        return dict(mapping(value, role, ""))
    if not isinstance(value, (list, tuple, set, frozenset)):
        raise fault(role, f"give a list or dict of symbols, here {value!r}")
    return {symbol_of(one, role): default for one in value}


def symbol_of(value: Any, role: str) -> Any:
    """Return a symbol or a function of time (dynamicsymbols) as it is, or a name as a symbol."""
    if not isinstance(value, (str, Symbol, AppliedUndef)):
        raise fault(role, f"{value!r} is not a symbol")
    return symbol(value) if isinstance(value, str) else value


def run(
    h: Any, duration: Any, methods: Any, real: Any, batch: Any, linearize: Any, discretize: Any,
    tolerance: Any, events: bool, inverse_dynamics: Any,
) -> Run:  # fmt: skip
    """Return the settings of a run. Raises EomcError for invalid ones."""
    for name, value in (("h", h), ("duration", duration)):
        if number(value, name) <= 0:
            raise fault(name, f"must be greater than zero, here {value!r}")
    methods = (methods,) if isinstance(methods, str) else methods
    methods = tuple(methods) if isinstance(methods, (tuple, list)) else (methods,)
    known = (*METHODS, "auto")
    if not methods or not all(isinstance(m, str) and m in known for m in methods):
        raise fault("methods", f"known are {', '.join(known)}, here {methods!r}")
    events = events or "auto" in methods
    methods = tuple(m for m in methods if m != "auto") or ("rk4",)
    if real not in REALS:
        raise fault("real", f"known are {', '.join(REALS)}, here {real!r}")
    flags = {"batch": batch, "discretize": discretize, "inverse_dynamics": inverse_dynamics}
    for name, value in flags.items():
        if not isinstance(value, bool):
            raise fault(name, f"must be True or False, here {value!r}")
    if not isinstance(linearize, bool) and linearize != "parameters":
        raise fault("linearize", f'must be True, False or "parameters", here {linearize!r}')
    if tolerance is not None:
        least = MIN_FLOAT_TOLERANCE if real == "float" else MIN_TOLERANCE
        if not least <= number(tolerance, "tolerance") <= MAX_TOLERANCE:
            raise fault(
                "tolerance", f"lies between {least:g} and {MAX_TOLERANCE:g}, here {tolerance!r}"
            )
        tolerance = float(tolerance)
    elif events:
        tolerance = DEFAULT_TOLERANCE[real]
    plain = (float(h), float(duration), methods, real, batch, linearize, discretize)
    return Run(*plain, tolerance=tolerance, inverse_dynamics=inverse_dynamics)
