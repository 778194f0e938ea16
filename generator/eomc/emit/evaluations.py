"""The evaluation functions that a program may have: D, C, g, bias, tau, energies, inputs and
more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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
        """The argument qdd, wrenches or lambda, if the function takes it in every scene; otherwise
        "".
        """
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
    "jacobi": Kind("", "", "qd", "qd.dK/dqd - K + P, J: what is conserved here in place of K + P."),
    "power": Kind("", "", "qd u",
        "Power into the system, W: d(energy)/dt, or d(jacobi)/dt if there is one."),
    "sensitivity": Kind("E", "n*p", "qd u",
        "E = dqdd/dp at held inputs, nq rows, a column for each parameter in its order."),
    "outputs": Kind("outputs", "y", "qd u qdd?", "What the scene asks for, in the order above."),
    "output_slopes": Kind("slopes", "y*x", "qd u qdd?",
        "[dy/dq, dy/dqd, dy/du, dy/dqdd] of the outputs y, by rows, each at the others held."),
    "output_sensitivity": Kind("slopes", "y*p", "qd u qdd?",
        "dy/dp of the outputs y at held q, qd, u and qdd, by rows, a column for each parameter."),
    "events": Kind("events", "e", "qd u", "Of each event what is zero where it happens."),
    "begins": Kind("begins", "e", "qd u",
        "Of each event what is above zero where it happens as motion begins; -1 of others."),
    "jumps": Kind("after", "e*2*n", "qd u",
        "[q; qd] behind each event, where it is one that jumps."),
    "frame_poses": Kind("poses", "f*pose", "", "Where each frame is: {pose}."),
    "frame_velocities": Kind("velocities", "f*twist", "qd",
        "Of each frame: {twist}, along the world's axes."),
    "frame_accelerations": Kind("accelerations", "f*twist", "qd qdd",
        "d(velocities)/dt at the accelerations qdd; at qdd = 0 that is dJ/dt qd of the Jacobians."),
    "frame_jacobians": Kind("jacobians", "f*twist*n", "",
        "J of each frame: velocities = J qd, by rows."),
    "frame_forces": Kind("forces", "n", "wrenches",
        "The sum of J^T w: what forces and moments w do that act on the frames, ordered "
        "as velocities."),
    "inverse_dynamics": Kind("tau", "n", "qd qdd",
        "tau = D qdd + C qd + g: the generalized forces of a motion, without forming D."),
    "momentum": Kind("momentum", "momentum", "qd",
        "Of all bodies that move, rotors aside: {momentum}."),
    "constraints": Kind("phi", "c", "qd",
        "What is zero along every motion: the constraints, in their order."),
    "constraint_rates": Kind("rates", "c", "qd",
        "A qd + dphi/dt of holonomic constraints, psi of others: zero along every motion too."),
    "constraint_jacobian": Kind("A", "c*n", "",
        "A = dphi/dq of holonomic constraints, dpsi/dqd of others, by rows."),
    "constraint_slopes": Kind("slopes", "c*n", "qd",
        "Of what constraint_rates gives, the derivatives along q, by rows; those along qd are A."),
    "multipliers": Kind("lambda", "c", "qd u",
        "lambda in D qdd + C qd + g = tau + A^T lambda, one a constraint as it is written.",
        refuses=True),
    "reactions": Kind("reactions", "l*6", "qd lambda",
        "Of each loop {reaction} on its second body, by the multipliers lambda."),
    "applied": Kind("applied", "m", "qd u",
        "The inputs as they act: u, or the signals, within limits."),
    "signal_slopes": Kind("slopes", "m*x", "qd",
        "[du/dq, du/dqd] of the scene's signals u, by rows."),
    "signal": Kind("u", "m", "qd", "u: the scene's own signals for the inputs."),
}  # fmt: skip


_PLANE = {
    "pose": "x, y, angle",
    "twist": "the velocity of its origin (2) and the angular one",
    "momentum": "mass, its centre (2), momentum (2), that about the centre",
    "reaction": "the force (2) and the moment",
}
_SPACE = {
    "pose": "position (3), rotation matrix by rows (9)",
    "twist": "the velocity of its origin (3) and the angular one (3)",
    "momentum": "mass, its centre (3), momentum (3), that about the centre (3)",
    "reaction": "the force (3) and the moment (3)",
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


def source(target: Target, name: str) -> Function | None:
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
    function = source(target, name)
    return KINDS[name].refuses or bool(function and function.checks)


def takes_qdd(target: Target, name: str) -> bool:
    """Return True if the evaluation function `name` reads accelerations in this scene.

    Functions that take accelerations in every scene are excluded, see `Kind.extra_argument`.
    """
    function = source(target, name)
    optional = "qdd?" in KINDS[name].takes
    return bool(optional and function and function.uses & target.groups()["qdd"])


def takes_t(target: Target, name: str) -> bool:
    """Return True if the evaluation function `name` takes the time as an argument.

    It may depend on time only through the signals, the functions that define the scene's inputs.
    """
    function = source(target, name)
    assert function is not None
    takes_u = KINDS[name].takes_u and target.system.inputs
    return TIME in function.uses or bool(takes_u and target.signal_t)
