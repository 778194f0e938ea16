"""Integration methods in optimised C: their functions, and the data of their templates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from math import sqrt

from eomc.emit.common import c_function as c
from eomc.emit.common.c_expression import DOUBLE
from eomc.emit.common.c_function import CArgument, CFunction
from eomc.emit.common.coefficients import literal, literals, matrix_rows, round_weights
from eomc.emit.common.functions import SceneFunctions
from eomc.emit.optimised.lanes import Accelerations, Lane
from eomc.integrators.tableaux import RK4, Method, Row
from eomc.program import two_point


@dataclass(frozen=True)
class Steppers:
    """The integration methods of a scene in optimised C: their functions and template data.

    A *lane* is the C type that a function computes with: one number, or a vector register with one
    value of each of several instances.

    accelerations, functions: the scene's accelerations and other C functions.
    """

    accelerations: Accelerations
    functions: SceneFunctions

    @cached_property
    def one(self) -> Lane:
        """Generator of the C functions for plain numbers, which single trajectories use."""
        return Lane(self.accelerations)

    @cached_property
    def two(self) -> Lane:
        """Generator of the C functions for vector registers with values of two configurations q."""
        return Lane(self.accelerations, "two")

    @cached_property
    def wide(self) -> Lane:
        """Generator of the C functions for vector registers.

        A register has one value of each of several instances of a batch, or of several stages of
        one step.
        """
        return Lane(self.accelerations, "wide")

    @property
    def predicts_angles(self) -> bool:
        """Whether RK4 extrapolates angles of a single trajectory from one step to the next.

        The sines and cosines of the extrapolated angles are then computed in advance.
        """
        s = self.accelerations
        few = 0 < len(s.angles) < two_point.MIN_ANGLES
        free = not (self.one.two_point or s.target.system.constraints)
        return few and s.target.real is DOUBLE and free

    def passes_sines_to_projection(self, method: Method) -> bool:
        """Return True if steps of `method` pass sines and cosines to the constraint projection.

        These are the sines and cosines of the angles at the end of the step, which the projection
        of that state onto the constraints can reuse.
        """
        s = self.accelerations
        return method is RK4 and self.functions.projection is not None and s.correction[1]

    def predicts(self, method: Method) -> bool:
        """Return True if steps of `method` extrapolate angles to the next step.

        The sines and cosines of these predicted angles are then computed in advance.
        """
        return method is RK4 and self.predicts_angles

    @property
    def constants_call(self) -> str:
        """The C call that precomputes expressions of the parameters before a run.

        "" if there are no such expressions to compute and nothing to check.
        """
        function = self.one.compute_constants.function
        lines = sum(len(b.lines) for b in function.body)
        is_empty = not self.accelerations.constants and lines == 2
        return "" if is_empty else function.call(c="&constants")

    @property
    def own_constants(self) -> bool:
        """Whether instances may have parameters, and so precomputed expressions, of their own."""
        return bool(self.constants_call) and self.accelerations.target.needs_p

    @property
    def tile_blocks(self) -> int:
        """Number of blocks of a batch, of one vector register each, that are stepped together."""
        return 1 if self.accelerations.is_long else 4

    def vector(self, row: Row) -> tuple[str, ...]:
        """Return coefficients of a method, such as its nodes, as C literals."""
        return literals(row, self.one.real)

    def matrix(self, rows: Sequence[Row]) -> tuple[str, ...]:
        """Return the rows of a matrix of coefficients as lines of a C initialiser."""
        return matrix_rows(rows, self.one.real)

    def columns(self, rows: Sequence[Row]) -> tuple[str, ...]:
        """Return the columns of a matrix of coefficients as lines of a C initialiser."""
        return self.matrix(list(zip(*rows, strict=True)))

    @property
    def uses_registers(self) -> bool:
        """Whether the code computes several instances, or stages, at once in vector registers."""
        return self.functions.target.system.run.batch or self.functions.iterates_stages

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
        target = self.accelerations.target
        alone = target.system.run.methods == ("rk4",) and not target.integrates
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

    def step(self, lane: Lane, method: Method, alone: bool = False) -> CFunction:
        """Return the C function that computes the increments r and v of q and q̇ in one step.

        lane: the C type that it computes with. alone: whether it repeats a step of a single
        instance that failed otherwise; RK4 then computes new sines at each stage. The step of an
        implicit method takes the state of the run.
        """
        if method.implicit:
            return self._implicit_step(method)
        new_sines = alone and method is RK4 and bool(self.accelerations.angles)
        name = f"{method.name}_alone" if new_sines else method.name
        ends = not new_sines and not lane.name and self.passes_sines_to_projection(method)
        end = [c.output_array(f"{lane.prefix}_sines", "end")] if ends else []
        long = lane.two_point or new_sines if method is RK4 else method.stages >= 4
        qualifier = lane.noinline if long else lane.inline
        return replace(self._step_prototype(lane, name, *end), qualifier=qualifier)

    def _step_prototype(self, lane: Lane, name: str, *extra: CArgument) -> CFunction:
        """Return the prototype of the C function that computes one step of a method.

        name: its C name without the scene's prefix and the lane's suffix. extra: arguments added at
        the end.
        """
        out = tuple(c.output_array(lane.real.name, n) for n in "rv")
        arguments = (*out, *self.step_arguments(lane), *extra)
        return CFunction(f"{lane.prefix}_{name}{lane.suffix}", lane.mask, arguments)

    # RK4

    def rk4_signals(self, lane: Lane) -> CFunction:
        """Return the C function for the signals at the start, the middle and the end of a step."""
        state = [a for a in self.step_arguments(lane) if a.name not in ("q", "qd")]
        arguments = (c.output_array(f"{lane.prefix}_rk4_stages{lane.suffix}", "w"), *state)
        name = f"{lane.prefix}_rk4_signals{lane.suffix}"
        return CFunction(name, "void", arguments, qualifier=lane.inline)

    def rk4_stage(self, lane: Lane) -> CFunction:
        """Return the C function for the accelerations of stage k = 0, 1, 2, 3."""
        known = bool(self.accelerations.angles) and not lane.name
        arguments = (
            CArgument("int", "k"), *([CArgument("int", "known")] if known else []),
            c.output_array(f"{lane.prefix}_rk4_stages{lane.suffix}", "w"),
            *self.step_arguments(lane),
        )  # fmt: skip
        name = f"{lane.prefix}_rk4_stage{lane.suffix}"
        return CFunction(name, "void", arguments, qualifier=lane.inline)

    @property
    def predicted_steps(self) -> CFunction:
        """The C function for steps of RK4 whose angles are close to their predictions."""
        lane, real, prefix = self.one, self.one.real.name, self.one.prefix
        arguments = (
            c.output_array(f"{prefix}_rk4_state", "state"), CArgument("long", "n"),
            CArgument("long", "stop"), *([c.input_array(real, "u")] if lane.target.inputs else []),
            c.input_array(f"{prefix}_options", "options"),
            c.output_array(f"{prefix}_output", "output"), c.output_array("long", "next"),
            *([c.input_array(lane.constants, "constants")] if self.accelerations.constants else []),
        )  # fmt: skip
        name = f"{lane.prefix}_rk4_predicted"
        return CFunction(name, "long", arguments, qualifier=lane.noinline)

    # other methods

    def weighted_sum(self, row: Row) -> str:
        """Return a weighted sum of the accelerations a[0][i], a[1][i], ... as a C expression."""
        real = self.accelerations.target.real
        terms = [f"{literal(x, real)}*a[{k}][i]" for k, x in enumerate(row) if x]
        return " + ".join(terms).replace("+ -", "- ") or literal(Fraction(0), real)

    def rounded_weights(self, method: Method) -> Row:
        """Return the weights b of a method, rounded such that their sum stays exact."""
        return round_weights(method.b, self.accelerations.target.real)

    def node(self, method: Method, k: int) -> str:
        """Return the time of stage k as a fraction of the step."""
        return literal(method.c[k], self.accelerations.target.real)

    def _implicit_step(self, m: Method) -> CFunction:
        """Return the prototype of the C function for a step of the implicit method `m`."""
        lane = self.one
        state = c.output_array(f"{lane.prefix}_{m.name}_state", "m")
        extra = (self.functions.public.argument("p"),) if self.newton_p and m.newton else ()
        prototype = self._step_prototype(lane, m.name, *extra, state)
        return c.static_prototype(prototype.name, f"{lane.prefix}_status", *prototype.arguments)

    @property
    def newton_p(self) -> bool:
        """Whether the derivatives of the accelerations for Newton's method need the parameters p.

        Newton's method solves the equations of the stages of implicit methods.
        """
        slopes = self.functions.linearization
        if slopes is None or not self.accelerations.target.needs_p:
            return False
        arguments_read = {a.name for a in slopes.slopes.function.arguments}
        return (
            "p" in arguments_read or bool(slopes.signal) or self.accelerations.target.signal_state
        )

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

    def settle(self, m: Method) -> CFunction:
        """Return the C function that iterates over the stages of `m` until they converge."""
        P = f"{self.one.prefix}_{m.name}"
        state = c.output_array(f"{P}_state", "m")
        fresh = CArgument("int", "fresh")
        arguments = (
            c.output_array(f"{P}_stages", "a"),
            fresh,
            *self.step_arguments(self.one),
            state,
        )
        return c.static_prototype(f"{P}_settle", f"{self.one.prefix}_status", *arguments)

    @property
    def feedback(self) -> CFunction | None:
        """The C function of the signals if Newton's method needs their derivatives; else None."""
        return self.functions.signal if self.accelerations.target.signal_state else None

    def gauss_factor(self, m: Method) -> CFunction:
        """Return the C function that computes the factors of the matrix of Newton's method."""
        lane, slopes, signal = self.one, self.functions.linearization, self.functions.signal
        assert slopes is not None
        arguments_read = {a.name for a in slopes.slopes.function.arguments} | {"m", "h"}
        if signal and (slopes.signal or self.accelerations.target.signal_state):
            arguments_read |= {a.name for a in signal.arguments} | {"u"}
        function = c.static_prototype(
            f"{lane.prefix}_{m.name}_factor", "void",
            c.output_array(f"{lane.prefix}_{m.name}_state", "m"), CArgument(lane.real.name, "h"),
            *map(lane.argument, (n for n in lane.argument_names if n in ("q", "qd", "t", "u"))),
            *([self.functions.public.argument("p")] if self.newton_p else []),
        )  # fmt: skip
        return replace(function, reads=frozenset(arguments_read))

    @property
    def angle_limits(self) -> tuple[str, str]:
        """The largest angles (rad) by which RK4 rotates sines and cosines from stage to stage.

        They are C literals: the limit in general, and that for corrections.
        """
        real = self.one.real
        limits = (0.125, 0.015625) if real is DOUBLE else (0.25, 0.0625)
        return real.literal(limits[0]), real.literal(limits[1])

    @property
    def sweep_limits(self) -> tuple[str, str]:
        """The limits of the iterations over the stages of an implicit method, as C literals.

        The first is the relative error of velocities below which the iterations of `settle` have
        converged; if they start from the accelerations at the start of the step, the limit is
        rounding error instead. The second is the relative change of velocities in the last of a
        fixed number of iterations above which the step is solved by `settle` instead.
        """
        real = self.one.real
        # Steps that need more than five iterations are long, with errors above the first limit.
        change = f"{max(1e-6, 512 * real.epsilon):.0e}{real.suffix}"
        return real.literal(max(1e-8, real.epsilon)), change

    @property
    def difference_step(self) -> str:
        """Relative step of finite differences, as a C literal."""
        real = self.one.real
        return real.literal(sqrt(real.epsilon))
