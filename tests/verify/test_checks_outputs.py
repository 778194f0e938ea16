"""The check compares outputs with formulas evaluated with dual numbers, and detects errors."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.session import Modules

from eomc.mechanism.assembly import assembled
from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.verify import equations
from eomc.verify.comparison import Comparison

SCENE = """eomc = 1
name = "swing"
[coordinates]
a = { unit = "rad", start = 0.5 }
b = { unit = "rad", start = 0.2, rate = 0.3 }
[inputs]
u = { signal = "sin(t) - a_dot" }
[definitions]
y = "sin(a) + cos(a - b)/2"
[energy]
kinetic = "a_dot**2 + b_dot**2/2 + a_dot*b_dot*cos(a - b)/3"
potential = "-cos(a) - cos(b)"
[forces]
a = "u"
[outputs]
far = "dot(dot(y)) + u*t"
near = "y*exp(-b_dot)"
[run]
linearize = true
"""


class Wrong:
    """The module with something added to outputs, to C, or to derivatives by parameters."""

    def __init__(
        self, module: ModuleType, output: float = 0.0, C: float = 0.0, F: float = 0.0
    ) -> None:
        self._module, self._output, self._C, self._F = module, output, C, F

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)

    def output(self, *state: Any) -> Any:
        return self._module.output(*state) * [1, 1 + self._output]

    def linearize(self, *state: Any, **how: Any) -> Any:
        A, B, *CD = self._module.linearize(*state, **how)
        return A, B, *([CD[0] + self._C, CD[1]] if CD else [])

    def sensitivity(self, *state: Any, **how: Any) -> Any:
        E, F = self._module.sensitivity(*state, **how)
        return E, F + self._F


@pytest.mark.parametrize(
    ("wrong", "failed"),
    [({}, []), ({"output": 1e-11}, ["outputs"]), ({"C": 1e-7}, ["outputs: C, D"])],
)
def test_wrong_outputs_fail(modules: Modules, wrong: dict[str, float], failed: list[str]) -> None:
    system, module = from_scene(parse(SCENE, "test.toml")), modules.unoptimised(SCENE)
    comparison = Comparison(system, Wrong(module, **wrong), np.random.default_rng(0), None)
    results = comparison.report(equations.output_checks)
    assert [row.name for row in results] == ["outputs", "outputs: C, D"]
    assert [row.name for row in results if not row.passed] == failed, results


ON_A_ROD = """eomc = 1
name = "on_a_rod"
[coordinates]
x = { start = 0.6, rate = 0.3 }
y = { start = -0.8, guess = true }
[inputs]
u = {}
[energy]
kinetic = "x_dot**2 + y_dot**2"
potential = "9.81*y"
[forces]
x = "u"
[constraints]
rod = "x**2 + y**2 - 1"
[outputs]
far = "x_ddot"
pull = "-2*lambda_rod"
[run]
linearize = true
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "failed"),
    [
        ({}, []),
        ({"output": 1e-11}, ["outputs"]),
        ({"C": 1e-4}, ["outputs: C, D"]),
    ],
)
def test_wrong_outputs_of_multipliers_fail(
    modules: Modules, wrong: dict[str, float], failed: list[str]
) -> None:
    system, module = (
        assembled(from_scene(parse(ON_A_ROD, "test.toml"))),
        modules.unoptimised(ON_A_ROD),
    )
    comparison = Comparison(system, Wrong(module, **wrong), np.random.default_rng(0), None)
    results = comparison.report(equations.output_checks)
    assert [row.name for row in results if not row.passed] == failed, results


@pytest.mark.slow
def test_derivatives_by_parameters_that_jumps_change(modules: Modules) -> None:
    text = ON_A_ROD.replace('"x_dot**2 + y_dot**2"', '"m*(x_dot**2 + y_dot**2)"')
    text = text.replace("[inputs]", "[parameters]\nm = 1.5\n[inputs]").replace(
        "lambda_rod", "m*x*lambda_rod"
    )
    text += '[[event]]\nname = "sheds"\nwhen = "t - 1"\naction = "jump"\nm = "m/2"\n'
    system, module = assembled(from_scene(parse(text, "test.toml"))), modules.unoptimised(text)
    comparison = Comparison(system, module, np.random.default_rng(0), None)
    results = comparison.report(equations.output_checks)
    assert [row.passed for row in results] == [True, True], results


CANCELLING = """eomc = 1
name = "cancelling"
[coordinates]
x = { start = 0.2 }
[parameters]
k = 4.0
[inputs]
force = {}
[energy]
kinetic = "x_dot**2/2"
potential = "k*x**2/2"
[forces]
x = "force"
[outputs]
load = "k*x + x_ddot"
"""


def test_output_that_cancels_with_an_acceleration_passes(modules: Modules) -> None:
    system, module = from_scene(parse(CANCELLING, "test.toml")), modules.unoptimised(CANCELLING)
    comparison = Comparison(system, module, np.random.default_rng(0), None)
    results = comparison.report(equations.output_checks)
    assert {row.name: row.passed for row in results} == {"outputs": True}


@pytest.mark.parametrize("wrong", [{}, {"F": 1e-7}])
def test_wrong_derivatives_by_parameters_fail(modules: Modules, wrong: dict[str, float]) -> None:
    text = CANCELLING.replace('"k*x + x_ddot"', '"k*x**2 + k*x_ddot"\nside = "k*x"')
    text += '[run]\nlinearize = "parameters"\n'
    system, module = from_scene(parse(text, "test.toml")), modules.unoptimised(text)
    comparison = Comparison(system, Wrong(module, **wrong), np.random.default_rng(0), None)
    results = comparison.report(equations.output_checks)
    assert {row.name: row.passed for row in results} == {
        "outputs": True,
        "outputs: C, D": True,
        "outputs: by parameters": not wrong,
    }
