"""Evaluation of formulas and SymPy expressions in different algebras.

The text of a formula becomes a SymPy expression (`expression`), and an expression becomes a
function of numbers (`compiled`). Before SymPy computes the exact numbers of a formula, their
numbers of digits are bounded (`bound`): numbers of a scene are exact fractions, and thirty
squarings of the number 3, spread over definitions, have half a billion digits. The tree of the
formula is therefore evaluated with upper bounds first, which takes a few floating-point operations
per node.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import mpmath
import sympy
from sympy import Dummy, Expr

from eomc.model.symbols import dot
from eomc.runtime.mathematics import (
    ANALYTIC,
    DOUBLES,
    FUNCTIONS,
    MathFunction,
    numpy_functions,
)
from eomc.scene import formulas
from eomc.scene.formulas import MAX_LOG10, Formula, FormulaError


def _number(text: str) -> Expr:
    whole = text[:2].lower() in ("0x", "0o", "0b")
    return sympy.Integer(int(text, 0)) if whole else sympy.Rational(text)


class DefinedFunction(sympy.Function):  # type: ignore[misc]
    """A function of formulas that SymPy does not have.

    Its derivative, and its exact form in other functions, come from the table of functions.
    """

    is_real = True

    @classmethod
    def eval(cls, *args: Expr) -> Expr | None:
        """Return the exact value if all arguments are numbers, else None (SymPy keeps the call)."""
        row = FUNCTIONS[cls.__name__]
        return _in_arguments(row, row.exact, args) if all(x.is_number for x in args) else None

    def fdiff(self, argindex: int = 1) -> Expr:
        """Return the derivative with respect to an argument, of which 1 is the first."""
        row = FUNCTIONS[type(self).__name__]
        return _in_arguments(row, row.derivatives[argindex - 1], self.args)

    @property
    def exact(self) -> Expr:
        """The equal expression in functions of SymPy."""
        row = FUNCTIONS[type(self).__name__]
        return _in_arguments(row, row.exact, self.args)


def _in_arguments(row: MathFunction, text: str, args: Sequence[Expr]) -> Expr:
    """Return a formula of the table of functions as a SymPy expression of these arguments."""
    known = dict(zip(row.arguments, args, strict=True))
    return sympy.sympify(formulas.evaluate(formulas.parse(text), ALGEBRA, known.__getitem__))


class cbrt(DefinedFunction):  # noqa: N801 - these print as the scene writes them
    """The real cube root."""


class expm1(DefinedFunction):  # noqa: N801
    """The function exp(x) - 1."""


class hypot(DefinedFunction):  # noqa: N801
    """The length sqrt(x^2 + y^2)."""


class log1p(DefinedFunction):  # noqa: N801
    """The function log(1 + x)."""


_DEFINED = {f.__name__: f for f in (cbrt, expm1, hypot, log1p)}
# the functions of formulas in SymPy, and their classes; sqrt is a power
CONSTRUCTORS: Mapping[str, Any] = {
    name: _DEFINED.get(name) or getattr(sympy, str(f.name_in("sympy")))
    for name, f in FUNCTIONS.items()
}
CLASSES: Mapping[str, Any] = {n: f for n, f in CONSTRUCTORS.items() if n != "sqrt"} | {"dot": dot}
ALGEBRA: Mapping[str, Any] = {
    "number": _number,
    "pi": sympy.pi,
    **CONSTRUCTORS,
    "heaviside": lambda x: sympy.Heaviside(x),
    "dot": dot,
}


def classes_of_shape(*shapes: str) -> tuple[Any, ...]:
    """Return the SymPy classes of the functions that are "steep", or have a "corner" or "jump"."""
    return tuple(CONSTRUCTORS[f.name] for f in FUNCTIONS.values() if f.shape in shapes)


UNDEFINED = (sympy.zoo, sympy.nan, sympy.oo, -sympy.oo)


def expression(formula: Formula, known: Mapping[str, Expr]) -> Expr:
    """Convert a parsed formula to a SymPy expression and return it.

    known: dict from each name that the formula may use to its SymPy expression. Raises
    FormulaError if the value is not real or not finite.
    """
    if formula.expression is not None:
        names = ((s, known[s.name]) for s in formula.expression.free_symbols)
        return formula.expression.xreplace({s: e for s, e in names if e != s})
    try:
        value = sympy.sympify(formulas.evaluate(formula, ALGEBRA, known.__getitem__))
    except (ArithmeticError, ValueError, TypeError) as fault:
        raise FormulaError(str(fault)) from None
    try:
        check_real(value)
    except FormulaError as fault:
        values = {name: float(x) for name, x in known.items() if x.is_number and x.is_real}
        advice = formulas.domain_advice(formula, values.__getitem__)
        raise FormulaError(f"{fault}{advice if value.has(sympy.I) else ''}") from None
    return value


def check_real(value: Expr) -> None:
    """Raise FormulaError if an expression divides by zero or is not real."""
    if value.has(*UNDEFINED):
        raise FormulaError("divides by zero")
    if value.has(sympy.I):
        raise FormulaError("has no real value")


# --- bounds on the digits of exact numbers --------------------------------------------------------

MAX_DIGITS = 10_000  # of an exact number

_IRRATIONAL_DIGITS = 20.0  # assumed for irrational numbers such as sqrt(2), sin(1) and pi
_TOO_LONG = (
    f"makes exact numbers of more than {MAX_DIGITS:,} digits, with what it is made of: "
    "write the large powers out as decimals"
)
_RANGE = f"is not between 1e-{MAX_LOG10} and 1e{MAX_LOG10} in size, as numbers must be"


@dataclass(frozen=True)
class DigitBound:
    """An upper bound on the number of decimal digits of an exact number.

    Arithmetic operations on bounds return the bound of the result. They raise FormulaError if the
    result has too many digits, overflows or is not real.

    Attributes
    ----------
    value
        The number in double precision; None for an expression that varies.
    digits
        Upper bound on the digits of the number, or of the coefficient of an expression.
    """

    value: float | None = None
    digits: float = 0.0

    def __add__(self, other: DigitBound) -> DigitBound:
        return _apply_to_bounds(lambda a, b: a + b, self.digits + other.digits, self, other)

    def __sub__(self, other: DigitBound) -> DigitBound:
        return _apply_to_bounds(lambda a, b: a - b, self.digits + other.digits, self, other)

    def __mul__(self, other: DigitBound) -> DigitBound:
        return _apply_to_bounds(lambda a, b: a * b, self.digits + other.digits, self, other)

    def __truediv__(self, other: DigitBound) -> DigitBound:
        if other.value == 0:
            raise FormulaError("divides by zero")
        return _apply_to_bounds(lambda a, b: a / b, self.digits + other.digits, self, other)

    def __neg__(self) -> DigitBound:
        return DigitBound(None if self.value is None else -self.value, self.digits)

    def __pos__(self) -> DigitBound:
        return self

    def __pow__(self, other: DigitBound) -> DigitBound:
        if other.value is None:
            if self.value == 0:
                raise FormulaError(
                    "raises 0 to a power that varies, which is 0 or infinite with the sign of the "
                    "exponent: write 0, or give the base another value"
                )
            return VARIES
        root = 0.0 if other.value.is_integer() else _IRRATIONAL_DIGITS
        digits = 1.0 if self.value in (0, 1) else self.digits * max(abs(other.value), 1) + root
        return _apply_to_bounds(lambda a, b: a**b, digits, self, other)


VARIES = DigitBound()


def _apply_to_bounds(function: Callable[..., Any], digits: float, *parts: DigitBound) -> DigitBound:
    """Apply a function to bounded values. Raises FormulaError beyond MAX_DIGITS."""
    if not digits <= MAX_DIGITS:
        raise FormulaError(_TOO_LONG)
    numbers = [part.value for part in parts]
    if None in numbers:
        return DigitBound(None, digits)
    try:
        value = function(*numbers)
    except OverflowError:
        raise FormulaError(_RANGE) from None
    except ZeroDivisionError:
        raise FormulaError("divides by zero") from None
    except (ValueError, TypeError):
        raise FormulaError("has no real value") from None
    if isinstance(value, complex) or math.isnan(value):
        raise FormulaError("has no real value")
    if not abs(value) < 10.0**MAX_LOG10:
        raise FormulaError(_RANGE)
    return DigitBound(float(value), digits)


def _literal(text: str) -> DigitBound:
    mantissa, _, exponent = text.partition("e") if text[:2] != "0x" else (text, "", "")
    digits = float(len(mantissa) + abs(int(exponent or 0)))
    return DigitBound(formulas.NUMERIC["number"](text), digits)


def _bound_call(name: str) -> Callable[..., DigitBound]:
    function = formulas.NUMERIC[name]
    rational = name in ("abs", "min", "max", "sign", "heaviside")

    def bound_of_call(*parts: DigitBound) -> DigitBound:
        if any(part.value is None for part in parts):
            return VARIES
        return _apply_to_bounds(
            function, sum(p.digits for p in parts) + (0 if rational else _IRRATIONAL_DIGITS), *parts
        )

    return bound_of_call


_BOUND_ALGEBRA: Mapping[str, Any] = {
    "number": _literal,
    "pi": DigitBound(math.pi, _IRRATIONAL_DIGITS),
    "dot": lambda _: VARIES,
    **{name: _bound_call(name) for name in formulas.FUNCTIONS if name != "dot"},
}


def bound(formula: Formula, known: Mapping[str, DigitBound]) -> DigitBound:
    """Return an upper bound on the digits of the value of a formula, without computing it exactly.

    known: dict from a name in the formula to the bound of its value; names that are not in it stand
    for variables. Raises FormulaError if the value is out of the range of doubles, is not real or
    has too many digits.
    """
    result = formulas.evaluate(formula, _BOUND_ALGEBRA, lambda name: known.get(name, VARIES))
    assert isinstance(result, DigitBound)
    return result if result.value is not None else VARIES


# --- functions of numbers -------------------------------------------------------------------------


def mpmath_functions(mp: Any) -> dict[str, Callable[..., Any]]:
    """Return the functions of formulas in an mpmath context, by name."""

    def function(f: MathFunction) -> Callable[..., Any]:
        if (name := f.name_in("mpmath")) is not None:
            return getattr(mp, name)  # type: ignore[no-any-return]
        exact = formulas.parse(f.exact)
        return lambda *args: formulas.evaluate(
            exact, {**DOUBLES, "number": mp.mpf}, dict(zip(f.arguments, args, strict=True)).get
        )

    return {**DOUBLES, **{f.name: function(f) for f in ANALYTIC}}


def compile_function(
    arguments: Sequence[Any],
    expressions: Any,
    modules: Any,
    definitions: Sequence[tuple[Any, Expr]] = (),
) -> Callable[..., Any]:
    """Return a Python function of numbers that evaluates an expression or a list of expressions.

    Symbols may have any names: they are replaced by dummy symbols, so that a parameter may have the
    name of an object in Python or in `modules`, such as `size` or `e`.

    Parameters
    ----------
    arguments : sequence of Symbol
        The arguments of the function, in order.
    expressions : Expr or sequence of Expr
        The expressions to evaluate. A sequence gives a function that returns a list.
    modules : as `modules` of `sympy.lambdify`
        Modules that contain the functions and constants, such as "math".
    definitions : sequence of (Symbol, Expr), optional
        Symbols of the expressions and their values, which are evaluated first and in order; each
        may use the symbols before it. Without definitions, common subexpressions are eliminated.
    """
    names = [*arguments, *(name for name, _ in definitions)]
    stand_ins: dict[Any, Any] = {name: Dummy(real=True) for name in names}

    def renamed(e: Expr) -> Expr:
        return sympy.sympify(e).xreplace(stand_ins)

    modules = modules if isinstance(modules, (list, tuple)) else [modules]
    modules = [
        x for m in modules for x in (*((_lacking_functions(m),) if isinstance(m, str) else ()), m)
    ]
    several = isinstance(expressions, (list, tuple))
    replaced = [*map(renamed, expressions)] if several else renamed(expressions)
    known = [(stand_ins[name], renamed(e)) for name, e in definitions]
    shared = (lambda e: (known, e)) if definitions else True
    function: Callable[..., Any]
    function = sympy.lambdify([stand_ins[x] for x in arguments], replaced, modules, cse=shared)
    return function


@cache
def _lacking_functions(module: str) -> dict[str, Callable[..., Any]]:
    """Return the functions of formulas that a module lacks; none where it is not known."""
    if module not in ("mpmath", "numpy"):
        return {}
    own = mpmath_functions(mpmath) if module == "mpmath" else numpy_functions()
    return {f.name: own[f.name] for f in ANALYTIC if f.name_in(module) is None}
