"""Coordinates without inertia of their own, determined by constraints: built, run and checked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import eomc
from eomc.verify.check import check

# a mass on a rod, a string over a pulley pulled by it; s has no inertia
PULLEY = """eomc = 1
name = "cord"
[coordinates]
x = { start = 0.3 }
y = { start = -0.9, guess = true }
s = { start = 0.1, guess = true }
[energy]
kinetic = "x_dot**2 + y_dot**2"
potential = "9.81*2*y + 3*s**2"
[constraints]
rod = "x**2 + y**2 - 1"
pulley = "s - x - 2*y"
[run]
METHODS
h = 0.01
duration = 2
"""

# only x + s has inertia: D is singular, although no diagonal entry is 0
BELT = """eomc = 1
name = "belt"
[coordinates]
x = { start = 0.3 }
s = { start = 0.1 }
y = { start = 0.2, rate = 0.3, guess = true }
[energy]
kinetic = "(x_dot + s_dot)**2/2 + y_dot**2/2"
potential = "9.81*y + 3*x**2 + s**2"
[constraints]
belt = "x - 2*s - y"
[run]
METHODS
h = 0.01
duration = 2
"""

pytestmark = pytest.mark.usefixtures("quickly_compiled")


def built(text: str, folder: Path) -> tuple[eomc.System, object]:
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    system = eomc.read(folder / "scene.toml")
    return system, eomc.load(system, folder / "build")


def test_singular_D_is_accepted_if_constraints_are_regular(tmp_path: Path) -> None:
    """Compare with x = 2 s + y substituted by hand: K = (3 s' + y')^2/2 + y'^2/2."""
    system, module = built(BELT.replace("METHODS", 'method = "rk4"'), tmp_path)
    s, y = 0.25, -0.4
    x = 2 * s + y
    a = np.linalg.solve([[9, 3], [3, 2]], [-(12 * x + 2 * s), -(9.81 + 6 * x)])
    expected = [2 * a[0] + a[1], *a]
    accelerations = module.acceleration([x, s, y], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(accelerations, expected, rtol=1e-13)
    # Row s: 0 + A^T lambda = 2 s + the inertia of x + s.
    belt = module.multipliers([x, s, y], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(float(np.squeeze(belt)), (a[1] + 9.81) / -1, rtol=1e-13)
    run = module.simulate(method="rk4")
    assert np.ptp(run.energy) < 1e-6 and np.abs(run.constraints["belt"]).max() < 1e-14
    assert system.closure is not None and len(system.closure.weights) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "methods"),
    [
        (PULLEY, 'method = ["rk4", "gauss8", "gauss16", "dp8"]'),
        (BELT, 'method = ["rk4", "dp8"]\nlinearize = true\nbatch = true'),
        (BELT, 'real = "float"'),
    ],
    ids=["pulley", "belt", "belt in floats"],
)
def test_check_passes(text: str, methods: str, tmp_path: Path) -> None:
    system, module = built(text.replace("METHODS", methods), tmp_path)
    report = check(system, module)
    assert report.passed, report.table()


def test_unconstrained_massless_coordinate_is_refused(tmp_path: Path) -> None:
    text = PULLEY.replace('pulley = "s - x - 2*y"\n', "").replace("METHODS", "")
    with pytest.raises(eomc.EomcError, match="coordinate 's' has no inertia"):
        built(text, tmp_path)
