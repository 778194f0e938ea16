"""Optimised C: the header and the source of a program.

For gcc and clang. Functions of a step are printed for several C types: numbers for a trajectory, a
vector register for batches and for iterated stages, two configurations for long accelerations.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from eomc.base import resources
from eomc.emit import adaptive, events, sources
from eomc.emit import c_function as c
from eomc.emit.c_expression import C_NAMES, DOUBLE, PIVOT
from eomc.emit.c_function import CFunction, GeneratedFunction
from eomc.emit.c_names import Target
from eomc.emit.derivatives import linearization, step_derivatives
from eomc.emit.functions import SceneFunctions
from eomc.emit.optimised import runs
from eomc.emit.optimised.accelerations import Accelerations
from eomc.emit.optimised.lanes import INLINE, Lane
from eomc.emit.optimised.runs import prediction_width
from eomc.emit.optimised.steppers import LaneFields, Steppers
from eomc.emit.projection import project_view
from eomc.emit.sources import SourceFields
from eomc.emit.views import NameFields, PrefixFields, Show
from eomc.integrators.tableaux import RK4

# Placeholders in csrc for names, types and sizes of a lane
PLACEHOLDERS = ("BITS_OF_SIZE", "INTEGER", "LANE_ALIGNED", "LANE_BYTES", "LANE_COUNT", "REAL")
LANE_FUNCTIONS = frozenset({"exp", "tanh"})  # mathematical functions in csrc over a lane
BINARY_FUNCTIONS = ("atan2", "pow", "min", "max", PIVOT)


@dataclass(frozen=True)
class OptimisedSourceView(NameFields, SourceFields):
    """Data for c/optimised/source.c: the source file of the optimised C.

    Attributes
    ----------
    rolled
        Whether loops over coordinates are left to the compiler to vectorise, not unrolled.
    unroll, inline
        Macros before loops over coordinates and before inlined functions.
    extent
        Length of vectors of coordinates, as a C expression.
    wide
        Whether the code uses vector registers with values of several instances.
    csrc
        Texts of the hand-written C that this scene needs.
    lanes
        Finished C texts of the accelerations, for one number and for vector registers.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/source.c"
    rolled: bool
    unroll: str
    extent: str
    inline: str
    wide: bool
    csrc: tuple[str, ...]
    lanes: tuple[str, ...]


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


@dataclass(frozen=True)
class LibraryView(PrefixFields, LaneFields):
    """Data for c/optimised/library.c: mathematical functions for a vector register.

    count: number of values in the register, as a C expression. calls: the functions.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/library.c"
    count: str
    calls: tuple[LibraryFunction, ...]


@dataclass(frozen=True)
class LaneView(LaneFields):
    """Data for c/optimised/lane.c: C functions for the accelerations.

    The template is printed for each *lane* type: one number, or a vector register with one value of
    each of several instances. Angles are those whose sines and cosines the accelerations read.

    Attributes
    ----------
    unroll, clear
        Macro before loops over angles, and initialiser for "no failure".
    constants
        C text of the struct of precomputed expressions and of the function that computes it.
    angles, count
        Length of arrays of angles as C text ("" without angles), and the number of angles.
    across
        Whether the sines of four angles are computed in one vector register.
    angles_at, changes
        The C functions for the angles at q, and for changes of these from a change of q.
    sincos
        Name of the C function for sine and cosine of one angle.
    signal, signal_call
        The function for the scene's signals (None without signals), and its C call in the
        accelerations ("" if all callers supply the inputs).
    rates, rates_call
        C text of the accelerations from the state, its sines and the inputs, and the C call of that
        function.
    accelerations
        Prototype of the C function for the accelerations that also computes inputs (by the scene's
        signals) and sines if its arguments for these are NULL.
    two_point, takes_c
        Whether the accelerations are split into two parts, see `TwoPointsView`, and whether these
        read precomputed expressions.
    alone
        Whether some callers do not pass the sines, so that the function must compute them.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/lane.c"
    prefix: str
    PREFIX: str
    unroll: str
    clear: str
    constants: str
    angles: str
    count: int
    across: bool
    angles_at: CFunction
    changes: CFunction
    sincos: str
    signal: GeneratedFunction | None
    signal_call: str
    rates: str
    rates_call: str
    accelerations: CFunction
    two_point: bool
    takes_c: bool
    alone: bool


@dataclass(frozen=True)
class BlocksView:
    """Data for c/optimised/blocks.c: the C types of blocks and tiles.

    A block is the group of instances of a batch that share a vector register. A tile is a group of
    blocks that are stepped together.

    lane: C type of a vector register. inputs: whether the scene has inputs. constants: C type of
    the precomputed expressions of the parameters; "" for none. blocks: number of blocks in a tile.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/blocks.c"
    prefix: str
    PREFIX: str
    lane: str
    inputs: bool
    constants: str
    blocks: int


@dataclass(frozen=True)
class TwoPointsView(PrefixFields):
    """Data for c/optimised/two_point.c: accelerations that are split into two C functions.

    The first one computes the position-dependent part for two configurations q in one vector
    register. The second one computes the accelerations from it, at one of the two configurations.

    Attributes
    ----------
    extent, inline
        Length of vectors of coordinates as C text, and the macro before inlined functions.
    members
        C definition of the struct with the values that the first part hands to the second one.
    angles
        Length of arrays of angles as C text.
    configuration, velocity
        The functions for the two parts.
    constants
        Whether there are precomputed expressions of the parameters.
    call
        C call of `configuration`.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/two_point.c"
    extent: str
    inline: str
    members: str
    angles: str
    configuration: GeneratedFunction
    constants: bool
    call: str
    velocity: GeneratedFunction


@dataclass(frozen=True)
class LUView(PrefixFields):
    """Data for c/optimised/lu.c: LU factorisation of a matrix, and solution of A x = b.

    fabs: name of the C function for |x|. f: suffix of C literals.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/lu.c"
    fabs: str
    f: str


def steppers(target: Target) -> Steppers:
    """Return the integration methods of a scene in optimised C, with its accelerations.

    target: the scene's program and its C names.
    """
    functions = SceneFunctions(target)
    return Steppers(Accelerations(target), functions, linearization(functions))


def workspace_sizes(steppers: Steppers) -> list[int]:
    """Return the lengths of the workspaces that runs in optimised C need, as counts of numbers.

    The list has one length for each integration method with fixed steps, and then the length for
    adaptive steps.
    """
    system = steppers.one.target.system
    size = adaptive.workspace_size(system, steppers.one.width)
    return [*(runs.state_size(steppers, m) for m in steppers.methods), size]


def files(steppers: Steppers, show: Show) -> dict[str, str]:
    """Return the header and the source of a scene in optimised C, as texts by file name.

    steppers: the scene's integration methods. show: function that renders template data as text.
    """
    functions, slopes, target = steppers.functions, steppers.slopes, steppers.accelerations.target
    stamp = f"0x{hashlib.sha256(f'fast {target.system.digest}'.encode()).hexdigest()[:8]}u"
    header = show(
        sources.header_view(functions, slopes, stamp, workspace_sizes(steppers), fast=True)
    )
    source = show(
        OptimisedSourceView(
            **sources.source_fields(functions, stamp, slopes, show),
            rolled=steppers.two_point,
            unroll=steppers.one.unroll,
            extent=steppers.one.c_width,
            inline=steppers.one.qualifiers[INLINE],
            wide=_wide(steppers),
            csrc=tuple(_csrc(steppers)),
            lanes=tuple(filter(None, _lanes(steppers, show))),
            steppers=tuple(_steppers(steppers, show)),
        )
    )
    name = target.prefix
    return {f"{name}.h": c.break_long_lines(header), f"{name}.c": c.break_long_lines(source)}


def _wide(steppers: Steppers) -> bool:
    """Return True if code for vector registers is needed."""
    run = steppers.accelerations.target.system.run
    return run.batch or steppers.functions.iterates_stages


def _csrc(steppers: Steppers) -> Iterator[str]:
    """Yield the hand-written C that this scene needs, with its prefix."""
    target = steppers.accelerations.target
    end = target.real.function_suffix
    size = 8 if target.real is DOUBLE else 4
    rotates = bool(steppers.accelerations.angles) and RK4 in steppers.methods
    lanes = [("wide", f"{target.PREFIX}_WIDE_BYTES", True)] * _wide(steppers)
    if steppers.two_point:
        lanes += [("two", str(2 * size), False)]
    simd = steppers.accelerations.simd_angles
    angles = steppers.functions.has_grouped_angles or simd
    if angles:
        lanes += [("four", str(4 * size), simd)]
    if RK4 in steppers.methods and steppers.predicts_angles:
        prediction_bytes = size * prediction_width(len(steppers.accelerations.angles))
        lanes += [("prediction", str(prediction_bytes), False)]
    texts = [(f"sincos/sincos{end}.h", "", "")] if target.sincos else []
    if rotates:
        texts += [("lanes/scalar.h", "", ""), (f"lanes/rotate{end}.h", "", "")]
    texts += [("lanes/larger.h", "", "")] * any(m.implicit for m in steppers.methods)
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
        texts += [("lanes/interleave.h", name, width)] * (name == "four" and steppers.two_point)
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


def _lanes(steppers: Steppers, show: Show) -> Iterator[str]:
    """Yield the C text of the accelerations, and of the projection, over each lane type."""
    if steppers.two_point:
        yield _library_text(Lane(steppers.accelerations, "two"), show)
    yield _lane(steppers, steppers.one, show)
    batch = steppers.accelerations.target.system.run.batch
    if _wide(steppers):
        yield _library_text(steppers.wide, show)
        yield _lane(steppers, steppers.wide, show)
    if steppers.functions.projection:
        yield show(project_view(steppers.functions))
        for lane in (steppers.one, *([steppers.wide] * batch)):
            yield show(lane.projection_view(steppers.functions))
    if batch:
        yield show(
            BlocksView(
                prefix=steppers.one.prefix,
                PREFIX=steppers.one.target.PREFIX,
                lane=steppers.wide.real.name,
                constants=steppers.wide.constants if steppers.accelerations.constants else "",
                inputs=bool(steppers.accelerations.target.system.inputs),
                blocks=1 if steppers.accelerations.is_long else 4,
            )
        )


def _lane(steppers: Steppers, lane: Lane, show: Show) -> str:
    """Return the accelerations over one lane."""
    s, target = steppers.accelerations, lane.target
    signal = lane.signal
    constants = c.define_struct(lane.constants, lane.real.name, s.constants) if s.constants else ""
    parts = s.parts if not lane.name else None
    rates = lane.rates.text if parts is None else show(_two_points(steppers)).rstrip("\n")
    computed = (
        lane.compute_constants.text if not lane.name and runs.constants_call(steppers) else ""
    )
    return show(
        LaneView(
            prefix=target.prefix,
            PREFIX=target.PREFIX,
            unroll=lane.unroll,
            **lane.names,
            clear=lane.clear,
            constants="\n\n".join(filter(None, (constants, computed))),
            angles=lane.angle_count if s.angles else "",
            count=len(s.angles),
            across=lane.simd_angles,
            angles_at=lane.angles_function("angles_at", "q", offset=True),
            changes=lane.angles_function("changes", "d", offset=False),
            sincos=lane.sincos,
            signal=signal,
            signal_call=""
            if signal is None or steppers.signals_supplied
            else signal.function.call(u="now"),
            rates=rates,
            rates_call=lane.velocity.function.call(k="&k", point="0")
            if parts
            else lane.rates.function.call(),
            accelerations=lane.accelerations_function,
            two_point=parts is not None,
            takes_c=bool(s.constants),
            alone=lane.computes_own_sines,
        )
    )


def _library_text(lane: Lane, show: Show) -> str:
    """Return the functions of the mathematics library over a lane of several numbers."""
    names = set(lane.math_functions) - LANE_FUNCTIONS
    if lane.name == "wide" and adaptive.steps_in_parallel(lane.accelerations.target):
        names.add("sqrt")
    return show(
        LibraryView(
            prefix=lane.prefix,
            real=lane.accelerations.target.real.name,
            **lane.names,
            count=f"{lane.target.PREFIX}_{lane.name.upper()}_COUNT",
            calls=tuple(
                _library(lane.accelerations, n, lane.suffix == "_wide") for n in sorted(names)
            ),
        )
    )


def _library(s: Accelerations, name: str, wide: bool) -> LibraryFunction:
    """Return the view of one mathematical function. wide: over a vector register."""
    if name == PIVOT:
        return LibraryFunction(name, name, True, "")
    called = C_NAMES.get(name, name)
    letter = "d" if s.target.real is DOUBLE else "s"
    whole = f"__builtin_ia32_sqrtp{letter}512_mask(x, x, -1, 4)" if wide and name == "sqrt" else ""
    return LibraryFunction(
        called, called + s.target.real.function_suffix, name in BINARY_FUNCTIONS, whole
    )


def _two_points(steppers: Steppers) -> TwoPointsView:
    """Return the view of the accelerations of one trajectory in two parts."""
    s, one = steppers.accelerations, steppers.one
    two = Lane(s, "two")
    assert s.parts is not None
    configuration = two.configuration
    return TwoPointsView(
        prefix=one.prefix,
        real=one.real.name,
        extent=one.c_width,
        inline=one.qualifiers[INLINE],
        members=c.define_struct(f"{one.prefix}_configuration", two.real.name, s.parts.handed),
        angles=one.angle_count,
        configuration=configuration,
        constants=bool(s.constants),
        call=configuration.function.call(),
        velocity=one.velocity,
    )


def _steppers(steppers: Steppers, show: Show) -> Iterator[str]:
    """Yield the methods: state, step, run and batch of each."""
    real = steppers.one.real
    run = steppers.accelerations.target.system.run
    if run.tolerance is not None or any(m.newton for m in steppers.methods):
        fabs = f"fabs{real.function_suffix}"
        yield show(LUView(steppers.one.prefix, steppers.one.real.name, fabs, real.suffix))
    for m in steppers.methods:
        lanes = [steppers.one, *([steppers.wide] if run.batch else [])]
        if m is RK4:
            yield from (show(steppers.rk4_view(lane)) for lane in lanes)
        elif not m.implicit:
            yield from (show(steppers.explicit_view(lane, m)) for lane in lanes)
        if runs.predicts(steppers, m):
            yield show(steppers.predictions_view())
        yield show(runs.state_view(steppers, m))
        if runs.predicts(steppers, m):
            yield show(steppers.predicted_steps_view())
        if m.sweeps:
            yield show(steppers.stages_view(m)) + "\n" + show(steppers.sweeps_view(m)).rstrip("\n")
        elif m.implicit:
            yield show(steppers.gauss_view(m))
        yield show(runs.runs_view(steppers, m))
        if run.batch:
            yield show(runs.batch_view(steppers, m))
    if run.tolerance is not None:
        if adaptive.METHOD not in steppers.methods:
            yield show(steppers.stages_view(adaptive.METHOD))
        yield from map(show, events.adaptive_views(steppers.functions, _adaptive(steppers)))
        if run.batch:
            side_by_side = adaptive.steps_in_parallel(steppers.accelerations.target)
            batch_view = (
                runs.adaptive_lanes_view(steppers, _adaptive(steppers)) if side_by_side else None
            )
            yield show(batch_view or adaptive.batch_view(steppers.functions))
    yield from map(show, step_derivatives(steppers.functions))


def _adaptive(steppers: Steppers) -> adaptive.SweepInterface:
    """Return the iteration over the stages for adaptive steps, one stage per lane element."""
    one, m = steppers.one, adaptive.METHOD
    sweep = steppers.sweep_prototype(m).call(b="to", a="from", w=f"&{one.prefix}_{m.name}_within")
    return adaptive.SweepInterface(
        steppers.step_arguments(one), sweep, steppers.accelerate(one, a="f"), one.c_width,
        bool(steppers.accelerations.constants), runs.constants_call(steppers),
        f"{one.target.PREFIX}_LANES",
        one.project_end_call(s="NULL", t=f"{c.member('x', 't')} + h", singular="&singular"
        ),
    )  # fmt: skip
