"""The evaluation functions that a program may have: D, C, g, bias, tau, energies, signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from eomc.emit.c_names import Target
from eomc.program.ir import Function
from eomc.program.program import TIME


@dataclass(frozen=True)
class Kind:
    """What is known of a function before it is looked at: results, arguments, meaning."""

    out: str
    shape: str  # one that `extent` knows; "" of a number
    qd: bool
    u: bool
    doc: str
    symmetric: bool = False
    qdd: bool = False  # whether it may read accelerations
    given: str = ""  # what it takes besides: "qdd" or "wrenches"


KINDS: Mapping[str, Kind] = {
    "D": Kind("D", "n*n", False, False, "D(q): mass matrix, nq x nq, symmetric.", True),
    "C": Kind("C", "n*n", True, False, "C(q, qd): Coriolis matrix, nq x nq, Christoffel form."),
    "g": Kind("g", "n", False, False, "g(q): dP/dq, the forces of the potential energy."),
    "bias": Kind("bias", "n", True, False, "bias = C(q, qd) qd + g(q), without forming C."),
    "tau": Kind("tau", "n", True, True, "tau = Q - dR/dqd: inputs, friction and other forces."),
    "kinetic_energy": Kind("", "", True, False, "K(q, qd), J."),
    "potential_energy": Kind("", "", False, False, "P(q), J."),
    "energy": Kind("", "", True, False, "K + P, J."),
    "jacobi": Kind(
        "", "", True, False, "qd.dK/dqd - K + P, J: what is conserved here in place of K + P."
    ),
    "power": Kind(
        "",
        "",
        True,
        True,
        "Power into the system, W: d(energy)/dt, or d(jacobi)/dt if there is one.",
    ),
    "sensitivity": Kind(
        "E",
        "n*p",
        True,
        True,
        "E = dqdd/dp at held inputs, nq rows, a column for each parameter in its order.",
    ),
    "outputs": Kind(
        "outputs", "y", True, True, "What the scene asks for, in the order above.", qdd=True
    ),
    "output_slopes": Kind(
        "slopes",
        "y*x",
        True,
        True,
        "[dy/dq, dy/dqd, dy/du, dy/dqdd] of the outputs y, by rows, each at the others held.",
        qdd=True,
    ),
    "events": Kind("events", "e", True, True, "Of each event what is zero where it happens."),
    "begins": Kind(
        "begins",
        "e",
        True,
        True,
        "Of each event what is above zero where it happens as motion begins; -1 of others.",
    ),
    "jumps": Kind(
        "after", "e*2*n", True, True, "[q; qd] behind each event, where it is one that jumps."
    ),
    "frame_poses": Kind("poses", "f*pose", False, False, "Where each frame is: {pose}."),
    "frame_velocities": Kind(
        "velocities", "f*twist", True, False, "Of each frame: {twist}, along the world's axes."
    ),
    "frame_accelerations": Kind(
        "accelerations",
        "f*twist",
        True,
        False,
        "d(velocities)/dt at the accelerations qdd; at qdd = 0 that is dJ/dt qd of the Jacobians.",
        given="qdd",
    ),
    "frame_jacobians": Kind(
        "jacobians", "f*twist*n", False, False, "J of each frame: velocities = J qd, by rows."
    ),
    "frame_forces": Kind(
        "forces",
        "n",
        False,
        False,
        "The sum of J^T w: what forces and moments w do that act on the frames, ordered as "
        "velocities.",
        given="wrenches",
    ),
    "inverse_dynamics": Kind(
        "tau",
        "n",
        True,
        False,
        "tau = D qdd + C qd + g: the generalized forces of a motion, without forming D.",
        given="qdd",
    ),
    "momentum": Kind(
        "momentum", "momentum", True, False, "Of all bodies that move, rotors aside: {momentum}."
    ),
    "constraints": Kind(
        "phi", "c", True, False, "What is zero along every motion: the constraints, in their order."
    ),
    "constraint_rates": Kind(
        "rates",
        "c",
        True,
        False,
        "A qd + dphi/dt of holonomic constraints, psi of others: zero along every motion too.",
    ),
    "constraint_jacobian": Kind(
        "A",
        "c*n",
        False,
        False,
        "A = dphi/dq of holonomic constraints, dpsi/dqd of others, by rows.",
    ),
    "constraint_slopes": Kind(
        "slopes",
        "c*n",
        True,
        False,
        "Of what constraint_rates gives, the derivatives along q, by rows; those along qd are A.",
    ),
    "multipliers": Kind(
        "lambda",
        "c",
        True,
        True,
        "lambda in D qdd + C qd + g = tau + A^T lambda, one a constraint as it is written.",
    ),
    "reactions": Kind(
        "reactions",
        "l*6",
        True,
        False,
        "Of each loop {reaction} on its second body, by the multipliers lambda.",
        given="lambda",
    ),
    "applied": Kind(
        "applied", "m", True, True, "The inputs as they act: u, or the signals, within limits."
    ),
    "signal_slopes": Kind(
        "slopes", "m*x", True, False, "[du/dq, du/dqd] of the scene's signals u, by rows."
    ),
    "signal": Kind("u", "m", True, False, "u: the scene's own signals for the inputs."),
}


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
    """What a function gives, in the words of the plane or of space."""
    found = KINDS[name].doc.format(**(_PLANE if target.system.plane else _SPACE))
    if name == "inverse_dynamics" and target.system.constraints:
        found = found.replace("tau =", "tau + A^T lambda =")
    return found


def extent(target: Target, shape: str) -> str:
    """How many numbers that is, in C."""
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
    """The function that `name` is computed by: its own, or one that gives a column at a time."""
    of = target.program.functions
    return of.get(name) or of.get(f"{name}_column")


def takes_qdd(target: Target, name: str) -> bool:
    """Whether a function reads accelerations."""
    function = source(target, name)
    return bool(KINDS[name].qdd and function and function.uses & target.groups()["qdd"])


def takes_t(target: Target, name: str) -> bool:
    """Whether a function's result depends on time, by itself or by the signals."""
    function = source(target, name)
    assert function is not None
    takes_u = KINDS[name].u and target.system.inputs
    return TIME in function.uses or bool(takes_u and target.signal_t)
