"""Statements over the coordinates of a vector: members of a struct, or an array in a loop."""

from __future__ import annotations

from collections.abc import Sequence

from eomc.target import Target


def each(target: Target, large: bool, lines: Sequence[str], index: str = "i") -> list[str]:
    """Statements for every coordinate: $ is its member of a vector, # its place in an array."""
    if large:
        inside = [line.replace("$", f"x[{index}]").replace("#", index) for line in lines]
        return loop(index, f"{target.PREFIX}_NQ", inside)
    return [
        line.replace("$", name).replace("#", target.enum[name])
        for name in target.names
        for line in lines
    ]


def rows(target: Target, large: bool) -> list[str]:
    """The state into the present rows."""
    both = ("q_rows", "at"), ("qd_rows", "moving")
    if large:
        return each(target, True, [f"{row}[#] = {x}.$;" for row, x in both])
    return [f"{row}[{k}] = {x}.{name};" for k, name in enumerate(target.names) for row, x in both]


def loop(index: str, end: str, inside: Sequence[str]) -> list[str]:
    """Statements for every index below an end."""
    brace = len(inside) > 1
    head = f"for (int {index} = 0; {index} < {end}; {index}++)" + " {" * brace
    return [head, *(f"    {line}" for line in inside), *(["}"] if brace else [])]


def gathered(target: Target, large: bool, of: str, name: str) -> str:
    """The numbers of a vector as an array."""
    inside = ", ".join(
        f"{of}->x[{target.enum[n]}]" if large else f"{of}->{n}" for n in target.names
    )
    return f"const {target.real.name} {name}[{target.PREFIX}_NQ] = {{ {inside} }};"


def vector_of(target: Target, large: bool, name: str, element: str) -> str:
    """A vector whose numbers are `element` with # for each place."""
    inside = ", ".join(element.replace("#", target.enum[n]) for n in target.names)
    inside = f"{{ {{ {inside} }} }}" if large else f"{{ {inside} }}"
    return f"{target.prefix}_vector {name} = {inside};"
