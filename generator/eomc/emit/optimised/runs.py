"""Runs and batches of a method in optimised C: their template data and C calls."""

from __future__ import annotations

from eomc.emit import c_function as c
from eomc.emit.optimised import views
from eomc.emit.optimised.lanes import NOINLINE
from eomc.emit.optimised.projection import ending
from eomc.emit.optimised.steppers import Steppers
from eomc.integrators.tableaux import RK4, Method


def predicts(steppers: Steppers, m: Method) -> bool:
    """Return True if steps of the integration method `m` extrapolate angles to the next step.

    The sines and cosines of these predicted angles are then computed in advance.
    """
    return m is RK4 and steppers.predicted


def state(steppers: Steppers, m: Method) -> views.State:
    """Return the template data of the C struct with the state of a run by the method `m`."""
    lane = steppers.one
    return views.State(
        **steppers.extended(lane),
        name=m.name,
        title=m.title,
        stages=m.stages,
        predicted=predicts(steppers, m),
        newton=m.newton,
        sweeps=m.sweeps,
        implicit=m.implicit,
        inputs=bool(lane.target.system.inputs),
        constrained=bool(steppers.functions.projection),
    )


def state_size(steppers: Steppers, m: Method) -> int:
    """Return the length of the workspace that a run by the method `m` needs.

    It is a count of numbers of the C type of the scene, which the C header reserves.
    """
    n, angles, s = len(steppers.one.target.names), len(steppers.accelerations.angles), m.stages
    size = 4 * steppers.one.width + 32
    if steppers.functions.projection:
        size += 4
    if predicts(steppers, m):
        size += n + 2 * angles + 5 * prediction_width(angles)
    if m.newton:
        size += s * n * (s * n + 2)
    if m.sweeps:
        size += s * n + len(steppers.one.target.input_names)
    return size


def constants_call(steppers: Steppers) -> str:
    """Return the C call that precomputes expressions of the parameters before a run.

    "" if there are no such expressions to compute and nothing to check.
    """
    function = steppers.one.compute_constants.function
    is_empty = (
        not steppers.accelerations.constants and sum(len(b.lines) for b in function.body) == 2
    )
    return "" if is_empty else function.call(c="&constants")


def loop(steppers: Steppers, m: Method) -> views.Loop:
    """Return the template data of the C functions for one step and many steps of the method `m`."""
    lane, s, public = steppers.one, steppers.accelerations, steppers.functions.public
    run = public.run(m.name)
    corrected = steppers.corrected(m)
    here = {"q": "x.q", "qd": "x.qd", "u": "input", "m": "&x", "end": "&sines"}
    end = [c.output_array(f"{lane.prefix}_sines", "end")] if corrected else []
    advance = steppers.implicit(m) if m.implicit else steppers.advanced(lane, m.name, *end)
    alone = steppers.advanced(lane, f"{m.name}_alone")
    step_end = {"q": "x.q", "qd": "x.qd", "t": "t + h", "singular": "&singular"}
    first = {"q": "x.q", "qd": "x.qd", "s": "&x.s", "u": "input", "a": "x.a"}
    zeros = dict.fromkeys(("first", "every", "q_rows", "qd_rows", "memory", "u_stride"), "0")
    predicted = ["&x", *(["t0"] if lane.target.driven else []), "h", "first", "n", "steps"]
    predicted += ["u", "u_stride"] if lane.target.system.inputs else []
    predicted += ["every", "q_rows", "qd_rows", *(["c"] if s.constants else [])]
    return views.Loop(
        **steppers.extended(lane),
        name=m.name,
        step=public.step(m.name),
        run_once=run.call(**zeros, t0="t", steps="1", status="&status"),
        run=run,
        **steppers.driven,
        unread_p=lane.target.needs_p
        and not constants_call(steppers)
        and "p" not in {a.name for a in advance.arguments},
        compute_constants=constants_call(steppers),
        newton=m.newton,
        implicit=m.implicit,
        padded=m.implicit and lane.padded,
        predicted=predicts(steppers, m),
        start_call=lane.all_in_one.call(**first),
        predicted_call=f"{lane.prefix}_rk4_predicted({', '.join(predicted)})",
        advance=advance.call(**here),
        otherwise=alone.call(**here) if m is RK4 and s.angles else "",
        corrected=corrected,
        project=ending(steppers.functions, lane, **step_end, s="&sines" if corrected else "NULL"),
        project_again=ending(steppers.functions, lane, **step_end, s="NULL"),
    )


def batch(steppers: Steppers, m: Method) -> views.Batch:
    """Return the template data of the C function that steps many instances by the method `m`."""
    lane, s = steppers.one, steppers.accelerations
    rk4 = m is RK4
    alone = steppers.advanced(lane, "rk4_alone" if rk4 and s.angles else m.name)
    has_own_constants = bool(constants_call(steppers)) and lane.target.needs_p
    return views.Batch(
        **steppers.extended(lane),
        noinline=lane.qualifiers[NOINLINE],
        name=m.name,
        batch=steppers.functions.public.batch(m.name),
        rk4=rk4,
        angles=bool(s.angles),
        **steppers.driven,
        shared_signals=steppers.shared_signals,
        members=s.constants,
        unread_p=lane.target.needs_p and not has_own_constants,
        own=has_own_constants,
        compute_constants=constants_call(steppers),
        compute_own=lane.compute_constants.function.call(c="&constants", p="p + k*p_instance"),
        alone=alone.call(q="at", qd="moving", u="input"),
        corrected=steppers.corrected(m),
        project=ending(
            steppers.functions, steppers.wide, q="from[b].q", qd="from[b].qd", t="t + h",
            c="&from[b].c", s="&w[b].end" if steppers.corrected(m) else "NULL",
        ),
        project_alone=ending(
            steppers.functions, lane, q="at", qd="moving", t="t + h", singular="&singular", s="NULL"
        ),
    )  # fmt: skip


def prediction_width(angles: int) -> int:
    """Return the number of values in the C vector type for predicted angles.

    It is twice `angles`, the number of angles, rounded up to a power of two.
    """
    return 1 << (2 * angles - 1).bit_length()
