"""What the templates of constraints ask for, in both forms of C: one frozen view each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from eomc.emit.c_function import CFunction
from eomc.emit.plain.parts import Computed, Named


@dataclass(frozen=True)
class Projection:
    """c/projection.c.jinja, for both forms of C: a step's end moved onto the constraints.

    L, lane, mask: of the lane, L "" for one number. increments: whether r, v are what a step adds.
    near, apart: squares of parts of a coordinate, and of all, beyond which a correction is large.
    rate_terms, rate_terms_call: of rows that may be left out, where there are; rows: their number;
    loose, part: of the largest of their terms, and of a row's own, what its rate may be then.
    little, slight: squares of parts of all coordinates and of all velocities, which corrections
    near a singular position are below; rounded: of coordinates, where one may be rounding there.
    sines, sines_call: their type where a caller may know them, and how they are had at `at`. onto:
    of a stage, where sweeps may take it.
    """

    TEMPLATE: ClassVar[str] = "c/projection.c"
    PREFIX: str
    real: str
    L: str
    lane: str
    mask: str
    extent: str
    size: int
    increments: bool
    projection: Computed
    function: CFunction
    call: str
    rate_terms: Computed | None
    rate_terms_call: str
    rows: int
    loose: str
    part: str
    fabs: str
    near: str
    crossed: str
    apart: str
    little: str
    slight: str
    rounded: str
    sines: str
    sines_call: str
    onto: CFunction | None


@dataclass(frozen=True)
class Project(Named):
    """c/project.c.jinja, for both forms of C: a state moved onto the constraints, and calls in it.

    dependent: the part of a row's square below which it depends on others; small: of the square of
    q, where a change is rounding; enough: where what rows lack is; loose: of the terms of a rate;
    rounded: the same of rows and rates, where a state is left as it is; redundant: rows that the
    others imply; weights: of rows, an initializer, where D alone is singular; sums: initializers of
    sums of rows, which stand in the places of the rows `sum_places`. pinned: whether coordinates
    may have neither inertia nor a row of positions.
    """

    TEMPLATE: ClassVar[str] = "c/project.c"
    fabs: str
    sqrt: str
    count: int
    holonomic: int
    function: CFunction
    call_D: str
    call_A: str
    call_phi: str
    call_rates: str
    dependent: str
    small: str
    enough: str
    loose: str
    rounded: str
    redundant: tuple[int, ...]
    weights: str
    sums: tuple[str, ...]
    sum_places: tuple[int, ...]
    pinned: bool
    tiny: str
