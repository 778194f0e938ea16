"""`project` moves positions by the least change that the rows of positions ask for."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from conftest import Modules

from eomc.model.from_scene import from_scene
from eomc.program.assembly import assembled
from eomc.scene.read import parse

# a ball that rolls: K is singular along the quaternion, which its length fixes
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
# s has no inertia, and no row of positions
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


@pytest.mark.parametrize("held", [(), ("qx",), ("qw",), ("qy", "x")])
def test_rows_of_rates_do_not_move_positions(rolling: ModuleType, held: tuple[str, ...]) -> None:
    q = np.array([0.3, 0.0, 0.98, 0.1, -0.1, 0.1])
    found = rolling.project(q, np.zeros(6), held=list(held))[0]
    free = [k for k in range(2, 6) if rolling.coordinates[k] not in held]
    still = [k for k in range(6) if k not in free]
    np.testing.assert_array_equal(found[still], q[still])
    # of one length, the nearest has the direction of the free components
    rest = 1 - sum(q[k] ** 2 for k in still[2:])
    nearest = q[free] * np.sqrt(rest / np.sum(q[free] ** 2))
    np.testing.assert_allclose(found[free], nearest, atol=1e-12)


def test_rows_of_rates_do_not_move_an_assembled_start() -> None:
    made = assembled(from_scene(parse(ROLLING)))
    q = np.array([c.start for c in made.coordinates])
    np.testing.assert_array_equal(q[[0, 1, 3, 5]], [0.3, 0, 0.1, 0])
    np.testing.assert_allclose(q[[2, 4]], np.array([1, 0.2]) * np.sqrt(0.99 / 1.04), atol=1e-12)


def test_a_coordinate_in_rows_of_rates_alone_and_without_inertia_stays(modules: Modules) -> None:
    counted = modules.unoptimised(COUNTED)
    for held in ([], ["y"]):
        q = counted.project([1.1, 0.2, 0.5], np.zeros(3), held=held)[0]
        assert q[2] == 0.5
        assert q[0] ** 2 + q[1] ** 2 == pytest.approx(1, abs=1e-14)
        assert q[1] == 0.2 if held else q[1] / q[0] == pytest.approx(0.2 / 1.1)
