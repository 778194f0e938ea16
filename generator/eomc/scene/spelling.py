"""Parsers of values that may be written in several ways; each raises ValueError with a remedy."""

from __future__ import annotations

import math
from typing import Any


def short_toml(value: object) -> str:
    """Return a value as TOML, shortened."""
    if isinstance(value, bool):
        text = str(value).lower()
    elif isinstance(value, dict):
        text = "a table"
    else:
        text = repr(value) if isinstance(value, (str, list, float, int)) else str(value)
    return text if len(text) <= 40 else text[:37] + "..."


def entry(value: object) -> float | str:
    """Return a number or formula."""
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
    """Return a list of numbers and formulas as a tuple."""
    if not isinstance(value, list) or not value:
        raise ValueError(
            f"must be a list of numbers and formulas, such as [0, 1.5], here {short_toml(value)}"
        )
    return tuple(map(entry, value))


def each(value: object) -> float | str | tuple[float | str, ...]:
    """Return one value for all, or a tuple with one value each."""
    return tuple(map(entry, value)) if isinstance(value, list) else entry(value)


def rotation(value: object) -> float | str | tuple[tuple[str, float | str], ...]:
    """Return an angle, or a list of turns, each with an axis and an angle."""
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
    """Return one or more axes; a single one may be written without outer brackets."""
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
    """Return the smallest and largest value, None if infinite."""
    if not (isinstance(value, list) and len(value) == 2):
        raise ValueError(
            "must be the least and the largest value, such as [-1, 1] or [0, inf], "
            f"here {short_toml(value)}"
        )
    unbounded = (("-inf", -math.inf), ("inf", "+inf", math.inf))
    return tuple(None if x in none else entry(x) for x, none in zip(value, unbounded, strict=True))


def names(value: object) -> tuple[str, ...]:
    """Return a name or a list of names as a tuple."""
    names_ = value if isinstance(value, list) else [value]
    if not all(isinstance(name, str) for name in names_):
        raise ValueError(f"must be a name in quotes, or a list of names, here {short_toml(value)}")
    return tuple(names_)


def two_names(value: object) -> tuple[str, ...]:
    """Return the names of two bodies."""
    names_ = names(value)
    if len(names_) != 2:
        raise ValueError(
            f'must name two bodies, such as ["world", "cart"], here {short_toml(value)}'
        )
    return names_


def two_coordinates(value: object) -> tuple[str, ...]:
    """Return the names of two coordinates."""
    names_ = names(value)
    if len(names_) != 2:
        raise ValueError(
            f'must name two coordinates, such as ["phi", "psi"], here {short_toml(value)}'
        )
    return names_


def points(value: object) -> tuple[tuple[float | str, ...], ...]:
    """Return two points."""
    if not (isinstance(value, list) and len(value) == 2):
        raise ValueError(
            f'must be two points, such as [[0, 0], ["l", 0]], here {short_toml(value)}'
        )
    return tuple(map(vector, value))


# --- [run] ---------------------------------------------------------------------------------------


def linearized(value: object) -> bool | str:
    """Return whether derivatives are generated, "parameters" for those by parameters too."""
    if isinstance(value, bool) or value == "parameters":
        return value
    raise ValueError(f'must be true, false or "parameters", here {short_toml(value)}')


def frame_selection(value: object) -> bool | tuple[str, ...]:
    """Return True for all frames, False for none, or a tuple of names."""
    if isinstance(value, bool):
        return value
    if isinstance(value, list) and all(isinstance(name, str) for name in value):
        return tuple(dict.fromkeys(value))
    example = 'true, or a list of bodies and points such as ["tip"]'
    raise ValueError(f"must be {example}, here {short_toml(value)}")


# --- [picture] ------------------------------------------------------------------------------------

Place = str | tuple[float | str, ...]  # a name, or a vector


def named_points(value: object) -> dict[str, tuple[float | str, ...]]:
    """Return a table of vectors."""
    if not isinstance(value, dict):
        raise ValueError(
            f'must be a table, such as {{ tip = ["x", "l*cos(theta)"] }}, here {short_toml(value)}'
        )
    return {name: vector(entries) for name, entries in value.items()}


def _place(value: object) -> Place:
    return value if isinstance(value, str) else vector(value)


def places(value: object) -> tuple[Place, ...]:
    """Return a list of points, each a name or a vector."""
    if not isinstance(value, list):
        raise ValueError(f'must be a list of points, such as ["tip"], here {short_toml(value)}')
    return tuple(map(_place, value))


def lines(value: object) -> tuple[tuple[Place, ...], ...]:
    """Return a list of lines, each through two points or more."""
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
    """Return a list of pairs of points."""
    pairs = lines(value)
    for pair in pairs:
        if len(pair) != 2:
            raise ValueError(f"each goes from a point to another, here there are {len(pair)}")
    return pairs


Solid = tuple[Place, tuple[float | str, ...], object]  # place, size, rotation


def boxes(value: object) -> tuple[Solid, ...]:
    """Return a list of boxes."""
    return _solids(value, "size", '{ at = "cart", size = [0.4, 0.2] }')


def circles(value: object) -> tuple[Solid, ...]:
    """Return a list of circles."""
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
    """Return the names of the axes of a plane picture."""
    if value in ("xy", "xz", "yz"):
        return str(value)
    raise ValueError(
        'must be "xy", "xz" or "yz", what is drawn to the right and upwards, '
        f"here {short_toml(value)}"
    )
