"""Optimised C: the header and the source of a program.

For gcc and clang. Functions of a step are printed for several C types: numbers for a trajectory, a
vector register for batches and for iterated stages, two configurations for long accelerations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from eomc.base import resources
from eomc.emit.common import adaptive, projection, solver
from eomc.emit.common import c_function as c
from eomc.emit.common.c_expression import C_NAMES, DOUBLE, PIVOT, Real
from eomc.emit.common.c_function import CArgument
from eomc.emit.common.derivatives import step_derivatives
from eomc.emit.common.functions import SceneFunctions
from eomc.emit.common.solver import SolverModel
from eomc.emit.common.templates import show
from eomc.emit.optimised.lanes import Accelerations, Lane
from eomc.emit.optimised.steppers import Steppers
from eomc.integrators.tableaux import RK4, Method
from eomc.runtime.mathematics import FUNCTIONS

# Placeholders in csrc for names, types and sizes of a lane
PLACEHOLDERS = ("BITS_OF_SIZE", "INTEGER", "LANE_ALIGNED", "LANE_BYTES", "LANE_COUNT", "REAL")
LANE_ROOTS = ("eom_initial_step_size", "eom_copy_state", "eom_gauss_last", "eom_gauss_weights")
SWEEP = "b = the accelerations at the stages to which a lead. Returns 0 if some do not exist."
PROJECT_INCREMENTS = (
    "Change the increments r, v of a step from q, qd such that its end satisfies the constraints."
)
LANE_FUNCTIONS = frozenset({"exp", "tanh"})  # mathematical functions in csrc over a lane
BINARY_FUNCTIONS = ("pow", *(f.name for f in FUNCTIONS.values() if len(f.arguments) == 2))


@dataclass(frozen=True)
class LibraryFunction:
    """A function of the C mathematics library that is applied to each value of a vector register.

    Attributes
    ----------
    name
        Ending of the C name of the generated function, which takes registers.
    c, two
        Name of the library function, and whether it has two arguments.
    whole
        C expression for a single AVX-512 instruction that computes the whole register; "" for none.
    """

    name: str
    c: str
    two: bool
    whole: str


def files(functions: SceneFunctions) -> dict[str, str]:
    """Return the header and the source of a scene in optimised C, as texts by file name."""
    steppers, name = Steppers(Accelerations(functions.target), functions), functions.prefix
    workspace = max(state_size(steppers, m) for m in functions.methods)
    header = adaptive.header(functions, workspace, steppers.one.width)
    source = show(
        "c/optimised/source.c",
        functions,
        steps=list(_steppers(steppers)),
        steppers=steppers,
        csrc=list(_csrc(steppers)),
        lanes=list(filter(None, _lanes(steppers))),
    )
    return {f"{name}.h": c.break_long_lines(header), f"{name}.c": c.break_long_lines(source)}


def _csrc(steppers: Steppers) -> Iterator[str]:
    """Yield the hand-written C that this scene needs, with its prefix."""
    target = steppers.accelerations.target
    end = target.real.function_suffix
    size = 8 if target.real is DOUBLE else 4
    rotates = bool(steppers.accelerations.angles) and RK4 in steppers.functions.methods
    lanes = [("wide", f"{target.PREFIX}_WIDE_BYTES", True)] * steppers.uses_registers
    if steppers.one.two_point:
        lanes += [("two", str(2 * size), False)]
    simd = steppers.accelerations.simd_angles
    angles = steppers.functions.has_grouped_angles or simd
    if angles:
        lanes += [("four", str(4 * size), simd)]
    if RK4 in steppers.functions.methods and steppers.predicts_angles:
        prediction_bytes = size * prediction_width(len(steppers.accelerations.angles))
        lanes += [("prediction", str(prediction_bytes), False)]
    texts = [(f"sincos/sincos{end}.h", "", "")] if target.sincos else []
    if rotates:
        texts += [("lanes/scalar.h", "", ""), (f"lanes/rotate{end}.h", "", "")]
    texts += [("lanes/larger.h", "", "")] * any(m.implicit for m in steppers.functions.methods)
    for name, width, rotates_angles in lanes:
        texts += [("lanes/vector.h", name, width)]
        texts += [(f"lanes/sincos{end}.h", name, width)] * target.sincos
        texts += [(f"lanes/rotate{end}.h", name, width)] * (rotates_angles and rotates)
        needed_functions = (
            LANE_FUNCTIONS & set(steppers.one.math_functions)
            if name in ("wide", "two")
            else frozenset()
        )
        selects = bool(needed_functions) or (name == "wide" and adaptive.steps_in_parallel(target))
        texts += [("lanes/select.h", name, width)] * selects
        texts += [(f"lanes/exp{end}.h", name, width)] * bool(needed_functions)
        texts += [(f"lanes/tanh{end}.h", name, width)] * ("tanh" in needed_functions)
        texts += [("lanes/four.h", name, width)] * (name == "four" and simd)
        texts += [("lanes/interleave.h", name, width)] * (name == "four" and steppers.one.two_point)
        texts += [("lanes/angles.h", name, width)] * (name == "four" and angles)
    for file, name, width in texts:
        text = resources.text("csrc", file).replace("#include <math.h>\n", "")
        integer, bits = ("long long", "0x7fffffffffffffff") if size == 8 else ("int", "0x7fffffff")
        for old, new in (
            # With many angles, inlining the sincos of each makes the code of gcc 50 % slower.
            *([("static inline void", "static void")] if steppers.accelerations.is_long else ()),
            ("EOMC_BITS_OF_SIZE", bits),
            ("EOMC_INTEGER", integer),
            # Compilers pass values with larger alignment than a register in different ways.
            ("EOMC_LANE_ALIGNED", width if name == "wide" else "16"),
            ("EOMC_LANE_BYTES", width),
            ("EOMC_LANE_COUNT", f"{target.PREFIX}_{name.upper()}_COUNT"),
            ("fabs_REAL", f"fabs{end}"),
            ("sincos_REAL", f"sincos{end}"),
            ("EOMC_REAL", target.real.name),
            *(
                (("_LANE", f"_{name}"),)
                if name
                else (("eomc_LANE", target.real.name), ("_LANE", ""))
            ),
            ("eomc_", f"{target.prefix}_"),
            ("EOMC_", f"{target.PREFIX}_"),
        ):
            text = text.replace(old, new)
        yield text.strip()


def _lanes(steppers: Steppers) -> Iterator[str]:
    """Yield the C text of the accelerations, and of the projection, over each lane type."""
    functions, one, wide = steppers.functions, steppers.one, steppers.wide
    batch = functions.target.system.run.batch
    if steppers.one.two_point:
        yield _library(functions, steppers.two)
    yield show("c/optimised/lane.c", functions, steppers=steppers, lane=one)
    if steppers.uses_registers:
        yield _library(functions, wide)
        yield show("c/optimised/lane.c", functions, steppers=steppers, lane=wide)
    if functions.projection:
        yield "\n\n".join(one.projection_source(functions)) + "\n"
        if batch:
            size = projection.correction_size(functions.target)
            yield show("c/optimised/projection.c", functions, lane=wide, size=size)
    if batch:
        yield show("c/optimised/blocks.c", functions, steppers=steppers)


def _library(functions: SceneFunctions, lane: Lane) -> str:
    """Return the functions of the mathematics library over a lane of several numbers."""
    names = set(lane.math_functions) - LANE_FUNCTIONS
    if lane.name == "wide" and adaptive.steps_in_parallel(functions.target):
        names.add("sqrt")
    calls = [_library_function(functions.target.real, n, lane) for n in sorted(names)]
    return show("c/optimised/library.c", functions, lane=lane, calls=calls)


def _library_function(real: Real, name: str, lane: Lane) -> LibraryFunction:
    """Return one mathematical function over a lane of several numbers."""
    if name == PIVOT:
        return LibraryFunction(name, name, True, "")
    called, letter = C_NAMES.get(name, name), "d" if real is DOUBLE else "s"
    is_whole = lane.name == "wide" and name == "sqrt"
    whole = f"__builtin_ia32_sqrtp{letter}512_mask(x, x, -1, 4)" if is_whole else ""
    return LibraryFunction(called, real.function(called), name in BINARY_FUNCTIONS, whole)


def _steppers(steppers: Steppers) -> Iterator[str]:
    """Yield the methods: state, step, run and batch of each."""
    functions, run = steppers.functions, steppers.functions.target.system.run
    model = library_model(steppers)
    texts = [*solver.functions_source(model, "rows.c", "row_step")]
    if run.tolerance is not None or any(m.newton for m in functions.methods):
        texts += solver.functions_source(model, "linear.c", "factor", "substitute")
    yield from (f"{text}\n" for text in texts)
    for m in functions.methods:

        def show_method(template: str, method: Method = m, **objects: Any) -> str:
            path = f"c/optimised/{template}.c"
            return show(path, functions, steppers=steppers, method=method, **objects)

        for lane in (steppers.one, *([steppers.wide] if run.batch else [])):
            if not m.implicit:
                yield show_method("rk4" if m is RK4 else "explicit", lane=lane)
        if steppers.predicts(m):
            yield show("c/optimised/predictions.c", functions, steppers=steppers)
        yield show_method("state")
        if steppers.predicts(m):
            yield show("c/optimised/predicted.c", functions, steppers=steppers)
        if m.sweeps:
            yield show_method("stages") + "\n" + show_method("sweeps").rstrip("\n")
        elif m.implicit:
            yield show_method("gauss")
        yield show_method("run")
        if run.batch:
            yield show_method("batch")
    if functions.target.is_adaptive and adaptive.METHOD not in functions.methods:
        method = adaptive.METHOD
        yield show("c/optimised/stages.c", functions, steppers=steppers, method=method)
    yield from _from_library(steppers, model)


def _from_library(steppers: Steppers, model: SolverModel) -> Iterator[str]:
    """Yield projection of states, adaptive steps, and derivatives of steps, by the library."""
    functions = steppers.functions
    run, integrates = functions.target.system.run, functions.target.integrates
    texts = [*projection.state_source(model)]
    side_by_side = run.batch and integrates and adaptive.steps_in_parallel(functions.target)
    if integrates:
        texts += adaptive.library_texts(model, LANE_ROOTS if side_by_side else ())
    texts += step_derivatives(model)
    if texts:
        own = (*functions.constraint_texts, *model.source(texts), *dict.fromkeys(texts))
        yield from (text.rstrip("\n") + "\n" for text in own)
    if not (integrates or len(run.methods) > 1):
        return
    yield show("c/integrate.c", functions, model=model)
    if side_by_side:
        yield show(
            "c/optimised/adaptive_lanes.c", functions, steppers=steppers, method=adaptive.METHOD,
            model=model, control=adaptive.step_control(functions.target),
        )  # fmt: skip
    if run.batch:
        yield show("c/integrate_batch.c", functions, in_parallel=side_by_side)


# --- what the form supplies to the library ----------------------------------------------------


def state_size(steppers: Steppers, m: Method) -> int:
    """Return the length of the workspace that a run by the method `m` needs.

    It is a count of numbers of the C type of the scene, which the C header reserves.
    """
    n, angles, s = len(steppers.one.target.names), len(steppers.accelerations.angles), m.stages
    size = 4 * steppers.one.width + 32
    if steppers.predicts(m):
        size += n + 2 * angles + 5 * prediction_width(angles)
    if m.newton:
        size += s * n * (s * n + 2)
    if m.sweeps:
        size += s * n + len(steppers.one.target.input_names)
    return size


def prediction_width(angles: int) -> int:
    """Return the number of values in the C vector type for predicted angles.

    It is twice `angles`, the number of angles, rounded up to a power of two.
    """
    return 1 << (2 * angles - 1).bit_length()


def library_model(steppers: Steppers) -> SolverModel:
    """Return what optimised C supplies to the library.

    The library makes adaptive steps, detects events, projects states onto the constraints and
    differentiates steps.
    """
    functions, one, m = steppers.functions, steppers.one, adaptive.METHOD
    real, prefix, system = functions.real, functions.prefix, functions.target.system
    integrates = functions.target.integrates
    members = [a for a in steppers.step_arguments(one) if a.name in "ucp" and integrates]
    present = {a.name for a in members}
    if system.events or system.constraints or system.run.discretize:
        members += [a for a in functions.public.arguments("u", "p") if a.name not in present]
    bare = SolverModel(functions, tuple(members), (), one.c_width)
    passed = bare.arguments
    state = (*solver.state_arguments(real), *bare.argument)
    qdd = c.output_array(real, "qdd")
    stages = f"{prefix}_{m.name}_stages"
    sweep_arguments = (
        c.output_array(stages, "b"), c.input_array(stages, "a"), *solver.state_arguments(real),
        CArgument(real, "h"), *functions.onto_argument, *bare.argument,
    )  # fmt: skip
    accelerations = one.accelerations_function
    own = {one.out.name: "qdd"} | ({"s": "NULL"} if steppers.accelerations.angles else {})
    callbacks = [
        solver.callback(
            f"{prefix}_accelerate", accelerations, (qdd, *state), solver.ACCELERATE, **passed, **own
        ),
        solver.callback(
            f"{prefix}_{m.name}_iterate", steppers.sweep_prototype(m), sweep_arguments, SWEEP,
            w=f"&{prefix}_{m.name}_within", **passed,
        ),
    ]  # fmt: skip
    if functions.projection:
        r, v = c.output_array(real, "r"), c.output_array(real, "v")
        singular = one.project_end.arguments[-1]
        callbacks.append(
            solver.callback(
                f"{prefix}_project_increments", one.project_end, (r, v, *state, singular),
                PROJECT_INCREMENTS, s="NULL", **passed,
            )
        )  # fmt: skip
    return SolverModel(
        functions, tuple(members), (*callbacks, *solver.public_callbacks(functions, bare)),
        one.c_width, f"{one.target.PREFIX}_LANES", bool(steppers.accelerations.constants),
        steppers.constants_call, has_sweep=True,
    )  # fmt: skip
