"""Optimised C: the header and the source of a program, and the functions of its methods.

For gcc and clang. Functions of a step are printed for several C types: numbers for a trajectory, a
vector register for batches and for iterated stages, two configurations for long accelerations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from math import sqrt
from typing import Any

from eomc.base import resources
from eomc.emit.common import adaptive, solver
from eomc.emit.common import c_function as c
from eomc.emit.common.c_expression import C_NAMES, DOUBLE, PIVOT, Real
from eomc.emit.common.c_function import CArgument, CFunction
from eomc.emit.common.functions import SceneFunctions
from eomc.emit.common.solver import (
    SolverModel,
    literal,
    literals,
    matrix_rows,
    round_weights,
    step_derivatives,
)
from eomc.emit.common.templates import show
from eomc.emit.optimised.lanes import Accelerations, Lane
from eomc.integrators.tableaux import RK4, Method, Row
from eomc.program import two_point
from eomc.runtime.mathematics import FUNCTIONS


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
        """Whether the code computes several instances or stages in vector registers."""
        return self.steps_in_registers or self.functions.public.linearization_block is not None

    @property
    def steps_in_registers(self) -> bool:
        """Whether steps compute several instances, or stages, at once in vector registers."""
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


# Placeholders in csrc for names, types and sizes of a lane
PLACEHOLDERS = ("BITS_OF_SIZE", "INTEGER", "LANE_ALIGNED", "LANE_BYTES", "LANE_COUNT", "REAL")
LANE_ROOTS = ("eom_initial_step_size", "eom_copy_state", "eom_gauss_last", "eom_gauss_weights")
SWEEP = "b = the accelerations at the stages to which a lead. Returns 0 if some do not exist."
PROJECT_INCREMENTS = (
    "Change the increments r, v of a step from q, qd such that its end satisfies the constraints."
)
LANE_FUNCTIONS = frozenset({"exp", "tanh"})  # mathematical functions in csrc over a lane
BINARY_FUNCTIONS = ("pow", *(f.name for f in FUNCTIONS.values() if len(f.arguments) == 2))


@dataclass(frozen=True)
class LibraryFunction:
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


def files(functions: SceneFunctions) -> dict[str, str]:
    """Return the header and the source of a scene in optimised C, as texts by file name."""
    steppers, name = Steppers(Accelerations(functions.target), functions), functions.prefix
    workspace = max(state_size(steppers, m) for m in functions.methods)
    header = adaptive.header(functions, workspace, steppers.one.width)
    source = show(
        "c/optimised/source.c",
        functions,
        steps=list(_steppers(steppers)),
        steppers=steppers,
        csrc=list(_csrc(steppers)),
        lanes=list(filter(None, _lanes(steppers))),
    )
    return {f"{name}.h": c.break_long_lines(header), f"{name}.c": c.break_long_lines(source)}


def _csrc(steppers: Steppers) -> Iterator[str]:
    """Yield the hand-written C that this scene needs, with its prefix."""
    target = steppers.accelerations.target
    end = target.real.function_suffix
    size = 8 if target.real is DOUBLE else 4
    rotates = bool(steppers.accelerations.angles) and RK4 in steppers.functions.methods
    lanes = [("wide", f"{target.PREFIX}_WIDE_BYTES", True)] * steppers.uses_registers
    if steppers.one.two_point:
        lanes += [("two", str(2 * size), False)]
    simd = steppers.accelerations.simd_angles
    angles = steppers.functions.has_grouped_angles or simd
    if angles:
        lanes += [("four", str(4 * size), simd)]
    if RK4 in steppers.functions.methods and steppers.predicts_angles:
        prediction_bytes = size * prediction_width(len(steppers.accelerations.angles))
        lanes += [("prediction", str(prediction_bytes), False)]
    texts = [(f"sincos/sincos{end}.h", "", "")] if target.sincos else []
    if rotates:
        texts += [("lanes/scalar.h", "", ""), (f"lanes/rotate{end}.h", "", "")]
    texts += [("lanes/larger.h", "", "")] * any(m.implicit for m in steppers.functions.methods)
    for name, width, rotates_angles in lanes:
        texts += [("lanes/vector.h", name, width)]
        texts += [(f"lanes/sincos{end}.h", name, width)] * target.sincos
        texts += [(f"lanes/rotate{end}.h", name, width)] * (rotates_angles and rotates)
        needed_functions = (
            LANE_FUNCTIONS & set(steppers.one.math_functions)
            if name in ("wide", "two")
            else frozenset()
        )
        selects = bool(needed_functions) or (name == "wide" and adaptive.steps_in_parallel(target))
        texts += [("lanes/select.h", name, width)] * selects
        texts += [(f"lanes/exp{end}.h", name, width)] * bool(needed_functions)
        texts += [(f"lanes/tanh{end}.h", name, width)] * ("tanh" in needed_functions)
        texts += [("lanes/four.h", name, width)] * (name == "four" and simd)
        texts += [("lanes/interleave.h", name, width)] * (name == "four" and steppers.one.two_point)
        texts += [("lanes/angles.h", name, width)] * (name == "four" and angles)
    for file, name, width in texts:
        text = resources.text("csrc", file).replace("#include <math.h>\n", "")
        integer, bits = ("long long", "0x7fffffffffffffff") if size == 8 else ("int", "0x7fffffff")
        for old, new in (
            # With many angles, inlining the sincos of each makes the code of gcc 50 % slower.
            *([("static inline void", "static void")] if steppers.accelerations.is_long else ()),
            ("EOMC_BITS_OF_SIZE", bits),
            ("EOMC_INTEGER", integer),
            # Compilers pass values with larger alignment than a register in different ways.
            ("EOMC_LANE_ALIGNED", width if name == "wide" else "16"),
            ("EOMC_LANE_BYTES", width),
            ("EOMC_LANE_COUNT", f"{target.PREFIX}_{name.upper()}_COUNT"),
            ("fabs_REAL", f"fabs{end}"),
            ("sincos_REAL", f"sincos{end}"),
            ("EOMC_REAL", target.real.name),
            *(
                (("_LANE", f"_{name}"),)
                if name
                else (("eomc_LANE", target.real.name), ("_LANE", ""))
            ),
            ("eomc_", f"{target.prefix}_"),
            ("EOMC_", f"{target.PREFIX}_"),
        ):
            text = text.replace(old, new)
        yield text.strip()


def _lanes(steppers: Steppers) -> Iterator[str]:
    """Yield the C text of the accelerations, and of the projection, over each lane type."""
    functions, one, wide = steppers.functions, steppers.one, steppers.wide
    batch = functions.target.system.run.batch
    if steppers.one.two_point:
        yield _library(functions, steppers.two)
    yield show("c/optimised/lane.c", functions, steppers=steppers, lane=one)
    if steppers.uses_registers:
        yield _library(functions, wide)
    if steppers.steps_in_registers:
        yield show("c/optimised/lane.c", functions, steppers=steppers, lane=wide)
    if functions.projection:
        yield "\n\n".join(one.projection_source(functions)) + "\n"
        if batch:
            size = solver.correction_size(functions.target)
            yield show("c/optimised/projection.c", functions, lane=wide, size=size)
    if batch:
        yield show("c/optimised/blocks.c", functions, steppers=steppers)


def _library(functions: SceneFunctions, lane: Lane) -> str:
    """Return the functions of the mathematics library over a lane of several numbers."""
    names = set(lane.math_functions) - LANE_FUNCTIONS
    if lane.name == "wide" and adaptive.steps_in_parallel(functions.target):
        names.add("sqrt")
    calls = [_library_function(functions.target.real, n, lane) for n in sorted(names)]
    return show("c/optimised/library.c", functions, lane=lane, calls=calls)


def _library_function(real: Real, name: str, lane: Lane) -> LibraryFunction:
    """Return one mathematical function over a lane of several numbers."""
    if name == PIVOT:
        return LibraryFunction(name, name, True, "")
    called, letter = C_NAMES.get(name, name), "d" if real is DOUBLE else "s"
    is_whole = lane.name == "wide" and name == "sqrt"
    whole = f"__builtin_ia32_sqrtp{letter}512_mask(x, x, -1, 4)" if is_whole else ""
    return LibraryFunction(called, real.function(called), name in BINARY_FUNCTIONS, whole)


def _steppers(steppers: Steppers) -> Iterator[str]:
    """Yield the methods: state, step, run and batch of each."""
    functions, run = steppers.functions, steppers.functions.target.system.run
    model = library_model(steppers)
    texts = [*solver.functions_source(model, "rows.c", "row_step")]
    if run.tolerance is not None or any(m.newton for m in functions.methods):
        texts += solver.functions_source(model, "linear.c", "factor", "substitute")
    yield from (f"{text}\n" for text in texts)
    for m in functions.methods:

        def show_method(template: str, method: Method = m, **objects: Any) -> str:
            path = f"c/optimised/{template}.c"
            return show(path, functions, steppers=steppers, method=method, **objects)

        for lane in (steppers.one, *([steppers.wide] if run.batch else [])):
            if not m.implicit:
                yield show_method("rk4" if m is RK4 else "explicit", lane=lane)
        if steppers.predicts(m):
            yield show("c/optimised/predictions.c", functions, steppers=steppers)
        yield show_method("state")
        if steppers.predicts(m):
            yield show("c/optimised/predicted.c", functions, steppers=steppers)
        if m.sweeps:
            yield show_method("stages") + "\n" + show_method("sweeps").rstrip("\n")
        elif m.implicit:
            yield show_method("gauss")
        yield show_method("run")
        if run.batch:
            yield show_method("batch")
    if functions.target.is_adaptive and adaptive.METHOD not in functions.methods:
        method = adaptive.METHOD
        yield show("c/optimised/stages.c", functions, steppers=steppers, method=method)
    yield from _from_library(steppers, model)
    if functions.public.linearization_block:
        yield show("c/optimised/linearization_block.c", functions, lane=steppers.wide)


def _from_library(steppers: Steppers, model: SolverModel) -> Iterator[str]:
    """Yield projection of states, adaptive steps, and derivatives of steps, by the library."""
    functions = steppers.functions
    run, integrates = functions.target.system.run, functions.target.integrates
    texts = [*solver.state_source(model)]
    side_by_side = run.batch and integrates and adaptive.steps_in_parallel(functions.target)
    if integrates:
        texts += adaptive.library_texts(model, LANE_ROOTS if side_by_side else ())
    texts += [*step_derivatives(model), *solver.run_adjoints(model)]
    if texts:
        own = (*functions.constraint_texts, *model.source(texts), *dict.fromkeys(texts))
        yield from (text.rstrip("\n") + "\n" for text in own)
    if not (integrates or len(run.methods) > 1):
        return
    yield adaptive.integrate(model)
    if side_by_side:
        yield show(
            "c/optimised/adaptive_lanes.c", functions, steppers=steppers, method=adaptive.METHOD,
            model=model, control=adaptive.step_control(functions.target),
        )  # fmt: skip
    if run.batch:
        yield show("c/integrate_batch.c", functions, in_parallel=side_by_side)


# --- what the form supplies to the library ----------------------------------------------------


def state_size(steppers: Steppers, m: Method) -> int:
    """Return the length of the workspace that a run by the method `m` needs.

    It is a count of numbers of the C type of the scene, which the C header reserves.
    """
    n, angles, s = len(steppers.one.target.names), len(steppers.accelerations.angles), m.stages
    size = 4 * steppers.one.width + 32
    if steppers.predicts(m):
        size += n + 2 * angles + 5 * prediction_width(angles)
    if m.newton:
        size += s * n * (s * n + 2)
    if m.sweeps:
        size += s * n + len(steppers.one.target.input_names)
    return size


def prediction_width(angles: int) -> int:
    """Return the number of values in the C vector type for predicted angles.

    It is twice `angles`, the number of angles, rounded up to a power of two.
    """
    return 1 << (2 * angles - 1).bit_length()


def library_model(steppers: Steppers) -> SolverModel:
    """Return what optimised C supplies to the library.

    The library makes adaptive steps, detects events, projects states onto the constraints and
    differentiates steps.
    """
    functions, one, m = steppers.functions, steppers.one, adaptive.METHOD
    real, prefix, system = functions.real, functions.prefix, functions.target.system
    products = functions.public.has("acceleration_vjp")
    accelerates = functions.target.integrates or products
    members = [a for a in steppers.step_arguments(one) if a.name in "ucp" and accelerates]
    present = {a.name for a in members}
    if system.events or system.constraints or system.run.discretize or products:
        members += [a for a in functions.public.arguments("u", "p") if a.name not in present]
    bare = SolverModel(functions, tuple(members), (), one.c_width)
    passed = bare.arguments
    state = (*solver.state_arguments(real), *bare.argument)
    qdd = c.output_array(real, "qdd")
    stages = f"{prefix}_{m.name}_stages"
    sweep_arguments = (
        c.output_array(stages, "b"), c.input_array(stages, "a"), *solver.state_arguments(real),
        CArgument(real, "h"), *functions.onto_argument, *bare.argument,
    )  # fmt: skip
    accelerations = one.accelerations_function
    own = {one.out.name: "qdd"} | ({"s": "NULL"} if steppers.accelerations.angles else {})
    callbacks = [
        solver.callback(
            f"{prefix}_accelerate", accelerations, (qdd, *state), solver.ACCELERATE, **passed, **own
        ),
        solver.callback(
            f"{prefix}_{m.name}_iterate", steppers.sweep_prototype(m), sweep_arguments, SWEEP,
            w=f"&{prefix}_{m.name}_within", **passed,
        ),
    ]  # fmt: skip
    if functions.projection:
        r, v = c.output_array(real, "r"), c.output_array(real, "v")
        singular = one.project_end.arguments[-1]
        callbacks.append(
            solver.callback(
                f"{prefix}_project_increments", one.project_end, (r, v, *state, singular),
                PROJECT_INCREMENTS, s="NULL", **passed,
            )
        )  # fmt: skip
    return SolverModel(
        functions, tuple(members), (*callbacks, *solver.public_callbacks(functions, bare)),
        one.c_width, f"{one.target.PREFIX}_LANES", bool(steppers.accelerations.constants),
        steppers.constants_call, has_sweep=True,
    )  # fmt: skip
