"""Data for the templates of portable C (views): frozen dataclasses with values only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from eomc.base.texts import FreeText
from eomc.emit.c_function import CFunction
from eomc.emit.portable.adaptive_views import (
    Adaptive,
    AdaptiveBatch,
    AdaptiveRun,
    Events,
    FixedSteps,
    InitialEvents,
)
from eomc.emit.portable.constraint_views import Project, Projection
from eomc.emit.portable.parts import Computed, Named, Tableau


@dataclass(frozen=True)
class Indexed:
    """A C enumerator in the generated header: the index of a coordinate, input, output or the like.

    Constraints and events have enumerators too. enum: name of the enumerator. words: unit and note
    from the scene file, for the C comment.
    """

    enum: str
    words: FreeText


@dataclass(frozen=True)
class Parameter:
    """A parameter of the scene, as a member of the parameter struct in the C header.

    name: name of the member. value: the parameter's value in the scene file, as a C literal. words:
    unit and note from the scene file, for the C comment.
    """

    name: str
    value: str
    words: FreeText


@dataclass(frozen=True)
class Declared:
    """The C functions of one integration method with fixed steps, as declared in the C header.

    Attributes
    ----------
    name, title
        The method's name in C names, and its title in comments.
    implicit
        Whether the method is implicit.
    workspace
        Length of the workspace of a run, as a count of numbers; 0 for a run that needs none.
    step, run, batch
        Prototypes of the functions for one step, for many steps, and for many instances; `batch` is
        None if the scene does not request it.
    derivative
        Prototype of the function for the derivatives of the state at the end of a step with respect
        to the state at its start and the inputs; None if the scene does not request it.
    """

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
    """The C functions of runs with adaptive step-size control, as declared in the C header.

    Attributes
    ----------
    title
        The method's title in comments.
    memory, workspace
        C type of the workspace of a run, and its length as a count of numbers.
    run, batch
        Prototypes of the functions for one instance and for many; `batch` is None if the scene does
        not request it.
    together
        Whether the optimised C steps many instances of a batch in parallel.
    fixed
        C function type for one step of fixed size. A run with event detection can make such steps
        instead of adaptive ones. None for scenes without events.
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
    """Data for c/header.h: the header of the generated C.

    Attributes
    ----------
    stamp, notes, description
        Lines of comments at the top.
    handshake
        Number by which the source detects the header of another build.
    fast
        Whether the header belongs to the optimised rather than the portable C.
    implicit
        Whether some steps are implicit, or adaptive.
    timed
        Whether steps take the time t as an argument.
    functions, linearization, project
        Prototypes of the functions of mechanics (such as D, energy and accelerations), of the
        derivatives of the accelerations, and of the projection onto the constraints; None for those
        that the scene does not have.
    methods, adaptive
        The integration methods with fixed steps, and with adaptive steps (None if not requested).
    max_events
        Largest number of events in one step.
    """

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
    """Data that the templates of the portable and of the optimised C source share.

    Attributes
    ----------
    stamp
        Lines of the comment at the top.
    handshake
        Number that must be equal to the one in the header of the same build.
    q0, qd0
        Initial coordinates and velocities, as C literals.
    evaluations, acceleration
        The functions of mechanics, and the function for the accelerations.
    solved
        Lines of a comment on how D q̈ = τ - bias is solved for the accelerations q̈.
    slopes, steppers
        C text for the derivatives of the accelerations ("" for none), and for the steps and runs of
        each method: the rendered text of other templates.
    """

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
    """Data for c/portable/source.c: the source file of the portable C.

    adaptive: whether it contains adaptive steps.
    """

    TEMPLATE: ClassVar[str] = "c/portable/source.c"
    adaptive: bool


@dataclass(frozen=True)
class Slopes(Named):
    """Data for c/slopes.c: derivatives of the accelerations by q, q̇ and u.

    Attributes
    ----------
    inputs
        Whether the scene has inputs u.
    width
        Length of one row [da/dq, da/dqd, da/du], as a C expression.
    slopes
        The static function that computes all rows.
    linearization
        Prototype of the public function, which splits the rows into A_q, A_qd and B.
    unread
        Names of arguments of the public function that its body does not use.
    signal_call, slopes_call
        C calls of the scene's signals for u ("" if they are not needed) and of `slopes`.
    """

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
    """Data for c/derivative.c: a C function for the derivatives of one step.

    They are the derivatives of q and q̇ at the end of the step with respect to q, q̇ and u at its
    start.

    Attributes
    ----------
    inputs, width
        Whether there are inputs u, and the number of variables in q, q̇ and u, as a C expression.
    rates, eliminate, projection
        C functions that all methods share, so that only one method prints them: the derivatives of
        the accelerations (None for the other methods), Gaussian elimination (whether it is
        printed), and the correction onto the constraints with its directional derivative (or None).
    linearization, feedback
        C calls of the derivatives of the accelerations, and of the derivatives of the signals, the
        scene's formulas for inputs ("" if the signals do not depend on the state).
    moved, projection_call, move
        For scenes with constraints: the function that projects the end of a step and its
        derivatives onto the constraints, the call of `projection` in it, and the call of `moved`.
    near, scale_floor
        Tolerances of that correction, as in `Projection`.
    function, implicit, stages
        Prototype of the function, whether the method is implicit, and its number of stages.
    step, start, stage, rates_call
        C calls of the step, of the accelerations at its start and at a stage, and of `rates`.
    converged, tolerance
        Largest relative correction of velocities with which the stages of an implicit method are
        accepted: in general, and when Newton's iteration does not reduce it further.
    other
        Largest relative difference between the end of the step itself and the end that follows from
        the stages computed here; if it is exceeded, the function fails.
    most
        Largest number of Newton iterations.
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
    """Data for c/portable/rk4.c: one step of the classical Runge-Kutta method.

    Attributes
    ----------
    about
        Lines of the comment above the function.
    step
        Prototype of the public function.
    advance, advance_call
        The function that makes the step, and its C call. Without constraints it is `step` itself.
        With constraints it is a static function, which also reports singular configurations: those
        in which a constraint equation has no multiplier.
    correct
        C call that projects the end of the step onto the constraints; "" without constraints.
    first, second, third, fourth
        C calls of the accelerations at the four stages.
    """

    TEMPLATE: ClassVar[str] = "c/portable/rk4.c"
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
    """Data for c/portable/explicit.c: one step of an explicit Runge-Kutta method.

    about, step, advance, advance_call, correct: as in `RungeKutta4`. stages: the number of stages.
    stage: the C call of the accelerations at stage i.
    """

    TEMPLATE: ClassVar[str] = "c/portable/explicit.c"
    about: tuple[str, ...]
    step: CFunction
    advance: CFunction
    advance_call: str
    correct: str
    stages: int
    stage: str


@dataclass(frozen=True)
class Implicit(Named):
    """Data for c/portable/implicit.c: C functions that all implicit methods share.

    Attributes
    ----------
    fabs, fmax, tiny
        Names of the C functions for |x| and max(x, y), and a small positive number that avoids
        divisions by zero.
    nudge
        Relative step of finite differences.
    corrections, factors, newton
        Whether these functions are needed: for the size of corrections of the stages, for LU
        factorisation, and for derivatives of the accelerations by finite differences.
    slopes
        Prototype of the function for these derivatives.
    here, near
        C calls of the accelerations at the state and at a perturbed state.
    """

    TEMPLATE: ClassVar[str] = "c/portable/implicit.c"
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
    """Data for c/portable/gauss.c: one step of a Gauss method, solved by iteration.

    Attributes
    ----------
    method
        Prefix of the method's C names.
    newton
        Whether Newton's method is used where fixed-point iteration converges too slowly.
    sweeps
        Largest number of iterations.
    eps, tenth, half
        C literals: the rounding unit, 0.1 and 0.5.
    stages_function, matrix, solve, step
        Prototypes of the C functions: for the accelerations at all stages, for the LU factors of
        Newton's matrix, for the solution of a step by iteration, and the public one for a step.
    about
        Lines of the comment above the step.
    stage, slopes_call, start, sweep, matrix_start, matrix_mid, solve_call
        C calls: the accelerations at stage i, their derivatives, the accelerations at the start,
        `stages_function`, `matrix` at the start and at the middle of the step, and `solve`.
    onto, correct
        C calls that project a stage and the end of the step onto the constraints; "" for none. Only
        methods without Newton's method project stages.
    """

    TEMPLATE: ClassVar[str] = "c/portable/gauss.c"
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
    """Data for c/portable/nodes.c: one fixed-point iteration over all stages of a step.

    Adaptive steps in portable C call the C function of this template.

    Attributes
    ----------
    title, name, stages
        The integration method: its title in comments, its name in C, and its number of stages.
    c, A, AA
        Nodes and coefficients of the method, as in `Tableau`.
    sweep
        Prototype of the C function.
    stage
        C call of the accelerations at stage i.
    onto
        C call that projects stage i onto the constraints; "" without constraints.
    """

    TEMPLATE: ClassVar[str] = "c/portable/nodes.c"
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
    """Data for c/portable/run.c: C functions for runs of one instance and of many.

    Attributes
    ----------
    implicit, constrained
        Whether the integration method is implicit, and whether the scene has constraints.
    run, batch
        Prototypes of the functions for one instance and for many; `batch` is None if the scene does
        not request it.
    one_step, run_one
        C call of one step in the body of `run`, and C call of `run` in the body of `batch`.
    """

    TEMPLATE: ClassVar[str] = "c/portable/run.c"
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
