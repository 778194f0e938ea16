"""What Python callers give to System.make: the same as scenes may say, and faults in words."""

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
_INSTEAD = {
    "asinh": "log(x + sqrt(x**2 + 1))",
    "acosh": "log(x + sqrt(x**2 - 1))", "atanh": "log((1 + x)/(1 - x))/2", "acot": "atan(1/x)",
    "ITE": "Heaviside(x), Min or Max",
    "floor": "a smooth function", "ceiling": "a smooth function", "Mod": "a smooth function",
    "Integral": "its value, by .doit()", "Sum": "its terms, by .doit()",
    "Product": "its factors, by .doit()", "sinc": "sin(x)/x",
}  # fmt: skip


def fault(role: str, message: str) -> EomcError:
    """The error to raise."""
    return EomcError(f"System.make: {role}: {message}")


def called(name: object, role: str) -> str:
    """A name as text. Raises EomcError where it is none, or can be none in C and Python."""
    if not isinstance(name, (str, Symbol)):
        raise fault(role, f"{name!r} is not a name")
    if why := names.fault(str(name)):
        raise fault(role, why)
    return str(name)


# what scenes, runs and newcomers call the arguments of System.make
_CALLED = {
    "method": "methods", "start": "coordinates", "K": "kinetic", "T": "kinetic", "P": "potential",
    "V": "potential", "params": "parameters", "loads": "forces", "tol": "tolerance",
    "event": "events",
}  # fmt: skip


LAGRANGIAN = (
    "give the Lagrangian L = K - P as kinetic=K and potential=P, where the potential can have "
    "terms linear in the velocities"
)


def check_arguments(unknown: Iterable[str], known: Iterable[str]) -> None:
    """A TypeError where System.make has not such an argument, with what may be meant."""
    for name in unknown:
        known = [*known]
        if name in ("L", "lagrangian", "Lagrangian"):
            raise TypeError(f"System.make has no argument '{name}': {LAGRANGIAN}")
        near = formulas.suggest(_CALLED.get(name, name), known)
        raise TypeError(
            f"System.make has no argument '{name}'{near or ': it has ' + ', '.join(known)}"
        )


def check_units(units: Mapping[str, str], known: Iterable[str], outputs: Collection[str]) -> None:
    """An EomcError where a unit is of nothing that there is, or in degrees but of no output."""
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
    """A formula as scenes have it; rule: what it is made of, in words. Raises EomcError."""
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
    """The error where an expression has names that nobody declared, or that a rule forbids."""
    known = [*known]
    meant = formulas.suggest(strange[0], known)
    if strange[0] in known:
        meant = f"; the '{strange[0]}' declared there is another symbol: take the same one"
    why = "not declared: name it among coordinates, parameters, inputs or definitions"
    if rule:
        why = f"can't be used here: {rule}"
    return fault(role, f"{', '.join(strange)} {why}{meant}")


def expression(given: Any, role: str) -> Expr:
    """A SymPy expression, or a number as one. Raises EomcError for anything else."""
    try:
        expr = sympy.sympify(given)
    except (sympy.SympifyError, TypeError, AttributeError, ValueError, RecursionError):
        expr = None
    if isinstance(expr, (sympy.MatrixBase, sympy.MatrixExpr)):
        rows, columns = expr.shape
        raise fault(role, f"give one expression, not a matrix of {rows} by {columns}: its entry")
    if not isinstance(expr, Expr):
        raise fault(role, f"{given!r} is not an expression")
    return expr


def check_functions(expr: Expr, role: str) -> None:
    """Raise EomcError where `expr` has a function that C code is not made of."""
    queue, seen = [expr], {expr}
    while queue:
        part = queue.pop()
        if not isinstance(part, _KNOWN):
            name = type(part).__name__
            if name in formulas.NOT_ELEMENTARY:
                why = in_words_of_python(formulas.NOT_ELEMENTARY[name])
                raise fault(role, f"{name} can't be used: {why}")
            instead = f": write {_INSTEAD[name]}" if name in _INSTEAD else ""
            known = ", ".join(f.__name__ for f in _FUNCTIONS)
            raise fault(role, f"{name} can't be used{instead}; functions are {known}")
        if isinstance(part, sympy.Heaviside) and part.args[1] != sympy.S.Half:
            raise fault(role, f"{part}: Heaviside(x) is 1/2 at 0, without another value")
        more = [arg for arg in part.args if arg not in seen]
        seen.update(more)
        queue += more


def check_smooth(
    expr: Expr, role: str, definitions: Mapping[Symbol, Expr], fixed: Any, what: str
) -> None:
    """Raise EomcError where `expr`, which is differentiated, has a function that jumps.

    fixed: symbols that do not vary, in which such functions do not jump. what: it is, in words.
    """
    queue, seen = [expr], {expr}
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
        queue += [e for e in more if e not in seen]
        seen.update(more)


def number(given: Any, role: str, rule: str = "it is made of numbers") -> float:
    """A finite number, or a formula of numbers. Raises EomcError."""
    if isinstance(given, str):
        given = from_text(given, role, {}, rule)
    if isinstance(given, Expr) and given.free_symbols:
        raise undeclared(role, sorted(map(str, given.free_symbols)), (), rule)
    try:
        value = float(given)
    except (TypeError, ValueError, OverflowError, IndexError):  # as SymPy has it
        raise fault(role, f"must be a number, here {given!r}") from None
    if not math.isfinite(value):
        raise fault(role, f"must be a finite number, here {value}")
    return value


def start(given: Any, role: str) -> tuple[Any, Any]:
    """A start and a rate, as they were given; None where there is none."""
    pair = given if isinstance(given, (tuple, list)) else (given, None)
    if len(pair) != 2:
        raise fault(role, f"give a start, or a pair (start, rate), here {given!r}")
    return pair[0], pair[1]


def mapping(given: Any, role: str, example: str) -> Mapping[Any, Any]:
    """A mapping from symbols. Raises EomcError."""
    if not isinstance(given, Mapping):
        raise fault(role, f"give a dict, such as {example}, here {given!r}")
    return {symbol_of(key, role): value for key, value in given.items()}


def by_name(given: Any, role: str, example: str) -> dict[str, Any]:
    """A mapping from symbols, by their names. Raises EomcError."""
    return {name_of(one): value for one, value in mapping(given, role, example).items()}


def name_of(one: Any) -> str:
    """What a symbol, or a function of time, is called."""
    return str(one.func.__name__ if isinstance(one, AppliedUndef) else one)


def or_empty(value: Any) -> Any:
    """Return the value, or an empty dict in place of None."""
    return {} if value is None else value


def symbols(given: Any, role: str, default: Any) -> dict[Any, Any]:
    """Symbols to what belongs to them; a list of symbols alone gives each the default."""
    if isinstance(given, Mapping):
        return dict(mapping(given, role, ""))
    if not isinstance(given, (list, tuple, set, frozenset)):
        raise fault(role, f"give a list or dict of symbols, here {given!r}")
    return {symbol_of(one, role): default for one in given}


def symbol_of(given: Any, role: str) -> Any:
    """A symbol, a function of time as dynamicsymbols makes them, or a name as a symbol."""
    if not isinstance(given, (str, Symbol, AppliedUndef)):
        raise fault(role, f"{given!r} is not a symbol")
    return symbol(given) if isinstance(given, str) else given


def run(
    h: Any, duration: Any, methods: Any, real: Any, batch: Any, linearize: Any, discretize: Any,
    tolerance: Any, events: bool, inverse_dynamics: Any,
) -> Run:  # fmt: skip
    """How the system is run. Raises EomcError where that is not possible."""
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
