"""The public C functions of a scene, which both forms of C have: meanings and prototypes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from eomc.emit.c_function import CArgument, CFunction, input_array, member, output_array
from eomc.emit.c_names import Target
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
        Arguments besides q, t and p, separated by spaces: qd, u, qdd, wrenches, lambda. "qdd?" if
        only some scenes need the accelerations.
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
    def extra_argument(self) -> str:
        """The argument qdd, wrenches or lambda if the function takes it in every scene, or ""."""
        return next((n for n in ("qdd", "wrenches", "lambda") if n in self.takes.split()), "")


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
    NY, NF, NE, NC = (f"{target.PREFIX}_{n}" for n in ("NY", "NF", "NE", "NC"))
    pose, twist, momentum = (3, 3, 6) if s.plane else (12, 6, 10)
    return {
        "n*n": f"{NQ}*{NQ}",
        "n*p": f"{NQ}*{len(s.parameters)}",
        "n": NQ,
        "m": NU,
        "m*x": f"{NU}*2*{NQ}",
        "y": NY,
        "y*x": f"{NY}*(3*{NQ} + {NU})" if s.inputs else f"{NY}*(3*{NQ})",
        "y*p": f"{NY}*{len(s.parameters)}",
        "e": NE,
        "e*2*n": f"{NE}*2*{NQ}",
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


def refuses(target: Target, name: str) -> bool:
    """Return True if the evaluation function `name` returns a status code in C.

    It does so if it factors a matrix that may be singular.
    """
    function = program_function(target, name)
    return KINDS[name].refuses or bool(function and function.checks)


def takes_qdd(target: Target, name: str) -> bool:
    """Return True if the evaluation function `name` reads accelerations in this scene.

    Functions that take accelerations in every scene are excluded, see `Kind.extra_argument`.
    """
    function = program_function(target, name)
    optional = "qdd?" in KINDS[name].takes
    return bool(optional and function and function.uses & target.groups()["qdd"])


def takes_t(target: Target, name: str) -> bool:
    """Return True if the evaluation function `name` takes the time as an argument.

    It may depend on time only through the signals, the functions that define the scene's inputs.
    """
    function = program_function(target, name)
    assert function is not None
    takes_u = KINDS[name].takes_u and target.system.inputs
    return TIME in function.uses or bool(takes_u and target.signal_t)


STATE = ("q", "qd")
LIMITS = ("t_end", "tol", "max_step")  # of adaptive steps


@dataclass(frozen=True)
class Public:
    """Prototypes of the functions that the generated C header declares.

    Both forms of the C code, portable and optimised, implement them.
    """

    target: Target

    def arguments(self, *names: str) -> tuple[CArgument, ...]:
        """Return the arguments of C functions with the given names, such as q, qd, t, u or p.

        Arguments that the scene does not need are left out: u without inputs, p without parameters,
        and t if the motion does not depend on time.
        """
        target, real = self.target, self.target.real.name
        arguments = {
            "q": input_array(real, "q", f"{target.PREFIX}_NQ"),
            "qd": input_array(real, "qd", f"{target.PREFIX}_NQ"),
            "qdd": input_array(real, "qdd", f"{target.PREFIX}_NQ"),
            "wrenches": input_array(real, "wrenches", c_array_size(target, "f*twist")),
            "lambda": input_array(real, "lambda", c_array_size(target, "c")),
            "t": CArgument(real, "t") if target.driven else None,
            "h": CArgument(real, "h"),
            "u": input_array(real, "u") if target.system.inputs else None,
            "p": input_array(f"{target.prefix}_params", "p") if target.needs_p else None,
        }
        return tuple(a for name in names if (a := arguments[name]))

    def evaluations(self) -> tuple[CFunction, ...]:
        """Return the prototypes of the C functions that evaluate one quantity, such as D or energy.

        Quantities that the scene does not have are left out.
        """
        return tuple(
            map(self.evaluation, (n for n in KINDS if program_function(self.target, n) is not None))
        )

    def evaluation(self, name: str) -> CFunction:
        """Return the prototype of the C function that evaluates a quantity.

        `name` is the name of the quantity, such as D or energy.
        """
        kind, target, real = KINDS[name], self.target, self.target.real.name
        signal = name == "signal"
        t = (CArgument(real, "t"),) if takes_t(target, name) else ()
        state = STATE if "qd" in kind.takes.split() else STATE[:1]
        result_type = "void" if kind.out else real
        return CFunction(
            f"{target.prefix}_{name}",
            f"{target.prefix}_status" if refuses(target, name) else result_type,
            (
                *(
                    [output_array(real, kind.out, c_array_size(target, kind.shape))]
                    if kind.out
                    else []
                ),
                *(t if signal else ()),
                *(self.arguments(*state) if not signal or target.signal_state else ()),
                *(self.arguments("qdd") if takes_qdd(target, name) else ()),
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
    def project(self) -> CFunction:
        """The prototype of the C function that projects a state (q, qd) onto the constraints.

        It overwrites the state and returns a status code.
        """
        names = ("D", "constraints", "constraint_jacobian", "constraint_rates")
        t = self.arguments(*["t"] if any(takes_t(self.target, n) for n in names) else [])
        fixed = input_array("int", "fixed")
        return self._status("project", *self._state, *t, fixed, *self.arguments("p"))

    def step(self, method: str) -> CFunction:
        """Return the prototype of the C function that makes one step of fixed size.

        `method` is the name of the integration method. The function overwrites q and qd with the
        state after the step and returns a status code.
        """
        return self._status(f"{method}_step", *self._state, *self.arguments("t", "h", "u", "p"))

    @property
    def fixed_step(self) -> CFunction:
        """The prototype of the function pointer by which an adaptive run makes steps of fixed size.

        The pointer is a member of the workspace of the run, `memory->step`.
        """
        return replace(self.step("fixed"), name=member("memory", "step"))

    @property
    def fixed_type(self) -> CFunction:
        """The type of functions that make a step of fixed size, for a typedef in the header."""
        return self.step("fixed")

    def derivative(self, method: str) -> CFunction:
        """Return the prototype of the C function that differentiates one step of a method.

        It computes the partial derivatives of the state [q, qd] after the step: Phi with respect to
        [q, qd] before the step, and Gamma with respect to u. The function returns a status code.
        """
        target, NQ = self.target, f"{self.target.PREFIX}_NQ"
        out = [output_array(target.real.name, "Phi", f"4*{NQ}*{NQ}")]
        if target.system.inputs:
            out.append(output_array(target.real.name, "Gamma", f"2*{NQ}*{target.PREFIX}_NU"))
        return self._status(
            f"{method}_derivative", *out, *self.arguments(*STATE, "t", "h", "u", "p")
        )

    def run(self, method: str) -> CFunction:
        """Return the prototype of the C function that makes many steps of fixed size by a method.

        The function overwrites q and qd with the final state.
        """
        P = self.target.prefix
        strides = [CArgument("long", "u_stride")] if self.target.system.inputs else []
        return CFunction(
            f"{P}_{method}_run",
            "long",
            (
                *self._state, *self._steps, *self.arguments("u"), *strides, *self._row_output,
                *self.arguments("p"), CArgument(f"{P}_{method}_memory *", "memory"),
                CArgument(f"{P}_status *", "status"),
            ),
        )  # fmt: skip

    def batch(self, method: str) -> CFunction:
        """Return the prototype of the C function that makes many steps of fixed size for a batch.

        `method` is the name of the integration method. A batch is a number of instances of the
        system, each with its own state.
        """
        target, real = self.target, self.target.real.name
        strides = [CArgument("long", name) for name in ("u_instance", "u_step", "p_instance")]
        return CFunction(
            f"{target.prefix}_{method}_batch",
            "void",
            (
                CArgument("long", "count"), output_array(real, "q"), output_array(real, "qd"),
                *self._steps, *self.arguments("u"), *(strides[:2] if target.system.inputs else []),
                *self._row_output, CArgument("long", "row_count"), *self.arguments("p"),
                *(strides[2:] if target.needs_p else []),
                CArgument("long *", "completed"), CArgument("int *", "status"),
            ),
        )  # fmt: skip

    def adaptive(self, method: str) -> CFunction:
        """Return the prototype of the C function that makes a run with adaptive step-size control.

        `method` is the name of the integration method.
        """
        P, real = self.target.prefix, self.target.real.name
        name = f"{P}_{method}_adaptive"
        return CFunction(
            name,
            "long",
            (
                *self._state, output_array(real, "t"), *(CArgument(real, n) for n in LIMITS),
                *self.arguments("u"), CArgument("long", "steps"), input_array(real, "times"),
                CArgument("long", "count"),
                *(output_array(real, f"{n}_rows") for n in ("t", *STATE)),
                *(self.adaptive_events if self.target.system.events else ()),
                *self.arguments("p"), CArgument(f"{name}_memory *", "memory"),
                CArgument(f"{P}_status *", "status"),
            ),
        )  # fmt: skip

    def adaptive_batch(self, method: str) -> CFunction:
        """Return the prototype of the C function that makes adaptive runs of a batch.

        `method` is the name of the integration method. A batch is a number of instances of the
        system, each with its own state and time.
        """
        target, real = self.target, self.target.real.name
        name = f"{target.prefix}_{method}_adaptive"
        strides = [CArgument("long", name) for name in ("u_instance", "p_instance")]
        return CFunction(
            f"{name}_batch",
            "int",
            (
                CArgument("long", "count"), *(output_array(real, n) for n in (*STATE, "t")),
                *(CArgument(real, n) for n in LIMITS),
                *self.arguments("u"), *(strides[:1] if target.system.inputs else []),
                CArgument("long", "steps"), input_array(real, "times"),
                CArgument("long", "row_count"), *(output_array(real, f"{n}_rows") for n in STATE),
                *(self.adaptive_events if target.system.events else ()), *self.arguments("p"),
                *(strides[1:] if target.needs_p else []),
                CArgument(f"{name}_memory *", "memory"), CArgument("long *", "row_counts"),
                CArgument("int *", "status"),
            ),
        )  # fmt: skip

    @property
    def adaptive_events(self) -> tuple[CArgument, ...]:
        """The C arguments by which an adaptive run returns the detected events.

        They are the capacity of the arrays, the number of events so far, the index of each event,
        and an array with the time and state of each event.
        """
        return (
            CArgument("long", "room"), output_array("long", "events"), output_array("int", "which"),
            output_array(self.target.real.name, "event_rows"),
        )  # fmt: skip

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

    @property
    def _steps(self) -> tuple[CArgument, ...]:
        """The C arguments of a run: initial time, step size, first step and number of steps."""
        real = self.target.real.name
        t0 = [CArgument(real, "t0")] if self.target.driven else []
        return (*t0, CArgument(real, "h"), CArgument("long", "first"), CArgument("long", "steps"))

    @property
    def _row_output(self) -> tuple[CArgument, ...]:
        """The C arguments for stored states: `every` (steps between them), arrays for q and qd."""
        rows = (output_array(self.target.real.name, f"{name}_rows") for name in STATE)
        return (CArgument("long", "every"), *rows)
