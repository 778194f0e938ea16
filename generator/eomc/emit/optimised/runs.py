"""Runs and batches of a method in optimised C, by fixed and by adaptive steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from eomc.emit import adaptive
from eomc.emit import c_function as c
from eomc.emit.adaptive import METHOD, AdaptiveFields, AdaptiveFunctions, SweepInterface
from eomc.emit.c_function import CFunction
from eomc.emit.optimised.lanes import INLINE, NOINLINE
from eomc.emit.optimised.steppers import StepFields, Steppers
from eomc.emit.views import NameFields
from eomc.integrators.tableaux import RK4, Method
from eomc.scene.schema import MAX_TOLERANCE


@dataclass(frozen=True)
class RunStateView(NameFields):
    """Data for c/optimised/state.c: the C struct with the state of a run by one method.

    Attributes
    ----------
    extent
        Length of vectors of coordinates as C text.
    name, title, stages, implicit
        The method: its name in C, its title in comments, its number of stages, and whether it is
        implicit.
    predicted
        Whether the run extrapolates angles from one step to the next.
    newton, sweeps
        Whether the method uses Newton's method, and its fixed number of iterations (0 for none).
    inputs, constrained
        Whether the scene has inputs, and constraints.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/state.c"
    extent: str
    name: str
    title: str
    stages: int
    predicted: bool
    newton: bool
    sweeps: int
    implicit: bool
    inputs: bool
    constrained: bool


@dataclass(frozen=True)
class OptimisedRunsView(NameFields, StepFields):
    """Data for c/optimised/run.c: the functions for one step and for a run of many steps.

    Attributes
    ----------
    step, run
        Prototypes of the two functions.
    run_once
        C call of `run` for one step.
    unread_p
        Whether the parameters are an argument that the body does not use.
    compute_constants
        C call that precomputes expressions of the parameters; "" for none.
    newton, implicit, predicted
        Whether the method uses Newton's method, is implicit, and predicts angles.
    padded
        Whether vectors of coordinates are padded with zeros to a multiple of four.
    start_call, predicted_call
        C calls of the accelerations at the start of the run, and of the function for all steps that
        can use predicted (extrapolated) angles.
    advance, otherwise
        C calls of one step. `otherwise` repeats a step that failed by `advance`, and computes all
        sines anew; "" if `advance` already does so.
    project, project_again
        C calls that project the end of the step onto the constraints, after `advance` and after
        `otherwise`; "" without constraints.
    corrected
        Whether the step returns the sines and cosines at its end for the projection.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/run.c"
    extent: str
    name: str
    step: CFunction
    run_once: str
    run: CFunction
    unread_p: bool
    compute_constants: str
    newton: bool
    implicit: bool
    padded: bool
    predicted: bool
    start_call: str
    predicted_call: str
    advance: str
    otherwise: str
    project: str
    project_again: str
    corrected: bool


@dataclass(frozen=True)
class OptimisedBatchView(NameFields, StepFields):
    """Data for c/optimised/batch.c: steps of many instances in vector registers.

    Attributes
    ----------
    batch
        Prototype of the function.
    rk4, angles
        Whether the method is RK4, and whether the accelerations take sines of angles as arguments.
    shared_signals
        Whether the signals depend on time only, so that they are computed once for several stages.
    members
        Names of the precomputed expressions of the parameters.
    unread_p
        Whether the parameters are an argument that the body does not use.
    own
        Whether instances may have parameters, and so precomputed expressions, of their own.
    compute_constants, compute_own
        C calls that compute these expressions from the first parameters and from those of instance
        k.
    alone
        C call of a step of a single instance. It repeats a step that failed when it was computed in
        a vector register together with other instances.
    project, project_alone
        C calls that project the end of a step onto the constraints, in a register and for one
        instance; "" without constraints.
    corrected
        Whether the step returns the sines and cosines at its end for the projection.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/batch.c"
    extent: str
    noinline: str
    name: str
    batch: CFunction
    rk4: bool
    angles: bool
    shared_signals: bool
    members: tuple[str, ...]
    unread_p: bool
    own: bool
    compute_constants: str
    compute_own: str
    alone: str
    project: str
    corrected: bool
    project_alone: str


@dataclass(frozen=True)
class AdaptiveLanesView(NameFields, AdaptiveFields):
    """Data for c/optimised/adaptive_lanes.c: adaptive steps of many instances.

    The instances are computed side by side in vector registers.

    Attributes
    ----------
    max_roughness
        Largest error estimate, in units of sqrt(tol/2), after two iterations; a step that exceeds
        it is rejected.
    loosest, tightest
        Largest and smallest tolerance.
    inputs, constants, members
        Whether there are inputs and precomputed expressions, and the names of the latter.
    compute_constants, compute_own, own
        As in `OptimisedBatchView`.
    accelerate, forces
        C calls of the accelerations: of all instances in a register at a stage, and of one instance
        at its initial state.
    batch, alone
        Prototype of the function, and C call that steps one instance.
    store_row, look
        C calls that store a state of the trajectory: the one at the end of a step, and one
        interpolated within the step.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/adaptive_lanes.c"
    inline: str
    noinline: str
    max_roughness: str
    loosest: str
    tightest: str
    inputs: bool
    constants: bool
    members: tuple[str, ...]
    compute_constants: str
    compute_own: str
    own: bool
    accelerate: str
    forces: str
    batch: CFunction
    alone: str
    store_row: str
    look: str


def predicts(steppers: Steppers, m: Method) -> bool:
    """Return True if steps of the integration method `m` extrapolate angles to the next step.

    The sines and cosines of these predicted angles are then computed in advance.
    """
    return m is RK4 and steppers.predicts_angles


def state_view(steppers: Steppers, m: Method) -> RunStateView:
    """Return the template data of the C struct with the state of a run by the method `m`."""
    lane = steppers.one
    return RunStateView(
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


def runs_view(steppers: Steppers, m: Method) -> OptimisedRunsView:
    """Return the template data of the C functions for one step and many steps of the method `m`."""
    lane, s, public = steppers.one, steppers.accelerations, steppers.functions.public
    run = public.run(m.name)
    corrected = steppers.passes_sines_to_projection(m)
    here = {"q": "x.q", "qd": "x.qd", "u": "input", "m": "&x", "end": "&sines"}
    end = [c.output_array(f"{lane.prefix}_sines", "end")] if corrected else []
    advance = (
        steppers.implicit_step(m) if m.implicit else steppers.step_prototype(lane, m.name, *end)
    )
    alone = steppers.step_prototype(lane, f"{m.name}_alone")
    step_end = {"q": "x.q", "qd": "x.qd", "t": "t + h", "singular": "&singular"}
    first = {"q": "x.q", "qd": "x.qd", "s": "&x.s", "u": "input", "a": "x.a"}
    zeros = dict.fromkeys(("first", "every", "q_rows", "qd_rows", "memory", "u_stride"), "0")
    predicted = ["&x", *(["t0"] if lane.target.driven else []), "h", "first", "n", "steps"]
    predicted += ["u", "u_stride"] if lane.target.system.inputs else []
    predicted += ["every", "q_rows", "qd_rows", *(["c"] if s.constants else [])]
    return OptimisedRunsView(
        **steppers.extended(lane),
        name=m.name,
        step=public.step(m.name),
        run_once=run.call(**zeros, t0="t", steps="1", status="&status"),
        run=run,
        **steppers.step_fields,
        unread_p=lane.target.needs_p
        and not constants_call(steppers)
        and "p" not in {a.name for a in advance.arguments},
        compute_constants=constants_call(steppers),
        newton=m.newton,
        implicit=m.implicit,
        padded=m.implicit and lane.padded,
        predicted=predicts(steppers, m),
        start_call=lane.accelerations_function.call(**first),
        predicted_call=f"{lane.prefix}_rk4_predicted({', '.join(predicted)})",
        advance=advance.call(**here),
        otherwise=alone.call(**here) if m is RK4 and s.angles else "",
        corrected=corrected,
        project=lane.project_end_call(**step_end, s="&sines" if corrected else "NULL"),
        project_again=lane.project_end_call(**step_end, s="NULL"),
    )


def batch_view(steppers: Steppers, m: Method) -> OptimisedBatchView:
    """Return the template data of the C function that steps many instances by the method `m`."""
    lane, s = steppers.one, steppers.accelerations
    rk4 = m is RK4
    alone = steppers.step_prototype(lane, "rk4_alone" if rk4 and s.angles else m.name)
    has_own_constants = bool(constants_call(steppers)) and lane.target.needs_p
    return OptimisedBatchView(
        **steppers.extended(lane),
        noinline=lane.qualifiers[NOINLINE],
        name=m.name,
        batch=steppers.functions.public.batch(m.name),
        rk4=rk4,
        angles=bool(s.angles),
        **steppers.step_fields,
        shared_signals=steppers.shared_signals,
        members=s.constants,
        unread_p=lane.target.needs_p and not has_own_constants,
        own=has_own_constants,
        compute_constants=constants_call(steppers),
        compute_own=lane.compute_constants.function.call(c="&constants", p="p + k*p_instance"),
        alone=alone.call(q="at", qd="moving", u="input"),
        corrected=steppers.passes_sines_to_projection(m),
        project=steppers.wide.project_end_call(
            q="from[b].q", qd="from[b].qd", t="t + h", c="&from[b].c",
            s="&w[b].end" if steppers.passes_sines_to_projection(m) else "NULL",
        ),
        project_alone=lane.project_end_call(
            q="at", qd="moving", t="t + h", singular="&singular", s="NULL"
        ),
    )  # fmt: skip


def prediction_width(angles: int) -> int:
    """Return the number of values in the C vector type for predicted angles.

    It is twice `angles`, the number of angles, rounded up to a power of two.
    """
    return 1 << (2 * angles - 1).bit_length()


def adaptive_lanes_view(steppers: Steppers, form: SweepInterface) -> AdaptiveLanesView:
    """Return the template data for adaptive steps of many instances side by side.

    steppers: the scene's integration methods in optimised C. form: the C calls and arguments that
    optimised C supplies to the code of adaptive steps, which both forms of C share.
    """
    one, wide, s, m = steppers.one, steppers.wide, steppers.accelerations, METHOD
    stepping, computed = AdaptiveFunctions(steppers.functions, form), constants_call(steppers)
    here = {"q": "at[i]", "qd": "moving[i]", "t": f"{c.member('x', 't')} + h*c_[i]"}
    return AdaptiveLanesView(
        **adaptive.adaptive_fields(stepping),
        inline=wide.qualifiers[INLINE],
        noinline=wide.qualifiers[NOINLINE],
        max_roughness=s.target.literal(adaptive.REJECT_AFTER_TWO),
        loosest=s.target.literal(MAX_TOLERANCE),
        tightest=s.target.literal(adaptive.min_tolerance(s.target.real)),
        inputs=bool(s.target.system.inputs),
        constants=bool(s.constants),
        members=s.constants,
        compute_constants=computed,
        compute_own=one.compute_constants.function.call(c="&constants", p="p + k*p_instance"),
        own=bool(computed) and one.target.needs_p,
        accelerate=steppers.accelerate(wide, a="f", **here, u="input", c=f"&{c.member('x', 'c')}"),
        forces=stepping.forces.call(f="f", q="s.q", qd="s.qd", t="s.t", u="input"),
        batch=steppers.functions.public.adaptive_batch(m.name),
        alone=adaptive.instance_call(steppers.functions),
        store_row=adaptive.store_row_prototype(stepping).call(q="s.q", qd="s.qd"),
        look=stepping.interpolate.call(
            q_at="q_row", qd_at="qd_row", x="&s", u="input", memory="memory + k",
            z="(times[row_counts[k]] - s.from - s.from_rest)/s.size",
        ),
    )  # fmt: skip
