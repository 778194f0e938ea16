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


def array(
    name: str, words: str, item: ValueType[T], least: int = 0, most: int | None = None
) -> ValueType[tuple[T, ...]]:
    """Return the type of a list of `least` to `most` values of another type, a tuple."""
    bounds = {"minItems": least} if least else {}
    bounds |= {"maxItems": most} if most else {}

    def convert(value: object) -> tuple[T, ...]:
        if not isinstance(value, list) or not least <= len(value) <= (most or len(value)):
            raise expected(words, value)
        return tuple(map(item, value))

    return ValueType(name, words, {"type": "array", "items": item.json_schema, **bounds}, convert)


# --- numbers, formulas and vectors ----------------------------------------------------------------


@value_type("formula", "a number or a formula in quotes", {"type": ["number", "string"]})
def entry(value: object) -> Value:
    """Check that a value is a finite number or a formula; numbers are returned as float."""
    if isinstance(value, (str, Formula)):
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise entry.mismatch(value)
    if not abs(value) < math.inf or abs(value) > sys.float_info.max:
        raise expected("a finite number", value)
    return float(value)


vector = array("vector", "a list of numbers and formulas, such as [0, 1.5]", entry, 1)
points = array("two points", 'two points, such as [[0, 0], ["l", 0]]', vector, 2, 2)
_entries = array("list", "a list of numbers and formulas", entry)


@value_type(
    "formula or list",
    "a number or a formula, or a list of these, one for each coordinate of a joint",
    {"anyOf": [entry.json_schema, _entries.json_schema]},
)
def scalar_or_list(value: object) -> Value | tuple[Value, ...]:
    """Convert a list of numbers and formulas to a tuple; a single value is returned as it is."""
    return _entries(value) if isinstance(value, list) else entry(value)


_TURN = {
    "type": "array",
    "items": [{"enum": ["x", "y", "z"]}, entry.json_schema],
    "minItems": 2,
    "maxItems": 2,
}


@value_type(
    "rotation",
    'a list of turns, each an axis and an angle, such as [["z", "pi/2"]]',
    {"anyOf": [entry.json_schema, {"type": "array", "items": _TURN}]},
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


_AXIS = {"type": "array", "items": {"type": "number"}, "minItems": 1}


@value_type(
    "axis",
    "a list of numbers, such as [0, 0, 1]",
    {"anyOf": [_AXIS, {"type": "array", "items": _AXIS, "minItems": 1}]},
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


_PAIR = array("pair", "the least and the largest value, such as [-1, 1] or [0, inf]", entry, 2, 2)


@value_type("limits", _PAIR.words, _PAIR.json_schema)
def limits(value: object) -> tuple[Value | None, ...]:
    """Convert a pair of limits, such as [-1, 1] or [0, inf].

    Returns the smallest and the largest value, each a number, a formula, or None if infinite.
    """
    if not (isinstance(value, list) and len(value) == 2):
        raise limits.mismatch(value)
    unbounded = (("-inf", -math.inf), ("inf", "+inf", math.inf))
    return tuple(None if x in none else entry(x) for x, none in zip(value, unbounded, strict=True))


# --- names and texts ------------------------------------------------------------------------------


@value_type("text", "text in quotes", {"type": "string"})
def text(value: object) -> str:
    """Check that a value is a text."""
    if isinstance(value, str):
        return value
    raise text.mismatch(value)


@value_type("line", "text in quotes, in one line", text.json_schema)
def line(value: object) -> str:
    """Check that a value is a text in one line without hidden characters."""
    return texts.checked_line(text(value))


@value_type("text", "text in quotes", text.json_schema)
def note(value: object) -> str:
    """Check that a value is a text without hidden characters."""
    return texts.checked_lines(text(value))


_names = array("names", "a list of names", text)


@value_type(
    "names",
    "a name in quotes, or a list of names",
    {"anyOf": [text.json_schema, _names.json_schema]},
)
def names(value: object) -> tuple[str, ...]:
    """Convert a name or a list of names to a tuple."""
    if not isinstance(value, (str, list)):
        raise names.mismatch(value)
    return _names(value if isinstance(value, list) else [value])


def two_names(what: str) -> ValueType[tuple[str, ...]]:
    """Return the type of a list of two names.

    what: what they name, with an example, such as 'bodies, such as ["world", "cart"]'.
    """
    return array("two names", f"the names of two {what}", text, 2, 2)


@value_type("true or false", "true or false", {"type": "boolean"})
def flag(value: object) -> bool:
    """Check that a value is true or false."""
    if isinstance(value, bool):
        return value
    raise flag.mismatch(value)


def choice(what: str, values: Sequence[T]) -> ValueType[T]:
    """Return the type of one of some texts, true and false; what: what the values choose."""

    def convert(value: object) -> T:
        for each in values:
            if value == each and type(value) is type(each):
                return each
        known = ", ".join(str(x).lower() if isinstance(x, bool) else str(x) for x in values)
        raise ValueError(f"unknown {what} {short_toml(value)}: known are {known}")

    name = ", ".join(str(x).lower() if isinstance(x, bool) else f'"{x}"' for x in values)
    return ValueType(name, f"one of {name}", {"enum": [*values]}, convert)


@value_type("1", "the version of the format, 1", {"const": 1})
def version(value: object) -> int:
    """Check that a value is the version 1 of the format."""
    if value != 1 or isinstance(value, bool):
        here = short_toml(value)
        raise ValueError(f"format {here} is not known to this version, which reads eomc = 1")
    return 1


# --- [run] ---------------------------------------------------------------------------------------


_frames = array("names", 'true, or a list of bodies and points such as ["tip"]', text)


@value_type("true, false, names", _frames.words, {"anyOf": [flag.json_schema, _frames.json_schema]})
def frame_selection(value: object) -> bool | tuple[str, ...]:
    """Convert the value of `frames` in [run]: a bool for all or none, else a tuple of names."""
    return value if isinstance(value, bool) else tuple(dict.fromkeys(_frames(value)))


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
_methods = array("methods", "a list of methods", METHOD, 1)


@value_type(
    "method, or a list",
    f"a method, or a list of methods: {METHOD.name}",
    {"anyOf": [METHOD.json_schema, _methods.json_schema]},
)
def methods(value: object) -> tuple[str, ...]:
    """Convert the name of a stepper or a list of names to a tuple; the first is the default."""
    return tuple(dict.fromkeys(_methods(value if isinstance(value, list) and value else [value])))


# --- [picture] ------------------------------------------------------------------------------------

Place = str | tuple[Value, ...]  # a name, or a vector
Solid = tuple[Place, tuple[Value, ...], object]  # place, size, rotation


@value_type(
    "vectors by name",
    'a table, such as { tip = ["x", "l*cos(theta)"] }',
    {"type": "object", "additionalProperties": vector.json_schema},
)
def named_points(value: object) -> dict[str, tuple[Value, ...]]:
    """Convert a table of points; returns their vectors by name."""
    if not isinstance(value, dict):
        raise named_points.mismatch(value)
    return {name: vector(entries) for name, entries in value.items()}


@value_type("point", "a point", {"anyOf": [text.json_schema, vector.json_schema]})
def place(value: object) -> Place:
    """Convert a point, a name or a vector."""
    return value if isinstance(value, str) else vector(value)


_LINES = 'a list of lines, such as [["cart", "tip"]], each through two points or more'
_SPRINGS = 'a list of springs, such as [["cart", "tip"]], each from a point to another'
places = array("points", 'a list of points, such as ["tip"]', place)
lines = array("lists of points", _LINES, array("points", _LINES, place, 2))
ends = array("pairs of points", _SPRINGS, array("points", _SPRINGS, place, 2, 2))


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
            "at": place.json_schema,
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
            out.append((place(table["at"]), large, turned))
        return tuple(out)

    return ValueType(
        "tables", words, {"anyOf": [solid, {"type": "array", "items": solid}]}, convert
    )
