"""IFToMM's four-bar A02 lies flat twice a turn; adaptive steps and gauss16 go through.

There rows depend on one another: what errors of velocities make of accelerations grows without end
towards it, and sweeps find no stages but where these are moved onto the constraints.
"""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from conftest import MODULES, Modules, tiers
from constrained import error_of, system

import eomc
from eomc.model.from_scene import from_scene
from eomc.scene.read import parse

pytestmark = pytest.mark.usefixtures("quickly_compiled")
N1, N2 = "iftomm_A02_four_bar_N1", "iftomm_A02_four_bar_N2"

# Sarrus' linkage: two chains of hinges, across one another, that lift a plate; it folds flat
SARRUS = """
eomc = 1
name = "sarrus"
gravity = [0, 0, -9.81]
[coordinates]
a = { start = "-pi/6", rate = 0.5 }
b = { start = "pi/3", guess = true }
c = { start = "-pi/6", guess = true }
d = { start = "pi/6", guess = true }
e = { start = "-pi/3", guess = true }
[[loop]]
name = "hinge"
joint = "revolute"
bodies = ["d", "plate"]
points = [[0, -1, 0], [-1, 1, 0]]
axis = [1, 0, 0]
[run]
duration = 1.0
tolerance = 1e-10
"""
BARS = (  # name, coordinate, parent, offset, axis, centre of mass
    ("low", "a", "", (0, 0, 0), (0, 1, 0), (0.5, 0, 0)),
    ("high", "b", "low", (1, 0, 0), (0, 1, 0), (-0.5, 0, 0)),
    ("plate", "c", "high", (-1, 0, 0), (0, 1, 0), (-0.2, 0, 0)),
    ("b", "d", "", (-1, 1, 0), (1, 0, 0), (0, 0.5, 0)),
    ("d", "e", "b", (0, 1, 0), (1, 0, 0), (0, -0.5, 0)),
)


@pytest.fixture(
    scope="module",
    params=tiers([f"{n} {f}" for n in (N1, N2) for f in ("fast", "plain")], f"{N1} fast"),
)
def case(
    request: pytest.FixtureRequest, modules: Modules, unoptimised_file: None
) -> tuple[str, ModuleType]:
    """Its name, and the module of a form."""
    name, form = request.param.split()
    made = system(name)
    made = replace(made, run=replace(made.run, methods=("rk4", "gauss16"), tolerance=1e-9))
    if form == "fast":
        return name, modules.unoptimised(made)
    return name, eomc.load(made, MODULES.parent / "passages", form="plain")


@pytest.mark.parametrize("tol", [1e-4, 1e-6, 1e-9, 1e-11, 1e-12])
def test_steps_that_fit_a_tolerance_end_where_the_reference_does(
    case: tuple[str, ModuleType], tol: float
) -> None:
    name, module = case
    run = module.simulate(tol=tol)
    assert run.status == "ok" and run.steps < 120
    assert error_of(name, run.q[-1]) < 10 * tol


def test_they_get_through_from_anywhere(case: tuple[str, ModuleType]) -> None:
    """However near to a stage or a step's end the flat position is met."""
    _, module = case
    q, qd = module.start
    for part in np.random.default_rng(0).uniform(0.7, 1.3, 60):
        run = module.simulate(q0=q, qd0=part * qd, tol=1e-9)
        assert run.status == "ok" and np.ptp(run.energy) < 3e-8


def test_states_between_are_as_exact(case: tuple[str, ModuleType]) -> None:
    _, module = case
    run, other = module.simulate(tol=1e-8), module.simulate(tol=1e-11)
    times = np.linspace(0, run.t[-1], 400)
    for a, b in zip(run(times), other(times), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-6)


def test_fifty_steps_of_gauss16_do(case: tuple[str, ModuleType]) -> None:
    name, module = case
    run = module.simulate(method="gauss16", h=0.2, duration=10.0)
    assert run.status == "ok"
    assert error_of(name, run.q[-1]) < 1e-7


def test_their_error_is_found(case: tuple[str, ModuleType]) -> None:
    """The run beside it takes shorter steps, and where these find nothing its own."""
    name, module = case
    run = module.simulate(tol=1e-8)
    error = run.estimate()
    assert error.verdict == "" and error_of(name, run.q[-1]) < 10 * max(error.end.values())


@pytest.mark.slow
def test_sarrus_linkage_folds(modules: Modules) -> None:
    """Its end by RK4, which meets the flat position nowhere; its energy."""
    text = SARRUS
    for name, coordinate, parent, *places in BARS:
        text += f'[[body]]\nname = "{name}"\njoint = "revolute"\ncoordinates = "{coordinate}"\n'
        text += f'parent = "{parent}"\n' if parent else ""
        for key, place in zip(("offset", "axis", "center"), places, strict=True):
            text += f"{key} = {list(place)}\n"
        text += "mass = 1.0\ninertia = [0.05, 0.05, 0.08]\n"
    module = modules.unoptimised(from_scene(parse(text)))
    right = module.simulate(method="rk4", h=2.5e-4, duration=1.0)
    assert right.status == "ok" and np.sin(right["a"]).max() > 0.1 > -0.1 > np.sin(right["a"]).min()
    for tol in (1e-4, 1e-6, 1e-8, 1e-10, 1e-12):
        run = module.simulate(tol=tol)
        assert run.status == "ok" and run.steps < 60
        np.testing.assert_allclose(run.q[-1], right.q[-1], rtol=0, atol=1e-7 + 10 * tol)
        assert np.ptp(run.energy) < 1e-9 + 10 * tol * run.energy[0]
