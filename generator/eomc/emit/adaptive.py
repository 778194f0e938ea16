"""Adaptive steps in both forms of C, portable and optimised: data of the shared templates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any, ClassVar

from eomc.emit import c_function as c
from eomc.emit.c_expression import Real
from eomc.emit.c_function import CArgument, CFunction
from eomc.emit.c_names import Target
from eomc.emit.coefficients import literals, matrix_rows, round_weights
from eomc.emit.functions import SceneFunctions
from eomc.emit.views import NameFields
from eomc.integrators.tableaux import GAUSS16, Row
from eomc.model.nonsmooth import has_steep_terms
from eomc.model.system import System
from eomc.program import outline
from eomc.scene.schema import MAX_TOLERANCE

METHOD = GAUSS16
TITLE = f"the implicit method of Gauss and Legendre with {METHOD.stages} stages"
MAX_ITERATIONS = 14  # over the stages, per step
REJECT_AFTER_TWO = 2 * 0.8**-8  # error over sqrt(tol/2) for which two iterations suffice to reject
MAX_TIME_SCALES = 1e4  # the minimal step is relative to at most this many initial time scales
SCALE_FLOOR = 1e-4  # least scale of a coordinate or velocity, relative to the largest
COARSE_SCALE_FLOOR = 0.01  # the same for rounding errors, and in single precision
KINK_SHARE = 0.1  # of the tolerance, for the error of a step with a discontinuity
RETRY_AFTER = 32  # steps by Newton's method before fixed-point iteration is tried again
MAX_BATCH_OPERATIONS = 300  # of the accelerations, up to which instances are stepped in parallel
RECENT_STEPS = 4  # steps in which one may be halved for its events without being counted
EVENTS_PER_STEP = 32  # without events at the same time


@dataclass(frozen=True)
class AdaptiveFields:
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
class AdaptiveStepView(NameFields, AdaptiveFields):
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
class FixedStepsView(NameFields):
    """Data for c/fixed_steps.c: steps of fixed size with event detection.

    Attributes
    ----------
    method, extent, stages, f, eps
        As in `AdaptiveFields`.
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
class AdaptiveRunView(NameFields):
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
        As in `EventsView` and `AdaptiveFields`.
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
class AdaptiveBatchView:
    """Data for c/adaptive_batch.c: adaptive runs of many instances, in sequence.

    prefix: the scene's name, with which C names begin. batch: prototype of the public function.
    alone: C call of the run of one instance, with index k. events: whether the scene has events.
    """

    TEMPLATE: ClassVar[str] = "c/adaptive_batch.c"
    prefix: str
    batch: CFunction
    alone: str
    events: bool


def workspace_type(functions: SceneFunctions) -> str:
    """Return the name of the C struct for the workspace of a run with adaptive step-size control.

    The workspace keeps data between the calls that continue a run.
    """
    return f"{functions.prefix}_{METHOD.name}_adaptive_memory"


def workspace_size(system: System, width: int) -> int:
    """Return the size of the workspace of an adaptive run, as a number of floating-point numbers.

    The workspace keeps data between the calls that continue a run. `width` is the length of a
    vector of coordinates in C, which may include padding.
    """
    vectors, scalars = (8, 26) if has_steep_terms(system) else (6, 22)
    stages = METHOD.stages * len(system.coordinates)
    event_numbers = 11 * len(system.events) + 14 * bool(system.events) + bool(system.constraints)
    vectors += 2 * any(e.begins is not None for e in system.events)
    return vectors * width + stages + scalars + event_numbers


@dataclass(frozen=True)
class SweepInterface:
    """C code that the portable and the optimised form supply to the shared code of adaptive steps.

    Attributes
    ----------
    around
        C arguments of an iteration over the stages: q, qd, t, h and so on, not accelerations.
    sweep
        C call of one iteration, which computes the stage accelerations *to from *from.
    start
        C call that computes the accelerations f at q, qd.
    extent
        Length of C arrays for coordinates, which may include padding.
    constants
        Whether expressions that depend on parameters only are precomputed and stored in a struct c.
    compute_constants
        C call that computes this struct and is nonzero on failure; "" if not needed.
    lanes
        Macro before loops over the stages, by which compilers vectorise them; "" for none.
    project
        C call that projects the end of a step onto the constraints; "" without constraints.
    whole
        Whether `project` takes the state itself rather than its increment in the step.
    """

    around: tuple[CArgument, ...]
    sweep: str
    start: str
    extent: str
    constants: bool = False
    compute_constants: str = ""
    lanes: str = ""
    project: str = ""
    whole: bool = False


@dataclass(frozen=True)
class AdaptiveFunctions:
    """The C functions of adaptive steps for one form (portable or optimised) of the C code.

    Most properties are prototypes of static functions whose bodies are in templates.
    """

    functions: SceneFunctions
    form: SweepInterface

    @property
    def method(self) -> str:
        """The common prefix of the C names: the scene's name, "_" and the method's name."""
        return f"{self.functions.prefix}_{METHOD.name}"

    @property
    def constant_arguments(self) -> Sequence[CArgument]:
        """The C arguments u, c and p, as far as this form has them; they are constant during a run.

        These are the inputs, the precomputed expressions of parameters, and the parameters.
        """
        return [a for a in self.form.around if a.name in "ucp"]

    @property
    def workspace(self) -> CArgument:
        """The C argument for the workspace of a run, which keeps data between calls."""
        return c.output_array(workspace_type(self.functions), "memory")

    @property
    def state(self) -> CArgument:
        """The C argument for the current state of a run: q, qd, t, step size and interpolant."""
        return c.output_array(f"{self.method}_adaptive_state", "x")

    def number(self, name: str) -> CArgument:
        """Return a C argument called `name` of the scene's floating-point type, passed by value."""
        return CArgument(self.functions.real, name)

    @cached_property
    def solve_stages(self) -> CFunction:
        """The prototype of the function that solves for the stage accelerations of a step."""
        real = self.functions.real
        out = c.output_array(f"{self.method}_stages", "a")
        measures = (c.output_array(real, name) for name in ("scale", "coarse", "rough", "beyond"))
        newton = c.input_array(f"{self.method}_newton", "m")
        limits = (self.number("tol"), self.number("most"))
        arguments = (*self.form.around, *self.functions.onto_argument, *limits, newton)
        results = (*measures, c.output_array("int", "sweeps"))
        cap = [c.input_array(real, "cap")] if self.may_rest else []
        return c.static_prototype(
            f"{self.method}_solve_stages", "int", out, *arguments, *cap, *results
        )

    @property
    def may_rest(self) -> bool:
        """Whether all bodies can stay at rest although time-dependent forces act on them.

        This is possible if the scene has friction that sticks, which may balance these forces.
        Accelerations computed at rest are then rounding errors only.
        """
        target = self.functions.target
        return bool(target.system.modes) and target.driven

    @cached_property
    def rounding_cap(self) -> CFunction:
        """The prototype of the function that limits the scales of accelerations by rounding errors.

        The scales weight the changes of accelerations in a step. See `may_rest` for when it is
        used.
        """
        real = self.functions.real
        values = (c.input_array(f"{self.method}_stages", "a"), c.input_array(real, "scale"))
        others = (*self.form.around, *self.functions.onto_argument)
        arguments = (c.output_array(real, "cap"), *values, *others, self.number("tol"))
        return c.static_prototype(f"{self.method}_cap_scales", "int", *arguments)

    @cached_property
    def forces(self) -> CFunction:
        """The prototype of the function that computes the accelerations at a state."""
        out = c.output_array(self.functions.real, "f")
        arguments = (a for a in self.form.around if a.name != "h")
        return c.static_prototype(f"{self.method}_forces", "int", out, *arguments)

    @cached_property
    def slopes(self) -> CFunction:
        """The prototype of the function for the derivatives that Newton's method requires.

        They are derivatives of the accelerations with respect to q and qd.
        """
        out = c.output_array(f"{self.method}_newton", "m")
        return c.static_prototype(f"{self.method}_slopes", "int", out, *self.form.around)

    @cached_property
    def step(self) -> CFunction:
        """The prototype of the function that makes the next adaptive step of a run.

        The function chooses the step size by the error tolerance.
        """
        arguments = (*map(self.number, ("t_end", "tol", "max_step")), *self.constant_arguments)
        status = self.functions.status
        return c.static_prototype(
            f"{self.method}_adaptive_step", status, self.state, *arguments, self.workspace
        )

    @cached_property
    def interpolate(self) -> CFunction:
        """The prototype of the function that interpolates q and qd within the last adaptive step.

        Its argument z is the fraction of the step, from 0 to 1.
        """
        out = tuple(c.output_array(self.functions.real, name) for name in ("q_at", "qd_at"))
        state = c.input_array(f"{self.method}_adaptive_state", "x")
        arguments = (state, self.number("z"), self.number("tol"), *self.constant_arguments)
        return c.static_prototype(
            f"{self.method}_interpolate", "void", *out, *arguments, self.workspace
        )

    @property
    def step_arguments(self) -> Sequence[CArgument]:
        """The C arguments that are constant during a run.

        They include all such arguments of the functions for steps of fixed size.
        """
        rest = self.constant_arguments
        present = {a.name for a in rest}
        return [*rest, *(a for a in self.functions.arguments("u", "p") if a.name not in present)]

    @cached_property
    def fixed(self) -> CFunction:
        """The prototype of the function that makes the next step in a run of fixed step size.

        Only scenes with events use it.
        """
        limits, status = map(self.number, ("t_end", "max_step")), self.functions.status
        return c.static_prototype(
            f"{self.method}_fixed",
            status,
            self.state,
            *limits,
            *self.step_arguments,
            self.workspace,
        )

    @cached_property
    def state_within(self) -> CFunction:
        """The prototype of the function that computes q and qd within the last step.

        Its argument z is the fraction of the step, from 0 to 1. If the scene has events, the last
        step may be adaptive or of fixed size.
        """
        if not self.functions.target.system.events:
            return self.interpolate
        own = self.interpolate.arguments[: -len(self.constant_arguments) - 1]
        return c.static_prototype(
            f"{self.method}_at", "void", *own, *self.step_arguments, self.workspace
        )


def adaptive_fields(stepping: AdaptiveFunctions) -> dict[str, Any]:
    """Return the variables, by name, that all templates of adaptive steps share.

    These are the coefficients of the integration method, tolerances and C names.
    """
    m, target = METHOD, stepping.functions.target
    real = target.real
    return {
        **stepping.functions.names,
        "method": stepping.method,
        "extent": stepping.form.extent,
        "stages": m.stages,
        "f": real.suffix,
        "sqrt": f"sqrt{real.function_suffix}",
        "eps": target.literal(real.epsilon),
        "tiny": target.literal(1e-30),
        "of_most": target.literal(SCALE_FLOOR if real.epsilon < 1e-10 else COARSE_SCALE_FLOOR),
        "of_most_coarse": target.literal(COARSE_SCALE_FLOOR),
        "most": MAX_ITERATIONS,
        "c": literals(m.c, real),
        "powers": matrix_rows(list(zip(*m.powers, strict=True)), real),
        "retry_after": RETRY_AFTER,
        "unscaled": len(target.system.modes) + len(target.system.discrete),
    }


def step_view(stepping: AdaptiveFunctions) -> AdaptiveStepView:
    """Return the data for the template of the C code that makes one adaptive step.

    The template also has the code that interpolates the state within the step.
    """
    functions, m, form = stepping.functions, METHOD, stepping.form
    target, real = functions.target, functions.target.real
    references = {name: f"&{name}" for name in ("a", "rough", "beyond", "sweeps")}
    references["m"] = "newton ? &m : 0"
    eigenvalues, to_parts, from_parts = m.eigen
    last, b = [m.legendre(n) for n in range(m.stages - 4, m.stages)], round_weights(m.b, real)
    return AdaptiveStepView(
        **adaptive_fields(stepping),
        title=TITLE,
        fabs=f"fabs{real.function_suffix}",
        lanes=form.lanes and f"{form.lanes} ",
        total=_balanced_sum([f"half[{i}]" for i in range(m.stages // 2)]),
        top=c.initialiser_rows(literals(row, real) for row in zip(*last, strict=True)),
        weights=c.initialiser_rows(zip(literals(m.b_a, real), literals(b, real), strict=True)),
        timed=target.driven,
        may_rest=stepping.may_rest,
        capped=stepping.rounding_cap,
        capped_now=stepping.rounding_cap.call(a="&a"),
        events=bool(target.system.events),
        begins="begins" in target.program,
        project=form.project,
        whole=form.whole,
        solve_stages=stepping.solve_stages,
        sweep=form.sweep,
        step=stepping.step,
        start=form.start,
        solve=stepping.solve_stages.call(
            most=f"{target.literal(REJECT_AFTER_TWO)}*aim", cap="capped ? cap : 0", **references
        ),
        within=stepping.interpolate,
        corners=has_steep_terms(target.system),
        longest=target.literal(MAX_TIME_SCALES),
        close=target.literal(float(f"{real.epsilon ** (-1 / 3):.0e}")),
        share=target.literal(KINK_SHARE),
        ends=c.initialiser_rows(literals(row, real) for row in _end_weights()),
        forces=stepping.forces,
        forces_here=stepping.forces.call(f="here", q="at_q", qd="at_qd"),
        forces_near=stepping.forces.call(f="near", q="at_q", qd="at_qd"),
        slopes=stepping.slopes,
        slopes_now=stepping.slopes.call(m="&m"),
        nudge=target.literal(math.sqrt(real.epsilon)),
        eigenvalues=c.initialiser_rows(literals(row, real) for row in eigenvalues),
        to_parts=c.initialiser_rows(literals(row, real) for row in to_parts),
        from_parts=c.initialiser_rows(literals(row, real) for row in from_parts),
        forces_there=stepping.forces.call(f="there", q="to_q", qd="to_qd", t="t + h"),
        solve_within=stepping.solve_stages.call(most=target.literal(1e30), cap="0", **references),
    )


def fixed_steps_view(stepping: AdaptiveFunctions) -> FixedStepsView:
    """Return the data for the template of steps of fixed size in which events are detected."""
    functions = stepping.functions
    target, real = functions.target, functions.target.real
    at = {"q": "q_at", "qd": "qd_at"}
    state = {name: c.member(stepping.state.name, name) for name in ("q", "qd")}
    return FixedStepsView(
        **functions.names,
        method=stepping.method,
        extent=stepping.form.extent,
        stages=METHOD.stages,
        f=real.suffix,
        eps=target.literal(real.epsilon),
        fabs=f"fabs{real.function_suffix}",
        timed=target.driven,
        jumps="jumps" in target.program,
        above="begins" in target.program,
        fixed=stepping.fixed,
        at=stepping.state_within,
        inside=stepping.interpolate.call(),
        step=functions.public.fixed_step.call(**at),
        forces_before=stepping.forces.call(f="before", **state),
        forces_halfway=stepping.forces.call(f="halfway", t="t + h/2", **at),
        forces_after=stepping.forces.call(f="after", t="t + h", **at),
    )


def max_events_per_step(system: System) -> int:
    """Return the number of events in one step at which the step is ended early."""
    return EVENTS_PER_STEP + sum(e.begins is not None for e in system.events)


def store_row_prototype(stepping: AdaptiveFunctions) -> CFunction:
    """Return the prototype of the C function that stores a state in a run's output arrays."""
    arguments = (c.output_array(stepping.functions.real, n) for n in ("q_row", "qd_row", "q", "qd"))
    return CFunction(f"{stepping.method}_store_row", "void", tuple(arguments))


def min_tolerance(real: Real) -> float:
    """Return the smallest error tolerance of adaptive steps that the type `real` permits."""
    return 1e-15 if real.epsilon < 1e-10 else 5e-7


def run_view(
    stepping: AdaptiveFunctions, happen: str = "", restart: str = "", initial_events: str = "",
    changed: str = "", values: str = "",
) -> AdaptiveRunView:  # fmt: skip
    """Return the data for the template of an adaptive run, the loop over steps.

    Parameters
    ----------
    happen, restart, initial_events
        C calls that detect events in a step, continue the run after an event, and trigger events at
        the start of the run; "" without events.
    changed, values
        C calls that report whether new inputs or parameters have changed the event functions, and
        evaluate these functions.
    """
    functions, form = stepping.functions, stepping.form
    target = functions.target
    row = {name: f"{name} + {functions.NQ}*rows" for name in ("q_rows", "qd_rows")}
    store_row = store_row_prototype(stepping)
    row_arguments = {"q_row": row["q_rows"], "qd_row": row["qd_rows"]}
    takes_p = "p" in {a.name for a in stepping.constant_arguments} or bool(
        form.compute_constants or happen or form.project
    )

    def projected(**state: str) -> str:
        return functions.public.project.call(fixed="0", **state) if form.project else ""

    return AdaptiveRunView(
        **functions.names,
        method=stepping.method,
        constants=form.constants,
        unread_p=target.needs_p and not takes_p,
        compute_constants=form.compute_constants,
        loosest=target.literal(MAX_TOLERANCE),
        tightest=target.literal(min_tolerance(target.real)),
        events=bool(happen),
        f=target.real.suffix,
        eps=target.literal(target.real.epsilon),
        fabs=f"fabs{target.real.function_suffix}",
        recent_steps=RECENT_STEPS,
        initial_events=initial_events,
        changed=changed,
        values=values,
        huge=target.literal(1e30),
        max_events=max_events_per_step(target.system),
        retry_after=RETRY_AFTER,
        run=functions.public.adaptive(METHOD.name),
        advance=stepping.step.call(x="&x", **({"max_step": "longest"} if happen else {})),
        fixed=stepping.fixed.call(x="&x") if happen else "",
        happen=happen,
        restart=restart,
        row=store_row.call(q="x.q", qd="x.qd", **row_arguments),
        row_before=store_row.call(q="q_at", qd="qd_at", **row_arguments),
        look=stepping.state_within.call(q_at=row["q_rows"], qd_at=row["qd_rows"], x="&x"),
        project_row=projected(q=row["q_rows"], qd=row["qd_rows"], t="times[rows]"),
        project_restart=projected(q="x.q", qd="x.qd", t="x.t"),
    )


def steps_in_parallel(target: Target) -> bool:
    """Return True if optimised C steps several instances of a batch together in vector registers.

    It does so for small systems with smooth forces; a large system occupies the vector registers
    with one instance.
    """
    s = target.system
    plain = not (s.events or s.constraints or has_steep_terms(s))
    return (
        plain
        and s.run.batch
        and outline.weight(target.program["acceleration"]) <= MAX_BATCH_OPERATIONS
    )


def instance_call(functions: SceneFunctions) -> str:
    """Return the C call that continues the adaptive run of one instance of a batch.

    A batch is a number of instances of the system. The call is in a loop in which k is the index of
    the instance.
    """
    NQ = functions.NQ
    rows = {f"{n}_rows": f"times ? {n}_rows + {NQ}*row : 0" for n in ("q", "qd")}
    return functions.public.adaptive(METHOD.name).call(
        q=f"q + {NQ}*k", qd=f"qd + {NQ}*k", t="t + k", u="u ? u + u_instance*k : 0",
        times="times ? times + row_counts[k] : 0", count="row_count - row_counts[k]",
        t_rows="0", **rows,
        events="events ? events + k : 0", which="which ? which + room*k : 0",
        event_rows=f"which ? event_rows + (1 + 2*{NQ})*room*k : 0", p="p + p_instance*k",
        memory="memory + k", status="&result",
    )  # fmt: skip


def batch_view(functions: SceneFunctions) -> AdaptiveBatchView:
    """Return the data for the template of the C function that makes a batch of adaptive runs.

    A batch is a number of instances of the system. The C code steps one instance after the other.
    """
    return AdaptiveBatchView(
        prefix=functions.prefix,
        batch=functions.public.adaptive_batch(METHOD.name),
        alone=instance_call(functions),
        events=bool(functions.target.system.events),
    )


def _end_weights() -> tuple[Row, Row]:
    """Return weights that extrapolate from the stages to the start and to the end of a step.

    They give the values there of the polynomial through the values at the stages.
    """
    parts = [METHOD.legendre(n) for n in range(METHOD.stages)]
    columns = list(zip(*parts, strict=True))
    start = tuple(sum(column[::2], Fraction(0)) - sum(column[1::2]) for column in columns)
    return start, tuple(sum(column, Fraction(0)) for column in columns)


def _balanced_sum(terms: list[str]) -> str:
    """Return the sum of terms as a balanced tree, which shortens the dependency chain."""
    half = len(terms) // 2
    if not half:
        return terms[0]
    parts = (_balanced_sum(terms[:half]), _balanced_sum(terms[half:]))
    return " + ".join(f"({part})" if " " in part else part for part in parts)
