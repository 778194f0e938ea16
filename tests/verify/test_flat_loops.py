"""`check` of linkages that pass positions where their rows depend on each other."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import ModuleType

import numpy as np
import pytest
from conftest import Modules

from eomc.model.from_scene import from_scene
from eomc.model.system import System
from eomc.program.assembly import assembled
from eomc.scene.read import parse
from eomc.verify.check import check
from eomc.verify.checks_constraints import MAX_RESIDUAL, ConstraintChecks
from eomc.verify.checks_runs import SHORT_LIMIT, RunChecks
from eomc.verify.comparison import Comparison

CRANK = """
[[body]]
name = "crank{k}"
joint = "revolute"
coordinates = "q{k}"
offset = ["{at}*d", 0]
mass = 0.6
center = ["a/2", 0]
inertia = "0.05*a**2"
"""
LOOP = """
[[loop]]
name = "pin{k}"
joint = "revolute"
bodies = ["coupler", "crank{k}"]
points = [["{at}*d", 0], ["a", 0]]
"""
COUPLER = """
[[body]]
name = "coupler"
parent = "crank1"
joint = "revolute"
coordinates = "q2 - q1"
offset = ["a", 0]
mass = 1.5
center = ["d/2", 0]
inertia = "d**2/8"
"""
PLACES = {1: 0.0, 3: 1.0, 4: 0.5}  # of cranks, in parts of the coupler


def parallelogram(cranks: tuple[int, ...], start: float, rate: float) -> str:
    """Cranks of one length on one coupler, which goes flat where they do."""
    how = {k: f"start = {start}, {f'rate = {rate}' if k == 1 else 'guess = true'}" for k in cranks}
    return "\n".join(
        [
            'eomc = 1\nname = "parallelogram"\ngravity = [0, "-g"]\n[coordinates]',
            *(f'q{k} = {{ unit = "rad", {text} }}' for k, text in how.items()),
            'q2 = { unit = "rad", start = 0.0, guess = true }',
            "[parameters]\na = 0.5\nd = 1.0\ng = 9.81",
            *(CRANK.format(k=k, at=PLACES[k]) for k in cranks),
            COUPLER,
            *(LOOP.format(k=k, at=PLACES[k]) for k in cranks[1:]),
            "[run]\nh = 0.005\nduration = 5.0",
        ]
    )


RESTS, TURNS = ((1, 3, 4), 0.3, 0.0), ((1, 3), 0.5, 6.0)


@cache
def system(*of: object) -> System:
    return assembled(from_scene(parse(parallelogram(*of), "parallelogram.toml")))


def comparison(modules: Modules, *of: object, seed: int = 0) -> Comparison:
    made: ModuleType = modules.unoptimised(parallelogram(*of))
    return Comparison(system(*of), made, np.random.default_rng(seed), None)


@pytest.mark.slow
def test_an_advised_step_is_tried_from_starts_on_the_rows(modules: Modules) -> None:
    """Near the flat position: a start moved off the rows by 1e-6 has none on them near."""
    advice = comparison(modules, *TURNS).advice
    x, v = -5e-6, -3.6
    advice.stiffest_state = replace(advice.start, q=np.array([x, x, 0]), qd=np.array([v, v, 0]))
    _, grown = advice._ends("rk4", 0.001, 1)
    assert grown < 10


@pytest.mark.slow
def test_states_are_as_fast_as_the_motion(modules: Modules) -> None:
    """A turned start is assembled: a step's correction would throw it, to 70 rad/s."""
    assert comparison(modules, *TURNS).sampler.speed.max() < 12


@pytest.mark.slow
@pytest.mark.parametrize(("of", "seed"), [(TURNS, 1), (RESTS, 0)])
def test_roundings_that_grow_where_rows_fade_are_no_errors(
    of: tuple[object, ...], seed: int, modules: Modules
) -> None:
    made = comparison(modules, *of, seed=seed)
    runs, rows = RunChecks(made), ConstraintChecks(made, made.module)
    for found, limit in (
        (runs.short_step_error(), SHORT_LIMIT), (runs.long_step_error(), runs.limit),
        (rows.residual_along_run("rk4"), MAX_RESIDUAL),
    ):  # fmt: skip
        assert isinstance(found, float) and found <= limit
    runs.sine_error()  # which draws before it
    assert runs.far_angle_error() <= runs.limit


@pytest.mark.slow
@pytest.mark.parametrize("of", [RESTS, TURNS, ((1, 3), 0.05, -3.0), ((1, 3, 4), 0.5, 6.0)])
@pytest.mark.parametrize("seed", range(3))
def test_parallelograms_pass(of: tuple[object, ...], seed: int, modules: Modules) -> None:
    report = check(system(*of), modules.unoptimised(parallelogram(*of)), seed=seed)
    assert report.passed, report.table()
