"""Adaptive steps and events in both forms of C: the library's part, its tables, and its glue."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from math import cos, pi

from eomc.emit.common import c_function as c
from eomc.emit.common import solver
from eomc.emit.common.amalgamate import Names, amalgamate
from eomc.emit.common.c_names import Target
from eomc.emit.common.functions import SceneFunctions
from eomc.emit.common.solver import SolverModel, c_matrix, c_vector, round_weights
from eomc.emit.common.templates import show
from eomc.integrators.tableaux import GAUSS16, Row
from eomc.model.mechanics import has_steep_terms
from eomc.model.system import System
from eomc.program import outline
from eomc.scene.schema import ACTIONS
from eomc.scene.value_types import MAX_TOLERANCE

METHOD = GAUSS16
TITLE = f"the implicit method of Gauss and Legendre with {METHOD.stages} stages"
REJECT_AFTER_TWO = 2 * 0.8**-8  # error over sqrt(tol/2) for which two iterations suffice to reject
MAX_TIME_SCALES = 1e4  # the minimal step is relative to at most this many initial time scales
SCALE_FLOOR = 1e-4  # least scale of a coordinate or velocity, relative to the largest
COARSE_SCALE_FLOOR = 0.01  # the same for rounding errors, and in single precision
MAX_BATCH_OPERATIONS = 300  # of the accelerations, up to which instances are stepped in parallel
POWERS = 4  # of the accelerations between the ends of a fixed step
FILES = (
    "state.c", "linear.c", "gauss_sweep.c", "increments.c", "types.h", "gauss.c", "step_size.c",
    "newton.c", "iteration.c", "discontinuity.c", "adaptive_step.c", "fixed_step.c", "series.c",
    "events.c", "jumps.c", "run.c",
)  # fmt: skip


def step_control(target: Target) -> dict[str, str]:
    """Return constants of the control of step sizes for one scene, as C literals by name.

    `scale_floor` is the least scale of a coordinate or velocity, relative to the largest, and
    `coarse_floor` that for rounding errors. A step is rejected if its error estimate after two
    iterations exceeds `max_roughness` sqrt(tol/2). `loosest` and `tightest` are the limits of
    tolerances.
    """
    is_double = target.real.epsilon < 1e-10
    numbers = {
        "scale_floor": SCALE_FLOOR if is_double else COARSE_SCALE_FLOOR,
        "coarse_floor": COARSE_SCALE_FLOOR,
        "max_roughness": REJECT_AFTER_TWO,
        "loosest": MAX_TOLERANCE,
        "tightest": 1e-15 if is_double else 5e-7,
    }
    return {name: target.literal(x) for name, x in numbers.items()}


def discrete_coordinates(system: System) -> int:
    """Return the number of trailing coordinates that only jumps change; they have no scale."""
    return len(system.modes) + len(system.discrete)


def workspace_size(system: System, width: int) -> int:
    """Return the size of the workspace of an adaptive run, as a number of floating-point numbers.

    The workspace keeps data between the calls that continue a run. `width` is the length of a
    vector of coordinates in C, which may include padding.
    """
    if system.run.tolerance is None:
        return _fixed_workspace_size(system, width)
    vectors, scalars = (8, 27) if has_steep_terms(system) else (6, 23)
    stages = METHOD.stages * len(system.coordinates)
    event_numbers = 11 * len(system.events) + 14 * bool(system.events) + bool(system.constraints)
    vectors += 2 * any(e.begins is not None for e in system.events)
    return vectors * width + stages + scalars + event_numbers


def _fixed_workspace_size(system: System, width: int) -> int:
    """Return the size of the workspace of a run with fixed steps and events, as `workspace_size`.

    Integers count as a number of floating-point numbers each, and `long` ones as two.
    """
    initial = any(e.begins is not None for e in system.events)
    per_event = 10 if any(e.action == "jump" for e in system.events) else 5
    n = len(system.coordinates)
    return (4 + 2 * initial) * width + POWERS * n + per_event * len(system.events) + 20


def library_texts(model: SolverModel, roots: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the library's part of adaptive steps and events in a model's source, as definitions.

    roots: names of functions that the source calls, besides the one for a run.
    """
    functions = model.functions
    own = {"linear.c", "gauss_sweep.c", "increments.c"} if model.has_sweep else set()
    if not functions.target.is_adaptive:
        own = set(FILES[: FILES.index("fixed_step.c")]) - {"state.c", "types.h"}
    has_tables = not model.has_sweep and METHOD.name in functions.target.system.run.methods
    return amalgamate(
        tuple(file for file in FILES if file not in own),
        ["eom_run", *roots],
        library_names(model),
        features(functions),
        (*(() if has_tables else solver.tableau_tables(functions, METHOD)), *tables(functions)),
    )


def integrate(model: SolverModel) -> str:
    """Return the definition of the function for a run to a given time."""
    return show("c/integrate.c", model.functions, model=model)


def library_names(model: SolverModel) -> Names:
    """Return the names of the library for adaptive steps and events in a model's source."""
    functions = model.functions
    target, real = functions.target, functions.target.real
    exact = {
        **{f"EOM_{name.upper()}": text for name, text in step_control(target).items()},
        "EOM_DISCRETE": str(discrete_coordinates(target.system)),
        "EOM_LONGEST": target.literal(MAX_TIME_SCALES),
        "EOM_REPEATED_KINKS": target.literal(float(f"{real.epsilon ** (-1 / 3):.0e}")),
        "EOM_POWERS": str(METHOD.stages if target.is_adaptive else POWERS),
        **sizes(functions),
    }
    if model.has_sweep:
        exact["eom_gauss_sweep"] = f"{functions.prefix}_{METHOD.name}_iterate"
    return solver.library_names(model, METHOD, **exact)


def features(functions: SceneFunctions) -> dict[str, bool]:
    """Return which features of the library a scene has."""
    system, program = functions.target.system, functions.target.program
    return {
        "ADAPTIVE": functions.target.is_adaptive,
        "CONSTRAINTS": bool(functions.projection),
        "KINKS": has_steep_terms(system),
        "METHODS": bool(functions.public.method_type),
        "DISCRETE": discrete_coordinates(system) > 0,
        # Bodies that stick may stay at rest although time-dependent forces act on them. Their
        # accelerations at rest are then rounding errors.
        "REST": bool(system.modes) and functions.target.driven,
        "EVENTS": bool(system.events),
        "SEVERAL": len(system.events) > 1,
        "JUMPS": "jumps" in program,
        "TWO_SIDED": functions.target.has_two_sided_jumps,
        "SWITCHES": any(switches(functions.target)),
        "ONLY_JUMPS": all(e.action == "jump" for e in system.events),
        # Events that are ignored where their functions are zero in a whole step, within rounding
        "RECORDS": functions.target.is_adaptive
        or bool(system.modes)
        or any(e.action == "record" for e in system.events),
        "INITIAL_EVENTS": "begins" in program,
        "MODES": bool(system.modes),
        "SETS": bool(functions.projection and system.own_events) and "jumps" in program,
    }


def tables(functions: SceneFunctions) -> tuple[str, ...]:
    """Return the tables of adaptive steps and events under the library's names.

    Those of fixed steps, `solver.tableau_tables`, precede them in the source.
    """
    real = functions.target.real
    eigenvalues, to_parts, from_parts = METHOD.eigen
    last = [METHOD.legendre(n) for n in range(METHOD.stages - 4, METHOD.stages)]
    weights = zip(METHOD.b_a, round_weights(METHOD.b, real), strict=True)
    matrices: dict[str, Sequence[Row]] = {
        "to_powers": list(zip(*METHOD.powers, strict=True)),
        "weights": list(weights),
        "last": list(zip(*last, strict=True)),
        "ends": _end_weights(),
        "eigenvalues": eigenvalues,
        "to_parts": to_parts,
        "from_parts": from_parts,
    }
    return (
        *(c_matrix(f"eom_gauss_{name}", rows, real) for name, rows in matrices.items()),
        *(event_tables(functions) if functions.target.system.events else ()),
    )


def steps_in_parallel(target: Target) -> bool:
    """Return True if optimised C steps several instances of a batch together in vector registers.

    It does so for small systems with smooth forces; a large system occupies the vector registers
    with one instance.
    """
    s = target.system
    plain = not (s.events or s.constraints or has_steep_terms(s))
    return (
        plain
        and s.run.batch
        and outline.weight(target.program["acceleration"]) <= MAX_BATCH_OPERATIONS
    )


def _end_weights() -> tuple[Row, Row]:
    """Return weights that extrapolate from the stages to the start and to the end of a step.

    They give the values there of the polynomial through the values at the stages.
    """
    parts = [METHOD.legendre(n) for n in range(METHOD.stages)]
    columns = list(zip(*parts, strict=True))
    start = tuple(sum(column[::2], Fraction(0)) - sum(column[1::2]) for column in columns)
    return start, tuple(sum(column, Fraction(0)) for column in columns)


def header(functions: SceneFunctions, workspace: int = 0, width: int = 0) -> str:
    """Return the C header of portable or of optimised C.

    workspace: length of the workspace of runs by fixed steps, as a count of numbers. width: length
    of a vector of coordinates with its padding; 0 if there is none.
    """
    target, s, adaptive_workspace = functions.target, functions.target.system, 0
    if target.integrates:
        adaptive_workspace = workspace_size(s, width or len(s.coordinates))
    return show(
        "c/header.h",
        functions,
        workspace=max(workspace, adaptive_workspace),
        in_parallel=not functions.is_portable and steps_in_parallel(target),
    )


SAMPLES = 9  # values of an event function in a step
DIRECTIONS = {"falling": -1, "both": 0, "rising": 1}

COMMENTS = {  # of the tables of integers, by name
    "direction": "Directions in which the events trigger: -1 falling, 1 rising, 0 both.",
    "action": "Actions of the events: 0 record, 1 stop, 2 jump.",
    "above": "Whether the event leaves zero upwards in any case.",
    "mode": "Indices of each friction mode and of the coordinate that it belongs to.",
    "switch": "Coordinates on which the motion depends, and which jumps set.",
    "jump_sets": "Which entries of [q, qd] the jump of each event sets.",
}


def sizes(functions: SceneFunctions) -> dict[str, str]:
    """Return the texts of the library's constants that depend on the scene's events."""
    target = functions.target
    system, is_double = target.system, target.real.epsilon < 1e-10
    initial = sum(e.begins is not None for e in system.events)
    return {
        "EOM_SAMPLES": str(SAMPLES),
        "EOM_MAX_EVENTS": str(target.max_events_per_step),
        "EOM_MAX_SIMULTANEOUS": str(target.max_events_per_step + 3 * initial),
        "EOM_OWN_EVENTS": str(len(system.own_events)),
        "EOM_MODES": str(len(system.modes)),
        "EOM_CLOSE": target.literal(1e-10 if is_double else 1e-5),
        "EOM_DIFFERENCE": target.literal(1e-6 if is_double else 1e-3),
        "EOM_SHIFT": target.literal(1e-7 if is_double else 1e-4),
    }


def event_tables(functions: SceneFunctions) -> tuple[str, ...]:
    """Return the tables of the library that depend on the scene's events, and nodes and weights."""
    target = functions.target
    system, x, real = target.system, chebyshev_nodes(), target.real
    stages = GAUSS16.stages
    integers: dict[str, Sequence[Sequence[int]] | Sequence[int]] = {
        "direction": [DIRECTIONS[e.direction] for e in system.events],
        "action": [ACTIONS.index(e.action) for e in system.events],
        "above": [int(e.above) for e in system.events],
    }
    if system.modes:
        integers["mode"] = [(m.at, m.of) for m in system.modes]
    if system.own_events:
        integers["jump_sets"] = _jump_flags(target)
    if any(flags := switches(target)):
        integers["switch"] = [int(flag) for flag in flags]
    return (
        *(c.define_int_table(f"eom_{name}", row, COMMENTS[name]) for name, row in integers.items()),
        c_vector("eom_nodes", x, real, "Chebyshev nodes, as fractions of a step."),
        c_matrix("eom_once_integrated", power_integrals(x, stages, 1), real),
        c_matrix("eom_twice_integrated", power_integrals(x, stages, 2), real),
    )


def switches(target: Target) -> list[bool]:
    """Return for each coordinate whether jumps set it and the motion or an event depends on it."""
    system = target.system
    jumped = {name for e in system.events for name, _ in e.jump}
    formulas = (
        system.kinetic, system.potential, system.linear_potential, system.dissipation,
        *system.forces, *(e for pair in system.applied for e in pair),
        *(e for _, e in system.definitions), *(c.formula for c in system.constraints),
        *(u.signal for u in system.inputs), *(e.when for e in system.events),
    )  # fmt: skip
    used = {symbol.name for e in formulas for symbol in e.free_symbols}
    names = (target.scene_name(c.name) for c in system.coordinates)
    return [name in jumped and name in used for name in names]


def _jump_flags(target: Target) -> list[list[int]]:
    """Return, for each event of the scene, flags of the entries of [q, qd] that jump."""
    coordinates = [target.scene_name(c.name) for c in target.system.coordinates]
    states = [name + end for end in ("", "_dot") for name in coordinates]
    rows = ({name for name, _ in e.jump} for e in target.system.own_events)
    return [[int(name in names) for name in states] for names in rows]


def chebyshev_nodes() -> Row:
    """Return the fractions of a step, from 0 to 1, at which event functions are evaluated.

    They are the extrema of a Chebyshev polynomial and include both ends.
    """
    last = SAMPLES - 1
    return tuple(Fraction((1 - cos(pi * j / last)) / 2).limit_denominator(10**12)
                 for j in range(SAMPLES))  # fmt: skip


def power_integrals(x: Row, count: int, times: int) -> Sequence[Row]:
    """Return the integrals of the powers (2 c - 1)^n over c, from 0 to each x.

    The result has a row for each x and a column for each power n < `count`. With `times` = 2, it
    has the integrals of these integrals.
    """
    signs = [Fraction((-1) ** n) for n in range(count + 3)]

    def once(n: int, at: Fraction) -> Fraction:
        power = Fraction(1)
        for _ in range(n + 1):
            power *= 2 * at - 1
        return (power - signs[n + 1]) / (2 * (n + 1))

    def twice(n: int, at: Fraction) -> Fraction:
        return (once(n + 1, at) - signs[n + 1] * at) / (2 * (n + 1))

    integral = (once, twice)[times - 1]
    return [tuple(integral(n, at) for n in range(count)) for at in x]
