"""The library of numerical methods, csrc/solver, in the C source of a model.

The library calls the model's functions by a struct with the arguments that only the model has, such
as inputs and parameters. `SolverModel` has these functions; `library_names` the names of the
library in the model's source; `tableau_tables` the coefficients of a method; `step_derivatives` and
`projected_step_source` the parts for derivatives of steps and for projections onto constraints.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from itertools import accumulate

from sympy import Rational

from eomc.emit.common import c_expression, c_function
from eomc.emit.common import c_function as c
from eomc.emit.common.amalgamate import Names, amalgamate
from eomc.emit.common.c_expression import Block, Real
from eomc.emit.common.c_function import (
    CArgument,
    CFunction,
    define_int_table,
    define_table,
    initialiser_rows,
)
from eomc.emit.common.c_names import Target
from eomc.emit.common.functions import SceneFunctions
from eomc.emit.common.public import c_array_size, program_function
from eomc.emit.common.templates import show
from eomc.integrators.tableaux import Method, Row


@cache
def literal(x: Fraction, real: Real) -> str:
    """Return the fraction x as a C literal of the type `real`."""
    return c_expression.number(Rational(x.numerator, x.denominator), real)


def _nearest(x: Fraction, real: Real) -> Fraction:
    """Return the nearest double, or the float nearest to it."""
    form = {"float64": "d", "float32": "f"}[real.dtype]
    return Fraction(*struct.unpack(form, struct.pack(form, float(x))))


def round_weights(weights: Row, real: Real) -> Row:
    """Return the weights of a method rounded to the type `real` such that their sum stays exact.

    An error of the sum would accumulate over steps. It is therefore corrected in the smallest
    weight for which this is exact, or in two equal weights if the method is symmetric.
    """
    if not real.dtype:  # 113 bits, for references
        return weights
    values = [_nearest(x, real) for x in weights]
    error = Fraction(round(sum(weights, Fraction(0)))) - sum(values, Fraction(0))
    symmetric = weights == weights[::-1] and len(weights) > 1
    for k in sorted(range(len(values)), key=lambda k: abs(values[k])):
        indices = {k, len(values) - 1 - k} if symmetric else {k}
        corrected = values[k] + error / len(indices)
        if values[k] and _nearest(corrected, real) == corrected:
            return tuple(corrected if n in indices else x for n, x in enumerate(values))
    return tuple(values)


def literals(row: Row, real: Real) -> tuple[str, ...]:
    """Return each coefficient of a row as a C literal of the type `real`."""
    return tuple(literal(x, real) for x in row)


def matrix_rows(rows: Sequence[Row], real: Real) -> tuple[str, ...]:
    """Return the lines of a C initialiser for a square matrix, one line for each row.

    Rows shorter than the matrix are padded with zeros.
    """
    padded = [(*row, *[Fraction(0)] * (len(rows) - len(row))) for row in rows]
    return c_function.initialiser_rows(literals(row, real) for row in padded)


def c_vector(name: str, row: Row, real: Real, comment: str = "") -> str:
    """Return the C definition of a constant vector of coefficients under the library's names.

    comment: text of the comment above the definition; "" for none.
    """
    return c_function.define_table(name, [len(row)], [", ".join(literals(row, real))], comment)


def c_matrix(name: str, rows: Sequence[Row], real: Real) -> str:
    """Return the C definition of a constant matrix; short rows are padded with zeros."""
    width = max(map(len, rows))
    padded = ((*row, *[Fraction(0)] * (width - len(row))) for row in rows)
    lines = c_function.initialiser_rows(literals(row, real) for row in padded)
    return c_function.define_table(name, [len(rows), width], lines)


# Files of csrc/solver with the methods of fixed steps, in the order in which C needs them.
STEP_FILES = {
    "explicit": ("state.c", "explicit.c"),
    "gauss": ("state.c", "linear.c", "differences.c", "step_end.c", "gauss_fixed.c"),
}
LIBM = ("atan", "fabs", "floor", "fmax", "sqrt")  # functions of the C mathematics library
ACCELERATE = "qdd = the accelerations at the state q, qd and time t."
ACCELERATION_VJP = "bar = the derivatives of the accelerations' sum with the weights qdd_bar."
SIGNAL_VJP = "bar = the derivatives of the signals' sum with weights, the entries of `along` for u."
CALL_STEP = "Advance q and qd by a step of size h of a method for fixed steps."
CORRECTION = "d = the corrections of q and qd onto the constraints, and the inverse pivots."
CORRECTION_ALONG = "The correction of the state q, qd, and its derivatives along a direction."
LINEARIZATION = "The derivatives of the accelerations at the state q, qd and time t."
RATE_TERMS = "Rates of the equations that a correction may drop, and the sizes of their terms."
ROTATIONS = (
    "Rotation errors of loops, squared cosines of half the angles, derivatives of the errors."
)
# Functions of the model that evaluate a function of the program: name, name in the program,
# comment, array for the result, and number of arguments among q and qd.
EVALUATIONS = (
    ("event_functions", "events", "g = the event functions at a state.", "g", 2),
    (
        "initial_event_functions",
        "begins",
        "g > 0: events that trigger at the start of a motion.",
        "g",
        2,
    ),
    ("jump_maps", "jumps", "after = the states q, qd after the jump of each event.", "after", 2),
    ("evaluate_metric", "D", "D = the mass matrix, which measures changes of q.", "D", 1),
    ("evaluate_jacobian", "constraint_jacobian", "A = the constraint Jacobian.", "A", 1),
    ("evaluate_residuals", "constraints", "Residuals of the constraints.", "residual", 2),
    ("evaluate_rates", "constraint_rates", "Rates of the constraints.", "residual", 2),
    ("evaluate_signal_derivatives", "signal_slopes", "K = the derivatives of the inputs.", "K", 2),
    (
        "evaluate_signal_sensitivity",
        "signal_sensitivity",
        "The derivatives of the inputs with respect to the parameters.",
        "u_p",
        2,
    ),
    (
        "evaluate_parameter_derivatives",
        "sensitivity",
        "E = the derivatives of the accelerations with respect to the parameters.",
        "E",
        2,
    ),
)


@dataclass(frozen=True)
class SolverModel:
    """Functions and array sizes that one form of C, portable or optimised, supplies to the library.

    Attributes
    ----------
    functions
        The C functions of the scene.
    members
        The arguments of the accelerations and other functions of the model besides the state and
        time. The struct of the model has them.
    callbacks
        The functions that the library calls, with their bodies. Those that it does not use are not
        emitted.
    extent
        Length of C arrays for coordinates, which may include padding.
    lanes
        Macro before loops over the stages, by which compilers vectorise them; "" for none.
    has_constants
        Whether expressions that depend on parameters only are precomputed and stored in a struct c.
    compute_constants
        C call that computes this struct and is nonzero on failure; "" if not needed.
    has_sweep
        Whether the form has its own iteration over the stages, `callbacks` included.
    """

    functions: SceneFunctions
    members: tuple[CArgument, ...]
    callbacks: tuple[CFunction, ...]
    extent: str
    lanes: str = ""
    has_constants: bool = False
    compute_constants: str = ""
    has_sweep: bool = False

    @property
    def struct(self) -> tuple[CArgument, ...]:
        """The members, or none in portable C whose only member is p, which then replaces `m`."""
        only_p = self.functions.is_portable and [a.name for a in self.members] == ["p"]
        return () if only_p else self.members

    @property
    def argument(self) -> tuple[CArgument, ...]:
        """The argument `m` of the library's functions, in a tuple; empty without members."""
        type_ = f"{self.functions.prefix}_model"
        return (c.input_array(type_, "m"),) if self.struct else self.members

    @property
    def passed(self) -> tuple[str, ...]:
        """The C expression of this argument where the struct is a variable, in a tuple."""
        return ("&m",) if self.struct else tuple(a.name for a in self.members)

    @property
    def arguments(self) -> dict[str, str]:
        """C expressions of the members in functions with the argument `m`, by name."""
        return {a.name: c.member("m", a.name) for a in self.struct}

    def value(self, **passed: str) -> str:
        """Return the C initialiser of the struct; "" without members.

        passed: C expressions of members, by name. Others are variables of the same names.
        """
        return c.initialiser(passed.get(a.name, a.name) for a in self.struct)

    def call(self, name: str, *passed: str, last: Sequence[str] = ()) -> str:
        """Return the C call of a function of the library, where `m` is the struct.

        name: its name in the library after `eom_`. passed, last: C expressions of its arguments
        before and after the model.
        """
        return f"{self.functions.prefix}_{name}({', '.join([*passed, *self.passed, *last])})"

    def variable(self, **passed: str) -> Block:
        """Return the C definition of the variable `m`, if there are any members.

        passed: C expressions of members, by name. Others are variables of the same names.
        """
        type_, value = f"{self.functions.prefix}_model", self.value(**passed)
        return Block("", (c.define_constant(type_, "m", value),) if value else ())

    def source(self, texts: Iterable[str]) -> tuple[str, ...]:
        """Return the C text of the struct and of the functions that C texts use, if any."""
        words = set(re.findall(r"\w+", "\n".join(texts)))
        used = tuple(f for f in self.callbacks if f.name in words)
        members = self.struct if f"{self.functions.prefix}_model" in words else ()
        if not (used or members):
            return ()
        return (show("c/model.c", self.functions, members=members, callbacks=used),)


def callback(
    name: str, callee: CFunction, arguments: Sequence[CArgument], doc: str, **passed: str
) -> CFunction:
    """Return a static function with arguments of the library that calls a function of the model.

    passed: C expressions of arguments of `callee`, by name. Other arguments are passed as variables
    of the same names.
    """
    call = callee.call(**passed)
    is_void = callee.result == "void"
    statement = c.call_statement(call) if is_void else c.return_statement(call)
    reads = frozenset(re.findall(r"\w+", call))
    body = (Block("", (statement,)),)
    return CFunction(name, callee.result, tuple(arguments), body, reads, "static", (doc,))


def state_arguments(real: str) -> tuple[CArgument, ...]:
    """Return the arguments q, qd and t of functions that the library calls."""
    return (c.input_array(real, "q"), c.input_array(real, "qd"), CArgument(real, "t"))


def portable_model(functions: SceneFunctions) -> SolverModel:
    """Return what portable C supplies to the library."""
    real, prefix = functions.real, functions.prefix
    members = functions.public.arguments("u", "p")
    model = SolverModel(functions, members, (), functions.NQ)
    passed = model.arguments
    qdd = c.output_array(real, "qdd")
    callbacks = [
        callback(
            f"{prefix}_accelerate",
            functions.acceleration.function,
            (qdd, *state_arguments(real), *model.argument),
            ACCELERATE,
            **passed,
        )
    ]
    state = (*state_arguments(real), *model.argument)
    for name, doc, out, function in (
        ("correction", CORRECTION, "d", functions.projection),
        ("rate_terms", RATE_TERMS, "rates", functions.rate_terms),
    ):
        if function:
            arguments = (c.output_array(real, out), *state)
            inner = function.function
            callbacks.append(callback(f"{prefix}_evaluate_{name}", inner, arguments, doc, **passed))
    callbacks += public_callbacks(functions, model)
    return SolverModel(functions, members, tuple(callbacks), functions.NQ)


def public_callbacks(functions: SceneFunctions, model: SolverModel) -> list[CFunction]:
    """Return the functions that the library calls and that are the same in both forms.

    They are for events, constraints, and derivatives of steps.
    """
    real, prefix, public = functions.real, functions.prefix, functions.public
    passed = model.arguments
    q, qd, t = state_arguments(real)
    callbacks = []
    for name, program_name, doc, array, count in EVALUATIONS:
        if program_function(functions.target, program_name):
            callee = public.evaluation(program_name)
            arguments = (c.output_array(real, array), *(q, qd)[:count], t, *model.argument)
            own = passed | {callee.arguments[0].name: array}
            callbacks.append(callback(f"{prefix}_{name}", callee, arguments, doc, **own))
    if functions.rotation_errors:
        name, callee = f"{prefix}_evaluate_rotation_errors", functions.rotation_errors.function
        arguments = (c.output_array(real, "errors"), q, t, *model.argument)
        callbacks.append(callback(name, callee, arguments, ROTATIONS, **passed))
    if functions.target.system.events:
        moved = (c.output_array(real, "q"), c.output_array(real, "qd"), t)
        arguments = (*moved, CArgument(real, "h"), *model.argument)
        steps = {public.method_enum(m.name): public.step(m.name) for m in functions.methods}
        if public.method_type:
            arguments = (CArgument(public.method_type, "method"), *arguments)
        lines = c.return_case("method", {k: f.call(**passed) for k, f in steps.items()})
        reads = frozenset(re.findall(r"\w+", "\n".join(lines)))
        prototype = c.static_prototype(f"{prefix}_call_step", functions.status, *arguments)
        body = (Block("", lines),)
        callbacks.append(replace(prototype, body=body, reads=reads, doc=(CALL_STEP,)))
    if functions.target.system.run.discretize or public.has("acceleration_vjp"):
        callbacks += derivative_callbacks(functions, model)
    return callbacks


def derivative_callbacks(functions: SceneFunctions, model: SolverModel) -> Iterator[CFunction]:
    """Yield the functions that derivatives of steps call."""
    real, prefix, public = functions.real, functions.prefix, functions.public
    passed = model.arguments
    q, qd, t = state_arguments(real)
    state, along = (q, qd, t, *model.argument), c.input_array(real, "along")
    taken = {a.name for a in public.linearization.arguments}
    accelerations, qdd = functions.acceleration.function, c.output_array(real, "qdd")
    matrices = [c.output_array(real, name) for name in ("A_q", "A_qd", "B") if name in taken]
    wrapped = [
        ("accelerations", accelerations, ACCELERATE, [qdd]),
        ("linearization", public.linearization, LINEARIZATION, matrices),
    ]
    if functions.projection_along:
        out = [c.output_array(real, "column"), along]
        callee = functions.projection_along.function
        wrapped.append(("correction_along", callee, CORRECTION_ALONG, out))
    for name, callee, doc, first in wrapped:
        arguments = (*first, *state)
        yield callback(f"{prefix}_evaluate_{name}", callee, arguments, doc, **passed)
    bar, weights = c.output_array(real, "bar"), c.input_array(real, "qdd_bar")
    if public.has("acceleration_vjp"):
        callee, name = public.evaluation("acceleration_vjp"), f"{prefix}_evaluate_acceleration_vjp"
        arguments = (bar, q, qd, weights, t, *model.argument)
        yield callback(name, callee, arguments, ACCELERATION_VJP, **passed)
    if public.has("signal_vjp"):
        callee, name = public.evaluation("signal_vjp"), f"{prefix}_evaluate_signal_vjp"
        yield callback(name, callee, (bar, along, *state), SIGNAL_VJP, **passed)
    moved = (c.output_array(real, "q"), c.output_array(real, "qd"), t, CArgument(real, "h"))
    for method in functions.methods:
        name, doc = f"{prefix}_{method.name}_make_step", f"Make a step of {method.title}."
        step = public.step(method.name)
        yield callback(name, step, (*moved, *model.argument), doc, **passed)


def define(function: CFunction, *blocks: Block) -> str:
    """Return the C definition of a function that reads all its arguments, with this body."""
    reads, body = frozenset(a.name for a in function.arguments), tuple(b for b in blocks if b.lines)
    return replace(function, body=body, reads=reads).definition


def projects_stages(method: Method) -> bool:
    """Return True if the method projects its stages onto constraints where it must."""
    return method.implicit and not method.newton


def step_advance(model: SolverModel, method: Method) -> CFunction:
    """Return the prototype of the library's function for a step of a method with fixed steps."""
    functions = model.functions
    return c.static_prototype(
        f"{functions.prefix}_{method.name}_advance",
        functions.status,
        c.output_array(functions.real, "q"),
        c.output_array(functions.real, "qd"),
        CArgument(functions.real, "t"),
        CArgument(functions.real, "h"),
        *model.argument,
        *((CArgument("long *", "evaluations"),) if method.implicit else ()),
        *((CArgument("int *", "singular"),) if functions.projection else ()),
    )


def step_source(model: SolverModel, method: Method) -> tuple[str, ...]:
    """Return the library's part of the C source for a method with fixed steps, as definitions."""
    constrained = bool(model.functions.projection)
    features = {
        "CONSTRAINTS": constrained,
        "NEWTON": method.newton,
        "PROJECTED_STAGES": constrained and projects_stages(method),
    }
    kind = method_kind(method)
    return amalgamate(
        STEP_FILES[kind],
        [f"eom_{kind}_advance", f"eom_{kind}_b", f"eom_{kind}_bA"],
        library_names(model, method),
        features,
        tableau_tables(model.functions, method),
    )


def functions_source(model: SolverModel, file: str, *names: str) -> tuple[str, ...]:
    """Return functions of one file of the library, as definitions. names: theirs after `eom_`."""
    return amalgamate((file,), [f"eom_{name}" for name in names], library_names(model), {})


def library_names(model: SolverModel, method: Method | None = None, **exact: str) -> Names:
    """Return the names of the library in the source of a model.

    method: integration method; definitions that depend on it have its name in theirs, such as
    `ball_gauss16_weights`. exact: texts that replace further names.
    """
    functions = model.functions
    real, prefix, PREFIX = functions.target.real, functions.prefix, functions.PREFIX
    libm = {f"eom_{name}": name + real.function_suffix for name in LIBM}
    numbers = {
        "EOM_SQRT_EPS": math.sqrt(real.epsilon),
        "EOM_FOURTH_ROOT_EPS": real.epsilon**0.25,
        "EOM_TINY": 1e-30,
        "EOM_HUGE": 1e30,
    }
    stages, prefixes = {}, {"eom_": f"{prefix}_", "EOM_": f"{PREFIX}_"}
    if method:
        kind = method_kind(method)
        stages = {f"EOM_{k}_STAGES": str(method.stages) for k in (kind.upper(), "METHOD")}
        prefixes |= dict.fromkeys((f"eom_{kind}_", "eom_method_"), f"{prefix}_{method.name}_")
    return Names(
        exact={
            **libm,
            **stages,
            "EOM_WIDTH": model.extent,
            "EOM_LANES": model.lanes,
            "EOM_EPS": real.epsilon_name,
            **{name: functions.target.literal(x) for name, x in numbers.items()},
            **exact,
        },
        prefixes=prefixes,
        real=real,
        model=next(iter(model.argument), None),
        forwards=tuple(f for f in model.callbacks if functions.is_portable and f.is_forward),
    )


def method_kind(method: Method) -> str:
    """Return the word in the library's names for methods like this one."""
    return "gauss" if method.implicit else "explicit"


def tableau_tables(functions: SceneFunctions, method: Method) -> tuple[str, ...]:
    """Return the coefficients of a Runge-Kutta method as C tables under the library's names."""
    real, name = functions.target.real, f"eom_{method_kind(method)}_"
    square = [(*row, *[Fraction(0)] * (method.stages - len(row))) for row in method.a]
    return (
        c_vector(f"{name}c", method.c, real, f"Coefficients c, A, A A, b, b A of {method.title}."),
        c_matrix(f"{name}A", square, real),
        c_matrix(f"{name}AA", method.a_squared, real),
        c_vector(f"{name}b", round_weights(method.b, real), real),
        c_vector(f"{name}bA", method.b_a, real),
    )


def step_derivatives(model: SolverModel) -> Iterator[str]:
    """Yield C definitions of the derivatives of a step of each integration method.

    The derivatives are with respect to q, qd, u and, if the scene requests them, the parameters.
    Nothing is yielded if the scene does not request derivatives of steps. Methods share
    definitions.
    """
    functions, target = model.functions, model.functions.target
    if not target.system.run.discretize:
        return
    inputs = bool(target.system.inputs)
    features = {
        "INPUTS": inputs,
        "FEEDBACK": "signal_slopes" in target.program,
        "CONSTRAINTS": functions.projection_along is not None,
        "PARAMETERS": "sensitivity" in target.program,
        "SIGNAL_PARAMETERS": "signal_sensitivity" in target.program,
    }
    width = " + ".join(functions.public.step_columns.values())
    exact = {"EOM_VARIABLES": width, "EOM_NP": str(len(target.parameters))}
    if model.has_sweep:  # whose accelerations take precomputed constants
        exact["eom_accelerate"] = f"{functions.prefix}_evaluate_accelerations"
    for method in functions.methods:
        kind = "implicit" if method.implicit else "explicit"
        tables = (f"eom_{method_kind(method)}_{name}" for name in ("c", "A", "AA", "b", "bA"))
        yield from amalgamate(
            ("step_end.c", "step_derivative.c"),
            [f"eom_method_differentiate_{kind}_step", "eom_copy_columns", *tables],
            library_names(model, method, **exact),
            features,
            tableau_tables(functions, method),
        )
        yield _derivative(model, method, width)


def run_adjoints(model: SolverModel) -> Iterator[str]:
    """Yield C definitions of the adjoint of runs by each method."""
    functions, target = model.functions, model.functions.target
    features = {
        "INPUTS": bool(target.system.inputs),
        "FEEDBACK": functions.public.has("signal_vjp"),
        "PARAMETERS": bool(target.system.parameters),
        "DRIVEN": target.driven,
        "CONSTRAINTS": False,
    }
    exact = {
        "EOM_VARIABLES": c_array_size(target, "x"),
        "EOM_PARAMETERS": str(len(target.system.parameters)),
    }
    for method in functions.methods if functions.public.has_adjoints else ():
        tables = (f"eom_{method_kind(method)}_{name}" for name in ("c", "A", "AA", "b", "bA"))
        yield from amalgamate(
            ("state.c", "step_end.c", "adjoint.c"),
            ["eom_method_pull_back_run", *tables],
            library_names(model, method, **exact),
            features | {"IMPLICIT": method.implicit},
            tableau_tables(functions, method),
        )
        yield show("c/adjoint.c", functions, method=method, model=model)


def _derivative(model: SolverModel, method: Method, width: str) -> str:
    """Return the definition of the public function for the derivatives of a step of a method.

    width: number of variables, as a C expression.
    """
    functions, prefix = model.functions, f"{model.functions.prefix}_{method.name}"
    function = functions.public.derivative(method.name)
    NQ, real = functions.NQ, functions.real
    # the end of the step itself, with which stages that may have other solutions are compared
    compares = method.implicit or functions.projection_along is not None
    end, time = ("q1", "qd1") if compares else (), "t" if functions.target.driven else "0"
    step = f"{prefix}_make_step({', '.join([*end, time, 'h', *model.passed])})"
    make_step = (*c.copy_loop("q1", "q", 0, NQ), *c.copy_loop("qd1", "qd", 0, NQ),
                 c.assign("status", step), *c.return_if(["status"], "status"))  # fmt: skip
    call = model.call(
        f"{method.name}_differentiate_{'implicit' if method.implicit else 'explicit'}_step",
        "ends", *end, "q", "qd", time, "h",
    )  # fmt: skip
    store, first = [], "0"
    for name, count in functions.public.step_columns.items():
        passed = ", ".join((name, "ends", first, count))
        store.append(c.call_statement(f"{functions.prefix}_copy_columns({passed})"))
        first = count if first == "0" else f"{first} + {count}"
    unfinite = c.return_if(
        [f"!{functions.prefix}_finite(ends, 2*{NQ}*({width}))"], f"{functions.PREFIX}_NOT_FINITE"
    )
    unused = {a.name: "0" for a in model.members if a.name == "c"}
    variables = (
        *model.variable(**unused).lines,
        c.declare(functions.status, "status"),
        c.declare(real, f"ends[2*{NQ}*({width})]"),
        *(c.declare(real, f"{name}[{NQ}]") for name in end),
    )
    statements = (
        *(make_step if compares else ()), c.assign("status", call),
        *c.return_if(["status"], "status"), *unfinite, *store,
        c.return_statement(f"{functions.PREFIX}_OK"),
    )  # fmt: skip
    return define(function, Block("", variables), Block("", statements))


def correction_size(target: Target) -> int:
    """Return the number of results of the C function that computes corrections for constraints.

    The results are the corrections that move q and qd onto the constraints, and one inverse pivot
    for each constraint equation.
    """
    return len(target.program["projection"].outputs)


def step_features(functions: SceneFunctions, increments: bool, sines: bool) -> dict[str, bool]:
    """Return which features of csrc/solver/step_projection.c a model has.

    increments: whether the end of a step is given by the increments of q and q̇. sines: whether the
    correction takes sines and cosines.
    """
    return {
        "INCREMENTS": increments,
        "SINES": sines,
        "RATE_TERMS": "rate_terms" in functions.target.program,
        "SINGLE": functions.target.system.run.real == "float",
    }


def projected_step_source(model: SolverModel) -> tuple[str, ...]:
    """Return the projection of steps and of their stages onto the constraints, in portable C."""
    functions = model.functions
    if functions.projection is None:
        return ()
    size = str(correction_size(functions.target))
    return amalgamate(
        ("step_projection.c",),
        ["eom_project_end", *(["eom_project_stage"] if functions.iterates_stages else [])],
        library_names(model, EOM_CORRECTION_SIZE=size),
        step_features(functions, increments=False, sines=False),
    )


def project_end(model: SolverModel, r: str, v: str, q: str, t: str) -> str:
    """Return the C call that projects the end r, v of a step from q, in portable C.

    t: C expression of the time at the end, for a motion that depends on time.
    """
    time = t if model.functions.target.driven else "0"
    return model.call("project_end", r, v, q, time, last=["singular"])


def state_source(model: SolverModel) -> tuple[str, ...]:
    """Return the public function `project` and its part of the library, as C definitions.

    The function projects a state (q, qd) onto the constraints.
    """
    functions = model.functions
    rows, closure = functions.target.system.constraints, functions.target.system.closure
    if not rows:
        return ()
    rotations = functions.target.system.rotations if functions.rotation_errors else ()
    holonomic = sum(row.holonomic for row in rows)
    sizes = {
        "EOM_HOLONOMIC_ROWS": holonomic,
        "EOM_SUMS": len(closure.sums) if closure else 0,
        "EOM_ROTATIONS": len(rotations),
        "EOM_ROTATION_ROWS": sum(map(len, rotations)),
    }
    weighted = bool(closure and closure.weights)
    features = {
        "HOLONOMIC": bool(holonomic),
        "MULTIPLE": len(rows) > 1,
        "SEARCH": any(row.holonomic and row.loop for row in rows),
        "ROTATIONS": bool(rotations),
        "WEIGHTS": weighted,
        "SUMS": bool(closure and closure.sums),
        "REDUNDANT": any(redundant_rows(functions.target)),
        "PINNED": weighted and holonomic < len(rows),
    }
    public = functions.public.project
    time = "t" if any(a.name == "t" for a in public.arguments) else "0"
    call = model.call("project_state", "q", "qd", time, "fixed")
    unused = {a.name: "0" for a in model.members if a.name != "p"}
    return (
        *amalgamate(
            ("projection.c",),
            ["eom_project_state"],
            library_names(model, None, **{name: str(size) for name, size in sizes.items()}),
            features,
            _tables(functions),
        ),
        define(public, model.variable(**unused), Block("", (c.return_statement(call),))),
    )


def redundant_rows(target: Target) -> list[bool]:
    """Return whether each constraint equation is redundant, since others or their sums imply it."""
    rows, closure = target.system.constraints, target.system.closure
    summed = summed_rows(target)[len(closure.sums) if closure else 0 :]
    return [row.redundant or k in summed for k, row in enumerate(rows)]


def summed_rows(target: Target) -> list[int]:
    """Return the indices of the constraint equations in sums that replace some of them."""
    closure = target.system.closure
    return sorted({k for row in (closure.sums if closure else ()) for k, x in enumerate(row) if x})


def _tables(functions: SceneFunctions) -> list[str]:
    """Return tables of the constraint equations: weights, sums, redundant ones, and rotations."""
    target = functions.target
    closure, count = target.system.closure, len(target.system.constraints)
    weights, sums = (closure.weights, closure.sums) if closure else ((), ())
    rotations = target.system.rotations if functions.rotation_errors else ()
    integers = {
        "sum_rows": summed_rows(target)[: len(sums)],
        "redundant_rows": [*map(int, redundant_rows(target))],
        "rotation_rows": [k for rows in rotations for k in rows],
        "rotation_ends": [*accumulate(map(len, rotations))],
    }
    sum_lines = initialiser_rows([*map(target.literal, row)] for row in sums)
    return [
        define_table("eom_row_weights", [count], [", ".join(map(target.literal, weights))]),
        define_table("eom_row_sums", [len(sums), count], sum_lines),
        *(define_int_table(f"eom_{name}", values) for name, values in integers.items() if values),
    ]
