"""Runs and batches of a method in the fast form: their views, and the calls in them."""

from __future__ import annotations

from eomc.emit import c_function as c
from eomc.emit.fast import views
from eomc.emit.fast.lanes import NOINLINE
from eomc.emit.fast.projection import ending
from eomc.emit.fast.steppers import Steppers
from eomc.integrators.tableaux import RK4, Method


def predicts(made: Steppers, m: Method) -> bool:
    """Whether a method predicts angles."""
    return m is RK4 and made.predicted


def state(made: Steppers, m: Method) -> views.State:
    """What a run carries."""
    lane = made.one
    return views.State(
        **made.extended(lane),
        name=m.name,
        title=m.title,
        stages=m.stages,
        predicted=predicts(made, m),
        newton=m.newton,
        sweeps=m.sweeps,
        implicit=m.implicit,
        inputs=bool(lane.target.system.inputs),
        constrained=bool(made.functions.projection),
    )


def kept(made: Steppers, m: Method) -> int:
    """Numbers of the state that the header gives room for."""
    n, angles, s = len(made.one.target.names), len(made.accelerations.angles), m.stages
    size = 4 * made.one.width + 32
    if made.functions.projection:
        size += 4
    if predicts(made, m):
        size += n + 2 * angles + 5 * ahead_count(angles)
    if m.newton:
        size += s * n * (s * n + 2)
    if m.sweeps:
        size += s * n + len(made.one.target.input_names)
    return size


def constants_call(made: Steppers) -> str:
    """The constants computed, where there is something to compute."""
    function = made.one.compute_constants.function
    idle = not made.accelerations.constants and sum(len(b.lines) for b in function.body) == 2
    return "" if idle else function.call(c="&constants")


def loop(made: Steppers, m: Method) -> views.Loop:
    """A method's step and run."""
    lane, s, public = made.one, made.accelerations, made.functions.public
    run = public.run(m.name)
    corrected = made.corrected(m)
    here = {"q": "x.q", "qd": "x.qd", "u": "given", "m": "&x", "end": "&sines"}
    end = [c.filled(f"{lane.prefix}_sines", "end")] if corrected else []
    advance = made.implicit(m) if m.implicit else made.advanced(lane, m.name, *end)
    alone = made.advanced(lane, f"{m.name}_alone")
    behind = {"q": "x.q", "qd": "x.qd", "t": "t + h", "singular": "&singular"}
    first = {"q": "x.q", "qd": "x.qd", "s": "&x.s", "u": "given", "a": "x.a"}
    zeros = dict.fromkeys(("first", "every", "q_rows", "qd_rows", "memory", "u_stride"), "0")
    predicted = ["&x", *(["t0"] if lane.target.driven else []), "h", "first", "n", "steps"]
    predicted += ["u", "u_stride"] if lane.target.system.inputs else []
    predicted += ["every", "q_rows", "qd_rows", *(["c"] if s.constants else [])]
    return views.Loop(
        **made.extended(lane),
        name=m.name,
        step=public.step(m.name),
        run_once=run.call(**zeros, t0="t", steps="1", status="&status"),
        run=run,
        **made.driven,
        unread_p=lane.target.needs_p
        and not constants_call(made)
        and "p" not in {a.name for a in advance.arguments},
        compute_constants=constants_call(made),
        newton=m.newton,
        implicit=m.implicit,
        padded=m.implicit and lane.padded,
        predicted=predicts(made, m),
        start_call=lane.all_in_one.call(**first),
        predicted_call=f"{lane.prefix}_rk4_predicted({', '.join(predicted)})",
        advance=advance.call(**here),
        otherwise=alone.call(**here) if m is RK4 and s.angles else "",
        corrected=corrected,
        project=ending(made.functions, lane, **behind, s="&sines" if corrected else "NULL"),
        project_anew=ending(made.functions, lane, **behind, s="NULL"),
    )


def batch(made: Steppers, m: Method) -> views.Batch:
    """A method's batch."""
    lane, s = made.one, made.accelerations
    rk4 = m is RK4
    alone = made.advanced(lane, "rk4_alone" if rk4 and s.angles else m.name)
    own = bool(constants_call(made)) and lane.target.needs_p
    return views.Batch(
        **made.extended(lane),
        noinline=lane.qualifiers[NOINLINE],
        name=m.name,
        batch=made.functions.public.batch(m.name),
        rk4=rk4,
        angles=bool(s.angles),
        **made.driven,
        shared_signals=made.shared_signals,
        members=s.constants,
        unread_p=lane.target.needs_p and not own,
        own=own,
        compute_constants=constants_call(made),
        compute_own=lane.compute_constants.function.call(c="&constants", p="p + k*p_instance"),
        alone=alone.call(q="at", qd="moving", u="given"),
        corrected=made.corrected(m),
        project=ending(
            made.functions, made.wide, q="from[b].q", qd="from[b].qd", t="t + h", c="&from[b].c",
            s="&w[b].end" if made.corrected(m) else "NULL",
        ),
        project_alone=ending(
            made.functions, lane, q="at", qd="moving", t="t + h", singular="&singular", s="NULL"
        ),
    )  # fmt: skip


def ahead_count(angles: int) -> int:
    """Numbers of the lane for predicted angles: two each, to a power of two."""
    return 1 << (2 * angles - 1).bit_length()
