"""How large a formula's exact numbers become, found in doubles before SymPy makes them.

Numbers of a scene are exact fractions, and definitions hide from the reader of one formula that
thirty squarings of the number 3 have half a billion digits. The same tree that gives a SymPy
expression is first evaluated in this algebra: upper bounds, a few operations on floats each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from eomc.scene import formulas
from eomc.scene.formulas import MAX_LOG10, Formula, FormulaError

MAX_DIGITS = 10_000  # of an exact number

_ROOT = 20.0  # digits: what sqrt(2), sin(1) or pi count for in the numbers made of them
_TOO_LONG = (
    f"makes exact numbers of more than {MAX_DIGITS:,} digits, with what it is made of: "
    "write the large powers out as decimals"
)
_RANGE = f"is not between 1e-{MAX_LOG10} and 1e{MAX_LOG10} in size, as numbers must be"


@dataclass(frozen=True)
class Bound:
    """What is known of a value before it is made.

    value: the number that it is, None where it varies. digits: at most so many has the number, or
    what stands before it.
    """

    value: float | None = None
    digits: float = 0.0

    def __add__(self, other: Bound) -> Bound:
        return _made(lambda a, b: a + b, self.digits + other.digits, self, other)

    def __sub__(self, other: Bound) -> Bound:
        return _made(lambda a, b: a - b, self.digits + other.digits, self, other)

    def __mul__(self, other: Bound) -> Bound:
        return _made(lambda a, b: a * b, self.digits + other.digits, self, other)

    def __truediv__(self, other: Bound) -> Bound:
        if other.value == 0:
            raise FormulaError("divides by zero")
        return _made(lambda a, b: a / b, self.digits + other.digits, self, other)

    def __neg__(self) -> Bound:
        return Bound(None if self.value is None else -self.value, self.digits)

    def __pos__(self) -> Bound:
        return self

    def __pow__(self, other: Bound) -> Bound:
        if other.value is None:
            if self.value == 0:
                raise FormulaError(
                    "raises 0 to a power that varies, which is 0 or infinite with the sign of the "
                    "exponent: write 0, or give the base another value"
                )
            return VARIES
        root = 0.0 if other.value.is_integer() else _ROOT
        digits = 1.0 if self.value in (0, 1) else self.digits * max(abs(other.value), 1) + root
        return _made(lambda a, b: a**b, digits, self, other)


VARIES = Bound()


def _made(function: Callable[..., Any], digits: float, *parts: Bound) -> Bound:
    """A size within the bounds. Raises FormulaError."""
    if not digits <= MAX_DIGITS:
        raise FormulaError(_TOO_LONG)
    numbers = [part.value for part in parts]
    if None in numbers:
        return Bound(None, digits)
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
    return Bound(float(value), digits)


def _literal(text: str) -> Bound:
    mantissa, _, exponent = text.partition("e") if text[:2] != "0x" else (text, "", "")
    digits = float(len(mantissa) + abs(int(exponent or 0)))
    return Bound(formulas.NUMERIC["number"](text), digits)


def _call(name: str) -> Callable[..., Bound]:
    function = formulas.NUMERIC[name]
    rational = name in ("abs", "min", "max", "sign", "heaviside")

    def bound_of_call(*parts: Bound) -> Bound:
        if any(part.value is None for part in parts):
            return VARIES
        return _made(function, sum(p.digits for p in parts) + (0 if rational else _ROOT), *parts)

    return bound_of_call


_ALGEBRA: Mapping[str, Any] = {
    "number": _literal,
    "pi": Bound(math.pi, _ROOT),
    "dot": lambda _: VARIES,
    **{name: _call(name) for name in formulas.FUNCTIONS if name != "dot"},
}


def bound(formula: Formula, known: Mapping[str, Bound]) -> Bound:
    """The size of a formula's value; names that are not known vary.

    Raises FormulaError where it is no number that a double can be, or needs too many digits.
    """
    found = formulas.evaluate(formula, _ALGEBRA, lambda name: known.get(name, VARIES))
    assert isinstance(found, Bound)
    return found if found.value is not None else VARIES
