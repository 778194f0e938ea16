"""Views of the templates of optimised C: frozen dataclasses with values only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from eomc.emit.c_function import CFunction
from eomc.emit.plain.adaptive_views import AdaptiveTableau
from eomc.emit.plain.parts import Computed, Named, Prefixed, Tableau
from eomc.emit.plain.views import AnySource


@dataclass(frozen=True)
class Library:
    """A function of the mathematics library over a lane. two: whether it has two arguments.

    whole: a single AVX-512 instruction for it over a register, or "".
    """

    name: str
    c: str
    two: bool
    whole: str


@dataclass(frozen=True)
class Source(AnySource):
    """c/fast/source.c.jinja. lanes: finished texts of the views below."""

    TEMPLATE: ClassVar[str] = "c/fast/source.c"
    rolled: bool
    unroll: str
    extent: str
    inline: str
    wide: bool
    csrc: tuple[str, ...]
    lanes: tuple[str, ...]


@dataclass(frozen=True)
class Laned:
    """Common fields of code over a lane: its type, the type of failures, the suffix of C names."""

    inline: str
    lane: str
    mask: str
    L: str


@dataclass(frozen=True)
class Driven:
    """Whether steps read the time, inputs, and constants of the parameters."""

    timed: bool
    inputs: bool
    constants: bool


@dataclass(frozen=True)
class LibraryText(Prefixed, Laned):
    """c/fast/library.c.jinja: the library's functions over a lane. count: numbers in it, in C."""

    TEMPLATE: ClassVar[str] = "c/fast/library.c"
    count: str
    calls: tuple[Library, ...]


@dataclass(frozen=True)
class LaneText(Laned):
    """c/fast/lane.c.jinja. angles: their number, in C. rates: finished text.

    across: angles go into registers of four together.
    signal_call: where accelerations have to find the signals.
    """

    TEMPLATE: ClassVar[str] = "c/fast/lane.c"
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
    signal: Computed | None
    signal_call: str
    rates: str
    rates_call: str
    accelerations: CFunction
    two_point: bool
    takes_c: bool
    alone: bool


@dataclass(frozen=True)
class Blocks:
    """c/fast/blocks.c.jinja: instances of a batch that are stepped together."""

    TEMPLATE: ClassVar[str] = "c/fast/blocks.c"
    prefix: str
    PREFIX: str
    lane: str
    inputs: bool
    constants: str
    blocks: int


@dataclass(frozen=True)
class TwoPoints(Prefixed):
    """c/fast/two_point.c.jinja. coordinates: whether the configuration reads q itself."""

    TEMPLATE: ClassVar[str] = "c/fast/two_point.c"
    extent: str
    inline: str
    members: str
    angles: str
    configuration: Computed
    constants: bool
    call: str
    velocity: Computed


@dataclass(frozen=True)
class RungeKutta4(Named, Laned, Driven):
    """c/fast/rk4.c.jinja. across: angles go into registers of four together."""

    TEMPLATE: ClassVar[str] = "c/fast/rk4.c"
    unroll: str
    extent: str
    noinline: str
    constants_type: str
    title: str
    source: str
    stability: str
    angles: str
    across: bool
    sincos: str
    largest: str
    small: str
    shared_signals: bool
    signal_call: str
    signal_now: str
    two_point: bool
    velocity_call: str
    stage_call: str
    corrected: bool


@dataclass(frozen=True)
class Predictions(Prefixed):
    """c/fast/predictions.c.jinja: sines and cosines at predicted angles, and near them."""

    TEMPLATE: ClassVar[str] = "c/fast/predictions.c"
    unroll: str
    inline: str
    angles: int


@dataclass(frozen=True)
class Predicted(Named, Driven):
    """c/fast/predicted.c.jinja. stage: the calls of the four stages."""

    TEMPLATE: ClassVar[str] = "c/fast/predicted.c"
    unroll: str
    noinline: str
    angles: int
    shared_signals: bool
    signal_first: str
    signal_mid: str
    signal_end: str
    stage: tuple[str, ...]


@dataclass(frozen=True)
class Stage:
    """A stage of an explicit method: its node, the sums over earlier ones, its call."""

    node: str
    positions: str
    velocities: str
    call: str


@dataclass(frozen=True)
class Explicit(Prefixed, Laned, Driven):
    """c/fast/explicit.c.jinja."""

    TEMPLATE: ClassVar[str] = "c/fast/explicit.c"
    unroll: str
    extent: str
    clear: str
    constants_type: str
    name: str
    title: str
    source: str
    order: int
    notes: tuple[str, ...]
    stability: str
    stages: tuple[Stage, ...]
    position: str
    velocity: str


@dataclass(frozen=True)
class Factors(Prefixed):
    """c/fast/lu.c.jinja."""

    TEMPLATE: ClassVar[str] = "c/fast/lu.c"
    fabs: str
    f: str


@dataclass(frozen=True)
class Gauss(Tableau):
    """c/fast/gauss.c.jinja: tableau, functions, calls. f: the suffix of literals."""

    TEMPLATE: ClassVar[str] = "c/fast/gauss.c"
    extent: str
    f: str
    fabs: str
    eps: str
    nudge: str
    title: str
    source: str
    order: int
    notes: tuple[str, ...]
    stages: int
    extrapolation: tuple[str, ...]
    width: str
    factor: CFunction
    factor_unread: tuple[str, ...]
    signal_call: str
    follows: str
    slopes_call: str
    solve: CFunction
    factor_now: str
    factor_mid: str
    start: str
    stage: str


@dataclass(frozen=True)
class Stages(Named):
    """c/fast/stages.c.jinja: tableau, functions, calls. padded: stages, to whole registers.

    onto: the call that moves a stage onto constraints, where there are. extrapolated: A and A A
    over the accelerations of the step before, where a method takes them.
    """

    TEMPLATE: ClassVar[str] = "c/fast/stages.c"
    extent: str
    inputs: bool
    constants: bool
    members: tuple[str, ...]
    name: str
    stages: int
    padded: str
    c: tuple[str, ...]
    within: tuple[tuple[str, ...], tuple[str, ...]]
    extrapolated: tuple[tuple[str, ...], tuple[str, ...]] | None
    sweep: CFunction
    together: str
    alone: str
    onto: str


@dataclass(frozen=True)
class Sweeps(Named):
    """c/fast/sweeps.c.jinja: tableau, functions, calls."""

    TEMPLATE: ClassVar[str] = "c/fast/sweeps.c"
    extent: str
    f: str
    fabs: str
    eps: str
    enough: str
    tolerance: str
    inputs: bool
    name: str
    title: str
    source: str
    notes: tuple[str, ...]
    stability: str
    stages: int
    sweeps: int
    b: tuple[str, ...]
    bA: tuple[str, ...]
    settle: CFunction
    settle_call: str
    sweep_settling: str
    sweep_first: str
    sweep_back: str
    sweep_forth: str
    start: str
    solve: CFunction
    constrained: bool


@dataclass(frozen=True)
class State(Named):
    """c/fast/state.c.jinja: what a run of a method carries."""

    TEMPLATE: ClassVar[str] = "c/fast/state.c"
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
class Loop(Named, Driven):
    """c/fast/run.c.jinja. advance: one step; otherwise: where that failed, without shortcuts.

    project: the call that ends a step on the constraints, if there are.
    """

    TEMPLATE: ClassVar[str] = "c/fast/run.c"
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
class Batch(Named, Driven):
    """c/fast/batch.c.jinja. own: whether instances may have constants of their own."""

    TEMPLATE: ClassVar[str] = "c/fast/batch.c"
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
class AdaptiveLanes(AdaptiveTableau):
    """c/fast/adaptive_lanes.c.jinja: adaptive steps of many instances side by side.

    max_roughness: in units of sqrt(tol/2); rougher steps are rejected after two iterations.
    accelerate: call of the accelerations of all lanes at a stage; forces: that of one instance at
    the start; alone: call that steps one instance; store_row, look: calls that write a row at the
    end of a step, and within it.
    """

    TEMPLATE: ClassVar[str] = "c/fast/adaptive_lanes.c"
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


View = (
    Source | LibraryText | LaneText | Blocks | TwoPoints | RungeKutta4 | Predictions
    | Predicted | Explicit | Factors | Gauss | Stages | Sweeps | State | Loop | Batch
    | AdaptiveLanes
)  # fmt: skip
