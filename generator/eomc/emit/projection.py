"""Projection onto the constraints, in both forms of C."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import Any, ClassVar

from eomc.emit.c_function import CFunction, GeneratedFunction, initialiser_rows
from eomc.emit.c_names import Target
from eomc.emit.functions import SceneFunctions
from eomc.emit.views import NameFields

# Near singular configurations: square of the largest relative correction; factor on rounding errors
SINGULAR_LIMITS = {"double": (1e-8, 1e9), "float": (1e-6, 1e5)}
# Largest rate of a dropped constraint near singular configurations, relative to its own terms
# (about 3 times the root of its pivot tolerance), and to the largest terms of all constraints
DROPPED_ROW_LIMITS = {"double": (1e-4, 1e-9), "float": (1e-2, 1e-4)}
COUPLING_ROUNDINGS = 30  # error of the rates, in units of rounding, after correcting q and qd
ZERO_SQUARE = 1e-12  # a coordinate counts as 0 if its square is below this part of the sum of all
NEAREST_TOLERANCE = (
    1e-14  # of the squared distance to the nearest state: the square of the last change
)
RANDOM_STARTS = 16  # random starts, if the search from a state does not converge


@dataclass(frozen=True)
class ProjectionView:
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
    projection: GeneratedFunction
    function: CFunction
    call: str
    rate_terms: GeneratedFunction | None
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
class ProjectView(NameFields):
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
    errors: GeneratedFunction | None
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


def large_correction_limit(target: Target) -> float:
    """Return the threshold above which a correction by the projection onto constraints is large.

    It applies to the square of the relative change of a coordinate. It is a few times the rounding
    error of the C type of numbers.
    """
    return 8 * target.real.epsilon


def result_count(target: Target) -> int:
    """Return the number of results of the C function that computes corrections for constraints.

    The results are the corrections that move q and qd onto the constraints, and one inverse pivot
    for each constraint equation.
    """
    return len(target.program["projection"].outputs)


def shared_fields(functions: SceneFunctions) -> dict[str, Any]:
    """Return the fields of `ProjectionView` that are the same in portable and in optimised C.

    These are C names, numbers of equations, and tolerances.
    """
    target = functions.target
    little, noise = SINGULAR_LIMITS[target.system.run.real]
    row_fraction, largest_fraction = DROPPED_ROW_LIMITS[target.system.run.real]
    large = large_correction_limit(target)
    return {
        "PREFIX": functions.PREFIX,
        "real": functions.real,
        "size": result_count(target),
        "rows": result_count(target) - 2 * len(target.names),
        "tolerance": target.literal(largest_fraction),
        "part": target.literal(row_fraction),
        "fabs": f"fabs{target.real.function_suffix}",
        "near": target.literal(large),
        "crossed": target.literal((COUPLING_ROUNDINGS * target.real.epsilon) ** 2),
        "scale_floor": target.literal(ZERO_SQUARE),
        "little": target.literal(little),
        "slight": target.literal(1e4 * little),
        "rounded": target.literal(large**2 * noise),
    }


def portable_view(functions: SceneFunctions) -> ProjectionView | None:
    """Return the data for the template of the projection onto the constraints, in portable C.

    Returns None if the scene has no constraints.
    """
    projection, rate_terms = functions.projection, functions.rate_terms
    if projection is None:
        return None
    state = {"q": "r", "qd": "v"}
    return ProjectionView(
        **shared_fields(functions),
        L="",
        lane=functions.real,
        mask="",
        extent=functions.NQ,
        increments=False,
        sines="",
        sines_call="",
        onto=functions.project_stage if functions.iterates_stages else None,
        projection=projection,
        function=functions.project_end,
        call=projection.function.call(**state),
        rate_terms=rate_terms,
        rate_terms_call=rate_terms.function.call(**state) if rate_terms else "",
    )


def project_view(functions: SceneFunctions) -> ProjectView:
    """Return the data for the template of the public C function `project`.

    That function projects a state (q, qd) onto the constraints.
    """
    target, public = functions.target, functions.public
    end, eps = target.real.function_suffix, target.real.epsilon
    D, A, phi, rates = (
        public.evaluation(name)
        for name in ("D", "constraint_jacobian", "constraints", "constraint_rates")
    )
    closure = target.system.closure
    weights = closure.weights if closure else ()
    rows = target.system.constraints
    sums = closure.sums if closure else ()
    summed = sorted({k for row in sums for k, weight in enumerate(row) if weight})
    errors, rotated = functions.rotation_errors, functions.replace_rotation_rows
    rotations = target.system.rotations if errors else ()
    return ProjectView(
        **functions.names,
        fabs=f"fabs{end}",
        sqrt=f"sqrt{end}",
        count=len(rows),
        holonomic=sum(row.holonomic for row in rows),
        function=public.project,
        call_D=D.call(q="at"),
        call_A=A.call(q="at"),
        call_phi=phi.call(phi="residual", q="at", qd="moving"),
        call_rates=rates.call(rates="residual", q="at", qd="moving"),
        dependent=target.literal(64 * eps),
        small=target.literal((64 * eps) ** 2),
        enough=target.literal((4096 * eps) ** 2),
        tolerance=target.literal(4096 * eps),
        rounded=target.literal(4 * eps),
        weights="{ " + ", ".join(map(target.literal, weights)) + " }" if weights else "",
        sums=initialiser_rows([*map(target.literal, row)] for row in sums),
        sum_places=tuple(summed[: len(sums)]),
        redundant=tuple(
            k for k, row in enumerate(rows) if row.redundant or k in summed[len(sums) :]
        ),
        pinned=bool(weights) and not all(row.holonomic for row in rows),
        tiny=target.literal(1e-30),
        errors=errors,
        error_rows="{ " + ", ".join(str(k) for rows in rotations for k in rows) + " }",
        error_ends=tuple(accumulate(map(len, rotations))),
        rotated=rotated,
        call_rotated=rotated.call(q="at", A="A") if rotated else "",
        call_turn=rotated.call(q="at", A="0") if rotated else "",
        atan=f"atan{end}",
        searched=any(row.holonomic and row.loop for row in rows),
        starts=RANDOM_STARTS,
        converged=target.literal(NEAREST_TOLERANCE),
        half_turn=target.literal(float(f"{eps**0.5:.0e}")),
    )
