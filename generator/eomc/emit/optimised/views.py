"""Data for the templates of optimised C (views): frozen dataclasses with values only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from eomc.emit.c_function import CFunction
from eomc.emit.portable.adaptive_views import AdaptiveTableau
from eomc.emit.portable.parts import Computed, Named, Prefixed, Tableau
from eomc.emit.portable.views import AnySource


@dataclass(frozen=True)
class Library:
    """A function of the C mathematics library that is applied to each value of a vector register.

    Attributes
    ----------
    name
        Ending of the C name of the generated function, which takes registers.
    c, two
        Name of the library function, and whether it has two arguments.
    whole
        C expression for a single AVX-512 instruction that computes the whole register; "" for none.
    """

    name: str
    c: str
    two: bool
    whole: str


@dataclass(frozen=True)
class Source(AnySource):
    """Data for c/optimised/source.c: the source file of the optimised C.

    Attributes
    ----------
    rolled
        Whether loops over coordinates are left to the compiler to vectorise, not unrolled.
    unroll, inline
        Macros before loops over coordinates and before inlined functions.
    extent
        Length of vectors of coordinates, as a C expression.
    wide
        Whether the code uses vector registers with values of several instances.
    csrc
        Texts of the hand-written C that this scene needs.
    lanes
        Finished C texts of the accelerations, for one number and for vector registers.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/source.c"
    rolled: bool
    unroll: str
    extent: str
    inline: str
    wide: bool
    csrc: tuple[str, ...]
    lanes: tuple[str, ...]


@dataclass(frozen=True)
class Laned:
    """Template fields for the C type that a template is printed for: the *lane* type.

    It is one number, or a vector register with one value of each of several instances.

    Attributes
    ----------
    inline
        C macro before inlined functions.
    lane, mask
        The C type itself, and the C type that records failures: int for one number, a mask of the
        failed values for a register.
    L
        Suffix of C names; "" for one number.
    """

    inline: str
    lane: str
    mask: str
    L: str


@dataclass(frozen=True)
class Driven:
    """Template fields that state what steps of a scene read.

    timed: the time t. inputs: the inputs u. constants: precomputed expressions of the parameters.
    """

    timed: bool
    inputs: bool
    constants: bool


@dataclass(frozen=True)
class LibraryText(Prefixed, Laned):
    """Data for c/optimised/library.c: mathematical functions for a vector register.

    count: number of values in the register, as a C expression. calls: the functions.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/library.c"
    count: str
    calls: tuple[Library, ...]


@dataclass(frozen=True)
class LaneText(Laned):
    """Data for c/optimised/lane.c: C functions for the accelerations.

    The template is printed for each *lane* type: one number, or a vector register with one value of
    each of several instances. Angles are those whose sines and cosines the accelerations read.

    Attributes
    ----------
    unroll, clear
        Macro before loops over angles, and initialiser for "no failure".
    constants
        C text of the struct of precomputed expressions and of the function that computes it.
    angles, count
        Length of arrays of angles as C text ("" without angles), and the number of angles.
    across
        Whether the sines of four angles are computed in one vector register.
    angles_at, changes
        The C functions for the angles at q, and for changes of these from a change of q.
    sincos
        Name of the C function for sine and cosine of one angle.
    signal, signal_call
        The function for the scene's signals (None without signals), and its C call in the
        accelerations ("" if all callers supply the inputs).
    rates, rates_call
        C text of the accelerations from the state, its sines and the inputs, and the C call of that
        function.
    accelerations
        Prototype of the C function for the accelerations that also computes inputs (by the scene's
        signals) and sines if its arguments for these are NULL.
    two_point, takes_c
        Whether the accelerations are split into two parts, see `TwoPoints`, and whether these read
        precomputed expressions.
    alone
        Whether some callers do not pass the sines, so that the function must compute them.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/lane.c"
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
    """Data for c/optimised/blocks.c: the C types of blocks and tiles.

    A block is the group of instances of a batch that share a vector register. A tile is a group of
    blocks that are stepped together.

    lane: C type of a vector register. inputs: whether the scene has inputs. constants: C type of
    the precomputed expressions of the parameters; "" for none. blocks: number of blocks in a tile.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/blocks.c"
    prefix: str
    PREFIX: str
    lane: str
    inputs: bool
    constants: str
    blocks: int


@dataclass(frozen=True)
class TwoPoints(Prefixed):
    """Data for c/optimised/two_point.c: accelerations that are split into two C functions.

    The first one computes the position-dependent part for two configurations q in one vector
    register. The second one computes the accelerations from it, at one of the two configurations.

    Attributes
    ----------
    extent, inline
        Length of vectors of coordinates as C text, and the macro before inlined functions.
    members
        C definition of the struct with the values that the first part hands to the second one.
    angles
        Length of arrays of angles as C text.
    configuration, velocity
        The functions for the two parts.
    constants
        Whether there are precomputed expressions of the parameters.
    call
        C call of `configuration`.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/two_point.c"
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
    """Data for c/optimised/rk4.c: a step of the classical Runge-Kutta method.

    It is printed for one instance, and for a vector register with values of several instances.

    Attributes
    ----------
    unroll, extent, noinline
        Macro before loops over coordinates, length of vectors of coordinates as C text, and macro
        before functions that are not inlined.
    constants_type
        C type of the precomputed expressions.
    title, source, stability
        Title, reference and stability limits of the method, for comments.
    angles, across, sincos
        As in `LaneText`.
    largest, small
        Largest angles, in rad, by which sines and cosines are rotated from one stage to another: in
        general, and for corrections.
    shared_signals
        Whether the signals depend on time only, so that they are computed once for several stages.
    signal_call, signal_now
        C calls of the signals (formulas for the inputs) at the start, middle and end of a step, and
        at one stage; "" for none.
    two_point, velocity_call
        Whether the accelerations are split into two parts, see `TwoPoints`, and the C call of the
        velocity-dependent part.
    stage_call
        C call of the whole accelerations at a stage.
    corrected
        Whether the step returns the sines and cosines at its end for the projection.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/rk4.c"
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
    """Data for c/optimised/predictions.c: sines and cosines of predicted angles.

    The C functions extrapolate the angles of the next RK4 step, and compute their sines and cosines
    in advance. angles: number of angles. unroll, inline: C macros before loops and before inlined
    functions.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/predictions.c"
    unroll: str
    inline: str
    angles: int


@dataclass(frozen=True)
class Predicted(Named, Driven):
    """Data for c/optimised/predicted.c: a loop over steps of RK4 with predicted angles.

    Predicted angles are extrapolated from the step before. The loop ends when they are not accurate
    enough.

    Attributes
    ----------
    angles
        Number of angles.
    shared_signals
        Whether the signals depend on time only, so that they are computed once for several stages.
    signal_first, signal_mid, signal_end
        C calls of the signals at the start of the first step, and at the middle and the end of a
        step; "" for none.
    stage
        C calls of the four stages.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/predicted.c"
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
    """C text of one stage of an explicit Runge-Kutta method.

    Attributes
    ----------
    node
        The time of the stage as a fraction of the step; "" at the start of the step.
    positions, velocities
        The weighted sums of accelerations of earlier stages in the position and the velocity of
        this stage.
    call
        The call of the function for the accelerations.
    """

    node: str
    positions: str
    velocities: str
    call: str


@dataclass(frozen=True)
class Explicit(Prefixed, Laned, Driven):
    """Data for c/optimised/explicit.c: a step of an explicit method except RK4.

    It is printed for one instance, and for a vector register with values of several instances.

    Attributes
    ----------
    unroll, extent
        Macro before loops over coordinates, and length of vectors of coordinates as C text.
    clear, constants_type
        Initialiser for "no failure", and C type of the precomputed expressions.
    name, title, source, order, notes, stability
        Name of the method in C, and what comments say about it.
    stages
        The stages.
    position, velocity
        C text of the sums over the stages in the increments of position and velocity.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/explicit.c"
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
    """Data for c/optimised/lu.c: LU factorisation of a matrix, and solution of A x = b.

    fabs: name of the C function for |x|. f: suffix of C literals.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/lu.c"
    fabs: str
    f: str


@dataclass(frozen=True)
class Gauss(Tableau):
    """Data for c/optimised/gauss.c: one step of a Gauss method with Newton's method.

    Attributes
    ----------
    extent, f, fabs, eps
        Length of vectors of coordinates as C text, suffix of C literals, name of the C function,
        and the rounding unit.
    nudge
        Relative step of finite differences.
    title, source, order, notes
        What comments say about the method.
    stages, extrapolation
        Number of stages, and rows of the matrix that extrapolates the accelerations of the stages
        of one step to those of the next.
    width
        Length of one row [da/dq, da/dqd, da/du], as a C expression.
    factor, factor_unread
        Prototype of the function that computes the factors of Newton's matrix, and the names of its
        arguments that its body does not use.
    signal_call, follows
        C calls of the scene's signals (formulas for the inputs) at the state, and at a perturbed
        state; "" for none.
    slopes_call
        C call of the derivatives of the accelerations.
    solve
        Prototype of the function for the step.
    factor_now, factor_mid
        C calls of `factor` with derivatives at the start and at the middle of the step.
    start, stage
        C calls of the accelerations at the start and at a stage.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/gauss.c"
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
    """Data for c/optimised/stages.c: one fixed-point iteration over all stages of a step.

    The method is an implicit Runge-Kutta method, such as a Gauss method. The stages are computed
    side by side in vector registers.

    Attributes
    ----------
    members
        Names of the precomputed expressions.
    stages, padded, c
        Number of stages; length of arrays over the stages, at least a whole register, as C text;
        and the nodes of the method.
    within
        Rows of the transposes of A and A A, which weight the accelerations at the stages of this
        step.
    extrapolated
        Rows of the transposed matrices that weight the accelerations at the stages of the step
        before, extrapolated as a polynomial; None for methods of adaptive steps only.
    sweep
        Prototype of the function for an iteration.
    together, alone
        C calls of the accelerations at all stages of a register, and at one stage.
    onto
        C call that projects a stage onto the constraints; "" without constraints.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/stages.c"
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
    """Data for c/optimised/sweeps.c: a step of an implicit method.

    The step makes a fixed number of fixed-point iterations over its stages. If these do not
    converge, the C function `settle` iterates until they do.

    Attributes
    ----------
    f, fabs, eps
        Suffix of C literals, name of the C function, and the rounding unit.
    enough
        Relative error of velocities below which the iterations of `settle` have converged. If they
        start from the accelerations at the start of the step, the limit is rounding error instead.
    tolerance
        Relative change of velocities in the last iteration above which the step is solved by
        `settle` instead.
    name, title, source, notes, stability
        Name of the method in C, and what comments say about it.
    stages, sweeps, b, bA
        Number of stages and of iterations, and the weights of the method.
    settle, settle_call
        Prototype of the function that iterates until convergence, and its C call.
    sweep_settling, sweep_first, sweep_back, sweep_forth
        C calls of one iteration: in `settle`; the first one of a step, which extrapolates the
        stages of the step before; and the later ones, from array a to b and from b to a.
    start
        C call of the accelerations at the start.
    solve
        Prototype of the function for the step.
    constrained
        Whether the scene has constraints.
    """

    TEMPLATE: ClassVar[str] = "c/optimised/sweeps.c"
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
class Loop(Named, Driven):
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
class Batch(Named, Driven):
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
class AdaptiveLanes(AdaptiveTableau):
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
        As in `Batch`.
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


View = (
    Source | LibraryText | LaneText | Blocks | TwoPoints | RungeKutta4 | Predictions
    | Predicted | Explicit | Factors | Gauss | Stages | Sweeps | State | Loop | Batch
    | AdaptiveLanes
)  # fmt: skip
