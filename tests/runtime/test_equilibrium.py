"""Equilibria and steady motions: against textbook formulas, and where none exists."""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.cases import scene_system
from support.session import Modules
from test_balance import STICKS


@pytest.mark.parametrize(("guess", "expected"), [(0.4, 0.0), (1.5, 0.0), (2.5, math.pi)])
def test_pole_is_upright_or_hanging(
    cartpole: ModuleType, driven: ModuleType, guess: float, expected: float
) -> None:
    """No force acts on the cart, so it stays where it is; an input that is not free stays too."""
    q, _, u = cartpole.equilibrium([0.3, guess])
    assert q == pytest.approx([0.3, expected], abs=1e-14) and u is None
    q, _, u = driven.equilibrium([0.3, guess], u={"force": 0.0})
    assert q == pytest.approx([0.3, expected], abs=1e-14) and u.tolist() == [0.0]
    assert np.abs(driven.acceleration(q, [0, 0], u=u)).max() < 1e-13


def test_result_is_named_and_unpacks_as_state_and_inputs(driven: ModuleType) -> None:
    equilibrium = driven.equilibrium([0.3, 0.4], 0.0, 0.0, [3.0], free=["theta", "force"])
    q, qd, u = equilibrium
    assert equilibrium.q is q and equilibrium.qd is qd and equilibrium.u is u
    assert qd.tolist() == [0.0, 0.0] and repr(equilibrium).startswith("Equilibrium(q=array(")


def test_input_is_solved_for(driven: ModuleType) -> None:
    q, _, u = driven.equilibrium([0.3, 0.4], u=[3.0], free=["theta", "force"])
    assert u == pytest.approx([0.0], abs=1e-14) and q == pytest.approx([0.3, 0.0], abs=1e-14)


@pytest.mark.parametrize(
    ("free", "fixed"),
    [
        ({"u", "theta", "q"}, {"x": 0.3, "push": 0.5}),
        ({"u", "push", "q"}, {"x": 0.3, "theta": 1.0}),
    ],
)
def test_values_that_are_not_free_are_unchanged(
    everything: ModuleType, free: set[str], fixed: dict[str, float]
) -> None:
    params = {"gamma": 0.0, "N": 0.1}
    q, _, u = everything.equilibrium(
        [0.3, 1.0, 0.1], u={"u": 1.0, "push": 0.5}, free=free, params=params
    )
    values = dict(zip((*everything.coordinates, *everything.inputs), [*q, *u], strict=True))
    assert {name: values[name] for name in fixed} == fixed
    zero = [0.0, 0.0, 0.0]
    residual = everything.tau(q, zero, u=u, params=params) - everything.bias(q, zero, params=params)
    assert np.abs(residual).max() < 1e-12 and q[2] == pytest.approx(-0.498, abs=1e-3)


def test_signals_are_used_where_no_input_is_free(driven: ModuleType) -> None:
    """At t = 1 the signal pushes, and nothing balances it on the cart."""
    u = driven.equilibrium([0.0, 0.1]).u
    assert u.tolist() == [0.0]
    with pytest.raises(driven.MotionError, match=r"where a force of 0\.00841 is left on x"):
        driven.equilibrium([0.0, 0.1], t=1.0)
    u = driven.equilibrium([0.0, 0.1], t=1.0, free=("theta", "force")).u
    assert u == pytest.approx([0.0], abs=1e-14)


def test_steady_precession_of_a_top(modules: Modules) -> None:
    """I1 phi'^2 cos(theta) - I3 (psi' + phi' cos(theta)) phi' + m g l = 0 (Goldstein, ch. 5)."""
    top = modules("heavy_top")
    phi_dot, psi_dot, p = 5.0, 15.0, top.defaults
    rates = {"phi": phi_dot, "theta": 0.0, "psi": psi_dot}
    qd = [rates[name] for name in top.coordinates]
    c = (p["I3"] * psi_dot * phi_dot - p["m"] * p["g"] * p["l"]) / (
        (p["I1"] - p["I3"]) * phi_dot**2
    )
    q = top.equilibrium(top.start[0], qd, free="theta").q
    assert math.cos(q[top.coordinates.index("theta")]) == pytest.approx(c, rel=1e-13)
    assert np.abs(top.acceleration(q, qd)).max() < 1e-12
    upright = top.equilibrium().q  # D is singular there, forces are not
    assert np.sin(upright[top.coordinates.index("theta")]) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.slow
def test_chain_converges_from_a_distant_guess(modules: Modules) -> None:
    chain = modules("chain")
    q = chain.equilibrium().q
    assert np.abs(chain.acceleration(q, 0 * q)).max() < 1e-12


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"u": 5.0}, r"no equilibrium found from q = .*where a force of 5 is left on x; start"),
        ({"free": []}, r"the search ends at q = \[0\.3 0\.5\], where a force of 9\.4 is left on"),
        ({"free": "force"}, r"a force of 9\.4 is left on theta"),
    ],
)
def test_missing_equilibrium_is_reported(driven: ModuleType, options: Any, message: str) -> None:
    with pytest.raises(driven.MotionError, match=message) as error:
        driven.equilibrium([0.3, 0.5], **options)
    assert error.value.status == "no convergence"


def test_force_that_only_vanishes_at_infinity_is_no_equilibrium(modules: Modules) -> None:
    kepler = modules("kepler_orbit")
    with pytest.raises(kepler.MotionError, match="no equilibrium found"):
        kepler.equilibrium()
    with pytest.raises(kepler.MotionError, match=r"from q = \[0\. 0\.\]"):
        kepler.equilibrium([0.0, 0.0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"free": ["Theta"]}, r"free: 'Theta' is not one of x, .*force; did you mean 'theta'"),
        ({"q": [1.0]}, r"q: shape \(1,\), expected \(2,\)"),
        ({"q": [[1.0, 2.0]]}, r"q: shape \(1, 2\), expected \(2,\)"),
        ({"qd": "x"}, "qd: 'x' is not a number"),
        ({"u": {"Force": 1}}, "u: 'Force' is not one of force"),
        ({"params": {"M": 1}}, "params: 'M' is not one of"),
    ],
)
def test_invalid_argument_is_named(driven: ModuleType, options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        driven.equilibrium(**{"q": [0.0, 0.1], "qd": [0.0, 0.0]} | options)


INTEGRAL = """eomc = 1
name = "integral_action"
[coordinates]
x = { unit = "m" }
z = { unit = "m s" }
[parameters]
r = 1.0
[inputs]
force = { unit = "N", signal = "4*(r - x) + 2*z - 3*x_dot" }
[energy]
kinetic = "x_dot**2/2"
[forces]
x = "force - 1"
[constraints]
integral = "z_dot - (r - x)"
"""


def test_nonholonomic_constraints_hold_at_an_equilibrium(modules: Modules) -> None:
    """A controller's integral rests where its error is zero, and ramps where that is requested."""
    loop = modules.unoptimised(INTEGRAL)
    q, _, u = loop.equilibrium()
    assert q == pytest.approx([1.0, 0.5], abs=1e-14) and u == pytest.approx([1.0], abs=1e-14)
    q, _, u = loop.equilibrium(qd=[0.0, 0.25], u=[0.0], free=["x", "force"])
    assert q == pytest.approx([0.75, 0.0], abs=1e-14) and u == pytest.approx([1.0], abs=1e-14)
    with pytest.raises(loop.MotionError, match=r"where the rates break integral by -0\.5; start"):
        loop.equilibrium([0.5, 0.0], free="z")


def test_free_velocities_are_solved_for(modules: Modules) -> None:
    """A motor held by its controller carries the load by its current, and idles without a load."""
    motor = modules.unoptimised(MOTOR)
    q, qd, u = motor.equilibrium(free=["phi", "sum", "charge_dot"])
    assert q == pytest.approx([1.0, 0.0, 0.3 / 0.5 * 2 / 4], abs=1e-12)
    assert qd == pytest.approx([0.0, 0.6, 0.0], abs=1e-12) and u == pytest.approx([1.2])
    assert np.abs(motor.acceleration(q, qd, u=u)).max() < 1e-9
    # turning at 6 V, where R i + k phi_dot = 6, the sum would grow ever faster
    with pytest.raises(motor.MotionError, match=r"the rates break error, by 9\.6 a second; start"):
        motor.equilibrium(u=6.0, free=["charge_dot", "sum_dot"], qd=[9.6, 0.0, 0.0])


MOTOR = """eomc = 1
name = "held_motor"
[coordinates]
phi    = { unit = "rad", start = 0.2 }
charge = { unit = "C" }
sum    = { unit = "rad s" }
[inputs]
voltage = { unit = "V", limits = [-12, 12], signal = "6*(1 - phi) + 4*sum - 0.6*phi_dot" }
[energy]
kinetic     = "0.02*phi_dot**2/2 + 0.01*charge_dot**2/2"
dissipation = "2*charge_dot**2/2"
[forces]
phi    = "0.5*charge_dot - 0.3"
charge = "voltage - 0.5*phi_dot"
[constraints]
error = "sum_dot - (1 - phi)"
"""


@pytest.mark.slow
def test_velocities_that_violate_holonomic_constraints_are_reported(modules: Modules) -> None:
    bob = modules("pendulum_xy")
    q = bob.equilibrium().q
    with pytest.raises(bob.MotionError, match=r"the rates break \w+ by .*rate \(free="):
        bob.equilibrium(qd=[1.0, -2.0])
    assert q[1] < 0
    with pytest.raises(bob.MotionError, match=r"the rates break rod, by 2 a second"):
        bob.equilibrium(qd=[1.0, 0.0], free=[])  # it would leave along the tangent


def test_underdetermined_velocities_are_steady(modules: Modules) -> None:
    """L di/dt + R i + k w = 6 V as a constraint: currents are steady if w = 6 V/k and i = 0."""
    motor = modules.unoptimised(CIRCUIT)
    q, qd, u = motor.equilibrium(free=["i", "phi_dot", "i_dot"])
    assert q == pytest.approx([0.0, 0.0], abs=1e-7) and u is None
    assert qd == pytest.approx([60.0, 0.0], abs=1e-7)
    assert np.abs(motor.acceleration(q, qd)).max() < 1e-6


CIRCUIT = """eomc = 1
name = "circuit_row"
[coordinates]
phi = { unit = "rad" }
i   = { unit = "A" }
[energy]
kinetic = "0.01*phi_dot**2/2"
[forces]
phi = "0.1*i"
[constraints]
circuit = "0.5*i_dot + i + 0.1*phi_dot - 6"
"""


@pytest.mark.slow
def test_stick_friction_balances_forces_up_to_its_limit(modules: Modules) -> None:
    """10 x against 1 N, and against 2 N."""
    block = modules.unoptimised(STICKS)
    assert block.equilibrium([0.09])[0].tolist() == [0.09, 0.0]
    with pytest.raises(block.MotionError, match=r"x slips, as 1\.5 is more than its friction hold"):
        block.equilibrium([0.15])
    assert block.equilibrium([0.15], params={"F": 2.0})[0].tolist() == [0.15, 0.0]


@pytest.mark.slow
def test_linkage_reaches_equilibrium_from_a_local_minimum_of_the_residual(modules: Modules) -> None:
    """Regression: Newton's method ended between two equilibria, at a force of -1.31."""
    four_bar = modules.unoptimised(scene_system("four_bar"))
    q = four_bar.equilibrium().q
    assert np.abs(four_bar.acceleration(q, [0, 0, 0])).max() < 1e-12
    assert np.abs(four_bar.constraints(q, [0, 0, 0])).max() < 1e-14
    neighbours = [
        four_bar.project(q + np.array([d, 0, 0]), [0, 0, 0], fixed=["q1"])[0] for d in (-0.01, 0.01)
    ]
    assert all(four_bar.potential_energy(x) > four_bar.potential_energy(q) for x in neighbours)


def test_no_equilibrium_where_the_mass_is_undefined(modules: Modules) -> None:
    """Regression: a NumPy error escaped from the descent."""
    text = """eomc = 1
name = "no_mass_here"
[coordinates]
x = { start = 1 }
[energy]
kinetic = "log(x)*x_dot**2/2"
potential = "x"
"""
    with pytest.raises(ArithmeticError, match=r"no equilibrium found from q = \[0\.\]"):
        modules.of_text(text).equilibrium([0.0])
