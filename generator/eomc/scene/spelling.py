"""Values of a scene that may be written in several ways; ValueErrors say what is wrong."""

from __future__ import annotations

import math
from typing import Any


def toml(value: object) -> str:
    """A value as TOML writes it, shortened."""
    if isinstance(value, bool):
        text = str(value).lower()
    elif isinstance(value, dict):
        text = "a table"
    else:
        text = repr(value) if isinstance(value, (str, list, float, int)) else str(value)
    return text if len(text) <= 40 else text[:37] + "..."


def entry(value: object) -> float | str:
    """A number or a formula."""
    if isinstance(value, str):
        return value
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            if math.isfinite(number := float(value)):
                return number
        except OverflowError:
            pass
        raise ValueError(f"must be a finite number, here {toml(value)}")
    raise ValueError(f"must be a number or a formula in quotes, here {toml(value)}")


def vector(value: object) -> tuple[float | str, ...]:
    """A list of numbers and formulas."""
    if not isinstance(value, list) or not value:
        raise ValueError(
            f"must be a list of numbers and formulas, such as [0, 1.5], here {toml(value)}"
        )
    return tuple(map(entry, value))


def each(value: object) -> float | str | tuple[float | str, ...]:
    """One for all, or a list of one each."""
    return tuple(map(entry, value)) if isinstance(value, list) else entry(value)


def rotation(value: object) -> float | str | tuple[tuple[str, float | str], ...]:
    """An angle, or a list of turns: an axis and an angle each."""
    if not isinstance(value, list):
        return entry(value)
    turns = []
    for turn in value:
        if not (isinstance(turn, list) and len(turn) == 2 and turn[0] in ("x", "y", "z")):
            raise ValueError(
                'must be a list of turns, each an axis and an angle, such as [["z", "pi/2"]], '
                f"here {toml(value)}"
            )
        turns.append((turn[0], entry(turn[1])))
    return tuple(turns)


def axes(value: object) -> tuple[tuple[float, ...], ...]:
    """Axes; one may be written without the outer brackets."""
    axes: list[Any] = [value]
    if isinstance(value, list) and value and isinstance(value[0], list):
        axes = value
    for axis in axes:
        if not (isinstance(axis, list) and axis and all(map(_is_number, axis))):
            raise ValueError(f"must be a list of numbers, such as [0, 0, 1], here {toml(value)}")
    return tuple(tuple(float(entry) for entry in axis) for axis in axes)


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) < 1e100


def limits(value: object) -> tuple[float | str | None, ...]:
    """The least and the largest value; None for an infinite one."""
    if not (isinstance(value, list) and len(value) == 2):
        raise ValueError(
            "must be the least and the largest value, such as [-1, 1] or [0, inf], "
            f"here {toml(value)}"
        )
    unbounded = (("-inf", -math.inf), ("inf", "+inf", math.inf))
    return tuple(None if x in none else entry(x) for x, none in zip(value, unbounded, strict=True))


def names(value: object) -> tuple[str, ...]:
    """A name, or a list of names."""
    given = value if isinstance(value, list) else [value]
    if not all(isinstance(name, str) for name in given):
        raise ValueError(f"must be a name in quotes, or a list of names, here {toml(value)}")
    return tuple(given)


def two_names(value: object) -> tuple[str, ...]:
    """Two bodies."""
    found = names(value)
    if len(found) != 2:
        raise ValueError(f'must name two bodies, such as ["world", "cart"], here {toml(value)}')
    return found


def points(value: object) -> tuple[tuple[float | str, ...], ...]:
    """Two points."""
    if not (isinstance(value, list) and len(value) == 2):
        raise ValueError(f'must be two points, such as [[0, 0], ["l", 0]], here {toml(value)}')
    return tuple(map(vector, value))
