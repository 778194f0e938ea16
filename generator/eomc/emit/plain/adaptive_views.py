"""What the templates of adaptive steps and events ask for, in both forms of C: a view each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from eomc.emit.c_function import CFunction
from eomc.emit.plain.parts import Named


@dataclass(frozen=True)
class AdaptiveTableau(Named):
    """The numbers that both texts of adaptive steps have.

    method: what C names begin with. powers: from accelerations at the stages, one a row, to their
    polynomial's powers. most: sweeps of a step; anew: steps by Newton's method, before sweeps alone
    are tried again. of_most, of_most_coarse: of the largest coordinate and velocity, in the
    measures of all, and where rounding counts. still: how many of the last coordinates jumps alone
    change; they have no scale.
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
    still: int
    most: int
    c: tuple[str, ...]
    powers: tuple[str, ...]
    anew: int


@dataclass(frozen=True)
class Adaptive(AdaptiveTableau):
    """c/adaptive.c.jinja, which takes in four others, for both forms: tableau, functions, calls.

    total: the sum of half[0], ... over half of the stages. lanes: before loops over stages. top:
    from accelerations at the stages, one a row, to their polynomial's parts in the last four of
    Legendre's; weights: to what a step adds to a position and a velocity.
    project: the call that ends a step on constraints, of what it adds, or of its `whole` end.
    held: whether forces that change in time may hold all at rest; capped: what rounding makes then.
    corners: whether forces jump or bend; share: of the tolerance, for a step in which they do;
    ends: from accelerations at the stages to the ends of the polynomial through them; forces: the
    accelerations at a state; slopes: their derivatives, by differences over `nudge`. eigenvalues,
    to_parts, from_parts: of A, as Method.eigen has them.
    """

    TEMPLATE: ClassVar[str] = "c/adaptive.c"
    title: str
    lanes: str
    total: str
    top: tuple[str, ...]
    weights: tuple[str, ...]
    timed: bool
    held: bool
    capped: CFunction
    capped_now: str
    events: bool
    begins: bool
    project: str
    whole: bool
    settle: CFunction
    sweep: str
    step: CFunction
    start: str
    settled: str
    within: CFunction
    settled_within: str
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
    """c/fixed_steps.c.jinja: steps of fixed size of a scene with events, and calls in them.

    fixed, at: the next step, and the state within the last one; step: the call of the method's own,
    through a pointer; inside: that of the state within an adaptive step; forces_before,
    forces_halfway, forces_behind: of the accelerations there. above: whether events are made of
    friction that sticks.
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
    forces_behind: str


@dataclass(frozen=True)
class Events(Named):
    """c/events.c.jinja: functions that find events in an adaptive step, and calls in them.

    samples: the parts of a step at which events are looked at, nodes; slopes: of the polynomial
    through values there. busy: the most events in one step; apart, near, close: parts of a step;
    chance: of the time between jumps, below which the next one has come by chance. last: to the
    last coefficients of the polynomial through values; told: what these may be of the largest
    value, beyond which a step is halved, `halvings` times more than a step in `lately` at most.
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
    busy: int
    together: int
    apart: str
    near: str
    close: str
    chance: str
    huge: str
    halvings: int
    lately: int
    rounding: CFunction
    rounded: str
    values_near: str
    told: str
    last: tuple[str, ...]
    looked: CFunction
    values: str
    bracketed: CFunction
    crossing: CFunction
    look_value: str
    bracket: str
    bracket_dip: str
    happened: CFunction
    cross: str
    look_before: str
    look_behind: str
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
class Begun(Named):
    """c/begun.c.jinja: events that happen as a motion begins, and calls in them."""

    TEMPLATE: ClassVar[str] = "c/begun.c"
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
    lately: int
    begun: str
    changed: str
    values: str
    huge: str
    busy: int
    anew: int
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
    """c/adaptive_batch.c.jinja: many, one after the other. alone: the call for one."""

    TEMPLATE: ClassVar[str] = "c/adaptive_batch.c"
    prefix: str
    batch: CFunction
    alone: str
    events: bool
