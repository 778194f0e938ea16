"""Data for the templates (views) of adaptive steps and events, in both forms of C."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from eomc.emit.c_function import CFunction
from eomc.emit.portable.parts import Named


@dataclass(frozen=True)
class AdaptiveTableau(Named):
    """Coefficients and constants that the templates of adaptive steps share, as C literals.

    Attributes
    ----------
    method
        Prefix of the C names of the integration method.
    extent
        Length of vectors of coordinates, as a C expression.
    stages, c
        Number of stages of the method, and the nodes: times of the stages as fractions of a step.
    f, sqrt
        Suffix of C literals of this precision, and the name of the C square root.
    eps, tiny
        The rounding unit, and a small positive number that avoids divisions by zero.
    powers
        Matrix that multiplies the accelerations at the stages, to obtain the coefficients of the
        polynomial of time through them.
    most
        Largest number of iterations over the stages.
    retry_after
        Number of steps by Newton's method before fixed-point iteration is tried again.
    of_most, of_most_coarse
        Least scale to which the error of a coordinate or velocity is related, as a fraction of the
        largest coordinate or velocity: in general, and where rounding errors are estimated.
    unscaled
        Number of trailing coordinates that only jumps change; they have no scale.
    """

    method: str
    extent: str
    stages: int
    f: str
    sqrt: str
    eps: str
    tiny: str
    of_most: str
    of_most_coarse: str
    unscaled: int
    most: int
    c: tuple[str, ...]
    powers: tuple[str, ...]
    retry_after: int


@dataclass(frozen=True)
class Adaptive(AdaptiveTableau):
    """Data for c/adaptive.c: one step with adaptive step-size control.

    The four templates that it includes read the same data.

    Attributes
    ----------
    lanes
        Macro before loops over stages that the compiler is to vectorise; "" for none.
    total
        C expression for the sum of half[0], half[1], ..., the sums of pairs of stages.
    top
        Rows of the matrix that multiplies the accelerations at the stages, to obtain the
        coefficients of the last four Legendre polynomials. The error is estimated from these.
    weights
        Rows of weights of the stage accelerations in the increments of position and velocity.
    timed, events, begins
        Whether accelerations depend on time, whether there are events, and whether some events may
        trigger at the start of a motion.
    may_rest, capped, capped_now
        Whether all bodies may stay at rest under time-dependent forces, so that motions are
        rounding errors; the function that then limits the scales of the error estimate; its call.
    project, whole
        C call that projects the end of a step onto the constraints ("" for none), and whether its
        arguments are the state (q, q̇) itself rather than the increments in the step.
    solve_stages, sweep, solve, solve_within
        The function `solve_stages`, which solves for the stages by iteration; the C call of one
        iteration in it; and its C calls for a step and for the state within a step.
    step, start, within
        The function for the next step, the call of the accelerations at its start, and the function
        for the state within a step (dense output).
    corners, share
        Whether forces may jump or have kinks, and the fraction of the tolerance that applies to
        steps in which they do.
    fabs, longest, close
        Name of the C function for |x|; largest time span, in time scales of the initial motion, to
        which the least step size is relative; number of least step sizes within which kinks count
        as repeated.
    ends
        Weights of the stage accelerations that give the values of their polynomial at the start and
        at the end of a step.
    forces, forces_there, forces_here, forces_near
        The function for the accelerations at a state, and its calls at the end of a step, at a
        state, and at a perturbed state.
    slopes, slopes_now, nudge
        The function for the derivatives of the accelerations by finite differences, its call, and
        the relative size of the differences.
    eigenvalues, to_parts, from_parts
        The three results of `Method.eigen`, for Newton's method.
    """

    TEMPLATE: ClassVar[str] = "c/adaptive.c"
    title: str
    lanes: str
    total: str
    top: tuple[str, ...]
    weights: tuple[str, ...]
    timed: bool
    may_rest: bool
    capped: CFunction
    capped_now: str
    events: bool
    begins: bool
    project: str
    whole: bool
    solve_stages: CFunction
    sweep: str
    step: CFunction
    start: str
    solve: str
    within: CFunction
    solve_within: str
    corners: bool
    fabs: str
    longest: str
    close: str
    share: str
    ends: tuple[str, ...]
    forces: CFunction
    forces_there: str
    forces_here: str
    forces_near: str
    slopes: CFunction
    slopes_now: str
    nudge: str
    eigenvalues: tuple[str, ...]
    to_parts: tuple[str, ...]
    from_parts: tuple[str, ...]


@dataclass(frozen=True)
class FixedSteps(Named):
    """Data for c/fixed_steps.c: steps of fixed size with event detection.

    Attributes
    ----------
    method, extent, stages, f, eps
        As in `AdaptiveTableau`.
    fabs
        Name of the C function for |x|.
    timed, jumps, above
        Whether accelerations depend on time, whether events make the state jump, and whether there
        are events of stick-slip friction.
    fixed, at
        Prototypes of the functions for the next step and for the state at a time within the last
        step.
    inside
        C call that interpolates the state within an adaptive step.
    step
        C call of the integration method through the function pointer memory->step.
    forces_before, forces_halfway, forces_after
        C calls of the accelerations at the start, the middle and the end of a step.
    """

    TEMPLATE: ClassVar[str] = "c/fixed_steps.c"
    method: str
    extent: str
    stages: int
    f: str
    eps: str
    fabs: str
    timed: bool
    jumps: bool
    above: bool
    fixed: CFunction
    at: CFunction
    inside: str
    step: str
    forces_before: str
    forces_halfway: str
    forces_after: str


@dataclass(frozen=True)
class Events(Named):
    """Data for c/events.c: event detection in a step, and state jumps.

    An event triggers at a root of its event function, a function of time and state.

    Attributes
    ----------
    method, fabs, sqrt, eps, tiny, huge
        Prefix of C names, names of C functions, and constants.
    samples, nodes, slopes
        Number of evaluations of an event function in a step; their positions, as fractions of the
        step; and the matrix that multiplies the values there to obtain the derivatives there.
    stages, once, twice
        Number of stages; the first and the second integrals of the powers of time up to each node.
    directions, actions, above
        For each event: -1, 0 or 1 for falling, both or rising; 0, 1 or 2 for record, stop or jump;
        1 if its function cannot become negative immediately after it was zero.
    jumps
        Whether events make the state jump.
    max_events, together
        Largest number of events in one step, and of jumps at the same time.
    difference_step, near, close
        Tolerances as fractions of a step: for finite differences, for corrections of a root, and
        for an accurate root.
    chance
        Fraction of the time between jumps. If the next jump follows within it, the two jumps are
        taken as coincidental.
    halvings, recent_steps
        A step is halved at most `halvings` times to resolve event functions, not counting one
        halving in every `recent_steps` steps.
    max_tail, last
        Largest size of the last Chebyshev coefficients of a resolved event function, relative to
        its largest value, and the weights that compute these coefficients.
    rounding, rounded, values_near
        The function that estimates the rounding error of an event function, its C call, and the C
        call of the event functions in its body.
    evaluate_events, refine_root, find_root, event_step, changed, restart
        The functions: event functions within a step, root between two times, first root in a step,
        all events of a step, changes by new inputs, and the start after an event.
    values, values_there, values_end, values_now, values_before, values_after
        C calls of the event functions: in `evaluate_events`, at a state within the step, at its
        end, in `changed`, and before and after a jump.
    look_value, look_before, look_after, bracket, bracket_dip, cross, inside
        C calls of `evaluate_events` at a time and shortly before and after it, of `refine_root` up
        to a node and up to a minimum, of `find_root`, and of the state within a step.
    jump, project, project_all
        C calls of the jump map (the new state after an event), and of the projection onto the
        constraints with and without entries of the state that stay fixed; "" for none.
    set
        For each event of the scene, 1 for the entries of q and qd that its jump sets, else 0.
    modes
        Initialisers with the indices of each friction mode and of its coordinate.
    own
        Number of events that the scene itself defines; the others belong to friction.
    """

    TEMPLATE: ClassVar[str] = "c/events.c"
    method: str
    fabs: str
    sqrt: str
    eps: str
    tiny: str
    samples: int
    nodes: tuple[str, ...]
    slopes: tuple[str, ...]
    stages: int
    once: tuple[str, ...]
    twice: tuple[str, ...]
    directions: tuple[int, ...]
    actions: tuple[int, ...]
    above: tuple[int, ...]
    jumps: bool
    max_events: int
    together: int
    difference_step: str
    near: str
    close: str
    chance: str
    huge: str
    halvings: int
    recent_steps: int
    rounding: CFunction
    rounded: str
    values_near: str
    max_tail: str
    last: tuple[str, ...]
    evaluate_events: CFunction
    values: str
    refine_root: CFunction
    find_root: CFunction
    look_value: str
    bracket: str
    bracket_dip: str
    event_step: CFunction
    cross: str
    look_before: str
    look_after: str
    inside: str
    values_there: str
    values_end: str
    changed: CFunction
    values_now: str
    restart: CFunction
    values_before: str
    jump: str
    project: str
    project_all: str
    set: tuple[str, ...]
    modes: tuple[str, ...]
    own: int
    values_after: str


@dataclass(frozen=True)
class InitialEvents(Named):
    """Data for c/initial_events.c: events that trigger at the start of a motion.

    Attributes
    ----------
    function
        Prototype of the static C function that makes the jumps of these events.
    values
        C call that computes one value for each event, which is positive if the event triggers.
    restart
        C call that makes the state jump.
    method
        Prefix of the C names of the integration method.
    """

    TEMPLATE: ClassVar[str] = "c/initial_events.c"
    function: CFunction
    values: str
    restart: str
    method: str


@dataclass(frozen=True)
class AdaptiveRun(Named):
    """Data for c/adaptive_run.c: a run by adaptive steps, with its rows and events.

    A row is one stored state of the run, at one of the requested times.

    Attributes
    ----------
    constants, compute_constants
        Whether there is a C struct of precomputed expressions of the parameters, and the C call
        that computes it ("" for none).
    unread_p
        Whether the parameters are an argument that the body does not use.
    loosest, tightest
        Largest and smallest tolerance.
    events, max_events
        Whether there are events, and their largest number in one step.
    recent_steps, retry_after
        As in `Events` and `AdaptiveTableau`.
    initial_events, changed, happen, restart, values
        C calls, "" for none: of the jumps at the start; of the function for changes of event
        functions when inputs change; of the detection of events in a step; of the restart after an
        event; and of the event functions.
    run, advance, fixed
        Prototype of the public function, and C calls of an adaptive step and of a fixed step.
    row, row_before, look
        C calls that store a row: the state at the end of a step, the state before a jump, and the
        state within a step.
    project_row, project_restart
        C calls that project a row and the state after an event onto the constraints; "" for none.
    """

    TEMPLATE: ClassVar[str] = "c/adaptive_run.c"
    method: str
    constants: bool
    unread_p: bool
    compute_constants: str
    loosest: str
    tightest: str
    events: bool
    f: str
    eps: str
    fabs: str
    recent_steps: int
    initial_events: str
    changed: str
    values: str
    huge: str
    max_events: int
    retry_after: int
    run: CFunction
    advance: str
    fixed: str
    happen: str
    restart: str
    row: str
    row_before: str
    look: str
    project_row: str
    project_restart: str


@dataclass(frozen=True)
class AdaptiveBatch:
    """Data for c/adaptive_batch.c: adaptive runs of many instances, in sequence.

    prefix: the scene's name, with which C names begin. batch: prototype of the public function.
    alone: C call of the run of one instance, with index k. events: whether the scene has events.
    """

    TEMPLATE: ClassVar[str] = "c/adaptive_batch.c"
    prefix: str
    batch: CFunction
    alone: str
    events: bool
