"""`project` finds the nearest positions and closes loops by the smallest rotation."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from support.session import Modules

from eomc.mechanism.assembly import assembled
from eomc.model.constraints import find_wrong_rotations
from eomc.model.system import from_scene
from eomc.scene.read import parse

# a rolling ball: K is singular along the quaternion, whose length a constraint fixes
ROLLING = """eomc = 1
name = "rolling_ball"
[coordinates]
x = { start = 0.3, guess = true }
y = { guess = true }
qw = { start = 1.0, guess = true }
qx = { start = 0.1 }
qy = { start = 0.2, guess = true }
qz = { guess = true }
[definitions]
wx = "2*(qw*dot(qx) - qx*dot(qw) + qy*dot(qz) - qz*dot(qy))"
wy = "2*(qw*dot(qy) - qy*dot(qw) + qz*dot(qx) - qx*dot(qz))"
wz = "2*(qw*dot(qz) - qz*dot(qw) + qx*dot(qy) - qy*dot(qx))"
[energy]
kinetic = "x_dot**2 + y_dot**2 + 0.001*(wx**2 + wy**2 + wz**2)"
[constraints]
unit = "(qw**2 + qx**2 + qy**2 + qz**2 - 1)/2"
roll_x = "x_dot - 0.05*wy"
roll_y = "y_dot + 0.05*wx"
"""
# s has no inertia and no position constraint
COUNTED = """eomc = 1
name = "counted_turns"
[coordinates]
x = { start = 1.0, guess = true }
y = { guess = true }
s = { start = 0.5, guess = true }
[energy]
kinetic = "x_dot**2 + y_dot**2"
[constraints]
rod = "x**2 + y**2 - 1"
count = "s_dot - x*y_dot + y*x_dot"
"""


@pytest.fixture(scope="module")
def rolling(modules: Modules) -> ModuleType:
    return modules.unoptimised(ROLLING)


@pytest.mark.parametrize("fixed_names", [(), ("qx",), ("qw",), ("qy", "x")])
def test_velocity_constraints_do_not_move_positions(
    rolling: ModuleType, fixed_names: tuple[str, ...]
) -> None:
    q = np.array([0.3, 0.0, 0.98, 0.1, -0.1, 0.1])
    result = rolling.project(q, np.zeros(6), fixed=list(fixed_names))[0]
    free = [k for k in range(2, 6) if rolling.coordinates[k] not in fixed_names]
    fixed_indices = [k for k in range(6) if k not in free]
    np.testing.assert_array_equal(result[fixed_indices], q[fixed_indices])
    # among vectors of one length, the nearest has the direction of the free components
    remainder = 1 - sum(q[k] ** 2 for k in fixed_indices[2:])
    nearest = q[free] * np.sqrt(remainder / np.sum(q[free] ** 2))
    np.testing.assert_allclose(result[free], nearest, atol=1e-12)


def test_velocity_constraints_do_not_move_an_assembled_initial_state() -> None:
    system = assembled(from_scene(parse(ROLLING)))
    q = np.array([c.start for c in system.coordinates])
    np.testing.assert_array_equal(q[[0, 1, 3, 5]], [0.3, 0, 0.1, 0])
    np.testing.assert_allclose(q[[2, 4]], np.array([1, 0.2]) * np.sqrt(0.99 / 1.04), atol=1e-12)


def test_massless_coordinate_in_velocity_constraints_only_is_unchanged(modules: Modules) -> None:
    counted = modules.unoptimised(COUNTED)
    for fixed_names in ([], ["y"]):
        q = counted.project([1.1, 0.2, 0.5], np.zeros(3), fixed=fixed_names)[0]
        assert q[2] == 0.5
        assert q[0] ** 2 + q[1] ** 2 == pytest.approx(1, abs=1e-14)
        assert q[1] == 0.2 if fixed_names else q[1] / q[0] == pytest.approx(0.2 / 1.1)


@pytest.mark.slow
@pytest.mark.parametrize("fixed_names", [(), ("q2",)])
def test_change_is_minimal_in_the_metric_of_the_mass_matrix(
    modules: Modules, fixed_names: tuple[str, ...]
) -> None:
    """Newton's method, used before, missed the nearest position by up to 1e-3 of the distance."""
    four_bar = modules("four_bar")
    free = [k for k, name in enumerate(four_bar.coordinates) if name not in fixed_names]
    random = np.random.default_rng(3)
    for _ in range(10):
        q = four_bar.start[0] + 0.05 * random.normal(size=four_bar.nq)
        result = four_bar.project(q, 0 * q, fixed=list(fixed_names))[0]
        assert np.max(np.abs(four_bar.constraints(result, 0 * q))) < 1e-14
        force = (four_bar.D(result) @ (result - q))[free]
        A = four_bar.constraint_jacobian(result)[:, free]
        left = force - A.T @ np.linalg.lstsq(A.T, force, rcond=None)[0]
        assert np.max(np.abs(left)) < 1e-9 * np.max(np.abs(force))


FREE_BODIES = """eomc = 1
name = "loose_bodies"
gravity = [0, 0, -9.81]
[coordinates]
"q[i]" = { repeat = "i = 1..12" }
[[body]]
name = "wheel"
joint = "free"
coordinates = ["q1", "q2", "q3", "q4", "q5", "q6"]
mass = 1
inertia = [0.1, 0.2, 0.25]
[[body]]
name = "slider"
joint = "free"
coordinates = ["q7", "q8", "q9", "q10", "q11", "q12"]
mass = 1
inertia = [0.1, 0.2, 0.25]
[[loop]]
name = "hinge"
joint = "revolute"
bodies = ["world", "wheel"]
points = [[0, 0, 1], [0.1, 0, 0]]
axis = [[0, 0.6, 0.8], [0.6, 0, -0.8]]
[[loop]]
name = "guide"
joint = "prismatic"
bodies = ["wheel", "slider"]
points = [[0, 0, 1], [0, 0, 0.3]]
axis = [0, 0.6, 0.8]
rotation = [["z", 2], ["x", 1]]
"""


WELDED = """eomc = 1
name = "welded_plate"
gravity = [0, -9.81]
[coordinates]
x = {}
y = {}
theta = {}
[[body]]
name = "plate"
joint = "planar"
coordinates = ["x", "y", "theta"]
mass = 1
center = [0.1, 0]
inertia = 0.1
[[loop]]
name = "seam"
joint = "weld"
bodies = ["world", "plate"]
points = [[0, 1], [0, 0.1]]
rotation = 2.5
"""


@pytest.mark.parametrize("text", [WELDED, pytest.param(FREE_BODIES, marks=pytest.mark.slow)])
def test_loops_are_closed_by_the_smallest_rotation(modules: Modules, text: str) -> None:
    """Loops with an error of more than a quarter turn were once closed half a turn off."""
    module = modules.unoptimised(text)
    wrong = find_wrong_rotations(from_scene(parse(text)))
    random = np.random.default_rng(7)
    starts = random.uniform(-np.pi, np.pi, (100, module.nq))
    if text is WELDED:  # exactly a quarter turn and half a turn off
        starts[:2] = [[0, 0, 2.5 - np.pi / 2], [0, 0, 2.5 - np.pi]]
    for q in starts:
        result = module.project(q, 0 * q)[0]
        assert wrong(result.tolist(), 0.0, {}) == []
        assert np.max(np.abs(module.constraints(result, 0 * q))) < 1e-11
        run = module.simulate(q0=q, duration=0.002, h=0.001)
        assert wrong(run.q[0].tolist(), 0.0, {}) == []
