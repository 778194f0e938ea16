"""Checks and conversion of the arguments of System.make, with the rules of scenes."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import sympy
from sympy import Expr, Symbol
from sympy.core.function import AppliedUndef

from eomc.base import names
from eomc.base.errors import EomcError
from eomc.integrators.tableaux import METHODS
from eomc.model import algebra
from eomc.model.mechanics import with_argument_names
from eomc.model.symbols import dot, symbol
from eomc.scene import formulas
from eomc.scene.formulas import FormulaError
from eomc.scene.messages import is_in_degrees
from eomc.scene.scene import RunSettings
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


def argument_error(role: str, message: str) -> EomcError:
    """Return the EomcError for an invalid argument of System.make.

    role: description of the argument for the message, such as "start of theta".
    """
    return EomcError(f"System.make: {role}: {message}")


def valid_name(name: object, role: str) -> str:
    """Return the name of a quantity as text, from the name itself or from a SymPy Symbol.

    name: the text or Symbol that the user passed to System.make. role: description of the argument
    for the message. Raises EomcError if the name is not valid in C and Python.
    """
    if not isinstance(name, (str, Symbol)):
        raise argument_error(role, f"{name!r} is not a name")
    if why := names.fault(str(name)):
        raise argument_error(role, why)
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
    """Raise TypeError if a user passed keyword arguments that System.make does not have.

    unknown: the names of these keyword arguments; nothing is raised if there are none. known: names
    of the valid arguments, of which the message suggests the most similar one.
    """
    for name in unknown:
        known = [*known]
        if name in ("L", "lagrangian", "Lagrangian"):
            raise TypeError(f"System.make has no argument '{name}': {LAGRANGIAN}")
        near = formulas.suggest(_ALIASES.get(name, name), known)
        raise TypeError(
            f"System.make has no argument '{name}'{near or ': it has ' + ', '.join(known)}"
        )


def check_units(units: Mapping[str, str], known: Iterable[str], outputs: Collection[str]) -> None:
    """Raise EomcError if a unit is given for an unknown quantity, or is wrong for the quantity.

    units: dict from the name of a quantity to its unit. known: names of all quantities. outputs:
    names of the outputs, the only quantities whose unit may contain degrees, since all other angles
    are in radians.
    """
    known = [*known]
    for name, unit in units.items():
        if name not in known:
            raise argument_error(
                "units",
                f"{name} is no coordinate, parameter, input, constraint or output"
                f"{formulas.suggest(name, known)}",
            )
        if name not in outputs and is_in_degrees(unit):
            raise argument_error(
                "units",
                f"{name}: '{unit}': angles are in radians, nothing is converted: give values "
                "in radians and the unit in rad",
            )


def parse_formula(text: str, role: str, known: Mapping[str, Symbol], rule: str = "") -> Expr:
    """Parse a formula in the syntax of scenes and return it as a SymPy expression.

    Parameters
    ----------
    text
        The formula.
    role
        Description of the argument for messages, such as "start of theta".
    known
        Symbol of each name that the formula may use.
    rule
        Rule on the names that are allowed, for the message about another name.

    Raises
    ------
    EomcError
        If the formula is invalid or uses another name.
    """
    try:
        formula = formulas.parse(text)
        if strange := [n.id for n in formula.names() if n.id not in known]:
            raise undeclared_error(role, strange, known, rule)
        algebra.bound(formula, {})
        return algebra.expression(formula, known)
    except FormulaError as wrong:
        shown = text if len(text) <= 80 else text[:79] + "…"
        raise argument_error(role, f"'{shown}' {with_argument_names(str(wrong))}") from None


def undeclared_error(
    role: str, strange: Sequence[str], known: Iterable[str], rule: str = ""
) -> EomcError:
    """Return the EomcError for names in an expression that are not declared or not allowed.

    role: description of the argument for the message. strange: the names. known: declared names,
    for a suggestion. rule: the rule that forbids the names, or "" if they are not declared.
    """
    known = [*known]
    suggestion = formulas.suggest(strange[0], known)
    if strange[0] in known:
        suggestion = f"; the '{strange[0]}' declared there is another symbol: take the same one"
    why = "not declared: name it among coordinates, parameters, inputs or definitions"
    if rule:
        why = f"can't be used here: {rule}"
    return argument_error(role, f"{', '.join(strange)} {why}{suggestion}")


def expression(value: Any, role: str) -> Expr:
    """Convert a value to a scalar SymPy expression and return it.

    role: description of the argument for the message. Raises EomcError if the conversion fails.
    """
    try:
        expr = sympy.sympify(value)
    except (sympy.SympifyError, TypeError, AttributeError, ValueError, RecursionError):
        expr = None
    if isinstance(expr, (sympy.MatrixBase, sympy.MatrixExpr)):
        rows, columns = expr.shape
        raise argument_error(
            role, f"give one expression, not a matrix of {rows} by {columns}: its entry"
        )
    if not isinstance(expr, Expr):
        raise argument_error(role, f"{value!r} is not an expression")
    return expr


def check_functions(expr: Expr, role: str) -> None:
    """Raise EomcError if `expr` contains a function that the generated C cannot evaluate.

    role: description of the argument for the message.
    """
    queue, visited = [expr], {expr}
    while queue:
        part = queue.pop()
        if not isinstance(part, _KNOWN):
            name = type(part).__name__
            if name in formulas.NOT_ELEMENTARY:
                why = with_argument_names(formulas.NOT_ELEMENTARY[name])
                raise argument_error(role, f"{name} can't be used: {why}")
            instead = f": write {_REPLACEMENTS[name]}" if name in _REPLACEMENTS else ""
            known = ", ".join(f.__name__ for f in _FUNCTIONS)
            raise argument_error(role, f"{name} can't be used{instead}; functions are {known}")
        if isinstance(part, sympy.Heaviside) and part.args[1] != sympy.S.Half:
            raise argument_error(role, f"{part}: Heaviside(x) is 1/2 at 0, without another value")
        more = [arg for arg in part.args if arg not in visited]
        visited.update(more)
        queue += more


def check_smooth(
    expr: Expr, role: str, definitions: Mapping[Symbol, Expr], fixed: Any, what: str
) -> None:
    """Raise EomcError if `expr`, which will be differentiated, is discontinuous.

    Parameters
    ----------
    expr
        The expression; sign(...) and Heaviside(...) in it are discontinuous.
    role
        Description of the argument for the message.
    definitions
        Expressions of the symbols in `expr`, which are checked too.
    fixed
        Constant symbols. Discontinuous functions of these alone are allowed.
    what
        Name of the expression for the message, such as "the kinetic energy".
    """
    queue, visited = [expr], {expr}
    while queue:
        part = queue.pop()
        for jump in part.atoms(sympy.sign, sympy.Heaviside):
            if jump.free_symbols - fixed:
                name = type(jump).__name__
                raise argument_error(
                    role,
                    f"{name}(...) jumps, and {what} is differentiated: use Abs, Min or "
                    "Max (Max(x, 0)**2 for a stop), a smooth tanh(x/width), or give the force "
                    "itself in forces",
                )
        more = [definitions[s] for s in part.free_symbols if s in definitions]
        queue += [e for e in more if e not in visited]
        visited.update(more)


def number(value: Any, role: str, rule: str = "it is made of numbers") -> float:
    """Convert a value that a user passed to System.make to a finite float and return it.

    value: a number, the text of a formula, or a SymPy expression; it must not contain names of
    quantities. role: description of the argument for messages. rule: the rule that the message
    states if the value does contain names. Raises EomcError if the value is not a finite number.
    """
    if isinstance(value, str):
        value = parse_formula(value, role, {}, rule)
    if isinstance(value, Expr) and value.free_symbols:
        raise undeclared_error(role, sorted(map(str, value.free_symbols)), (), rule)
    try:
        result = float(value)
    except (TypeError, ValueError, OverflowError, IndexError):  # SymPy raises each of these
        raise argument_error(role, f"must be a number, here {value!r}") from None
    if not math.isfinite(result):
        raise argument_error(role, f"must be a finite number, here {result}")
    return result


def initial_values(value: Any, role: str) -> tuple[Any, Any]:
    """Return the pair (initial value, initial velocity) that a user gave for one coordinate.

    value: the value of the coordinate in the mapping `coordinates` of System.make: an initial
    value, a pair, or None. In the result, a part that is not given is None. role: description of
    the argument for the message.
    """
    pair = value if isinstance(value, (tuple, list)) else (value, None)
    if len(pair) != 2:
        raise argument_error(role, f"give a start, or a pair (start, rate), here {value!r}")
    return pair[0], pair[1]


def by_symbol(value: Any, role: str, example: str) -> Mapping[Any, Any]:
    """Return a copy of the mapping `value` in which all keys are symbols.

    Keys that are names (text) are converted. role, example: description of the argument and a valid
    value, for messages. Raises EomcError if `value` is not a mapping or a key can't be converted.
    """
    if not isinstance(value, Mapping):
        raise argument_error(role, f"give a dict, such as {example}, here {value!r}")
    return {symbol_of(key, role): entry for key, entry in value.items()}


def by_name(value: Any, role: str, example: str) -> dict[str, Any]:
    """Return a copy of the mapping `value` in which all keys are names (text).

    Keys that are symbols are converted. role, example: description of the argument and a valid
    value, for messages. Raises EomcError if `value` is not a mapping or a key can't be converted.
    """
    return {name_of(one): entry for one, entry in by_symbol(value, role, example).items()}


def name_of(one: Any) -> str:
    """Return the name of `one`, a Symbol, a function of time such as theta(t), or text."""
    return str(one.func.__name__ if isinstance(one, AppliedUndef) else one)


def or_empty(value: Any) -> Any:
    """Return `value`, or an empty dict if it is None."""
    return {} if value is None else value


def symbols(value: Any, role: str, default: Any) -> dict[Any, Any]:
    """Return a dict from symbols to values, from a mapping or from a collection without values.

    value: a mapping from symbols or names to values, or a collection of symbols or names. role:
    description of the argument for messages. default: the value of each symbol in the result if
    `value` is a collection. Raises EomcError for other types.
    """
    if isinstance(value, Mapping):
        return dict(by_symbol(value, role, ""))
    if not isinstance(value, (list, tuple, set, frozenset)):
        raise argument_error(role, f"give a list or dict of symbols, here {value!r}")
    return {symbol_of(one, role): default for one in value}


def symbol_of(value: Any, role: str) -> Any:
    """Return the symbol that `value` stands for: a name is converted to a Symbol.

    A Symbol, or a function of time made by SymPy's `dynamicsymbols`, is returned unchanged. role:
    description of the argument for the message. Raises EomcError for other types.
    """
    if not isinstance(value, (str, Symbol, AppliedUndef)):
        raise argument_error(role, f"{value!r} is not a symbol")
    return symbol(value) if isinstance(value, str) else value


def run_settings(settings: RunSettings, adaptive: bool) -> RunSettings:
    """Check settings that a user passed to System.make, and return them in their final form.

    settings: the arguments as they were given; `methods` may contain "auto", for adaptive steps.
    adaptive: True if the system has events or friction, so that its steps are adaptive too. In the
    result "auto" is left out, and adaptive steps have a tolerance. Raises EomcError for invalid
    settings.
    """
    for name in ("h", "duration"):
        if number(value := getattr(settings, name), name) <= 0:
            raise argument_error(name, f"must be greater than zero, here {value!r}")
    methods, known = settings.methods, (*METHODS, "auto")
    if not methods or not all(isinstance(m, str) and m in known for m in methods):
        raise argument_error("methods", f"known are {', '.join(known)}, here {methods!r}")
    if settings.real not in REALS:
        raise argument_error("real", f"known are {', '.join(REALS)}, here {settings.real!r}")
    for name in ("batch", "discretize", "inverse_dynamics"):
        if not isinstance(value := getattr(settings, name), bool):
            raise argument_error(name, f"must be True or False, here {value!r}")
    linearize, tolerance = settings.linearize, settings.tolerance
    if not isinstance(linearize, bool) and linearize != "parameters":
        raise argument_error(
            "linearize", f'must be True, False or "parameters", here {linearize!r}'
        )
    if tolerance is not None:
        least = MIN_FLOAT_TOLERANCE if settings.real == "float" else MIN_TOLERANCE
        if not least <= number(tolerance, "tolerance") <= MAX_TOLERANCE:
            raise argument_error(
                "tolerance", f"lies between {least:g} and {MAX_TOLERANCE:g}, here {tolerance!r}"
            )
        tolerance = float(tolerance)
    elif adaptive or "auto" in methods:
        tolerance = DEFAULT_TOLERANCE[settings.real]
    return replace(
        settings,
        h=float(settings.h),
        duration=float(settings.duration),
        methods=tuple(m for m in methods if m != "auto") or ("rk4",),
        tolerance=tolerance,
    )


def as_tuple(value: Any) -> tuple[Any, ...]:
    """Return the items of a list or tuple as a tuple; any other value becomes a tuple of one."""
    return tuple(value) if isinstance(value, (tuple, list)) else (value,)
