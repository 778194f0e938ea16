"""Parsers of values that may be written in several ways; each raises ValueError with a remedy."""

from __future__ import annotations

import math
from typing import Any


def short_toml(value: object) -> str:
    """Return a value as it is written in TOML, shortened to 40 characters, for messages."""
    if isinstance(value, bool):
        text = str(value).lower()
    elif isinstance(value, dict):
        text = "a table"
    else:
        text = repr(value) if isinstance(value, (str, list, float, int)) else str(value)
    return text if len(text) <= 40 else text[:37] + "..."


def entry(value: object) -> float | str:
    """Check that a TOML value is a finite number or a text (a formula), and return it.

    Numbers are returned as float. Raises ValueError otherwise.
    """
    if isinstance(value, str):
        return value
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            if math.isfinite(number := float(value)):
                return number
        except OverflowError:
            pass
        raise ValueError(f"must be a finite number, here {short_toml(value)}")
    raise ValueError(f"must be a number or a formula in quotes, here {short_toml(value)}")


def vector(value: object) -> tuple[float | str, ...]:
    """Check that a TOML value is a list of numbers and formulas, and return it as a tuple.

    Raises ValueError otherwise.
    """
    if not isinstance(value, list) or not value:
        raise ValueError(
            f"must be a list of numbers and formulas, such as [0, 1.5], here {short_toml(value)}"
        )
    return tuple(map(entry, value))


def each(value: object) -> float | str | tuple[float | str, ...]:
    """Check that a TOML value is a number or formula, or a list of these.

    Returns the single value, or a tuple with the values of the list, such as one for each
    coordinate of a joint. Raises ValueError otherwise.
    """
    return tuple(map(entry, value)) if isinstance(value, list) else entry(value)


def rotation(value: object) -> float | str | tuple[tuple[str, float | str], ...]:
    """Check that a TOML value is an angle, or a list of turns such as [["z", "pi/2"]].

    Returns the angle, or a tuple of pairs (axis, angle). Angles are numbers or formulas in rad.
    Raises ValueError otherwise.
    """
    if not isinstance(value, list):
        return entry(value)
    turns = []
    for turn in value:
        if not (isinstance(turn, list) and len(turn) == 2 and turn[0] in ("x", "y", "z")):
            raise ValueError(
                'must be a list of turns, each an axis and an angle, such as [["z", "pi/2"]], '
                f"here {short_toml(value)}"
            )
        turns.append((turn[0], entry(turn[1])))
    return tuple(turns)


def axes(value: object) -> tuple[tuple[float, ...], ...]:
    """Check that a TOML value is one axis, such as [0, 0, 1], or a list of axes.

    Returns a tuple of axes, each a tuple of floats. Raises ValueError otherwise.
    """
    axes: list[Any] = [value]
    if isinstance(value, list) and value and isinstance(value[0], list):
        axes = value
    for axis in axes:
        if not (isinstance(axis, list) and axis and all(map(_is_number, axis))):
            raise ValueError(
                f"must be a list of numbers, such as [0, 0, 1], here {short_toml(value)}"
            )
    return tuple(tuple(float(entry) for entry in axis) for axis in axes)


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) < 1e100


def limits(value: object) -> tuple[float | str | None, ...]:
    """Check that a TOML value is a pair of limits, such as [-1, 1] or [0, inf].

    Returns the smallest and the largest value, each a number, a formula, or None if infinite.
    Raises ValueError otherwise.
    """
    if not (isinstance(value, list) and len(value) == 2):
        raise ValueError(
            "must be the least and the largest value, such as [-1, 1] or [0, inf], "
            f"here {short_toml(value)}"
        )
    unbounded = (("-inf", -math.inf), ("inf", "+inf", math.inf))
    return tuple(None if x in none else entry(x) for x, none in zip(value, unbounded, strict=True))


def names(value: object) -> tuple[str, ...]:
    """Check that a TOML value is a name or a list of names, and return a tuple of the names.

    Raises ValueError otherwise.
    """
    names_ = value if isinstance(value, list) else [value]
    if not all(isinstance(name, str) for name in names_):
        raise ValueError(f"must be a name in quotes, or a list of names, here {short_toml(value)}")
    return tuple(names_)


def two_names(value: object) -> tuple[str, ...]:
    """Check that a TOML value is a list of the names of two bodies, and return it as a tuple.

    Raises ValueError otherwise. The bodies need not exist.
    """
    names_ = names(value)
    if len(names_) != 2:
        raise ValueError(
            f'must name two bodies, such as ["world", "cart"], here {short_toml(value)}'
        )
    return names_


def two_coordinates(value: object) -> tuple[str, ...]:
    """Check that a TOML value is a list of the names of two coordinates; return it as a tuple.

    Raises ValueError otherwise. The coordinates need not exist.
    """
    names_ = names(value)
    if len(names_) != 2:
        raise ValueError(
            f'must name two coordinates, such as ["phi", "psi"], here {short_toml(value)}'
        )
    return names_


def points(value: object) -> tuple[tuple[float | str, ...], ...]:
    """Check that a TOML value is a list of two points, such as [[0, 0], ["l", 0]].

    Returns a tuple of two vectors of numbers and formulas. Raises ValueError otherwise.
    """
    if not (isinstance(value, list) and len(value) == 2):
        raise ValueError(
            f'must be two points, such as [[0, 0], ["l", 0]], here {short_toml(value)}'
        )
    return tuple(map(vector, value))


# --- [run] ---------------------------------------------------------------------------------------


def linearized(value: object) -> bool | str:
    """Check the value of `linearize` in [run]: true, false or "parameters"; return it.

    Raises ValueError otherwise.
    """
    if isinstance(value, bool) or value == "parameters":
        return value
    raise ValueError(f'must be true, false or "parameters", here {short_toml(value)}')


def frame_selection(value: object) -> bool | tuple[str, ...]:
    """Check the value of `frames` in [run]: true, false or a list of names of bodies and points.

    Returns a bool (all frames or none), or a tuple of the names. Raises ValueError otherwise.
    """
    if isinstance(value, bool):
        return value
    if isinstance(value, list) and all(isinstance(name, str) for name in value):
        return tuple(dict.fromkeys(value))
    example = 'true, or a list of bodies and points such as ["tip"]'
    raise ValueError(f"must be {example}, here {short_toml(value)}")


# --- [picture] ------------------------------------------------------------------------------------

Place = str | tuple[float | str, ...]  # a name, or a vector


def named_points(value: object) -> dict[str, tuple[float | str, ...]]:
    """Check that a TOML value is a table of points, and return their vectors by name.

    Each vector is a tuple of numbers and formulas. Raises ValueError otherwise.
    """
    if not isinstance(value, dict):
        raise ValueError(
            f'must be a table, such as {{ tip = ["x", "l*cos(theta)"] }}, here {short_toml(value)}'
        )
    return {name: vector(entries) for name, entries in value.items()}


def _place(value: object) -> Place:
    return value if isinstance(value, str) else vector(value)


def places(value: object) -> tuple[Place, ...]:
    """Check that a TOML value is a list of points, each a name or a vector; return it as a tuple.

    Raises ValueError otherwise.
    """
    if not isinstance(value, list):
        raise ValueError(f'must be a list of points, such as ["tip"], here {short_toml(value)}')
    return tuple(map(_place, value))


def lines(value: object) -> tuple[tuple[Place, ...], ...]:
    """Check that a TOML value is a list of lines, each a list of two points or more.

    Returns a tuple of lines, each a tuple of points (names or vectors). Raises ValueError
    otherwise.
    """
    example = 'a list of lines, such as [["cart", "tip"]]'
    if not isinstance(value, list):
        raise ValueError(f"must be {example}, here {short_toml(value)}")
    for line in value:
        if not (isinstance(line, list) and len(line) >= 2):
            raise ValueError(
                f"must be {example}, each through two points or more: {short_toml(line)}"
            )
    return tuple(map(places, value))


def ends(value: object) -> tuple[tuple[Place, ...], ...]:
    """Check that a TOML value is a list of pairs of points, such as the ends of springs.

    Returns a tuple of pairs of points (names or vectors). Raises ValueError otherwise.
    """
    pairs = lines(value)
    for pair in pairs:
        if len(pair) != 2:
            raise ValueError(f"each goes from a point to another, here there are {len(pair)}")
    return pairs


Solid = tuple[Place, tuple[float | str, ...], object]  # place, size, rotation


def boxes(value: object) -> tuple[Solid, ...]:
    """Check that a TOML value is a list of boxes, such as { at = "cart", size = [0.4, 0.2] }.

    Returns a tuple of (centre, edges, rotation), where the rotation is None if it is not given.
    Raises ValueError otherwise.
    """
    return _solids(value, "size", '{ at = "cart", size = [0.4, 0.2] }')


def circles(value: object) -> tuple[Solid, ...]:
    """Check that a TOML value is a list of circles, such as { at = "wheel", radius = 0.1 }.

    Returns a tuple of (centre, (radius,), rotation), where the rotation is None if it is not given.
    Raises ValueError otherwise.
    """
    return _solids(value, "radius", '{ at = "wheel", radius = 0.1 }')


def _solids(value: object, size: str, example: str) -> tuple[Solid, ...]:
    keys = ("at", size, "rotation")
    out = []
    for table in value if isinstance(value, list) else [value]:
        if not isinstance(table, dict) or not {"at", size} <= table.keys() <= {*keys}:
            raise ValueError(
                f"must be a list of tables with {keys[0]}, {keys[1]} and perhaps {keys[2]}, "
                f"such as [{example}], here {short_toml(table)}"
            )
        extent = table[size]
        large = vector(extent) if size == "size" else (entry(extent),)
        turned = rotation(table["rotation"]) if "rotation" in table else None
        out.append((_place(table["at"]), large, turned))
    return tuple(out)


def plane_axes(value: object) -> str:
    """Check that a TOML value is "xy", "xz" or "yz", the axes of a plane picture; return it.

    The first axis is drawn to the right, the second upwards. Raises ValueError otherwise.
    """
    if value in ("xy", "xz", "yz"):
        return str(value)
    raise ValueError(
        'must be "xy", "xz" or "yz", what is drawn to the right and upwards, '
        f"here {short_toml(value)}"
    )
