"""Data for the templates (views) of constraints, in both forms of C."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from eomc.emit.c_function import CFunction
from eomc.emit.portable.parts import Computed, Named


@dataclass(frozen=True)
class Projection:
    """Data for c/projection.c: projection of the end of a step onto the constraints.

    Attributes
    ----------
    L, lane, mask
        The template is printed for one instance and for a lane, a vector register with one value of
        each of several instances. L: suffix of C names ("" for one instance); lane: C type to
        compute with; mask: C type that records failures.
    extent, size
        Length of vectors of coordinates, as a C expression, and number of results of `projection`.
    increments
        Whether the arguments r and v of `function` are the increments of q and q̇ in a step rather
        than the state at its end.
    projection, call
        The function that computes corrections of q and q̇ and the inverse pivots of the constraint
        equations, and its C call.
    function
        Prototype of the function that applies these corrections.
    rate_terms, rate_terms_call, rows
        The function for the rates of constraint equations that may be dropped as dependent, its C
        call, and the number of these equations.
    tolerance, part
        Largest rate of a dropped constraint equation, relative to the largest terms of all
        equations and to its own terms.
    near, scale_floor
        Square of the relative correction above which a correction counts as large; square of the
        least scale of a coordinate, relative to that of all coordinates.
    crossed
        Bound on the product of the squared relative corrections of q and q̇; above it, another
        correction is made.
    little, slight, rounded
        Squares of relative corrections: bounds for coordinates and for velocities near a singular
        configuration, and the bound below which a correction of a coordinate may be rounding.
    sines, sines_call
        C type of the sines and cosines that a caller may supply ("" for none), and the C call that
        computes them.
    onto
        Prototype of the function that projects a stage of an implicit step onto the constraints, by
        a single correction; None if not needed.
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
    """Data for c/project.c: the public projection of a state onto the constraints.

    Attributes
    ----------
    count, holonomic
        Number of constraint equations, and of holonomic ones.
    function
        Prototype of the function.
    call_D, call_A, call_phi, call_rates
        C calls of the mass matrix, the constraint Jacobian, the residuals and their rates.
    dependent
        Fraction of a gradient's square below which a constraint equation depends on others.
    small, enough
        Squares of relative changes of q that are rounding errors, and of sufficiently small
        residuals.
    tolerance, rounded
        Largest residual of a projected state, and largest residual of a state that is left
        unchanged, both relative to the terms of the constraint equation.
    redundant
        Indices of constraint equations that others imply.
    weights
        C initialiser of the weights of the constraint equations that are added to D where D alone
        is singular; "" for none.
    sums, sum_places
        C initialisers of the sums of constraint equations that replace dependent equations, and the
        indices of the equations that they replace.
    pinned
        Whether there may be coordinates that have neither inertia nor a holonomic constraint.
    errors
        The function of the rotation errors of closed loops; None if there are no such loops.
    error_rows, error_ends
        Indices of the constraint equations that have a rotation error, as a C initialiser with the
        loops in sequence; for each loop, the position in it at which its indices end.
    rotated, call_rotated, call_turn
        The function that replaces these residuals by rotation vectors, its C call, and its C call
        without gradients.
    searched, starts
        Whether random starts are tried if the search from a state fails, and their number.
    converged
        Square of the last change in the search for the nearest state, relative to the square of the
        distance to it, below which the search has converged.
    half_turn
        Squared cosine of half an angle below which a rotation counts as half a turn.
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
