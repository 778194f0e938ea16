"""Integration methods in optimised C: one step of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from math import isfinite, sqrt
from typing import Any, ClassVar

from eomc.emit import c_function as c
from eomc.emit.c_expression import DOUBLE
from eomc.emit.c_function import CArgument, CFunction
from eomc.emit.coefficients import (
    TableauFields,
    literal,
    literals,
    matrix_rows,
    round_weights,
    tableau,
)
from eomc.emit.derivatives import LinearizationView
from eomc.emit.functions import SceneFunctions
from eomc.emit.optimised.accelerations import Accelerations
from eomc.emit.optimised.lanes import INLINE, NOINLINE, Lane
from eomc.emit.views import NameFields, PrefixFields
from eomc.integrators.tableaux import METHODS, RK4, Method, Row
from eomc.program import two_point


@dataclass(frozen=True)
class LaneFields:
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
class StepFields:
    """Template fields that state what steps of a scene read.

    timed: the time t. inputs: the inputs u. constants: precomputed expressions of the parameters.
    """

    timed: bool
    inputs: bool
    constants: bool


@dataclass(frozen=True)
class OptimisedRK4View(NameFields, LaneFields, StepFields):
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
        As in `LaneView`.
    largest, small
        Largest angles, in rad, by which sines and cosines are rotated from one stage to another: in
        general, and for corrections.
    shared_signals
        Whether the signals depend on time only, so that they are computed once for several stages.
    signal_call, signal_now
        C calls of the signals (formulas for the inputs) at the start, middle and end of a step, and
        at one stage; "" for none.
    two_point, velocity_call
        Whether the accelerations are split into two parts, see `files.TwoPointsView`, and the C
        call of the velocity-dependent part.
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
class PredictionsView(PrefixFields):
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
class PredictedStepsView(NameFields, StepFields):
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
class ExplicitStage:
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
class OptimisedExplicitView(PrefixFields, LaneFields, StepFields):
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
    stages: tuple[ExplicitStage, ...]
    position: str
    velocity: str


@dataclass(frozen=True)
class OptimisedGaussView(NameFields, TableauFields):
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
class StagesView(NameFields):
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
class SweepsView(NameFields):
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
class Steppers:
    """The integration methods of a scene in optimised C: their functions and template data.

    A *lane* is the C type that a function computes with: one number, or a vector register with one
    value of each of several instances.

    accelerations, functions: the scene's accelerations and other C functions. slopes: template data
    of the derivatives of the accelerations; None if the scene does not need them.
    """

    accelerations: Accelerations
    functions: SceneFunctions
    slopes: LinearizationView | None

    @cached_property
    def one(self) -> Lane:
        """Generator of the C functions for plain numbers, which single trajectories use."""
        return Lane(self.accelerations)

    @cached_property
    def wide(self) -> Lane:
        """Generator of the C functions for vector registers.

        A register has one value of each of several instances of a batch, or of several stages of
        one step.
        """
        return Lane(self.accelerations, "wide")

    @property
    def two_point(self) -> bool:
        """Whether single trajectories use accelerations that are split into two C functions.

        The position-dependent part is computed for two configurations at once in one register; the
        velocity-dependent part completes the accelerations for each of them.
        """
        return self.accelerations.parts is not None

    @property
    def predicts_angles(self) -> bool:
        """Whether RK4 extrapolates angles of a single trajectory from one step to the next.

        The sines and cosines of the extrapolated angles are then computed in advance.
        """
        s = self.accelerations
        few = 0 < len(s.angles) < two_point.MIN_ANGLES
        free = not (self.two_point or s.target.system.constraints)
        return few and s.target.real is DOUBLE and free

    def passes_sines_to_projection(self, method: Method) -> bool:
        """Return True if steps of `method` pass sines and cosines to the constraint projection.

        These are the sines and cosines of the angles at the end of the step, which the projection
        of that state onto the constraints can reuse.
        """
        s = self.accelerations
        return method is RK4 and self.functions.projection is not None and s.correction[1]

    @property
    def methods(self) -> tuple[Method, ...]:
        """The integration methods that the scene requests."""
        return tuple(METHODS[name] for name in self.accelerations.target.system.run.methods)

    @property
    def shared_signals(self) -> bool:
        """Whether the signals depend on time only, so that stages at one time share them.

        Signals are the scene's formulas for its inputs.
        """
        target = self.accelerations.target
        return "signal" in target.program and not target.signal_state

    @property
    def signals_supplied(self) -> bool:
        """Whether all callers pass the inputs to the C function for the accelerations.

        They compute them from the signals, the scene's formulas for its inputs. If False, the
        function for the accelerations must be able to compute the signals itself.
        """
        run = self.accelerations.target.system.run
        alone = run.methods == ("rk4",) and run.tolerance is None
        return self.shared_signals and alone and not self.predicts_angles

    def accelerate(self, lane: Lane, **passed: str) -> str:
        """Return a C call of the function for the accelerations.

        lane: the C type that it computes with, one number or a vector register. passed: C
        expressions for some arguments, by name; the others are passed under their own names. By
        default s, the sines of the angles, is NULL, so that the function computes them.
        """
        if self.accelerations.angles:
            passed = {"s": "NULL"} | passed
        return lane.accelerations_function.call(**passed)

    @property
    def step_fields(self) -> dict[str, Any]:
        """The fields of the template data class `StepFields`, by name.

        They state whether steps read time, inputs and precomputed expressions.
        """
        target = self.accelerations.target
        return {
            "timed": target.driven, "inputs": bool(target.system.inputs),
            "constants": bool(self.accelerations.constants),
        }  # fmt: skip

    def looping(self, lane: Lane) -> dict[str, Any]:
        """Return template fields by name: the scene's C names, and the macro `unroll`.

        The macro precedes loops over coordinates. lane: one number or a vector register.
        """
        return self.functions.names | {"unroll": lane.unroll}

    def extended(self, lane: Lane) -> dict[str, Any]:
        """Return template fields by name: the scene's C names, and `extent`.

        extent: length of the C vectors of coordinates. lane: one number or a vector register.
        """
        return self.functions.names | {"extent": lane.c_width}

    # what a step takes

    def step_arguments(self, lane: Lane) -> tuple[CArgument, ...]:
        """Return the arguments of the C function for one step: q, qd, t, h, u and c.

        Arguments that the scene does not need (t, u, c) are left out. h is the step size, and c the
        struct of precomputed expressions of the parameters. lane: one number or a vector register;
        it determines the C types.
        """
        real = self.accelerations.target.real.name
        names = [n for n in lane.argument_names if n != "s"]
        arguments = [lane.argument(n) for n in names]
        position = next((k for k, n in enumerate(names) if n in "uc"), len(names))
        return (*arguments[:position], CArgument(real, "h"), *arguments[position:])

    def step_prototype(self, lane: Lane, name: str, *extra: CArgument) -> CFunction:
        """Return the prototype of the C function that computes one step of a method.

        The function stores the increments of q and q̇ in its arguments r and v. lane: the C type
        that it computes with. name: its C name without the scene's prefix and the lane's suffix.
        extra: arguments added at the end.
        """
        out = tuple(c.output_array(lane.real.name, n) for n in "rv")
        return CFunction(
            f"{lane.prefix}_{name}{lane.suffix}",
            lane.mask,
            (*out, *self.step_arguments(lane), *extra),
        )

    # methods

    def rk4_view(self, lane: Lane) -> OptimisedRK4View:
        """Return the template data of one step of RK4, the classical Runge-Kutta method.

        lane: the C type that the step computes with, one number or a vector register.
        """
        s = self.accelerations
        double, one = s.target.real is DOUBLE, not lane.name
        two_point = one and self.two_point
        signal = lane.signal.function if lane.signal else None
        known = c.member("w", "k")
        here = {"a": c.member("w", "a[k]"), "q": "at", "qd": "moving", "t": "t + node"}
        return OptimisedRK4View(
            **self.looping(lane),
            **lane.names,
            **self.step_fields,
            extent=lane.c_width,
            noinline=lane.qualifiers[NOINLINE],
            constants_type=lane.constants,
            title=RK4.title,
            source=RK4.source,
            stability=stability(RK4),
            angles=lane.angle_count if s.angles else "",
            across=lane.simd_angles,
            sincos=lane.sincos,
            largest=s.target.literal(0.125 if double else 0.25),
            small=s.target.literal(0.015625 if double else 0.0625),
            shared_signals=self.shared_signals,
            signal_call=signal.call(u=c.member("w", "u[j]"), t="t + j*(h/2)") if signal else "",
            signal_now=signal.call(u="now", q="at", qd="moving", t="t + node") if signal else "",
            two_point=two_point,
            velocity_call=lane.velocity.function.call(**here, k=f"&{known}", point="k % 2")
            if two_point
            else "",
            stage_call=lane.accelerations_function.call(**here),
            corrected=self.passes_sines_to_projection(RK4),
        )

    def predictions_view(self) -> PredictionsView:
        """Return the template data of the C functions that extrapolate angles to the next RK4 step.

        They compute the sines and cosines of these angles in advance.
        """
        lane, angles = self.one, len(self.accelerations.angles)
        return PredictionsView(
            prefix=lane.prefix, real=lane.real.name, unroll=lane.unroll,
            inline=lane.qualifiers[INLINE], angles=angles,
        )  # fmt: skip

    def predicted_steps_view(self) -> PredictedStepsView:
        """Return the template data of the C loop over steps of RK4 that use predicted angles.

        Predicted angles are extrapolated from the step before.
        """
        lane, s = self.one, self.accelerations
        signal = lane.signal.function if lane.signal else None
        shared = self.shared_signals

        def stage(k: int) -> str:
            names = ["&w", *(a.name for a in self.step_arguments(lane))]
            named = {"q": "x.q", "qd": "x.qd", "u": "w.u[0]" if shared else "input"}
            arguments = [str(k), "1", *(named.get(n, n) for n in names)]
            return f"{lane.prefix}_rk4_stage({', '.join(arguments)})"

        def signalled(place: str, time: str) -> str:
            return signal.call(u=place, t=time) if signal and shared else ""

        real = s.target.real.name
        return PredictedStepsView(
            **self.looping(lane),
            noinline=lane.qualifiers[NOINLINE],
            angles=len(s.angles),
            **self.step_fields,
            shared_signals=shared,
            signal_first=signalled("w.u[2]", f"t0 + ({real})(first + n)*h"),
            signal_mid=signalled("w.u[1]", "t + h/2"),
            signal_end=signalled("w.u[2]", f"t0 + ({real})(first + n + 1)*h"),
            stage=tuple(map(stage, range(4))),
        )

    def explicit_view(self, lane: Lane, m: Method) -> OptimisedExplicitView:
        """Return the template data of a step of an explicit Runge-Kutta method `m`.

        For RK4, `rk4_view` is used instead. lane: the C type that the step computes with, one
        number or a vector register with values of several instances.
        """
        real = self.accelerations.target.real

        def total(row: Row) -> str:
            terms = [f"{literal(x, real)}*a[{k}][i]" for k, x in enumerate(row) if x]
            return " + ".join(terms).replace("+ -", "- ") or literal(Fraction(0), real)

        def stage(k: int, node: Fraction, positions: Row, velocities: Row) -> ExplicitStage:
            here = {"q": "at", "qd": "moving", "t": f"t + {literal(node, real)}*h"}
            start = k == 0 and not node
            call = self.accelerate(lane, a=f"a[{k}]", **({} if start else here))
            return ExplicitStage(
                "" if start else literal(node, real), total(positions), total(velocities), call
            )

        rows = zip(m.c, m.a_squared, m.a, strict=True)
        return OptimisedExplicitView(
            prefix=lane.prefix,
            real=real.name,
            unroll=lane.unroll,
            extent=lane.c_width,
            **lane.names | ({} if m.stages < 4 else {"inline": lane.qualifiers[NOINLINE]}),
            **self.step_fields,
            clear=lane.clear,
            constants_type=lane.constants,
            name=m.name,
            title=m.title,
            source=m.source,
            order=m.order,
            notes=m.notes,
            stability=stability(m),
            stages=tuple(stage(k, *rest) for k, rest in enumerate(rows)),
            position=total(m.b_a),
            velocity=total(round_weights(m.b, real)),
        )

    def implicit_step(self, m: Method) -> CFunction:
        """Return the prototype of the C function for a step of the implicit method `m`."""
        lane = self.one
        state = c.output_array(f"{lane.prefix}_{m.name}_state", "m")
        extra = (self.functions.argument("p"),) if self.newton_p and m.newton else ()
        prototype = self.step_prototype(lane, m.name, *extra, state)
        return c.static_prototype(prototype.name, f"{lane.prefix}_status", *prototype.arguments)

    @property
    def newton_p(self) -> bool:
        """Whether the derivatives of the accelerations for Newton's method need the parameters p.

        Newton's method solves the equations of the stages of implicit methods.
        """
        slopes = self.slopes
        if slopes is None or not self.accelerations.target.needs_p:
            return False
        arguments_read = {a.name for a in slopes.slopes.function.arguments}
        return "p" in arguments_read or bool(slopes.signal_call) or self.signals_read_state

    @property
    def signals_read_state(self) -> bool:
        """Whether the scene's signals (formulas for its inputs) depend on the state."""
        return self.accelerations.target.signal_state

    def gauss_view(self, m: Method) -> OptimisedGaussView:
        """Return the template data of a step of a Gauss method that uses Newton's method."""
        lane, target, real, slopes = self.one, self.one.target, self.one.real, self.slopes
        assert slopes is not None
        f = self.functions
        signal = f.signal if slopes.signal_call or self.signals_read_state else None
        state = lane.argument
        time_and_inputs = [n for n in ("t", "u") if n in lane.argument_names]
        factor = c.static_prototype(
            f"{lane.prefix}_{m.name}_factor", "void",
            c.output_array(f"{lane.prefix}_{m.name}_state", "m"), CArgument(real.name, "h"),
            *map(state, ("q", "qd")), *map(state, time_and_inputs),
            *([f.argument("p")] if self.newton_p else []),
        )  # fmt: skip
        arguments_read = {a.name for a in slopes.slopes.function.arguments}
        arguments_read |= {a.name for a in signal.arguments} | {"u"} if signal else set()
        return OptimisedGaussView(
            **self.extended(lane),
            **self.literal_fields,
            nudge=target.literal(sqrt(real.epsilon)),
            title=m.title,
            source=m.source,
            order=m.order,
            notes=m.notes,
            stages=m.stages,
            **tableau(m, real),
            extrapolation=matrix_rows(m.extrapolation, real),
            width=slopes.width,
            factor=factor,
            factor_unread=tuple(
                a.name for a in factor.arguments[2:] if a.name not in arguments_read
            ),
            signal_call=slopes.signal_call,
            follows=signal.call(u="near_u", q="near_q", qd="near_qd")
            if signal and self.signals_read_state
            else "",
            slopes_call=slopes.slopes_call,
            solve=self.implicit_step(m),
            factor_now=factor.call(),
            factor_mid=factor.call(q="mid_q", qd="mid_qd", t="t + h/2"),
            start=self.accelerate(lane, a="f"),
            stage=self.accelerate(lane, a="f", q="at", qd="moving", t="t + c_[i]*h"),
        )

    @property
    def literal_fields(self) -> dict[str, Any]:
        """Template fields by name, for the C type of numbers.

        f: suffix of C literals. fabs: name of the C function for |x|. eps: the rounding unit.
        """
        real = self.one.real
        end = real.function_suffix
        return {
            "f": real.suffix, "fabs": f"fabs{end}",
            "eps": self.one.target.literal(real.epsilon),
        }  # fmt: skip

    def sweep_prototype(self, m: Method) -> CFunction:
        """Return the prototype of the C function for one iteration over the stages of `m`.

        From the accelerations at all stages of a step it computes improved ones, side by side in
        vector registers.
        """
        P = f"{self.one.prefix}_{m.name}"
        out = c.output_array(f"{P}_stages", "b")
        arguments = (c.input_array(f"{P}_stages", "a"), c.input_array(f"{P}_sums", "w"))
        others = (*self.step_arguments(self.one), *self.functions.onto_argument)
        return c.static_prototype(f"{P}_sweep", "int", out, *arguments, *others)

    def stages_view(self, m: Method) -> StagesView:
        """Return the template data of the C function whose prototype `sweep_prototype` returns.

        It makes one fixed-point iteration over all stages of a step by the implicit method `m`.
        """
        lane, wide, real = self.one, self.wide, self.one.real
        fixed = m.name in lane.target.system.run.methods

        def by_stage(rows: Sequence[Row]) -> tuple[str, ...]:
            return c.initialiser_rows(literals(column, real) for column in zip(*rows, strict=True))

        before = (by_stage(m.a_extrapolated), by_stage(m.a_squared_extrapolated)) if fixed else None
        return StagesView(
            **self.extended(lane),
            inputs=bool(lane.target.system.inputs),
            constants=bool(self.accelerations.constants),
            members=self.accelerations.constants,
            name=m.name,
            stages=m.stages,
            padded=f"{max(m.stages, 64 // (8 if real is DOUBLE else 4))}",
            c=literals(m.c, real),
            within=(by_stage(m.a), by_stage(m.a_squared)),
            extrapolated=before,
            sweep=self.sweep_prototype(m),
            together=self.accelerate(
                wide, a="f", q="at", qd="moving", t="t + nodes", u="u ? input : NULL", c="&wide"
            ),
            alone=self.accelerate(lane, a="one", q="x", qd="v", t="t + c_[i + j]*h"),
            onto=lane.project_stage.call(at="x", moving="v", t="t + c_[i + j]*h")
            if self.functions.projection
            else "",
        )

    def sweeps_view(self, m: Method) -> SweepsView:
        """Return the template data of a step of an implicit method `m` by fixed-point iteration.

        The number of iterations is fixed; if they do not converge, the step iterates further.
        """
        lane, real = self.one, self.one.real
        P = f"{lane.prefix}_{m.name}"
        state = c.output_array(f"{P}_state", "m")
        values = c.output_array(f"{P}_stages", "a")
        arguments = (values, CArgument("int", "fresh"), *self.step_arguments(lane), state)
        settle = c.static_prototype(f"{P}_settle", f"{lane.prefix}_status", *arguments)
        sweep, within, before = self.sweep_prototype(m), f"&{P}_within", f"&{P}_extrapolated"
        return SweepsView(
            **self.extended(lane),
            **self.literal_fields,
            # Steps that need more than five iterations are long, with errors above this value.
            enough=lane.target.literal(max(1e-8, real.epsilon)),
            tolerance=f"{max(1e-6, 512 * real.epsilon):.0e}{real.suffix}",
            inputs=bool(lane.target.system.inputs),
            name=m.name,
            title=m.title,
            source=m.source,
            notes=m.notes,
            stability=stability(m),
            stages=m.stages,
            sweeps=m.sweeps,
            b=literals(round_weights(m.b, real), real),
            bA=literals(m.b_a, real),
            settle=settle,
            settle_call=settle.call(a="&a", fresh="!smooth"),
            constrained=bool(self.functions.projection),
            sweep_settling=sweep.call(b="&b", a="a", w=within),
            sweep_first=sweep.call(b="&a", a="&b", w=before, onto="0"),
            sweep_back=sweep.call(b="&b", a="&a", w=within, onto="0"),
            sweep_forth=sweep.call(b="&a", a="&b", w=within, onto="0"),
            start=self.accelerate(lane, a="f"),
            solve=self.implicit_step(m),
        )


def stability(m: Method) -> str:
    """Return the stability limits of the method `m` as text for a C comment.

    The limits are the largest h omega for undamped oscillation with angular frequency omega, and
    the largest h lambda for pure decay with rate lambda, where h is the step size.
    """
    undamped, decay = m.limits
    return f"h omega <= {undamped:.3g} undamped" + (
        f", h lambda <= {decay:.3g} for pure decay." if isfinite(decay) else "."
    )
