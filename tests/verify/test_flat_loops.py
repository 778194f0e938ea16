"""`check` of linkages that pass positions with dependent constraints."""

from __future__ import annotations

from functools import cache
from types import ModuleType

import numpy as np
import pytest
from support.session import Modules
from support.template_checks import check_all
from support.template_checks.runs import SHORT_LIMIT, RunChecks

from eomc.mechanism.assembly import assembled
from eomc.model.system import System, from_scene
from eomc.scene.read import parse
from eomc.verify.comparison import Comparison
from eomc.verify.constraints import MAX_RESIDUAL, residual_along_run

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
PLACES = {1: 0.0, 3: 1.0, 4: 0.5}  # of cranks, in fractions of the coupler


def parallelogram(cranks: tuple[int, ...], start: float, rate: float) -> str:
    """Return cranks of equal length on one coupler, which all become collinear together."""
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
def system(*parameters: object) -> System:
    return assembled(from_scene(parse(parallelogram(*parameters), "parallelogram.toml")))


def comparison(modules: Modules, *parameters: object, seed: int = 0) -> Comparison:
    module: ModuleType = modules.unoptimised(parallelogram(*parameters))
    return Comparison(system(*parameters), module, np.random.default_rng(seed), None)


@pytest.mark.slow
def test_sampled_velocities_are_those_of_the_motion(modules: Modules) -> None:
    """A rotated start is assembled; a step's correction would accelerate it to 70 rad/s."""
    assert comparison(modules, *TURNS).sampler.speed.max() < 12


@pytest.mark.slow
@pytest.mark.parametrize(("of", "seed"), [(TURNS, 1), (RESTS, 0)])
def test_rounding_amplified_near_singular_positions_is_no_error(
    of: tuple[object, ...], seed: int, modules: Modules
) -> None:
    linkage_comparison = comparison(modules, *of, seed=seed)
    runs = RunChecks(linkage_comparison)
    residuals = [residual_along_run("rk4", linkage_comparison, e) for e in runs.starts]
    for error, limit in (
        (runs.short_step_error(), SHORT_LIMIT), (runs.long_step_error(), runs.limit),
        *((x, MAX_RESIDUAL) for x in residuals),
    ):  # fmt: skip
        assert isinstance(error, float) and error <= limit
    runs.sine_error()  # advances the random numbers
    assert runs.far_angle_error() <= runs.limit


@pytest.mark.slow
@pytest.mark.parametrize("of", [RESTS, TURNS, ((1, 3), 0.05, -3.0), ((1, 3, 4), 0.5, 6.0)])
@pytest.mark.parametrize("seed", range(3))
def test_check_of_parallelograms_passes(
    of: tuple[object, ...], seed: int, modules: Modules
) -> None:
    report = check_all(system(*of), modules.unoptimised(parallelogram(*of)), seed=seed)
    assert report.passed, report.table()
