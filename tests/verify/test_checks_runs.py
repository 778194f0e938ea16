"""Checks of runs detect errors that only occur at particular states."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support.cases import scene_system
from support.compilation import Shipped
from support.fake_module import FakeModule
from support.forks import in_a_fork
from support.mutants import variant
from support.template_checks.runs import TURNS, RunChecks, largest_angle

from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.verify import symbolic
from eomc.verify.comparison import Comparison
from eomc.verify.runs import step_error
from eomc.verify.sampling import State

SYSTEM = variant("pendulum_gauss16")
STAGE = "x[k] = at[k][j];"


@pytest.fixture(scope="module")
def shipped(tmp_path_factory: pytest.TempPathFactory) -> Shipped:
    """The C of the double pendulum with rk4 and gauss16."""
    # Derive the reference once for all forked processes.
    symbolic.reference_for(SYSTEM).acceleration(*np.zeros((2, len(SYSTEM.q))))
    return Shipped(SYSTEM, tmp_path_factory.mktemp("runs"))


def evaluate_check(shipped: Shipped, source: str, row: Callable[[Comparison], object]) -> float:
    """Return the value of a check for changed C."""

    def measure() -> float:
        value = row(Comparison(SYSTEM, shipped.load(), np.random.default_rng(0), 4))
        assert isinstance(value, float)
        return value if math.isfinite(value) else 1e300

    assert shipped.compile(("-O0", "-march=native"), source) is None
    kind, value = in_a_fork(measure, 60)
    assert kind == "done" and isinstance(value, float), value
    return value


def test_unnecessary_refusal_of_a_step_fails() -> None:
    """The iteration of the method converges in the reference."""
    system = scene_system("mass_spring")
    module: Any = FakeModule(symbolic.derive(system))

    def refuse(*state: object, **how: object) -> None:
        fault = ArithmeticError("no convergence")
        fault.status = "no convergence"  # type: ignore[attr-defined]
        raise fault

    module.step = refuse
    comparison = Comparison(system, module, np.random.default_rng(0), 4)
    assert largest_step_error(comparison) == math.inf


def largest_step_error(of: Comparison) -> float:
    """Return the largest error of one step of gauss16, in units of rounding."""
    errors = (step_error(of, "gauss16", e, of.system.run.h) for e in of.few(4))
    return max(x for x in errors if x is not None)


GEARS = """eomc = 1
name = "gears"
[coordinates]
a = { start = 0.3 }
b = { start = 0.1, guess = true }
[energy]
kinetic = "a_dot**2/2 + b_dot**2/3"
potential = "cos(a)"
[constraints]
teeth = "a - 3*b"
"""


def test_large_angles_satisfy_gear_constraints() -> None:
    """For a - 3 b, three turns of a for one of b, up to their last digits."""
    system = from_scene(parse(GEARS, "gears.toml"))
    module: Any = FakeModule(symbolic.derive(system))
    runs = RunChecks(Comparison(system, module, np.random.default_rng(0), 4))
    turns = 2 * np.pi * np.round(TURNS / 2 / np.pi)
    for by, holds in (((3, 1), True), ((-3, -1), True), ((1, 1), False), ((1, -1), False)):
        assert (
            runs.constraints_hold(State(np.array([0.3, 0.1]) + turns * np.array(by), np.zeros(2)))
            == holds
        )
    for off, holds in ((1e-8, True), (1e-3, False)):  # digits of 2.5e7 are 4e-9
        q = np.array([0.3, 0.1]) + turns * np.array([3, 1]) + [off, 0]
        assert runs.constraints_hold(State(q, np.zeros(2))) == holds


PHASE = """eomc = 1
name = "phase"
[coordinates]
x = {}
[definitions]
late = "t*RATE"
z = "cos(ANGLE)"
[energy]
kinetic = "x_dot**2*(2 + z)"
[forces]
x = "z"
"""


def phase(angle: str, rate: str = "1") -> Any:
    """Return a scene with the cosine of an angle."""
    return from_scene(parse(PHASE.replace("ANGLE", angle).replace("RATE", rate), "phase.toml"))


@pytest.mark.parametrize("angle", ["late", "late**2", "late**3/12", "late**5", "exp(late/10)"])
def test_angles_are_compared_up_to_their_rounding(
    monkeypatch: pytest.MonkeyPatch, angle: str
) -> None:
    """A rounding error of the time is not an error of the module; 1e-9 is one."""
    monkeypatch.setattr(RunChecks, "far_steps", lambda *_: 0.0)  # those depend on the C code
    for rate, fails in (("(1 + 2**-52)", False), ("(1 + 1e-9)", True)):
        module: Any = FakeModule(symbolic.derive(phase(angle, rate)))
        system = phase(angle)
        runs = RunChecks(Comparison(system, module, np.random.default_rng(0), 4))
        assert (runs.far_angle_error() > runs.limit) == fails


def test_largest_angle_covers_all_formulas() -> None:
    at = State(np.array([2.0]), np.array([0.5]), 3.0)
    assert largest_angle(phase("late**3"))(at) == 27
    assert largest_angle(phase("late*x - 7*x_dot*sin(100*late)"))(at) == pytest.approx(300)
    assert largest_angle(phase("dot(late)*1e9"))(at) == 0  # a rate is not part of it


THROWN = """eomc = 1
name = "thrown"
[coordinates]
a = {}
[inputs]
u = {}
[energy]
kinetic = "a_dot**2/2"
potential = "cos(a)"
[forces]
a = "u - 5e4*a_dot"
"""


def test_inputs_are_compared_while_steps_are_stable() -> None:
    """A step of h times -5e4/s multiplies a velocity by 2.4e5."""
    system = from_scene(parse(THROWN, "thrown.toml"))
    module: Any = FakeModule(symbolic.derive(system))
    runs = RunChecks(Comparison(system, module, np.random.default_rng(0), 4))
    spread, at = np.array([[1.0], [1.0]]), State(np.zeros(1), np.array([1e-5]))
    steps, x, growth = runs.reference_run(at, np.zeros((6, 1)), spread)
    assert steps == 1
    assert 1 < x[1, 0] < 100 and 1e5 < growth < 1e6
    steps, x, _ = runs.reference_run(at, np.full((6, 1), 1e5), spread)
    assert (steps, x[1, 0]) == (0, 1e-5)


@pytest.mark.slow
def test_steps_of_every_method_are_compared_at_large_angles(shipped: Shipped) -> None:
    """There gauss16 evaluates stages one by one, in the code at the end of its iteration."""
    assert shipped.source.count(STAGE) == 1
    wrong = shipped.source.replace(STAGE, STAGE.replace("= at", "= -at"))
    assert (
        evaluate_check(shipped, shipped.source, lambda check: RunChecks(check).far_angle_error())
        < 10
    )
    assert (
        evaluate_check(shipped, wrong, lambda check: RunChecks(check).far_angle_error())
        > RunChecks.limit
    )


@pytest.mark.slow
def test_method_that_refuses_possible_steps_fails(shipped: Shipped) -> None:
    right, wrong = "double most = 0, change = 0, size;", "double most = 0, change = 1, size;"
    assert shipped.source.count(right) == 1
    assert evaluate_check(shipped, shipped.source, largest_step_error) < 10
    refusing = shipped.source.replace(right, wrong)
    assert evaluate_check(shipped, refusing, largest_step_error) == 1e300
