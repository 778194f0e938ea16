"""Rows of runs are compared with single steps, as far as these converge."""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.session import Modules

from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.verify import runs
from eomc.verify.comparison import LIMIT, Comparison
from eomc.verify.sampling import State

QUARTIC = """eomc = 1
name = "well_of_fourth"
[coordinates]
x = { start = 1e-5, rate = 3e-5 }
[energy]
kinetic = "x_dot**2/2"
potential = "0.05*x**2 + 2e3*x**4"
[run]
method = "gauss8"
h = H
duration = 100.0
"""

pytestmark = pytest.mark.usefixtures("quickly_compiled")


class TruncatedRun:
    """The first rows of a run, with a relative error in one number of the last row."""

    def __init__(self, run: Any, rows: int, off: float) -> None:
        self.t, self.q, self.qd = run.t[:rows], run.q[:rows].copy(), run.qd[:rows].copy()
        self.q[-1, 0] *= 1 + off
        self.status = run.status if rows >= len(run) else "no convergence"


class TruncatingModule:
    """A module whose runs end early."""

    def __init__(self, module: ModuleType, rows: int, off: float = 0.0) -> None:
        self.module, self.rows, self.off = module, rows, off

    def simulate(self, **how: Any) -> TruncatedRun:
        return TruncatedRun(self.module.simulate(**how), self.rows, self.off)

    def step(self, *state: Any, **how: Any) -> Any:
        return self.module.step(*state, **how)


def compared(modules: Modules, text: str) -> Comparison:
    system, module = from_scene(parse(text, "q.toml")), modules.unoptimised(text)
    return Comparison(system, module, np.random.default_rng(0), 4)


def run_error(
    modules: Modules, h: str, rows: int, off: float = 0.0, text: str = QUARTIC
) -> float | None:
    of = compared(modules, text.replace("H", h))
    of.module = TruncatingModule(of.module, rows, off)
    return runs.run_error(of, "gauss8", of.expected[0], float(h), 24)


def test_run_that_ends_although_the_step_is_possible_fails(modules: Modules) -> None:
    right, wrong = run_error(modules, "0.1", 25), run_error(modules, "0.1", 25, 1e-9)
    assert right is not None and right < 1
    assert wrong is not None and wrong > 1e4
    assert run_error(modules, "0.1", 5) == math.inf


@pytest.mark.slow
def test_stages_without_convergence_are_not_required(modules: Modules) -> None:
    """The motion oscillates many times within a step, and is not linear."""
    error = run_error(modules, "30.0", 5)
    assert error is None or error < 1


def test_constant_inputs_have_the_shape_of_states() -> None:
    """Inputs are constant over a step, for each of its stages: (..., nu) with q of (..., nq)."""

    class Reference:
        def acceleration(self, q: Any, qd: Any, t: Any, u: Any, params: Any) -> Any:
            assert u.shape == (*q.shape[:-1], 1)
            return -q + u

    of: Any = Comparison.__new__(Comparison)
    of.reference = Reference()
    s = State(*np.zeros((2, 2)), u=np.array([0.5]))
    for shape in ((2,), (3, 2)):
        assert of.accelerations(s)(np.ones(shape), np.ones(shape), 0.0).shape == shape


FRICTION = """eomc = 1
name = "friction_of_third_power"
[coordinates]
x = { start = 0.5, rate = -0.5 }
[energy]
kinetic = "0.6*x_dot**2"
potential = "1.4e4*x*atan(x)"
[forces]
x = "-0.53*x_dot**3"
[run]
method = ["rk4", "gauss16"]
h = 0.02
"""


@pytest.mark.slow
def test_few_iterations_are_compared_with_short_steps(modules: Modules) -> None:
    """Optimised C stops after five iterations, as accurate as they are in steps of that length."""
    of = compared(modules, FRICTION)
    e, module = of.expected[0], of.module
    long = runs.run_error(of, "gauss16", e, 0.02)
    assert long is None or long > LIMIT
    least = runs.largest_run_error("gauss16", of, e)
    assert least is not None and least < LIMIT
    of.module = TruncatingModule(module, 100, 1e-9)
    wrong = runs.largest_run_error("gauss16", of, e)
    assert wrong is not None and wrong > LIMIT
