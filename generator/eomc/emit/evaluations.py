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
    shape: str  # "", "n", "n*n", "n*p", "m", "m*x", "y" or "y*x"
    qd: bool
    u: bool
    doc: str
    symmetric: bool = False
    qdd: bool = False  # whether it may read accelerations


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
    "applied": Kind(
        "applied", "m", True, True, "The inputs as they act: u, or the signals, within limits."
    ),
    "signal_slopes": Kind(
        "slopes", "m*x", True, False, "[du/dq, du/dqd] of the scene's signals u, by rows."
    ),
    "signal": Kind("u", "m", True, False, "u: the scene's own signals for the inputs."),
}


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
