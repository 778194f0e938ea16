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
from typing import Any

import sympy
from sympy import Dummy, Expr

from eomc.model.symbols import dot
from eomc.scene import formulas
from eomc.scene.formulas import MAX_LOG10, Formula, FormulaError


def _number(text: str) -> Expr:
    whole = text[:2].lower() in ("0x", "0o", "0b")
    return sympy.Integer(int(text, 0)) if whole else sympy.Rational(text)


ALGEBRA: Mapping[str, Any] = {
    "number": _number,
    "pi": sympy.pi,
    **{name: getattr(sympy, name) for name in (*formulas.ELEMENTARY, "sign")},
    "abs": sympy.Abs,
    "heaviside": lambda x: sympy.Heaviside(x),
    "min": sympy.Min,
    "max": sympy.Max,
    "dot": dot,
}
UNDEFINED = (sympy.zoo, sympy.nan, sympy.oo, -sympy.oo)


def expression(formula: Formula, known: Mapping[str, Expr]) -> Expr:
    """Convert a parsed formula to a SymPy expression and return it.

    known: dict from each name that the formula may use to its SymPy expression. Raises
    FormulaError if the value is not real or not finite.
    """
    try:
        value = sympy.sympify(formulas.evaluate(formula, ALGEBRA, known.__getitem__))
    except (ArithmeticError, ValueError, TypeError) as fault:
        raise FormulaError(str(fault)) from None
    if value.has(*UNDEFINED):
        raise FormulaError("divides by zero")
    if value.has(sympy.I):
        raise FormulaError("has no real value")
    return value


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

    several = isinstance(expressions, (list, tuple))
    replaced = [*map(renamed, expressions)] if several else renamed(expressions)
    known = [(stand_ins[name], renamed(e)) for name, e in definitions]
    shared = (lambda e: (known, e)) if definitions else True
    function: Callable[..., Any]
    function = sympy.lambdify([stand_ins[x] for x in arguments], replaced, modules, cse=shared)
    return function
