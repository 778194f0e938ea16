"""Sines in a batch: rotated by velocities and accelerations, reduced for wide angles."""

from __future__ import annotations

import numpy as np
import pytest
from support.session import Modules, tiers
from support.trajectories import STEPS, module, starts


@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize(
    "name", tiers(("cartpole", "cartpole_driven", "double_pendulum"), "cartpole")
)
def test_fast_neighbour_changes_no_bit(name: str, real: str) -> None:
    """Sines are rotated in slow instances and evaluated in fast ones, whatever their neighbours."""
    m = module(name, real=f'"{real}"')
    q0, qd0 = starts(m, 192)
    q0, qd0 = q0.astype(m.dtype), qd0.astype(m.dtype)
    fast = np.random.default_rng(3).random(192) < 0.1
    fast[64:128] = np.arange(64) % 64 != 5  # a tile with a single slow instance
    qd0[fast] *= 300
    h = 0.01
    mixed = m.simulate_batch(q0, qd0, h=h, steps=STEPS)
    for selection in (fast, ~fast):
        separate = m.simulate_batch(q0[selection], qd0[selection], h=h, steps=STEPS)
        assert np.array_equal(separate.q, mixed.q[selection]) and np.array_equal(
            separate.qd, mixed.qd[selection]
        )
    if name != "cartpole_driven":  # t0 + n h is rounded differently
        half = STEPS // 2
        first_half = m.simulate_batch(q0, qd0, h=h, steps=half)
        second_half = m.simulate_batch(first_half.q[:, -1], first_half.qd[:, -1], h=h, steps=half)
        assert np.array_equal(second_half.q, mixed.q[:, half:])


@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("h", tiers([0.005, 0.02, 0.05, 0.2], 0.2))
def test_rotated_sines_are_as_accurate_as_evaluated_ones(h: float, real: str) -> None:
    """On both sides of the bounds: 1/8 for h/2 qd, 1/64 for h^2/2 qdd; for floats 1/4 and 1/16."""
    m = module("cartpole", real=f'"{real}"')
    q0, qd0 = (x.astype(m.dtype) for x in starts(m, 300))
    qd0[:, 1] = np.linspace(-20, 20, 300)
    runs = m.simulate_batch(q0, qd0, h=h, steps=1)
    tolerance = 18 * np.finfo(m.dtype).eps
    for k in range(300):
        single = m.simulate(q0[k], qd0[k], h=h, steps=1)
        assert np.max(np.abs(runs.q[k] - single.q)) < tolerance * (1 + 20 * h)
        assert np.max(np.abs(runs.qd[k] - single.qd)) < tolerance * (20 + 400 * h)


@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("h", [0.1, 0.5])
def test_rotations_by_accelerations_are_as_accurate_as_evaluated_sines(h: float, real: str) -> None:
    """At rest, from upright, where h^2/2 qdd is zero, to where it is too large for a rotation."""
    m = module("cartpole", real=f'"{real}"')
    q0, qd0 = np.zeros((500, 2), m.dtype), np.zeros((500, 2), m.dtype)
    q0[:, 1] = np.linspace(0, np.pi, 500)
    runs = m.simulate_batch(q0, qd0, h=h, steps=1)
    tolerance = 18 * np.finfo(m.dtype).eps
    for k in range(500):
        single = m.simulate(q0[k], qd0[k], h=h, steps=1)
        assert np.max(np.abs(runs.q[k] - single.q)) < tolerance * (1 + 20 * h)
        assert np.max(np.abs(runs.qd[k] - single.qd)) < tolerance * (1 + 20 * h)


@pytest.mark.parametrize("real", tiers(["double", "float"], "double"))
def test_rotations_by_velocities_are_as_accurate_as_evaluated_sines(
    real: str, modules: Modules
) -> None:
    """A heavy rotor turns evenly, by up to 2.4 rad a step, and pushes a mass by its sine."""
    m = modules.of_text(
        "eomc = 1\nname = 'rotor'\n[coordinates]\nx = {}\ntheta = {}\n[energy]\n"
        "kinetic = 'x_dot**2/2 + 100*theta_dot**2'\npotential = 'x*sin(theta)'\n"
        f"[run]\nbatch = true\nreal = '{real}'\n"
    )
    q0, qd0 = (x.astype(m.dtype) for x in starts(m, 400))
    qd0[:, 1] = np.linspace(0, 2.4, 400)
    runs = m.simulate_batch(q0, qd0, h=1.0, steps=1)
    for k in range(400):
        single = m.simulate(q0[k], qd0[k], h=1.0, steps=1)
        # numbers are up to 3
        assert np.max(np.abs(runs.q[k] - single.q)) < 8 * np.finfo(m.dtype).eps
        assert np.max(np.abs(runs.qd[k] - single.qd)) < 8 * np.finfo(m.dtype).eps


@pytest.mark.parametrize(("real", "wide"), [("double", 3e6), ("float", 3e4)])
def test_wide_angles_are_reduced_as_in_a_single_run(real: str, wide: float) -> None:
    m = module("cartpole", real=f'"{real}"')
    q0 = np.array([[0.0, wide], [0.0, 1.0]])
    runs = m.simulate_batch(q0, steps=5)
    assert np.isfinite(runs.q).all()
    ulp = np.spacing(m.start[0].dtype.type(wide))
    np.testing.assert_allclose(runs.q[0], m.simulate(q0[0], steps=5).q, rtol=0, atol=5 * ulp)


@pytest.mark.parametrize(("real", "wide"), [("double", 2e16), ("float", 4e7)])
def test_angles_too_wide_for_vector_code_use_libm(real: str, wide: float) -> None:
    """These angles are too wide to change; the cart moves by their sines and cosines."""
    m = module("cartpole", real=f'"{real}"')
    q0 = np.stack([np.zeros(9), np.linspace(1, 3, 9) * wide], axis=1).astype(m.dtype)
    qd0 = np.tile([0.3, 0.5], (9, 1)).astype(m.dtype)
    runs = m.simulate_batch(q0, qd0, steps=STEPS)
    for k in range(9):
        single = m.simulate(q0[k], qd0[k], steps=STEPS)
        assert (runs.q[k, :, 1] == q0[k, 1]).all()
        # an advance by h^2 a within a step is below the resolution of the angle
        np.testing.assert_allclose(runs.qd[k], single.qd, rtol=0, atol=1e-4)
