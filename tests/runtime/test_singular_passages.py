"""Passage through singular positions: IFToMM's four-bar A02 lies flat twice a turn.

There the constraints are dependent: towards it, velocity errors grow without bound in the
accelerations, and fixed-point iteration converges only if stages are projected onto constraints.
"""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from support.constraint_cases import error_of, system
from support.session import MODULES, Modules, tiers

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse

pytestmark = pytest.mark.usefixtures("quickly_compiled")
N1, N2 = "iftomm_A02_four_bar_N1", "iftomm_A02_four_bar_N2"

# Sarrus' linkage: two crossed chains of hinges that lift a plate; it folds flat
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
    """Return the case's name and its module in one form of C."""
    name, form = request.param.split()
    linkage = system(name)
    linkage = replace(linkage, run=replace(linkage.run, methods=("rk4", "gauss16"), tolerance=1e-9))
    if form == "fast":
        return name, modules.unoptimised(linkage)
    return name, eomc.load(linkage, MODULES.parent / "passages", form="plain")


@pytest.mark.parametrize("tol", [1e-4, 1e-6, 1e-9, 1e-11, 1e-12])
def test_adaptive_steps_end_at_the_reference(case: tuple[str, ModuleType], tol: float) -> None:
    name, module = case
    run = module.simulate(tol=tol)
    assert run.status == "ok" and run.steps < 120
    assert error_of(name, run.q[-1]) < 10 * tol


def test_passage_succeeds_from_any_speed(case: tuple[str, ModuleType]) -> None:
    """The flat position may be arbitrarily close to a stage or to the end of a step."""
    _, module = case
    q, qd = module.start
    for part in np.random.default_rng(0).uniform(0.7, 1.3, 60):
        run = module.simulate(q0=q, qd0=part * qd, tol=1e-9)
        assert run.status == "ok" and np.ptp(run.energy) < 3e-8


def test_interpolated_states_are_as_accurate(case: tuple[str, ModuleType]) -> None:
    _, module = case
    run, fine = module.simulate(tol=1e-8), module.simulate(tol=1e-11)
    times = np.linspace(0, run.t[-1], 400)
    for a, b in zip(run(times), fine(times), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-6)


def test_fifty_steps_of_gauss16_pass(case: tuple[str, ModuleType]) -> None:
    name, module = case
    run = module.simulate(method="gauss16", h=0.2, duration=10.0)
    assert run.status == "ok"
    assert error_of(name, run.q[-1]) < 1e-7


def test_error_is_estimated_across_singular_positions(case: tuple[str, ModuleType]) -> None:
    """The comparison run takes shorter steps; where these fail, it takes the run's own steps."""
    name, module = case
    run = module.simulate(tol=1e-8)
    error = run.estimate()
    assert error.verdict == "" and error_of(name, run.q[-1]) < 10 * max(error.end.values())


@pytest.mark.slow
def test_sarrus_linkage_folds(modules: Modules) -> None:
    """Compare its end with RK4, whose steps miss the flat position, and check the energy."""
    text = SARRUS
    for name, coordinate, parent, *places in BARS:
        text += f'[[body]]\nname = "{name}"\njoint = "revolute"\ncoordinates = "{coordinate}"\n'
        text += f'parent = "{parent}"\n' if parent else ""
        for key, place in zip(("offset", "axis", "center"), places, strict=True):
            text += f"{key} = {list(place)}\n"
        text += "mass = 1.0\ninertia = [0.05, 0.05, 0.08]\n"
    module = modules.unoptimised(from_scene(parse(text)))
    expected = module.simulate(method="rk4", h=2.5e-4, duration=1.0)
    assert (
        expected.status == "ok"
        and np.sin(expected["a"]).max() > 0.1 > -0.1 > np.sin(expected["a"]).min()
    )
    for tol in (1e-4, 1e-6, 1e-8, 1e-10, 1e-12):
        run = module.simulate(tol=tol)
        assert run.status == "ok" and run.steps < 60
        np.testing.assert_allclose(run.q[-1], expected.q[-1], rtol=0, atol=1e-7 + 10 * tol)
        assert np.ptp(run.energy) < 1e-9 + 10 * tol * run.energy[0]
