"""The public C functions of a scene, which both forms of C have: meanings and prototypes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from eomc.emit.common.c_function import (
    CArgument,
    CFunction,
    input_array,
    member,
    output_array,
    return_case,
    return_statement,
)
from eomc.emit.common.c_names import Target
from eomc.integrators.tableaux import METHODS
from eomc.program.ir import Function
from eomc.program.program import TIME


@dataclass(frozen=True)
class Kind:
    """Properties of an evaluation function (D, energy, ...) that are the same for all scenes.

    Attributes
    ----------
    out
        Name of the output array; "" for functions that return a number.
    shape
        Shape of the output, a key of `c_array_size`.
    takes
        Arguments besides q, t and p, separated by spaces: qd, u, those of EXTRA_ARGUMENTS. "qdd?"
        if only some scenes need the accelerations.
    doc
        The comment in the C header.
    symmetric
        Whether the output is a symmetric matrix.
    refuses
        Whether the C function returns a status in every scene. The status then also reports
        results that are not finite.
    """

    out: str
    shape: str
    takes: str
    doc: str
    symmetric: bool = False
    refuses: bool = False

    @property
    def takes_u(self) -> bool:
        """Whether the function may read the inputs u."""
        return "u" in self.takes.split()

    @property
    def is_product(self) -> bool:
        """Whether the function takes a vector, in addition to the inputs: a product with it."""
        return self.takes_u and bool(self.extra_argument)

    @property
    def extra_argument(self) -> str:
        """The argument among EXTRA_ARGUMENTS if the function takes it in every scene, or ""."""
        return next((n for n in EXTRA_ARGUMENTS if n in self.takes.split()), "")


EXTRA_ARGUMENTS = ("qdd", "wrenches", "lambda", "along", "qdd_bar")
KINDS: Mapping[str, Kind] = {
    "D": Kind("D", "n*n", "", "D(q): mass matrix, nq x nq, symmetric.", symmetric=True),
    "C": Kind("C", "n*n", "qd", "C(q, qd): Coriolis matrix, nq x nq, Christoffel form."),
    "g": Kind("g", "n", "", "g(q): dP/dq, the forces of the potential energy."),
    "bias": Kind("bias", "n", "qd", "bias = C(q, qd) qd + g(q), without forming C."),
    "tau": Kind("tau", "n", "qd u", "tau = Q - dR/dqd: inputs, friction and other forces."),
    "kinetic_energy": Kind("", "", "qd", "K(q, qd), J."),
    "potential_energy": Kind("", "", "", "P(q), J."),
    "energy": Kind("", "", "qd", "K + P, J."),
    "jacobi": Kind("", "", "qd",
        "Jacobi's integral qd.dK/dqd - K + P, J, which is conserved here instead of K + P."),
    "power": Kind("", "", "qd u",
        "Power into the system, W: d(energy)/dt, or d(jacobi)/dt if there is one."),
    "sensitivity": Kind("E", "n*p", "qd u",
        "E = dqdd/dp at constant inputs: nq rows, a column for each parameter."),
    "acceleration_jvp": Kind("rates", "n", "qd along u",
        "Jacobian-vector product: rates = J along, with the derivatives J of the accelerations by "
        "[q, qd, u, p] at constant inputs. along: a direction in [q, qd, u, p].", refuses=True),
    "acceleration_vjp": Kind("bar", "x", "qd qdd_bar u",
        "Vector-Jacobian product: bar = J^T qdd_bar, with the derivatives J of the accelerations "
        "by [q, qd, u, p] at constant inputs. bar: in the order [q, qd, u, p].", refuses=True),
    "outputs": Kind("outputs", "y", "qd u qdd?", "Outputs of the scene, in the order above."),
    "output_slopes": Kind("slopes", "y*x", "qd u qdd?",
        "Partial derivatives [dy/dq, dy/dqd, dy/du, dy/dqdd] of outputs y, by rows."),
    "output_sensitivity": Kind("slopes", "y*p", "qd u qdd?",
        "Partial derivatives dy/dp of outputs y (q, qd, u, qdd constant), by rows, columns for "
        "parameters."),
    "events": Kind("events", "e", "qd u",
        "Event functions: an event occurs where its function crosses zero."),
    "begins": Kind("begins", "e", "qd u",
        "For events that may occur at the start: positive if so; -1 for other events."),
    "jumps": Kind("after", "e*2*n", "qd u",
        "State [q; qd] after each event whose action is a jump."),
    "event_slopes": Kind("slopes", "e*x+e", "qd u",
        "Derivatives of the event functions by [q, qd, u, p, t], by rows."),
    "jump_vjp": Kind("bar", "e*x+e", "qd along u",
        "Vector-Jacobian products: for each event bar = J^T w, with the derivatives J by "
        "[q, qd, u, p, t] of the state [q; qd] after its jump, and the entries w of `along` for q "
        "and qd.", refuses=True),
    "frame_poses": Kind("poses", "f*pose", "", "Pose of each frame: {pose}."),
    "frame_velocities": Kind("velocities", "f*twist", "qd",
        "Twist of each frame: {twist}, along the world's axes."),
    "frame_accelerations": Kind("accelerations", "f*twist", "qd qdd",
        "d(velocities)/dt at the accelerations qdd; dJ/dt qd, with the Jacobians J, if qdd = 0."),
    "frame_jacobians": Kind("jacobians", "f*twist*n", "",
        "Jacobian J of each frame: velocities = J qd; by rows."),
    "frame_forces": Kind("forces", "n", "wrenches",
        "Generalized forces, the sum of J^T w, of wrenches w (force and moment) on the frames; "
        "components as in velocities."),
    "inverse_dynamics": Kind("tau", "n", "qd qdd",
        "tau = D qdd + C qd + g: generalized forces that a motion requires, without forming D."),
    "momentum": Kind("momentum", "momentum", "qd",
        "Momentum of all moving bodies, without rotors of drives: {momentum}."),
    "constraints": Kind("phi", "c", "qd",
        "Residuals of the constraint equations, in their order; zero along every motion."),
    "constraint_rates": Kind("rates", "c", "qd",
        "Residuals at velocity level: A qd + dphi/dt of holonomic constraints, psi of others."),
    "constraint_jacobian": Kind("A", "c*n", "",
        "Constraint Jacobian A: dphi/dq of holonomic constraints, dpsi/dqd of others; by rows."),
    "constraint_slopes": Kind("slopes", "c*n", "qd",
        "Derivatives of constraint_rates by q, by rows; those by qd are A."),
    "multipliers": Kind("lambda", "c", "qd u",
        "Lagrange multipliers lambda of the constraints: D qdd + C qd + g = tau + A^T lambda.",
        refuses=True),
    "reactions": Kind("reactions", "l*6", "qd lambda",
        "Reaction of the joint of each loop on its second body: {reaction}."),
    "applied": Kind("applied", "m", "qd u",
        "Inputs that act: u, or the signals, saturated at their limits."),
    "signal_slopes": Kind("slopes", "m*x", "qd",
        "Derivatives [du/dq, du/dqd] of the scene's signals u, by rows."),
    "signal_sensitivity": Kind("slopes", "m*p", "qd",
        "Derivatives du/dp of the scene's signals u, by rows, columns for parameters."),
    "signal_vjp": Kind("bar", "x", "qd along",
        "bar = J^T w, with the derivatives J of the scene's signals by [q, qd, u, p] and the "
        "entries w of `along` for u, in the same order."),
    "signal": Kind("u", "m", "qd", "Signals of the scene for the inputs u."),
}  # fmt: skip
_PLANE = {
    "pose": "x, y, angle",
    "twist": "velocity of its origin (2), angular velocity",
    "momentum": "mass, centre of mass (2), momentum (2), angular momentum about the centre of mass",
    "reaction": "force (2) and moment",
}
_SPACE = {
    "pose": "position (3), rotation matrix by rows (9)",
    "twist": "velocity of its origin (3), angular velocity (3)",
    "momentum": "mass, centre of mass (3), momentum (3), angular momentum about it (3)",
    "reaction": "force (3) and moment (3)",
}


def doc(target: Target, name: str) -> str:
    """Return the text of the comment above the evaluation function `name` in the C header."""
    text = KINDS[name].doc.format(**(_PLANE if target.system.plane else _SPACE))
    if name == "inverse_dynamics" and target.system.constraints:
        text = text.replace("tau =", "tau + A^T lambda =")
    return text


def c_array_size(target: Target, shape: str) -> str:
    """Return the number of elements of an output array as a C expression, such as "CARTPOLE_NQ".

    shape: sizes and products of them, as in `Kind.shape`: n coordinates, m inputs, y outputs, and
    so on. Returns "" for other shapes.
    """
    s, NQ, NU = target.system, f"{target.PREFIX}_NQ", f"{target.PREFIX}_NU"
    np = len(s.parameters)
    NY, NF, NE, NC = (f"{target.PREFIX}_{n}" for n in ("NY", "NF", "NE", "NC"))
    pose, twist, momentum = (3, 3, 6) if s.plane else (12, 6, 10)
    return {
        "n*n": f"{NQ}*{NQ}",
        "n*p": f"{NQ}*{np}",
        "n": NQ,
        "x": " + ".join((f"2*{NQ}", *([NU] if s.inputs else []), *([str(np)] if np else []))),
        "m": NU,
        "m*x": f"{NU}*2*{NQ}",
        "m*p": f"{NU}*{len(s.parameters)}",
        "y": NY,
        "y*x": f"{NY}*(3*{NQ} + {NU})" if s.inputs else f"{NY}*(3*{NQ})",
        "y*p": f"{NY}*{np}",
        "e": NE,
        "e*2*n": f"{NE}*2*{NQ}",
        "e*x+e": f"{NE}*(2*{NQ}{f' + {NU}' * bool(s.inputs)} + {np + 1})",
        "f*pose": f"{NF}*{pose}",
        "f*twist": f"{NF}*{twist}",
        "f*twist*n": f"{NF}*{twist}*{NQ}",
        "momentum": str(momentum),
        "c": NC,
        "c*n": f"(int){NC}*{NQ}",  # C++20 has no product of two enumerations
        "l*6": str(sum(len(r.values) for r in s.reactions)),
    }.get(shape, "")


def program_function(target: Target, name: str) -> Function | None:
    """Return the function of the program from which the C function `name` is generated.

    This function computes all results of the C function. For some matrices it computes the product
    with a direction instead, which gives one column. Returns None if the program has neither.
    """
    functions = target.program.functions
    return functions.get(name) or functions.get(f"{name}_column")


STATE = ("q", "qd")


@dataclass(frozen=True)
class Public:
    """Prototypes of the functions that the generated C header declares.

    Both forms of the C code, portable and optimised, implement them.
    """

    target: Target

    def has(self, name: str) -> bool:
        """Return True if the scene has the evaluation function `name`."""
        return program_function(self.target, name) is not None

    def refuses(self, name: str) -> bool:
        """Return True if the evaluation function `name` returns a status code in C.

        It does so if it factors a matrix that may be singular.
        """
        function = program_function(self.target, name)
        return KINDS[name].refuses or bool(function and function.checks)

    def takes_qdd(self, name: str) -> bool:
        """Return True if the evaluation function `name` reads accelerations in this scene.

        Functions that take accelerations in every scene are excluded, see `Kind.extra_argument`.
        """
        function = program_function(self.target, name)
        optional = "qdd?" in KINDS[name].takes
        return bool(optional and function and function.uses & self.target.groups()["qdd"])

    def takes_t(self, name: str) -> bool:
        """Return True if the evaluation function `name` takes the time as an argument.

        It may depend on time only through the signals, the functions that define the scene's
        inputs.
        """
        function = program_function(self.target, name)
        assert function is not None
        takes_u = KINDS[name].takes_u and self.target.system.inputs
        return TIME in function.uses or bool(takes_u and self.target.signal_t)

    def argument(self, name: str) -> CArgument:
        """Return the C argument with one of the usual names, such as q, qd, t, h, u or p."""
        target, real = self.target, self.target.real.name
        if name in ("t", "h"):
            return CArgument(real, name)
        if name == "p":
            return input_array(f"{target.prefix}_params", name)
        extents = {"wrenches": c_array_size(target, "f*twist"), "lambda": c_array_size(target, "c")}
        extents |= dict.fromkeys((*STATE, "qdd", "qdd_bar"), f"{target.PREFIX}_NQ")
        extents["along"] = c_array_size(target, "x")
        return input_array(real, name, extents.get(name, ""))

    def arguments(self, *names: str) -> tuple[CArgument, ...]:
        """Return the arguments of C functions with the given names, such as q, qd, t, u or p.

        Arguments that the scene does not need are left out: u without inputs, p without parameters,
        and t if the motion does not depend on time.
        """
        target = self.target
        needed = {"t": target.driven, "u": bool(target.system.inputs), "p": target.needs_p}
        return tuple(self.argument(name) for name in names if needed.get(name, True))

    def evaluations(self) -> tuple[CFunction, ...]:
        """Return the prototypes of the C functions that evaluate one quantity, such as D or energy.

        Quantities that the scene does not have are left out.
        """
        return tuple(map(self.evaluation, filter(self.has, KINDS)))

    def evaluation(self, name: str) -> CFunction:
        """Return the prototype of the C function that evaluates a quantity.

        `name` is the name of the quantity, such as D or energy.
        """
        kind, target, real = KINDS[name], self.target, self.target.real.name
        signal = name == "signal"
        t = (CArgument(real, "t"),) if self.takes_t(name) else ()
        state = STATE if "qd" in kind.takes.split() else STATE[:1]
        result_type = "void" if kind.out else real
        return CFunction(
            f"{target.prefix}_{name}",
            f"{target.prefix}_status" if self.refuses(name) else result_type,
            (
                *(
                    [output_array(real, kind.out, c_array_size(target, kind.shape))]
                    if kind.out
                    else []
                ),
                *(t if signal else ()),
                *(self.arguments(*state) if not signal or target.signal_state else ()),
                *(self.arguments("qdd") if self.takes_qdd(name) else ()),
                *(self.arguments(kind.extra_argument) if kind.extra_argument else ()),
                *(() if signal else t),
                *self.arguments(*(["u"] if kind.takes_u else []), "p"),
            ),
        )

    @property
    def acceleration(self) -> CFunction:
        """The prototype of the C function that computes the accelerations qdd.

        The function returns a status code.
        """
        target = self.target
        qdd = output_array(target.real.name, "qdd", f"{target.PREFIX}_NQ")
        return self._status("acceleration", qdd, *self.arguments(*STATE, "t", "u", "p"))

    @property
    def linearization(self) -> CFunction:
        """The prototype of the C function that linearizes the accelerations.

        It computes their partial derivatives A_q, A_qd and B with respect to q, qd and u. The
        function returns a status code.
        """
        target, NQ = self.target, f"{self.target.PREFIX}_NQ"
        widths = {"A_q": NQ, "A_qd": NQ}
        if target.system.inputs:
            widths["B"] = f"{target.PREFIX}_NU"
        # C++20 has no product of two enumerations
        out = (
            output_array(target.real.name, name, f"{NQ}*{w}" if w == NQ else f"(int){NQ}*{w}")
            for name, w in widths.items()
        )
        return self._status("linearization", *out, *self.arguments(*STATE, "t", "u", "p"))

    @property
    def linearization_block(self) -> CFunction | None:
        """The prototype of the C function that linearizes several states in vector registers.

        Only optimised C has it, if the scene requests derivatives and they are not computed by
        columns. It computes A and B of dx/dt = A x + B u, x = [q; qd], and returns a count of
        states.
        """
        target, s = self.target, self.target.system
        if "linearization" not in target.program or not s.run.needs_derivatives:
            return None
        return self._block("linearization_block", "A", *(["B"] if s.inputs else []))

    def derivative_block(self, method: str) -> CFunction | None:
        """Return the prototype of the C function that differentiates a step from several states.

        It is that of `linearization_block`, for a step by an explicit method.
        """
        s, columns = self.target.system, self.step_columns
        if not (s.linearizes_stages and self.linearization_block) or METHODS[method].implicit:
            return None
        return self._block(f"{method}_derivative_block", *columns, step=True)

    @property
    def load_states(self) -> CFunction:
        """The prototype of the C function that loads states into the lanes of registers."""
        function = self._block("load_states", "to")
        states = CArgument(f"{self.target.prefix}_states *", "to")
        arguments = (function.arguments[0], states, *function.arguments[2:])
        return replace(function, arguments=arguments, qualifier="static")

    def _block(self, name: str, *out: str, step: bool = False) -> CFunction:
        """Return the prototype of a C function of several states, which returns their number.

        out: names of the arrays for the results. step: whether it takes a step size.
        """
        target, real = self.target, self.target.real.name
        needed = {"t": target.driven, "u": bool(target.system.inputs), "p": target.needs_p}
        own = (
            argument
            for name in (name for name, is_needed in needed.items() if is_needed)
            for argument in (input_array(real, name), CArgument("long", f"{name}_instance"))
        )
        arguments = (
            CArgument("long", "count"), *(output_array(real, name) for name in out),
            *(input_array(real, name) for name in STATE),
            *([CArgument(real, "h")] if step else []), *own,
        )  # fmt: skip
        return CFunction(f"{target.prefix}_{name}", "long", arguments)

    @property
    def project(self) -> CFunction:
        """The prototype of the C function that projects a state (q, qd) onto the constraints.

        It overwrites the state and returns a status code.
        """
        names = ("D", "constraints", "constraint_jacobian", "constraint_rates")
        t = self.arguments(*["t"] if any(self.takes_t(n) for n in names) else [])
        fixed = input_array("int", "fixed")
        return self._status("project", *self._state, *t, fixed, *self.arguments("p"))

    def step(self, method: str) -> CFunction:
        """Return the prototype of the C function that makes one step of fixed size.

        `method` is the name of the integration method. The function overwrites q and qd with the
        state after the step and returns a status code.
        """
        return self._status(f"{method}_step", *self._state, *self.arguments("t", "h", "u", "p"))

    @property
    def step_columns(self) -> dict[str, str]:
        """The numbers of columns of the derivatives of a step, as C expressions by name.

        They are Phi, with inputs Gamma, and E if the scene requests derivatives with respect to its
        parameters.
        """
        target, columns = self.target, {"Phi": f"2*{self.target.PREFIX}_NQ"}
        if target.system.inputs:
            columns["Gamma"] = f"{target.PREFIX}_NU"
        if self.has("sensitivity"):
            columns["E"] = str(len(target.parameters))
        return columns

    def derivative(self, method: str) -> CFunction:
        """Return the prototype of the C function that differentiates one step of a method.

        It computes the partial derivatives of the state [q, qd] after the step: Phi with respect to
        [q, qd] before the step, Gamma with respect to u, and E with respect to the parameters. The
        function returns a status code.
        """
        real, NQ = self.target.real.name, f"{self.target.PREFIX}_NQ"
        sizes = {name: f"2*{NQ}*{count}" for name, count in self.step_columns.items()}
        sizes["Phi"] = f"4*{NQ}*{NQ}"
        out = (output_array(real, name, size) for name, size in sizes.items())
        return self._status(
            f"{method}_derivative", *out, *self.arguments(*STATE, "t", "h", "u", "p")
        )

    @property
    def has_adjoints(self) -> bool:
        """Whether there are functions for the adjoint of runs by fixed steps."""
        return self.has("acceleration_vjp") and not self.target.system.constraints

    def adjoint(self, method: str) -> CFunction:
        """Return the prototype of the C function for the adjoint of runs by a method.

        It computes the derivatives of a function of the rows of a run with respect to its start,
        inputs and parameters.
        """
        target, real = self.target, self.target.real.name
        bars = [output_array(real, name, f"{target.PREFIX}_NQ") for name in ("q_bar", "qd_bar")]
        bars += [output_array(real, "u_bar")] if target.system.inputs else []
        count = len(target.system.parameters)
        bars += [output_array(real, "p_bar", str(count))] if count else []
        bars += [output_array(real, "t_bar", "2")]
        rows = (input_array(real, name) for name in ("q_rows", "qd_rows", "q_bars", "qd_bars"))
        numbers = (CArgument("long", name) for name in ("steps", "every"))
        hold = [CArgument("long", "hold")] if target.system.inputs else []
        return self._status(
            f"{method}_adjoint", *bars, *rows, *self.arguments("t", "h"), *numbers,
            input_array(real, "times"), *self.arguments("u"), *hold, *self.arguments("p"),
            output_array(real, "work"),
        )  # fmt: skip

    @property
    def integrate(self) -> CFunction:
        """The prototype of the C function that makes the next steps of a run.

        They are fixed steps by any method, or adaptive steps. The function overwrites q and qd with
        the state after them and returns a status code.
        """
        options = input_array(f"{self.target.prefix}_options", "options")
        output = output_array(f"{self.target.prefix}_output", "output")
        arguments = (*self._state, *self.arguments("u", "p"), options, output)
        return self._status("integrate", *arguments)

    def fixed_steps(self, method: str = "") -> CFunction:
        """Return the prototype of the C function that makes the next fixed steps of a run.

        method: name of the method if each method has a function. The function is `integrate` itself
        if that makes no other steps; else a static function.
        """
        several = method and len(self.target.system.run.methods) > 1
        if not (several or self.target.integrates):
            return self.integrate
        name = f"{self.target.prefix}_{method or 'fixed'}_steps"
        return replace(self.integrate, name=name, qualifier="static")

    @property
    def uses_fixed_steps(self) -> str:
        """A C expression: whether the options of a run select steps of equal size."""
        if self.target.events:
            return member("options", "ignores_events")
        return f"{member('options', 'h')} != 0"

    @property
    def method_type(self) -> str:
        """The C type of methods of fixed steps, an enumeration; "" with a single method."""
        several = len(self.target.system.run.methods) > 1
        return f"{self.target.prefix}_method" if several else ""

    def method_enum(self, method: str) -> str:
        """Return the C enumerator of a method of fixed steps."""
        return f"{self.target.PREFIX}_METHOD_{method.upper()}"

    @property
    def integrate_batch(self) -> CFunction:
        """The prototype of the C function that makes the next steps of a batch of instances."""
        single, real = self.integrate, self.target.real.name
        state = (output_array(real, name) for name in STATE)
        arguments = (CArgument("long", "count"), *state, *single.arguments[2:])
        return CFunction(f"{self.target.prefix}_integrate_batch", "int", arguments)

    @property
    def lanes(self) -> CFunction:
        """The prototype of the C function for adaptive steps of a batch in vector registers."""
        name = f"{self.target.prefix}_adaptive_batch"
        return replace(self.integrate_batch, name=name, qualifier="static")

    def fixed_batch(self, method: str) -> CFunction:
        """Return the prototype of the C function that makes the next fixed steps of a batch.

        It is `integrate_batch` itself if that makes no other steps.
        """
        if not (len(self.target.system.run.methods) > 1 or self.target.integrates):
            return self.integrate_batch
        name = f"{self.target.prefix}_{method}_batch"
        return replace(self.integrate_batch, name=name, qualifier="static")

    def select_method(self, *, batch: bool = False, one: bool = False) -> tuple[str, ...]:
        """Return the lines of a C statement that returns the result of a run by fixed steps.

        batch: whether it is a batch. one: whether one function makes the steps of all methods.
        """
        methods = self.target.system.run.methods
        if one:
            return (return_statement(self.fixed_steps().call()),)
        prototype = self.fixed_batch if batch else self.fixed_steps
        calls = {self.method_enum(m): prototype(m).call() for m in methods}
        return return_case(member("options", "method"), calls)

    def _status(self, name: str, *arguments: CArgument) -> CFunction:
        """Return the prototype of a C function that returns a status.

        name: its C name without the scene's prefix.
        """
        return CFunction(f"{self.target.prefix}_{name}", f"{self.target.prefix}_status", arguments)

    @property
    def _state(self) -> tuple[CArgument, ...]:
        """The C arguments q and qd of a function that overwrites them."""
        real, NQ = self.target.real.name, f"{self.target.PREFIX}_NQ"
        return tuple(output_array(real, name, NQ) for name in STATE)
