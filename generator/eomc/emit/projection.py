"""Views of the projection onto the constraints, for both forms of C."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate

from eomc.emit.c_function import CFunction, in_braces
from eomc.emit.c_names import Target
from eomc.emit.functions import Functions
from eomc.emit.portable.constraint_views import Project, Projection
from eomc.emit.portable.parts import Computed

# Near singular configurations: square of the largest relative correction; factor on rounding errors
SINGULAR = {"double": (1e-8, 1e9), "float": (1e-6, 1e5)}
# Largest rate of a dropped constraint near singular configurations, relative to its own terms
# (about 3 times the root of its pivot tolerance), and to the largest terms of all constraints
LEFT_OUT = {"double": (1e-4, 1e-9), "float": (1e-2, 1e-4)}
COUPLING_ROUNDINGS = 30  # error of the rates, in units of rounding, after correcting q and qd
ZERO_SQUARE = 1e-12  # a coordinate counts as 0 if its square is below this part of the sum of all
NEAREST_TOLERANCE = (
    1e-14  # of the squared distance to the nearest state: the square of the last change
)
STARTS = 16  # random starts, if the search from a state does not converge


def near(target: Target) -> float:
    """Return the threshold above which a correction by the projection onto constraints is large.

    It applies to the square of the relative change of a coordinate. It is a few times the rounding
    error of the C type of numbers.
    """
    return 8 * target.real.epsilon


def width(target: Target) -> int:
    """Return the number of results of the C function that computes corrections for constraints.

    The results are the corrections that move q and qd onto the constraints, and one inverse pivot
    for each constraint equation.
    """
    return len(target.program["projection"].outputs)


def view(
    functions: Functions, projection: Computed, function: CFunction, call: str,
    rate_terms: Computed | None = None, state: Mapping[str, str] | None = None, *,
    lane: str = "", L: str = "", mask: str = "", extent: str = "", increments: bool = False,
    sines: str = "", sines_call: str = "", onto: CFunction | None = None,
) -> Projection:  # fmt: skip
    """Return the data for the template of the projection onto the constraints.

    Parameters
    ----------
    projection
        The C function for the corrections of q and qd.
    function
        Prototype of the function that applies them.
    call
        C call of `projection`.
    rate_terms, state
        The C function for the rates of dropped constraint equations, and its arguments that differ
        from their names.
    lane, L, mask
        C type of the numbers, suffix of C names and C type of failures, where several instances are
        computed together in a vector register (a lane). The defaults are for a single instance.
    extent
        Length of C arrays for coordinates; the number of coordinates by default.
    increments
        Whether the state at the end of a step is passed as its increments in the step.
    sines, sines_call
        C type of precomputed sines and cosines, and the C call that computes them; "" for none.
    onto
        Prototype of the function that projects a stage to first order; None if not needed.
    """
    target = functions.target
    little, noise = SINGULAR[target.system.run.real]
    row_fraction, largest_fraction = LEFT_OUT[target.system.run.real]
    large = near(target)
    return Projection(
        PREFIX=functions.PREFIX,
        real=functions.real,
        L=L,
        lane=lane or functions.real,
        mask=mask,
        extent=extent or functions.NQ,
        size=width(target),
        increments=increments,
        sines=sines,
        sines_call=sines_call,
        onto=onto,
        projection=projection,
        function=function,
        call=call,
        rate_terms=rate_terms,
        rate_terms_call=rate_terms.function.call(**(state or {})) if rate_terms else "",
        rows=width(target) - 2 * len(target.names),
        tolerance=target.literal(largest_fraction),
        part=target.literal(row_fraction),
        fabs=f"fabs{target.real.function_suffix}",
        near=target.literal(large),
        crossed=target.literal((COUPLING_ROUNDINGS * target.real.epsilon) ** 2),
        scale_floor=target.literal(ZERO_SQUARE),
        little=target.literal(little),
        slight=target.literal(1e4 * little),
        rounded=target.literal(large**2 * noise),
    )


def plain(functions: Functions) -> Projection | None:
    """Return the data for the template of the projection onto the constraints, in portable C.

    Returns None if the scene has no constraints. Portable C is the form for all compilers.
    """
    projection = functions.projection
    if projection is None:
        return None
    state = {"q": "r", "qd": "v"}
    call = projection.function.call(**state)
    return view(
        functions, projection, functions.projected, call, functions.rate_terms, state,
        onto=functions.onto if functions.swept else None,
    )  # fmt: skip


def project(functions: Functions) -> Project:
    """Return the data for the public C function `project`, which projects a state onto the
    constraints.
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
    errors, rotated = functions.rotation_errors, functions.rotated
    rotations = target.system.rotations if errors else ()
    return Project(
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
        sums=in_braces([*map(target.literal, row)] for row in sums),
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
        starts=STARTS,
        converged=target.literal(NEAREST_TOLERANCE),
        half_turn=target.literal(float(f"{eps**0.5:.0e}")),
    )
