"""Views of the templates for constraints, in both forms of C."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from eomc.emit.c_function import CFunction
from eomc.emit.plain.parts import Computed, Named


@dataclass(frozen=True)
class Projection:
    """c/projection.c.jinja: projection of a step's end onto the constraints.

    Attributes
    ----------
    L, lane, mask
        Suffix of C names ("" for one number), type and failure type of the lane.
    increments
        Whether r and v are increments of a step.
    near, scale_floor
        Squares of the relative correction above which it is large, and of the least scale of a
        coordinate, relative to all.
    rate_terms, rate_terms_call, rows
        Rates of constraints that may be dropped, and their number.
    tolerance, part
        Largest rate of a dropped constraint, relative to the largest terms and to its own terms.
    little, slight, rounded
        Squares that bound corrections near a singular configuration, of coordinates and velocities,
        and below which a correction of a coordinate may be rounding.
    sines, sines_call
        Type of sines that a caller may supply, and the call that computes them at `at`.
    onto
        The projection of a stage, for iterated stages.
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
    tolerance: str
    part: str
    fabs: str
    near: str
    crossed: str
    scale_floor: str
    little: str
    slight: str
    rounded: str
    sines: str
    sines_call: str
    onto: CFunction | None


@dataclass(frozen=True)
class Project(Named):
    """c/project.c.jinja: projection of a state onto the constraints.

    Attributes
    ----------
    dependent
        Fraction of a gradient's square below which a constraint depends on others.
    small, enough
        Squares of relative changes of q that are rounding errors, and of sufficiently small
        residuals.
    tolerance, rounded
        Fractions of a rate's terms, and of residuals and rates below which the state is unchanged.
    redundant
        Constraints that others imply.
    weights
        Initialiser of the weights of constraints where D alone is singular.
    sums, sum_places
        Initialisers of sums of constraints, and the constraints that they replace.
    pinned
        Whether coordinates may have neither inertia nor a holonomic constraint.
    errors
        The function of the rotation errors of loops, if there are any.
    error_rows, error_ends
        Constraints that have a rotation error, and the ends of each loop's part of them.
    rotated, call_rotated, call_turn
        The function that replaces these residuals by rotation vectors, its call, and its call
        without gradients.
    searched, starts
        Whether random starts are tried if the search from a state fails, and their number.
    converged
        Square of the last change towards the nearest state, relative to that of its distance.
    half_turn
        The squared cosine of half an angle, below which a rotation counts as half a turn.
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
    tolerance: str
    rounded: str
    redundant: tuple[int, ...]
    weights: str
    sums: tuple[str, ...]
    sum_places: tuple[int, ...]
    pinned: bool
    tiny: str
    errors: Computed | None
    error_rows: str
    error_ends: tuple[int, ...]
    rotated: CFunction | None
    call_rotated: str
    call_turn: str
    atan: str
    searched: bool
    starts: int
    converged: str
    half_turn: str
