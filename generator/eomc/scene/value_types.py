"""The types of values in a scene file: what a value must be, its conversion, its JSON Schema.

A type is called with a TOML value. It returns the converted value, and raises ValueError with a
remedy if the value has another type. The words of that message describe the type in the reference
of the scene format too.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from eomc.base import texts
from eomc.integrators.tableaux import METHODS
from eomc.scene import hints
from eomc.scene.formulas import Formula, Value

MIN_TOLERANCE, MAX_TOLERANCE = 1e-15, 1e-2

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class ValueType(Generic[T]):
    """A type of values in a scene file.

    Attributes
    ----------
    name : str
        Short name for tables, such as "formula".
    words : str
        What a value must be, for messages and the reference.
    json_schema : mapping
        JSON Schema of the values. It refuses no valid value; conditions that JSON Schema cannot
        express are left to `convert`.
    convert : callable
        Function that converts a TOML value, and raises ValueError for values of other types.
    """

    name: str
    words: str
    json_schema: Mapping[str, Any]
    convert: Callable[[object], T]

    def __call__(self, value: object) -> T:
        """Convert a value. Raises ValueError if it has another type."""
        return self.convert(value)

    def mismatch(self, value: object) -> ValueError:
        """Return the error for a value that does not have this type."""
        return expected(self.words, value)


def value_type(
    name: str, words: str, json_schema: Mapping[str, Any]
) -> Callable[[Callable[[object], T]], ValueType[T]]:
    """Return a decorator that makes a function that converts values the type of these values."""
    return lambda convert: ValueType(name, words, json_schema, convert)


def short_toml(value: object) -> str:
    """Return a value as it is written in TOML, shortened to 40 characters, for messages."""
    if isinstance(value, bool):
        text = str(value).lower()
    elif isinstance(value, dict):
        text = "a table"
    else:
        text = repr(value) if isinstance(value, (str, list, float, int)) else str(value)
    return text if len(text) <= 40 else text[:37] + "..."


def expected(words: str, value: object) -> ValueError:
    """Return the error for a value that must be what the words describe."""
    return ValueError(f"must be {words}, here {short_toml(value)}")


def _array(items: Mapping[str, Any], least: int = 0, most: int | None = None) -> dict[str, Any]:
    """Return the JSON Schema of an array with `least` to `most` items."""
    bounds = {"minItems": least} if least else {}
    return {"type": "array", "items": items, **bounds, **({"maxItems": most} if most else {})}


# --- numbers, formulas and vectors ----------------------------------------------------------------

_FORMULA = {"type": ["number", "string"]}
_VECTOR = _array(_FORMULA, 1)
_TURN = {
    "type": "array",
    "items": [{"enum": ["x", "y", "z"]}, _FORMULA],
    "minItems": 2,
    "maxItems": 2,
}


@value_type("formula", "a number or a formula in quotes", _FORMULA)
def entry(value: object) -> Value:
    """Check that a value is a finite number or a formula; numbers are returned as float."""
    if isinstance(value, (str, Formula)):
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise entry.mismatch(value)
    if not abs(value) < math.inf or abs(value) > sys.float_info.max:
        raise expected("a finite number", value)
    return float(value)


@value_type("vector", "a list of numbers and formulas, such as [0, 1.5]", _VECTOR)
def vector(value: object) -> tuple[Value, ...]:
    """Convert a list of numbers and formulas to a tuple."""
    if not isinstance(value, list) or not value:
        raise vector.mismatch(value)
    return tuple(map(entry, value))


@value_type(
    "formula or list",
    "a number or a formula, or a list of these, one for each coordinate of a joint",
    {"anyOf": [_FORMULA, _array(_FORMULA)]},
)
def scalar_or_list(value: object) -> Value | tuple[Value, ...]:
    """Convert a list of numbers and formulas to a tuple; a single value is returned as it is."""
    return tuple(map(entry, value)) if isinstance(value, list) else entry(value)


@value_type(
    "rotation",
    'a list of turns, each an axis and an angle, such as [["z", "pi/2"]]',
    {"anyOf": [_FORMULA, _array(_TURN)]},
)
def rotation(value: object) -> Value | tuple[tuple[str, Value], ...]:
    """Convert an angle, or a list of turns such as [["z", "pi/2"]].

    Returns the angle, or a tuple of pairs (axis, angle). Angles are numbers or formulas in rad.
    """
    if not isinstance(value, list):
        return entry(value)
    for turn in value:
        if not (isinstance(turn, list) and len(turn) == 2 and turn[0] in ("x", "y", "z")):
            raise rotation.mismatch(value)
    return tuple((axis, entry(angle)) for axis, angle in value)


_AXIS = _array({"type": "number"}, 1)


@value_type(
    "axis",
    "a list of numbers, such as [0, 0, 1]",
    {"anyOf": [_AXIS, _array(_AXIS, 1)]},
)
def axes(value: object) -> tuple[tuple[float, ...], ...]:
    """Convert one axis, such as [0, 0, 1], or a list of axes, to a tuple of axes."""
    several = isinstance(value, list) and value and isinstance(value[0], list)
    out: list[Any] = value if several else [value]  # type: ignore[assignment]
    for axis in out:
        if not (isinstance(axis, list) and axis and all(map(_is_number, axis))):
            raise axes.mismatch(value)
    return tuple(tuple(map(float, axis)) for axis in out)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e100


@value_type(
    "limits",
    "the least and the largest value, such as [-1, 1] or [0, inf]",
    _array(_FORMULA, 2, 2),
)
def limits(value: object) -> tuple[Value | None, ...]:
    """Convert a pair of limits, such as [-1, 1] or [0, inf].

    Returns the smallest and the largest value, each a number, a formula, or None if infinite.
    """
    if not (isinstance(value, list) and len(value) == 2):
        raise limits.mismatch(value)
    unbounded = (("-inf", -math.inf), ("inf", "+inf", math.inf))
    return tuple(None if x in none else entry(x) for x, none in zip(value, unbounded, strict=True))


@value_type("two points", 'two points, such as [[0, 0], ["l", 0]]', _array(_VECTOR, 2, 2))
def points(value: object) -> tuple[tuple[Value, ...], ...]:
    """Convert a list of two points to a tuple of two vectors."""
    if not (isinstance(value, list) and len(value) == 2):
        raise points.mismatch(value)
    return tuple(map(vector, value))


# --- names and texts ------------------------------------------------------------------------------

_TEXT = {"type": "string"}


@value_type("names", "a name in quotes, or a list of names", {"anyOf": [_TEXT, _array(_TEXT)]})
def names(value: object) -> tuple[str, ...]:
    """Convert a name or a list of names to a tuple."""
    names_ = value if isinstance(value, list) else [value]
    if not all(isinstance(name, str) for name in names_):
        raise names.mismatch(value)
    return tuple(names_)


def two_names(what: str) -> ValueType[tuple[str, ...]]:
    """Return the type of a list of two names.

    what: what they name, with an example, such as 'bodies, such as ["world", "cart"]'.
    """

    def convert(value: object) -> tuple[str, ...]:
        if len(names_ := names(value)) != 2:
            raise ValueError(f"must name two {what}, here {short_toml(value)}")
        return names_

    return ValueType("two names", f"the names of two {what}", _array(_TEXT, 2, 2), convert)


@value_type("text", "text in quotes", _TEXT)
def text(value: object) -> str:
    """Check that a value is a text."""
    if isinstance(value, str):
        return value
    raise text.mismatch(value)


@value_type("line", "text in quotes, in one line", _TEXT)
def line(value: object) -> str:
    """Check that a value is a text in one line without hidden characters."""
    return texts.checked_line(text(value))


@value_type("text", "text in quotes", _TEXT)
def note(value: object) -> str:
    """Check that a value is a text without hidden characters."""
    return texts.checked_lines(text(value))


@value_type("true or false", "true or false", {"type": "boolean"})
def flag(value: object) -> bool:
    """Check that a value is true or false."""
    if isinstance(value, bool):
        return value
    raise flag.mismatch(value)


def choice(what: str, words: Sequence[str]) -> ValueType[str]:
    """Return the type of one of some words. what: what the word names, for the message."""

    def convert(value: object) -> str:
        if value in words:
            return str(value)
        raise ValueError(f"unknown {what} {short_toml(value)}: known are {', '.join(words)}")

    name = ", ".join(f'"{word}"' for word in words)
    return ValueType(name, f"one of {name}", {"enum": [*words]}, convert)


@value_type("1", "the version of the format, 1", {"const": 1})
def version(value: object) -> int:
    """Check that a value is the version 1 of the format."""
    if value != 1 or isinstance(value, bool):
        here = short_toml(value)
        raise ValueError(f"format {here} is not known to this version, which reads eomc = 1")
    return 1


# --- [run] ---------------------------------------------------------------------------------------


@value_type(
    'true, false, "parameters", "products"',
    'true, false, "parameters" or "products"',
    {"enum": [True, False, "parameters", "products"]},
)
def linearization(value: object) -> bool | str:
    """Check the value of `linearize` in [run]."""
    if isinstance(value, bool) or value in ("parameters", "products"):
        return value
    raise linearization.mismatch(value)


@value_type(
    "true, false, names",
    'true, or a list of bodies and points such as ["tip"]',
    {"anyOf": [{"type": "boolean"}, _array(_TEXT)]},
)
def frame_selection(value: object) -> bool | tuple[str, ...]:
    """Convert the value of `frames` in [run]: a bool for all or none, else a tuple of names."""
    if isinstance(value, bool):
        return value
    if isinstance(value, list) and all(isinstance(name, str) for name in value):
        return tuple(dict.fromkeys(value))
    raise frame_selection.mismatch(value)


@value_type("number > 0", "greater than zero", {"type": "number", "exclusiveMinimum": 0})
def positive(value: object) -> float:
    """Check that a value is a positive, finite number, and return it as float."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        here = f"{short_toml(value)}{hints.number_remedy(value)}"
        raise ValueError(f"must be a number, here {here}")
    if value <= 0:
        raise positive.mismatch(value)
    return float(entry(value))  # type: ignore[arg-type]  # finite


@value_type(
    "number",
    "a number from 1e-15 to 1e-2",
    {"type": "number", "minimum": MIN_TOLERANCE, "maximum": MAX_TOLERANCE},
)
def tolerance(value: object) -> float:
    """Check that a value is a tolerance of adaptive steps."""
    if isinstance(value, (int, float)) and MIN_TOLERANCE <= value <= MAX_TOLERANCE:
        return float(value)
    raise tolerance.mismatch(value)


METHOD = choice("method", (*METHODS, "auto"))


@value_type(
    "method, or a list",
    f"a method, or a list of methods: {METHOD.name}",
    {"anyOf": [METHOD.json_schema, _array(METHOD.json_schema, 1)]},
)
def methods(value: object) -> tuple[str, ...]:
    """Convert the name of a stepper or a list of names to a tuple; the first is the default."""
    each = value if isinstance(value, list) and value else [value]
    return tuple(dict.fromkeys(map(METHOD, each)))


# --- [picture] ------------------------------------------------------------------------------------

Place = str | tuple[Value, ...]  # a name, or a vector
Solid = tuple[Place, tuple[Value, ...], object]  # place, size, rotation
_PLACE = {"anyOf": [_TEXT, _VECTOR]}


@value_type(
    "vectors by name",
    'a table, such as { tip = ["x", "l*cos(theta)"] }',
    {"type": "object", "additionalProperties": _VECTOR},
)
def named_points(value: object) -> dict[str, tuple[Value, ...]]:
    """Convert a table of points; returns their vectors by name."""
    if not isinstance(value, dict):
        raise named_points.mismatch(value)
    return {name: vector(entries) for name, entries in value.items()}


def _place(value: object) -> Place:
    return value if isinstance(value, str) else vector(value)


@value_type("points", 'a list of points, such as ["tip"]', _array(_PLACE))
def places(value: object) -> tuple[Place, ...]:
    """Convert a list of points, each a name or a vector, to a tuple."""
    if not isinstance(value, list):
        raise places.mismatch(value)
    return tuple(map(_place, value))


@value_type(
    "lists of points",
    'a list of lines, such as [["cart", "tip"]]',
    _array(_array(_PLACE, 2)),
)
def lines(value: object) -> tuple[tuple[Place, ...], ...]:
    """Convert a list of lines, each through two points or more (names or vectors)."""
    if not isinstance(value, list):
        raise lines.mismatch(value)
    for line in value:
        if not (isinstance(line, list) and len(line) >= 2):
            what = f"{lines.words}, each through two points or more: {short_toml(line)}"
            raise ValueError(f"must be {what}")
    return tuple(map(places, value))


@value_type(
    "pairs of points",
    'a list of pairs of points, such as [["cart", "tip"]]',
    _array(_array(_PLACE, 2, 2)),
)
def ends(value: object) -> tuple[tuple[Place, ...], ...]:
    """Convert a list of pairs of points, such as the ends of springs."""
    for pair in (pairs := lines(value)):
        if len(pair) != 2:
            raise ValueError(f"each goes from a point to another, here there are {len(pair)}")
    return pairs


def solids(size: str, example: str) -> ValueType[tuple[Solid, ...]]:
    """Return the type of a list of boxes or circles.

    Their values are converted to tuples (centre, edges or radius, rotation), where the rotation is
    None if it is not written.

    size: the key of their size, "size" for the edges of a box or "radius". example: one of them.
    """
    words = f"a list of tables with at, {size} and perhaps rotation, such as [{example}]"
    size_type: ValueType[Any] = vector if size == "size" else entry
    solid = {
        "type": "object",
        "properties": {
            "at": _PLACE,
            size: size_type.json_schema,
            "rotation": rotation.json_schema,
        },
        "required": ["at", size],
        "additionalProperties": False,
    }

    def convert(value: object) -> tuple[Solid, ...]:
        out = []
        tables: list[Any] = value if isinstance(value, list) else [value]
        for table in tables:
            keys = table.keys() if isinstance(table, dict) else set()
            if not {"at", size} <= keys <= {"at", size, "rotation"}:
                raise expected(words, table)
            large = vector(table[size]) if size == "size" else (entry(table[size]),)
            turned = rotation(table["rotation"]) if "rotation" in table else None
            out.append((_place(table["at"]), large, turned))
        return tuple(out)

    return ValueType("tables", words, {"anyOf": [solid, _array(solid)]}, convert)


@value_type(
    '"xy", "xz", "yz"',
    '"xy", "xz" or "yz", what is drawn to the right and upwards',
    {"enum": ["xy", "xz", "yz"]},
)
def plane_axes(value: object) -> str:
    """Check that a value is the axes of a plane picture: to the right and upwards."""
    if value in plane_axes.json_schema["enum"]:
        return str(value)
    raise plane_axes.mismatch(value)


@value_type(
    '"world", "body"',
    '"world" or "body", whose axes the entries are along',
    {"enum": ["world", "body"]},
)
def frame(value: object) -> str:
    """Check that a value is the frame along whose axes vectors are given."""
    if value in ("world", "body"):
        return str(value)
    raise frame.mismatch(value)
