"""A quadrotor whose attitude is a unit quaternion, with its norm as a constraint."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from support.cases import SCENES
from support.session import Modules

import eomc

H = 0.002


@pytest.fixture(scope="module")
def quadrotor(modules: Modules) -> ModuleType:
    return modules.unoptimised(eomc.read(SCENES / "quadrotor.toml"))


def rotation(q: np.ndarray) -> np.ndarray:
    """Return the rotation matrix from body to world, (n, 3, 3)."""
    w, x, y, z = q[:, 3:].T
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]).transpose(2, 0, 1)  # fmt: skip


def test_hovering_is_stationary(quadrotor: ModuleType) -> None:
    q, _, u = quadrotor.equilibrium()
    assert np.allclose(u, 0.5 * 9.81 / 4, atol=1e-12)
    assert np.allclose(quadrotor.simulate(h=H, duration=1.0).q[-1], q, atol=1e-12)


def test_flips_through_any_pitch(quadrotor: ModuleType) -> None:
    """A constant torque M about the y axis rotates it by M t^2/(2 Iyy)."""
    run = quadrotor.simulate(u=[0.1, 0.2, 0.3, 0.2], h=H, duration=3.0)
    angle = 0.17 * 0.2 / 0.0023 * run.t**2 / 2
    assert angle[-1] > 10 * 2 * np.pi
    assert np.max(np.abs(run["qw"] - np.cos(angle / 2))) < 1e-5
    assert np.max(np.abs(run["qy"] - np.sin(angle / 2))) < 1e-5
    assert np.max(np.abs(run.outputs["body_rate_y"] - 2 * angle / np.maximum(run.t, H))) < 5e-5
    assert np.max(np.abs(run.constraints["unit"])) < 1e-15


def test_free_tumbling_conserves_angular_momentum(quadrotor: ModuleType) -> None:
    """Only gravity acts; momentum is constant in the world, and rates follow Euler's equations."""
    start = [0.0, 0, 1, 0.6, 0.0, 0.8, 0.0]
    spin = np.array([3.0, 20.0, 5.0])
    w, x, y, z = start[3:]
    E = np.array([[-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])
    rates = [0.0, 0, 0, *(E.T @ spin / 2)]
    run = quadrotor.simulate(q0=start, qd0=rates, u=[0.0] * 4, h=H, duration=2.0, method="rk4")
    body = np.stack([run.outputs[f"body_rate_{k}"] for k in "xyz"], axis=1)
    assert np.allclose(body[0], spin, atol=1e-12)
    momentum = np.einsum("nij,nj->ni", rotation(run.q), body * [0.0023, 0.0023, 0.004])
    assert np.max(np.abs(momentum - momentum[0])) < 1e-6 * np.linalg.norm(momentum[0])
    turned = (0.004 / 0.0023 - 1) * 5 * run.t  # about z; moments about x, y are equal
    whirl = (3 + 20j) * np.exp(1j * turned)
    assert np.max(np.abs(body[:, 0] + 1j * body[:, 1] - whirl)) < 1e-4
    assert np.ptp(run.energy) < 1e-6 * run.energy[0]


def test_linearization_at_hover_has_twelve_states(quadrotor: ModuleType) -> None:
    q = quadrotor.equilibrium().q
    T = quadrotor.tangent(q, np.zeros(7))
    assert T.shape == (14, 12)
    Phi, _ = quadrotor.discretize(q, np.zeros(7), h=H)
    reduced = T.T @ Phi @ T
    assert np.allclose(np.linalg.eigvals(reduced), 1, atol=1e-2)  # it drifts and rotates freely
    assert np.linalg.matrix_rank(reduced - np.eye(12), tol=1e-9) == 8
