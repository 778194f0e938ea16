"""Views of the templates for adaptive steps and events, in both forms of C."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from eomc.emit.c_function import CFunction
from eomc.emit.plain.parts import Named


@dataclass(frozen=True)
class AdaptiveTableau(Named):
    """Coefficients and constants of adaptive steps.

    Attributes
    ----------
    method
        Prefix of the C names.
    powers
        Matrix from accelerations at the stages (rows) to coefficients of their polynomial.
    most
        Largest number of iterations over the stages.
    retry_after
        Steps by Newton's method before fixed-point iteration is tried again.
    of_most, of_most_coarse
        Least scale of coordinates and velocities, relative to the largest; for rounding errors.
    unscaled
        Number of trailing coordinates that only jumps change, which have no scale.
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
    """c/adaptive.c.jinja and the four templates that it includes: a step with error control.

    total: the sum of half[0], ... over half of the stages. lanes: macro before loops over stages.
    top: matrix from accelerations at the stages (rows) to the last four Legendre coefficients.
    weights: matrix to the increments of position and velocity. project: the call that projects the
    end of a step, given as an increment, or as a state with `whole`. may_rest: whether time-
    dependent forces may hold all bodies at rest; capped: the effect of rounding errors then.
    corners: whether forces jump or have kinks; share: of the tolerance, for steps with them. ends:
    weights of the values at both ends of a step. forces: accelerations at a state; slopes: their
    derivatives, by finite differences with step `nudge`. eigenvalues, to_parts, from_parts: see
    `Method.eigen`.
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
    """c/fixed_steps.c.jinja: steps of fixed size with event detection.

    fixed, at: the next step, and the state within the last one. step: the call of the method
    through a function pointer. inside: the call for the state within an adaptive step.
    forces_before, forces_halfway, forces_after: calls of the accelerations at both ends and the
    middle of a step. above: whether there are events of stick-slip friction.
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
    """c/events.c.jinja: event detection in adaptive steps.

    samples, nodes: number and positions of evaluations in a step. slopes: matrix from values at the
    nodes to derivatives. last: weights of the last Chebyshev coefficients. max_tail: largest such
    coefficient relative to the largest value; above it, a step is halved, at most `halvings` times
    besides one step in `recent_steps`. max_events: largest number of events in a step.
    difference_step, near, close: fractions of a step. chance: fraction of the time between jumps
    below which the next jump counts as coincidental.
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
    """c/initial_events.c.jinja: events at the start of a motion."""

    TEMPLATE: ClassVar[str] = "c/initial_events.c"
    function: CFunction
    values: str
    restart: str
    method: str


@dataclass(frozen=True)
class AdaptiveRun(Named):
    """c/adaptive_run.c.jinja: the loop over adaptive steps, rows and events."""

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
    """c/adaptive_batch.c.jinja: instances one after the other. alone: the call for one."""

    TEMPLATE: ClassVar[str] = "c/adaptive_batch.c"
    prefix: str
    batch: CFunction
    alone: str
    events: bool
