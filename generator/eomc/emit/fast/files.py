"""The fast form of C: a program as the views that its templates print, and all of its files.

For gcc and clang. What a step calls is printed over a lane type: one number for a trajectory, a
vector register for a batch and for the stages of sweeps, two points for what is long.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator

from eomc.base import resources
from eomc.emit import adaptive, events
from eomc.emit import c_function as c
from eomc.emit.c_expression import C_NAMES, DOUBLE, PIVOT
from eomc.emit.c_names import Target
from eomc.emit.derivatives import derivatives
from eomc.emit.fast import adaptive_lanes, projection, runs, views
from eomc.emit.fast.accelerations import Accelerations
from eomc.emit.fast.lanes import INLINE, Lane
from eomc.emit.fast.runs import ahead_count
from eomc.emit.fast.steppers import Steppers
from eomc.emit.functions import Functions
from eomc.emit.plain import steppers as plain
from eomc.emit.plain import views as plain_views
from eomc.emit.projection import project
from eomc.integrators.tableaux import RK4

Show = Callable[[views.View | plain_views.View], str]  # a view by its template

# what stands in csrc for names, types and sizes of a lane
PLACEHOLDERS = ("BITS_OF_SIZE", "INTEGER", "LANE_ALIGNED", "LANE_BYTES", "LANE_COUNT", "REAL")
OURS = frozenset({"exp", "tanh"})  # functions of the mathematics library that csrc has over a lane
TWO = ("atan2", "pow", "min", "max", PIVOT)  # of two arguments


def steppers(target: Target) -> Steppers:
    """The methods of a scene, on their accelerations."""
    functions = Functions(target)
    return Steppers(Accelerations(target), functions, plain.linearization(functions))


def rooms(made: Steppers) -> list[int]:
    """The numbers that each method's memory keeps, and behind that of adaptive steps."""
    system = made.one.target.system
    room = adaptive.workspace_size(system, made.one.width)
    return [*(runs.kept(made, m) for m in made.methods), room]


def files(made: Steppers, show: Show) -> dict[str, str]:
    """Header and source of the fast form by file name."""
    functions, slopes, target = made.functions, made.slopes, made.accelerations.target
    stamp = f"0x{hashlib.sha256(f'fast {target.system.digest}'.encode()).hexdigest()[:8]}u"
    header = show(plain.header(functions, slopes, stamp, rooms(made), fast=True))
    source = show(
        views.Source(
            **plain.source(functions, stamp, slopes, show),
            rolled=made.two_point,
            unroll=made.one.unroll,
            extent=made.one.extent,
            inline=made.one.qualifiers[INLINE],
            wide=_wide(made),
            csrc=tuple(_csrc(made)),
            lanes=tuple(filter(None, _lanes(made, show))),
            steppers=tuple(_steppers(made, show)),
        )
    )
    name = target.prefix
    return {f"{name}.h": c.laid_out(header), f"{name}.c": c.laid_out(source)}


def _wide(made: Steppers) -> bool:
    """Whether the lane of a register is needed."""
    run = made.accelerations.target.system.run
    return run.batch or made.functions.swept


def _csrc(made: Steppers) -> Iterator[str]:
    """The hand-written C that this scene needs, under its own prefix."""
    target = made.accelerations.target
    end = target.real.function_suffix
    size = 8 if target.real is DOUBLE else 4
    rotates = bool(made.accelerations.angles) and RK4 in made.methods
    lanes = [("wide", f"{target.PREFIX}_WIDE_BYTES", True)] * _wide(made)
    if made.two_point:
        lanes += [("two", str(2 * size), False)]
    across = made.accelerations.across
    angles = made.functions.several or across
    if angles:
        lanes += [("four", str(4 * size), across)]
    if RK4 in made.methods and made.predicted:
        bytes_ahead = size * ahead_count(len(made.accelerations.angles))
        lanes += [("ahead", str(bytes_ahead), False)]
    texts = [(f"sincos/sincos{end}.h", "", "")] if target.sincos else []
    if rotates:
        texts += [("lanes/scalar.h", "", ""), (f"lanes/rotate{end}.h", "", "")]
    texts += [("lanes/larger.h", "", "")] * any(m.implicit for m in made.methods)
    for name, width, turns in lanes:
        texts += [("lanes/vector.h", name, width)]
        texts += [(f"lanes/sincos{end}.h", name, width)] * target.sincos
        texts += [(f"lanes/rotate{end}.h", name, width)] * (turns and rotates)
        ours = OURS & set(made.one.calls) if name in ("wide", "two") else frozenset()
        selects = bool(ours) or (name == "wide" and adaptive.together(target))
        texts += [("lanes/select.h", name, width)] * selects
        texts += [(f"lanes/exp{end}.h", name, width)] * bool(ours)
        texts += [(f"lanes/tanh{end}.h", name, width)] * ("tanh" in ours)
        texts += [("lanes/four.h", name, width)] * (name == "four" and across)
        texts += [("lanes/interleave.h", name, width)] * (name == "four" and made.two_point)
        texts += [("lanes/angles.h", name, width)] * (name == "four" and angles)
    for file, name, width in texts:
        text = resources.text("csrc", file).replace("#include <math.h>\n", "")
        integer, bits = ("long long", "0x7fffffffffffffff") if size == 8 else ("int", "0x7fffffff")
        for old, new in (
            # for many angles, gcc takes half as long again where it has inlined each one's
            *([("static inline void", "static void")] if made.accelerations.long else ()),
            ("EOMC_BITS_OF_SIZE", bits),
            ("EOMC_INTEGER", integer),
            # compilers change how they pass what is aligned to more than a register has
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


def _lanes(made: Steppers, show: Show) -> Iterator[str]:
    """The accelerations over each lane, and RK4 or another explicit method over the register."""
    if made.two_point:
        yield _library_text(Lane(made.accelerations, "two"), show)
    yield _lane(made, made.one, show)
    batch = made.accelerations.target.system.run.batch
    if _wide(made):
        yield _library_text(made.wide, show)
        yield _lane(made, made.wide, show)
    if made.functions.projection:
        yield show(project(made.functions))
        for lane in (made.one, *([made.wide] * batch)):
            yield show(projection.view(made.functions, lane))
    if batch:
        yield show(
            views.Blocks(
                prefix=made.one.prefix,
                PREFIX=made.one.target.PREFIX,
                lane=made.wide.real.name,
                constants=made.wide.constants if made.accelerations.constants else "",
                inputs=bool(made.accelerations.target.system.inputs),
                blocks=1 if made.accelerations.long else 4,
            )
        )


def _lane(made: Steppers, lane: Lane, show: Show) -> str:
    """The accelerations over one lane."""
    s, target = made.accelerations, lane.target
    signal = lane.signal
    constants = c.struct(lane.constants, lane.real.name, s.constants) if s.constants else ""
    parts = s.parts if not lane.name else None
    rates = lane.rates.text if parts is None else show(_two_points(made)).rstrip("\n")
    computed = lane.compute_constants.text if not lane.name and runs.constants_call(made) else ""
    return show(
        views.LaneText(
            prefix=target.prefix,
            PREFIX=target.PREFIX,
            unroll=lane.unroll,
            **lane.names,
            clear=lane.clear,
            constants="\n\n".join(filter(None, (constants, computed))),
            angles=lane.angle_count if s.angles else "",
            count=len(s.angles),
            across=lane.across,
            angles_at=lane.linear("angles_at", "q", offset=True),
            changes=lane.linear("changes", "d", offset=False),
            sincos=lane.sincos,
            signal=signal,
            signal_call=""
            if signal is None or made.given_signals
            else signal.function.call(u="now"),
            rates=rates,
            rates_call=lane.velocity.function.call(k="&k", point="0")
            if parts
            else lane.rates.function.call(),
            accelerations=lane.all_in_one,
            two_point=parts is not None,
            takes_c=bool(s.constants),
            alone=lane.alone,
        )
    )


def _library_text(lane: Lane, show: Show) -> str:
    """The functions of the mathematics library over a lane of several numbers."""
    names = set(lane.calls) - OURS
    if lane.name == "wide" and adaptive.together(lane.accelerations.target):
        names.add("sqrt")
    return show(
        views.LibraryText(
            prefix=lane.prefix,
            real=lane.accelerations.target.real.name,
            **lane.names,
            count=f"{lane.target.PREFIX}_{lane.name.upper()}_COUNT",
            calls=tuple(
                _library(lane.accelerations, n, lane.end == "_wide") for n in sorted(names)
            ),
        )
    )


def _library(s: Accelerations, name: str, wide: bool) -> views.Library:
    """A function of the mathematics library, or ours; wide: over a register."""
    if name == PIVOT:
        return views.Library(name, name, True, "")
    called = C_NAMES.get(name, name)
    letter = "d" if s.target.real is DOUBLE else "s"
    whole = f"__builtin_ia32_sqrtp{letter}512_mask(x, x, -1, 4)" if wide and name == "sqrt" else ""
    return views.Library(called, called + s.target.real.function_suffix, name in TWO, whole)


def _two_points(made: Steppers) -> views.TwoPoints:
    """The accelerations of one trajectory in the two-point form."""
    s, one = made.accelerations, made.one
    two = Lane(s, "two")
    assert s.parts is not None
    configuration = two.configuration
    return views.TwoPoints(
        prefix=one.prefix,
        real=one.real.name,
        extent=one.extent,
        inline=one.qualifiers[INLINE],
        members=c.struct(f"{one.prefix}_configuration", two.real.name, s.parts.handed),
        angles=one.angle_count,
        configuration=configuration,
        constants=bool(s.constants),
        call=configuration.function.call(),
        velocity=one.velocity,
    )


def _steppers(made: Steppers, show: Show) -> Iterator[str]:
    """The methods: their state, one step, run and batch."""
    real = made.one.real
    run = made.accelerations.target.system.run
    if run.tolerance is not None or any(m.newton for m in made.methods):
        fabs = f"fabs{real.function_suffix}"
        yield show(views.Factors(made.one.prefix, made.one.real.name, fabs, real.suffix))
    for m in made.methods:
        lanes = [made.one, *([made.wide] if run.batch else [])]
        if m is RK4:
            yield from (show(made.rk4(lane)) for lane in lanes)
        elif not m.implicit:
            yield from (show(made.explicit(lane, m)) for lane in lanes)
        if runs.predicts(made, m):
            yield show(made.predictions())
        yield show(runs.state(made, m))
        if runs.predicts(made, m):
            yield show(made.prediction())
        if m.sweeps:
            yield show(made.stages(m)) + "\n" + show(made.sweeps(m)).rstrip("\n")
        elif m.implicit:
            yield show(made.gauss(m))
        yield show(runs.loop(made, m))
        if run.batch:
            yield show(runs.batch(made, m))
    if run.tolerance is not None:
        if adaptive.METHOD not in made.methods:
            yield show(made.stages(adaptive.METHOD))
        yield from map(show, events.views(made.functions, _adaptive(made)))
        if run.batch:
            side_by_side = adaptive.together(made.accelerations.target)
            many = adaptive_lanes.view(made, _adaptive(made)) if side_by_side else None
            yield show(many or adaptive.batch(made.functions))
    yield from map(show, derivatives(made.functions))


def _adaptive(made: Steppers) -> adaptive.SweepInterface:
    """The sweeps of adaptive steps, stages in a lane each."""
    one, m = made.one, adaptive.METHOD
    sweep = made.sweep(m).call(b="to", a="from", w=f"&{one.prefix}_{m.name}_within")
    return adaptive.SweepInterface(
        made.stepping(one), sweep, made.accelerate(one, a="f"), one.extent,
        bool(made.accelerations.constants), runs.constants_call(made),
        f"{one.target.PREFIX}_LANES",
        projection.ending(
            made.functions, one, s="NULL", t=f"{c.member('x', 't')} + h", singular="&singular"
        ),
    )  # fmt: skip
