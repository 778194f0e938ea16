"""Statements over the coordinates of a vector: members of a struct, or an array in a loop."""

from __future__ import annotations

from collections.abc import Sequence

from eomc.emit.c_names import Target


def member(target: Target, arrays: bool, name: str) -> str:
    """A coordinate's member of a vector."""
    return f"x[{target.enum[name]}]" if arrays else name


def each(
    target: Target, arrays: bool, lines: Sequence[str], index: str = "i", width: int = 0
) -> list[str]:
    """Statements for every coordinate: $ is its member of a vector, # its place in an array.

    width: the places of a vector, where loops are to go over all of them.
    """
    if arrays:
        inside = [line.replace("$", f"x[{index}]").replace("#", index) for line in lines]
        return loop(index, str(width or f"{target.PREFIX}_NQ"), inside)
    return one_by_one(target, False, lines)


def one_by_one(target: Target, arrays: bool, lines: Sequence[str]) -> list[str]:
    """The same without a loop, as loops around it want it."""
    return [
        line.replace("$", member(target, arrays, name)).replace("#", target.enum[name])
        for name in target.names
        for line in lines
    ]


def rows(target: Target, arrays: bool) -> list[str]:
    """The state into the present rows."""
    both = ("q_rows", "at"), ("qd_rows", "moving")
    if arrays:
        return each(target, True, [f"{row}[#] = {x}.$;" for row, x in both])
    return [f"{row}[{k}] = {x}.{name};" for k, name in enumerate(target.names) for row, x in both]


def loop(index: str, end: str, inside: Sequence[str]) -> list[str]:
    """Statements for every index below an end."""
    brace = len(inside) > 1
    head = f"for (int {index} = 0; {index} < {end}; {index}++)" + " {" * brace
    return [head, *(f"    {line}" for line in inside), *(["}"] if brace else [])]


def gathered(target: Target, arrays: bool, of: str, name: str) -> str:
    """The numbers of a vector as an array."""
    inside = ", ".join(f"{of}->{member(target, arrays, n)}" for n in target.names)
    return f"const {target.real.name} {name}[{target.PREFIX}_NQ] = {{ {inside} }};"


def vector_of(target: Target, arrays: bool, name: str, element: str) -> str:
    """A vector whose numbers are `element` with # for each place."""
    inside = ", ".join(element.replace("#", target.enum[n]) for n in target.names)
    inside = f"{{ {{ {inside} }} }}" if arrays else f"{{ {inside} }}"
    return f"{target.prefix}_vector {name} = {inside};"
