"""Test derivatives of roots at zero: finite where the limit exists, otherwise refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from support.session import Modules

from eomc.derive import lagrange
from eomc.model.system import System
from eomc.program import program
from eomc.program.ir import evaluate

PARAMETERS = {"c": 0.1, "n": 1.5, "k": 2.0}
FLAT = {  # all derivatives are 0 where x < 0 and the other variables are 0
    "-c*speed*x_dot": "drag in the plane",
    "-c*speed**0.5*x_dot": "a root of a root, times 0",
    "-c*(x_dot**2 + y_dot**2)**0.25*y_dot": "the same in one power",
    "-c*sqrt(x_dot**2 + 4*y_dot**2)": "a norm, as abs has it",
    "-c*abs(x_dot)*x_dot": "",
    "-c*abs(x_dot)**1.5": "",
    "-c*abs(y)**0.5*y": "",
    "-y_dot*sqrt(k*abs(y_dot))": "",
    "sqrt(max(x, 0))": "flat where x < 0",
    "max(x, 0)**0.25": "",
    "sqrt(k*max(x, 0))*y_dot": "",
    "sqrt(y**3)": "",
}
STEEP = (  # infinite, or without a limit
    "sqrt(y)", "sqrt(abs(y))", "abs(y_dot)**0.25", "sqrt(max(y, 0))", "speed**0.5",
    "(x_dot**2 + y_dot**2)**0.25", "-sqrt(k*abs(y_dot))", "y**0.75", "(1 + y)*sqrt(y)",
    "k*sqrt(y)*1e-6",
)  # fmt: skip


def system(law: str, **options: Any) -> System:
    """Return a point in the plane under a force along x."""
    return System.make(
        "rooted", {"x": -1.0, "y": 0.0}, "(x_dot**2 + y_dot**2)/2", "0",
        parameters=PARAMETERS, definitions={"speed": "sqrt(x_dot**2 + y_dot**2)"},
        forces={"x": law}, linearize="parameters", **options,
    )  # fmt: skip


def derivatives(law: str, real: str, state: dict[str, float]) -> np.ndarray:
    """Return d(xdd)/d(q, qd), then d(xdd)/dp, at a state whose other variables are 0."""
    functions_of_program = program.build(lagrange.derive(system(law, real=real)))
    full_state = {"x": -1.0, "y": 0.0, "x_dot": 0.0, "y_dot": 0.0, "t": 0.0, **PARAMETERS, **state}
    results = [
        evaluate(functions_of_program.functions[name], full_state)[0]
        for name in ("linearization", "sensitivity")
    ]
    values = np.array([*results[0][:4], *results[1][: len(PARAMETERS)]])
    if not np.isfinite(values).all():
        raise ArithmeticError(values)
    return values


@pytest.mark.parametrize("law", FLAT)
def test_derivatives_whose_limit_is_zero_are_zero(law: str) -> None:
    for real in ("double", "float"):
        assert derivatives(law, real, {}) == pytest.approx(np.zeros(7), abs=1e-30)


@pytest.mark.parametrize("law", STEEP)
def test_derivatives_that_are_infinite_are_not_finite(law: str) -> None:
    with pytest.raises((ArithmeticError, ValueError)):
        derivatives(law, "double", {})


@pytest.mark.parametrize("law", [*FLAT, *STEEP])
def test_derivatives_away_from_zero_agree_with_differences(law: str) -> None:
    state = {"x": 0.7, "y": 0.4, "x_dot": -0.3, "y_dot": 0.6}
    result, h = derivatives(law, "double", state), 1e-5
    acceleration = program.build(lagrange.derive(system(law))).functions["acceleration"]

    def force(**changes: float) -> float:
        return evaluate(acceleration, {"t": 0.0, **PARAMETERS, **state, **changes})[0][0]

    whole = {**state, **PARAMETERS}
    by_difference = [
        (force(**{name: whole[name] + h}) - force(**{name: whole[name] - h})) / (2 * h)
        for name in ("x", "y", "x_dot", "y_dot", *PARAMETERS)
    ]
    assert result == pytest.approx(np.array(by_difference), abs=1e-8)


def test_root_derivatives_in_c_in_steps_and_in_outputs(modules: Modules) -> None:
    module = modules.unoptimised(
        System.make(
            "flat_roots", {"x": -1.0, "y": 0.0}, "(x_dot**2 + y_dot**2)/2", "0",
            parameters={"c": 0.1, "n": 1.5}, definitions={"speed": "sqrt(x_dot**2 + y_dot**2)"},
            forces={
                "x": "-c*speed*x_dot + sqrt(max(x, 0)) + max(x, 0)**n",
                "y": "-c*speed*y_dot - abs(y_dot)**n*y_dot*max(x, 0)",
            },
            outputs={"drag": "c*speed*y_dot", "flow": "sqrt(max(y, 0))"},
            linearize="parameters", discretize=True,
        )
    )  # fmt: skip
    A, _, C, _ = module.linearize([-1, -1], [0, 0], outputs=True)
    assert np.array_equal(A[2:], np.zeros((2, 4))) and np.array_equal(C, np.zeros((2, 4)))
    assert np.array_equal(module.sensitivity([-1, -1], [0, 0]), np.zeros((2, 2)))
    Phi, _ = module.discretize([-1, 0], [0, 0], 0.1)
    assert Phi == pytest.approx(np.eye(4) + 0.1 * np.eye(4, k=2))
    A, _, C, _ = module.linearize([-1, 0], [0.3, -0.4], outputs=True)
    assert A[2:, 2:] == pytest.approx(-0.1 * np.array([[0.68, -0.24], [-0.24, 0.82]]))
    assert not math.isfinite(C[1, 1])  # the derivative of sqrt(max(y, 0)) at its kink
    with pytest.raises(module.MotionError, match="a derivative is not finite there"):
        module.linearize([0, 0], [0, 0])
