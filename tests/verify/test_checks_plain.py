"""Runs of both forms of C are compared as far as there is something to compare."""

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


class Ended:
    """A run of which the first rows are kept, one number of the last changed by a part of it."""

    def __init__(self, run: Any, rows: int, off: float) -> None:
        self.q, self.qd = run.q[:rows].copy(), run.qd[:rows].copy()
        self.q[-1, 0] *= 1 + off

    def __len__(self) -> int:
        return len(self.q)


class Plain:
    """A module whose runs end early."""

    def __init__(self, module: ModuleType, rows: int, off: float = 0.0) -> None:
        self.module, self.rows, self.off = module, rows, off

    def simulate(self, **how: Any) -> Ended:
        return Ended(self.module.simulate(**how), self.rows, self.off)


def compared(modules: Modules, h: str, rows: int, off: float = 0.0, text: str = QUARTIC) -> Any:
    text = text.replace("H", h)
    module = modules.unoptimised(text)
    made = Comparison(from_scene(parse(text, "q.toml")), module, np.random.default_rng(0), 4)
    return checks_plain._run_off(
        made, Plain(module, rows, off), "gauss8", made.expected[0], float(h)
    )


def test_a_form_that_ends_where_the_step_can_be_made_fails(modules: Modules) -> None:
    assert compared(modules, "0.1", 25) < 1
    assert compared(modules, "0.1", 25, 1e-9) > 1e4
    with pytest.raises(RuntimeError, match="24 steps of the fast form, 4 of plain"):
        compared(modules, "0.1", 5)


@pytest.mark.slow
def test_no_form_has_to_find_stages_that_nothing_finds_soon(modules: Modules) -> None:
    """Where the motion turns many times within a step, and is not linear in it."""
    assert compared(modules, "30.0", 5) < 1
    off = compared(modules, "30.0", 5, 1e-6)  # by the last step, which rounding may find or not
    assert off is None or off < 1
    linear = QUARTIC.replace("2e3*x**4", "0*x**4")
    with pytest.raises(RuntimeError, match="24 steps of the fast form, 4 of plain"):
        compared(modules, "30.0", 5, text=linear)
    assert compared(modules, "30.0", 25, 1e-6, linear) > 1e4


def test_steps_under_inputs_can_go_on_too() -> None:
    """Inputs are held over a step, for each of its stages: (..., nu) beside q of (..., nq)."""

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
def test_few_sweeps_are_compared_in_steps_so_short_that_they_do(modules: Modules) -> None:
    """The fast form leaves stages where five sweeps come to, as far as they were to settle."""
    module = modules.unoptimised(FRICTION)
    system = from_scene(parse(FRICTION, "f.toml"))
    plain = eomc.load(system, Path("build/tests/plain_sweeps"), form="plain")
    made = Comparison(system, module, np.random.default_rng(0), 4)
    long = checks_plain._run_off(made, plain, "gauss16", made.expected[0], 0.02 / 16)
    assert long is not None and long > LIMIT
    least = checks_plain._least_off(made, plain, "gauss16", made.expected[0])
    assert least is not None and least < LIMIT
    wrong = Plain(plain, 25, 1e-9)
    off = checks_plain._least_off(made, wrong, "gauss16", made.expected[0])
    assert off is not None and off > LIMIT


class Linear:
    """A module of which one entry of A is off by a part of it."""

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
def test_derivatives_that_cancel_to_nothing_are_compared_in_units_of_their_terms() -> None:
    """Of a rolling disk no angle's acceleration depends on where it points."""
    text = (SCENES / "rolling_disk.toml").read_text().replace("[run]", "[run]\nlinearize = true")
    system = from_scene(parse(text, "disk.toml"))
    plain = eomc.load(system, Path("build/tests/plain_disk"), form="plain")
    fast = eomc.load(system, Path("build/tests/fast_disk"), form="fast")
    made = Comparison(pipeline.assemble(system), fast, np.random.default_rng(0), 8)
    assert checks_plain._linearization(made, plain) < LIMIT
    for off in (1e-8, 1e-11):
        assert checks_plain._linearization(made, Linear(plain, off)) > LIMIT
