"""Views of the templates of portable C: frozen dataclasses with values only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from eomc.base.texts import FreeText
from eomc.emit.c_function import CFunction
from eomc.emit.plain.adaptive_views import (
    Adaptive,
    AdaptiveBatch,
    AdaptiveRun,
    Events,
    FixedSteps,
    InitialEvents,
)
from eomc.emit.plain.constraint_views import Project, Projection
from eomc.emit.plain.parts import Computed, Named, Tableau


@dataclass(frozen=True)
class Indexed:
    """A coordinate, input or output: enumerator, unit and note."""

    enum: str
    words: FreeText


@dataclass(frozen=True)
class Parameter:
    """A parameter: name, the scene's value as a literal, unit and note."""

    name: str
    value: str
    words: FreeText


@dataclass(frozen=True)
class Declared:
    """A method in the header: step, run, batch and derivative. workspace: its length."""

    name: str
    title: str
    implicit: bool
    workspace: int
    step: CFunction
    run: CFunction
    batch: CFunction | None
    derivative: CFunction | None


@dataclass(frozen=True)
class AdaptiveDeclared:
    """Adaptive steps in the header.

    memory, workspace: C type of the workspace and its length. together: whether optimised C steps
    many instances in parallel. fixed: the function type of fixed steps with event detection, for
    scenes with events.
    """

    title: str
    memory: str
    workspace: int
    run: CFunction
    batch: CFunction | None
    together: bool
    fixed: CFunction | None


@dataclass(frozen=True)
class Header(Named):
    """c/header.h.jinja. functions: those of mechanics. timed: whether steps take t."""

    TEMPLATE: ClassVar[str] = "c/header.h"
    title: FreeText
    stamp: tuple[FreeText, ...]
    notes: tuple[str, ...]
    description: tuple[FreeText, ...]
    handshake: str
    fast: bool
    coordinates: tuple[Indexed, ...]
    inputs: tuple[Indexed, ...]
    outputs: tuple[Indexed, ...]
    constraints: tuple[Indexed, ...]
    events: tuple[Indexed, ...]
    frames: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    implicit: bool
    timed: bool
    functions: tuple[CFunction, ...]
    linearization: CFunction | None
    project: CFunction | None
    methods: tuple[Declared, ...]
    adaptive: AdaptiveDeclared | None
    max_events: int


@dataclass(frozen=True)
class AnySource(Named):
    """Source of either form. slopes, steppers: rendered text of other views."""

    title: FreeText
    stamp: tuple[FreeText, ...]
    handshake: str
    parameters: tuple[Parameter, ...]
    q0: tuple[str, ...]
    qd0: tuple[str, ...]
    evaluations: tuple[Computed, ...]
    acceleration: Computed
    solved: tuple[str, ...]
    constrained: bool
    slopes: str
    steppers: tuple[str, ...]


@dataclass(frozen=True)
class Source(AnySource):
    """c/plain/source.c.jinja."""

    TEMPLATE: ClassVar[str] = "c/plain/source.c"
    adaptive: bool


@dataclass(frozen=True)
class Slopes(Named):
    """c/slopes.c.jinja. width: of a row [da/dq, da/dqd, da/du]. unread: unused arguments."""

    TEMPLATE: ClassVar[str] = "c/slopes.c"
    inputs: bool
    width: str
    slopes: Computed
    linearization: CFunction
    unread: tuple[str, ...]
    signal_call: str
    slopes_call: str


@dataclass(frozen=True)
class Derivative(Tableau):
    """c/derivative.c.jinja: of a step by a tableau. rates, eliminate: what methods share.

    width: of a row along q, qd and u. feedback: the call of the signals' derivatives, if there are.
    projection, moved: under constraints how rows move a state, shared too, and what moves a step's
    end by that; near, scale_floor: as in Projection. start, stage: calls of accelerations.
    converged, tolerance: relative corrections of velocities below which the stages are accepted,
    without and with a stagnating iteration; other: relative difference of the ends of two steps
    with different stages.
    """

    TEMPLATE: ClassVar[str] = "c/derivative.c"
    inputs: bool
    width: str
    rates: CFunction | None
    linearization: str
    feedback: str
    eliminate: bool
    projection: Computed | None
    moved: CFunction | None
    projection_call: str
    move: str
    near: str
    scale_floor: str
    function: CFunction
    implicit: bool
    stages: int
    step: str
    start: str
    stage: str
    rates_call: str
    fabs: str
    fmax: str
    tiny: str
    converged: str
    tolerance: str
    other: str
    most: int


@dataclass(frozen=True)
class RungeKutta4(Named):
    """c/plain/rk4.c.jinja: the calls of the four accelerations.

    advance: the step, which under constraints also tells whether a row has no multiplier behind it;
    correct: the call that moves its end onto the constraints.
    """

    TEMPLATE: ClassVar[str] = "c/plain/rk4.c"
    about: tuple[str, ...]
    step: CFunction
    advance: CFunction
    advance_call: str
    correct: str
    first: str
    second: str
    third: str
    fourth: str


@dataclass(frozen=True)
class Explicit(Tableau):
    """c/plain/explicit.c.jinja: a tableau, and the call of a stage's accelerations.

    advance, correct: as of RungeKutta4.
    """

    TEMPLATE: ClassVar[str] = "c/plain/explicit.c"
    about: tuple[str, ...]
    step: CFunction
    advance: CFunction
    advance_call: str
    correct: str
    stages: int
    stage: str


@dataclass(frozen=True)
class Implicit(Named):
    """c/plain/implicit.c.jinja: what implicit methods share, and what adaptive steps take of it.

    here, near: calls of accelerations.
    """

    TEMPLATE: ClassVar[str] = "c/plain/implicit.c"
    fabs: str
    fmax: str
    tiny: str
    nudge: str
    corrections: bool
    factors: bool
    newton: bool
    slopes: CFunction
    here: str
    near: str


@dataclass(frozen=True)
class Gauss(Tableau):
    """c/plain/gauss.c.jinja: a tableau, functions, calls. method: what its C names begin with.

    onto: the call that moves a stage onto constraints, of methods that find stages by sweeps alone.
    """

    TEMPLATE: ClassVar[str] = "c/plain/gauss.c"
    title: str
    method: str
    newton: bool
    sweeps: int
    stages: int
    eps: str
    tenth: str
    half: str
    stages_function: CFunction
    matrix: CFunction
    about: tuple[str, ...]
    solve: CFunction
    step: CFunction
    stage: str
    onto: str
    slopes_call: str
    start: str
    sweep: str
    matrix_start: str
    matrix_mid: str
    solve_call: str
    correct: str


@dataclass(frozen=True)
class Nodes(Named):
    """c/plain/nodes.c.jinja: a sweep over the stages of a method, as adaptive steps take it.

    onto: the call that moves a stage onto constraints, where there are.
    """

    TEMPLATE: ClassVar[str] = "c/plain/nodes.c"
    title: str
    name: str
    stages: int
    c: tuple[str, ...]
    A: tuple[str, ...]
    AA: tuple[str, ...]
    sweep: CFunction
    stage: str
    onto: str


@dataclass(frozen=True)
class Loop(Named):
    """c/plain/run.c.jinja: run and batch of one method, and the calls in them."""

    TEMPLATE: ClassVar[str] = "c/plain/run.c"
    implicit: bool
    constrained: bool
    run: CFunction
    batch: CFunction | None
    one_step: str
    run_one: str


View = (
    Header | Source | Slopes | Projection | Project | Derivative | RungeKutta4 | Explicit | Implicit
    | Gauss | Nodes | Adaptive | FixedSteps | Events | InitialEvents | AdaptiveRun | AdaptiveBatch
    | Loop
)  # fmt: skip
