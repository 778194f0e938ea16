"""Runs of portable and optimised C are compared as far as both can be compared."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cases import SCENES
from conftest import Modules

import eomc
from eomc import pipeline
from eomc.model.from_scene import from_scene
from eomc.scene.read import parse
from eomc.verify import checks_plain
from eomc.verify.comparison import Comparison
from eomc.verify.report import LIMIT
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
        self.q, self.qd = run.q[:rows].copy(), run.qd[:rows].copy()
        self.q[-1, 0] *= 1 + off

    def __len__(self) -> int:
        return len(self.q)


class TruncatingModule:
    """A module whose runs end early."""

    def __init__(self, module: ModuleType, rows: int, off: float = 0.0) -> None:
        self.module, self.rows, self.off = module, rows, off

    def simulate(self, **how: Any) -> TruncatedRun:
        return TruncatedRun(self.module.simulate(**how), self.rows, self.off)


def run_error(modules: Modules, h: str, rows: int, off: float = 0.0, text: str = QUARTIC) -> Any:
    text = text.replace("H", h)
    module = modules.unoptimised(text)
    comparison = Comparison(from_scene(parse(text, "q.toml")), module, np.random.default_rng(0), 4)
    return checks_plain._run_off(
        comparison, TruncatingModule(module, rows, off), "gauss8", comparison.expected[0], float(h)
    )


def test_run_that_ends_although_the_step_is_possible_fails(modules: Modules) -> None:
    assert run_error(modules, "0.1", 25) < 1
    assert run_error(modules, "0.1", 25, 1e-9) > 1e4
    with pytest.raises(RuntimeError, match="24 steps of the fast form, 4 of plain"):
        run_error(modules, "0.1", 5)


@pytest.mark.slow
def test_stages_without_quick_convergence_are_not_required(modules: Modules) -> None:
    """The motion oscillates many times within a step, and is not linear."""
    assert run_error(modules, "30.0", 5) < 1
    off = run_error(modules, "30.0", 5, 1e-6)  # whether the last step converges depends on rounding
    assert off is None or off < 1
    linear = QUARTIC.replace("2e3*x**4", "0*x**4")
    with pytest.raises(RuntimeError, match="24 steps of the fast form, 4 of plain"):
        run_error(modules, "30.0", 5, text=linear)
    assert run_error(modules, "30.0", 25, 1e-6, linear) > 1e4


def test_steps_with_inputs_are_continued() -> None:
    """Inputs are constant over a step, for each of its stages: (..., nu) with q of (..., nq)."""

    def acceleration(q: Any, qd: Any, t: Any, u: Any, params: Any) -> Any:
        assert u.shape == (*q.shape[:-1], 1)
        return -q + u

    reference = SimpleNamespace(acceleration=acceleration)
    of: Any = SimpleNamespace(reference=reference)
    of.accelerations = partial(Comparison.accelerations, of)
    x, s = np.array([[0.3, -0.2], [0.1, 0.4]]), State(*np.zeros((2, 2)), u=np.array([0.5]))
    for method in ("rk4", "gauss8", "gauss16"):
        assert checks_plain._next_step_converges(of, method, s, x, 0.01, 3)


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
    module = modules.unoptimised(FRICTION)
    system = from_scene(parse(FRICTION, "f.toml"))
    plain = eomc.load(system, Path("build/tests/plain_sweeps"), form="plain")
    comparison = Comparison(system, module, np.random.default_rng(0), 4)
    long = checks_plain._run_off(comparison, plain, "gauss16", comparison.expected[0], 0.02 / 16)
    assert long is not None and long > LIMIT
    least = checks_plain._least_off(comparison, plain, "gauss16", comparison.expected[0])
    assert least is not None and least < LIMIT
    wrong = TruncatingModule(plain, 25, 1e-9)
    off = checks_plain._least_off(comparison, wrong, "gauss16", comparison.expected[0])
    assert off is not None and off > LIMIT


class WrongDerivative:
    """A module in which one entry of A has a relative error."""

    def __init__(self, module: ModuleType, off: float) -> None:
        self.module, self.off = module, off

    def linearize(self, *state: Any, **how: Any) -> tuple[Any, ...]:
        A, *rest = self.module.linearize(*state, **how)
        A = A.copy()
        k = np.unravel_index(np.argmax(np.abs(A)), A.shape)
        A[k] *= 1 + self.off
        return A, *rest

    def sensitivity(self, *state: Any, **how: Any) -> Any:
        return self.module.sensitivity(*state, **how)


@pytest.mark.slow
def test_cancelling_derivatives_are_compared_relative_to_their_terms() -> None:
    """The angular accelerations of a rolling disk do not depend on its heading."""
    text = (SCENES / "rolling_disk.toml").read_text().replace("[run]", "[run]\nlinearize = true")
    system = from_scene(parse(text, "disk.toml"))
    plain = eomc.load(system, Path("build/tests/plain_disk"), form="plain")
    fast = eomc.load(system, Path("build/tests/fast_disk"), form="fast")
    comparison = Comparison(pipeline.assemble(system), fast, np.random.default_rng(0), 8)
    assert checks_plain._linearization(comparison, plain) < LIMIT
    for off in (1e-8, 1e-11):
        assert checks_plain._linearization(comparison, WrongDerivative(plain, off)) > LIMIT
