"""Sines and cosines near their zeros, where an error of 1e-17 in the angle reduction shows."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.cases import scene_system
from support.session import Modules
from support.template_checks.runs import VANISHING_LIMIT, largest_error_near_zeros

import eomc
from eomc.verify.comparison import Comparison, Measurement


class ModuleWithChangedD:
    """A module whose D is changed by a function."""

    def __init__(self, module: Any, bend: Callable[[np.ndarray, float], np.ndarray]) -> None:
        self.module, self.bend = module, bend

    def __getattr__(self, name: str) -> Any:
        return getattr(self.module, name)

    def D(self, q: Any, **how: Any) -> Any:
        return self.bend(np.array(self.module.D(q, **how)), float(q[1]))


def shifted(D: np.ndarray, _: float) -> np.ndarray:
    return D + np.array([[0, 3e-17], [3e-17, 0]])


def stretched(D: np.ndarray, _: float) -> np.ndarray:
    return np.asarray(D * [[1, 1.0001], [1.0001, 1]])


def noisy(D: np.ndarray, theta: float) -> np.ndarray:
    by = 1e-16 * (math.frexp(theta)[0] * 2**53 % 3 - 1)
    return D + np.array([[0, by], [by, 0]])


@pytest.mark.parametrize(
    "bend, wrong", [(lambda D, _: D, False), (shifted, True), (stretched, True), (noisy, False)]
)
def test_entry_that_is_a_cosine_is_judged_separately(
    modules: Modules, bend: Callable[[np.ndarray, float], np.ndarray], wrong: bool
) -> None:
    """Rounding errors of a cancelling sum are not errors of the sine."""
    module = ModuleWithChangedD(modules("cartpole"), bend)
    error = largest_error_near_zeros(
        Comparison(scene_system("cartpole"), module, np.random.default_rng(0), 4)
    )
    assert isinstance(error, float)
    assert (
        error > 1e6 * VANISHING_LIMIT
        if wrong and bend is shifted
        else (error > VANISHING_LIMIT) == wrong
    )


@pytest.mark.parametrize(
    "size, near, judged", [(1e-17, 0, False), (1e-9, 1, False), (1e-9, 0, True)]
)
def test_remainder_of_a_cancelling_sum_is_not_a_cosine(
    modules: Modules, size: float, near: float, judged: bool
) -> None:
    """g[0] of the reference is 0, and here a small multiple of cos(theta); or only at large
    angles.
    """
    check = Comparison(scene_system("cartpole"), modules("cartpole"), np.random.default_rng(0), 4)
    right = check.reference.evaluate

    def evaluate(name: str, q: Any, *rest: Any) -> Any:
        values = np.array(right(name, q, *rest))
        if name == "g":
            values[..., 0] += size * np.cos(q[..., 1]) + near * (np.abs(q[..., 1]) < 100)
        return values

    check.reference = SimpleNamespace(evaluate=evaluate)  # type: ignore[assignment]
    error = largest_error_near_zeros(check)
    assert isinstance(error, float) and (error > VANISHING_LIMIT) == judged


FIVE_BAR = (
    """eomc = 1
name = "five_bar"
gravity = [0, "-g"]
[coordinates]
q1 = { unit = "rad", start = 1.8 }
q2 = { unit = "rad", start = 0.6, guess = true }
q3 = { unit = "rad", start = 1.2 }
q4 = { unit = "rad", start = 2.5, guess = true }
[parameters]
a = 0.6
b = 1.06
c = 0.6
e = 0.94
d = 0.65
m = 1.59
g = 9.81
"""
    + "".join(
        f"""[[body]]
name = "{name}"
{parent}joint = "revolute"
coordinates = "{q}"
offset = {offset}
mass = "m"
center = ["{length}/2", 0]
inertia = "m*{length}**2/12"
"""
        for name, parent, q, offset, length in (
            ("one", "", "q1", "[0, 0]", "a"),
            ("two", 'parent = "one"\n', "q2 - q1", '["a", 0]', "b"),
            ("three", "", "q3", '["d", 0]', "c"),
            ("four", 'parent = "three"\n', "q4", '["c", 0]', "e"),
        )
    )
    + """[[loop]]
name = "pin"
joint = "revolute"
bodies = ["two", "four"]
points = [["b", 0], ["e", 0]]
"""
)


@pytest.mark.slow
def test_sines_of_angle_differences_are_not_judged(tmp_path: Path) -> None:
    """The rounding of a large q2 - q1 is equal at neighbours, and differs when others change."""
    (tmp_path / "five_bar.toml").write_text(FIVE_BAR, encoding="utf-8")
    system = eomc.read(tmp_path / "five_bar.toml")
    module = eomc.load(system, tmp_path / "build")
    errors = [
        largest_error_near_zeros(Comparison(system, module, np.random.default_rng(k), 4))
        for k in range(12)
    ]
    assert all(isinstance(x, float) and x <= VANISHING_LIMIT for x in errors), errors


@pytest.mark.slow
def test_nothing_is_judged_without_an_entry_that_is_a_sine(modules: Modules) -> None:
    comparison = Comparison(scene_system("chain"), modules("chain"), np.random.default_rng(0), 4)
    measurement = largest_error_near_zeros(comparison)
    assert isinstance(measurement, Measurement) and measurement.why
