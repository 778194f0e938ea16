"""Adaptive steps across jumps and kinks of forces: there too the tolerance bounds the error."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support.compilation import STRICT, compiled
from support.nonsmooth_cases import BOUNCING, CASES, PENDULUM, RUBBED, rubbed
from support.session import Modules, needs, tiers

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse

TOLERANCES = (1e-3, 1e-6, 1e-9, 1e-12)
SLIDING = RUBBED.replace("mu*sign(x_dot)", "30*sign(x_dot + x)").replace("rubbed", "sliding")


@pytest.fixture(scope="module")
def bouncing(modules: Modules) -> ModuleType:
    """A body on a stiff spring that only pushes."""
    return modules.unoptimised(BOUNCING)


@pytest.mark.parametrize("name", tiers(CASES, "limits", "sign"))
def test_error_at_end_is_about_the_tolerance(name: str, modules: Modules) -> None:
    case = CASES[name]
    module = modules.unoptimised(case.text)
    q0, _ = module.start
    for start in np.random.default_rng(5).uniform(*case.starts, 12):
        end = case.end(start)
        for tol in TOLERANCES:
            run = module.simulate(q0=[start, *q0[1:]], tol=tol)
            assert run.status == "ok" and abs(run.q[-1, 0] - end) < 10 * tol, (start, tol)


def test_small_force_jumps_are_resolved(modules: Modules) -> None:
    """The smooth force reaches 32."""
    module = modules.unoptimised(RUBBED)
    for start in np.random.default_rng(3).uniform(0.5, 2.0, 12):
        for mu in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
            for tol in TOLERANCES:
                run = module.simulate(q0=[start], tol=tol, params={"mu": mu})
                assert abs(run.q[-1, 0] - rubbed(start, mu)) < 10 * tol, (start, mu, tol)


def test_run_with_many_kinks_is_not_taken_for_chattering(modules: Modules) -> None:
    """Six hundred periods of a spring that is stiffer on one side."""
    text = RUBBED.replace("8*x**2", "0").replace("-mu*sign(x_dot)", "-1e6*x - 3e5*abs(x)")
    module = modules.unoptimised(text.replace("rubbed", "two_sided"))
    period = np.pi / np.sqrt(1.3e6) + np.pi / np.sqrt(7e5)
    run = module.simulate([1.0], tol=1e-7, duration=600 * period)
    assert run.status == "ok" and abs(run.q[-1, 0] - 1) < 1e-4


@pytest.mark.parametrize("width", tiers([1e-2, 1e-3], 1e-2))
def test_smoothed_friction_is_resolved_like_a_kink(width: float, modules: Modules) -> None:
    """Compare with steps short against the smoothing width; 0.01 suits a joint's friction."""
    text = RUBBED.replace("[energy]", "w = 0.01\n[energy]")
    text = text.replace("sign(x_dot)", "tanh(x_dot/w)").replace("rubbed", "softly_rubbed")
    module = modules.unoptimised(text)
    for start in (0.7, 1.0, 1.6):
        options = {"q0": [start], "params": {"w": width}}
        end = module.simulate(tol=1e-14, max_step=1e-3, **options).q[-1, 0]
        for tol in TOLERANCES:
            assert abs(module.simulate(tol=tol, **options).q[-1, 0] - end) < 10 * tol, (start, tol)


@pytest.mark.slow
@pytest.mark.usefixtures("quickly_compiled")
@pytest.mark.parametrize("name", tiers(CASES, "limits"))
def test_portable_form_resolves_kinks(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    module = eomc.load(from_scene(parse(case.text, "x.toml")), tmp_path, form="plain")
    for tol in TOLERANCES:
        run = module.simulate(tol=tol)
        assert abs(run.q[-1, 0] - case.end(module.start[0][0])) < 10 * tol, tol


def test_batch_equals_single_runs(bouncing: ModuleType) -> None:
    q0 = np.linspace(0.2, 1.0, 9)[:, None]
    times = [0.0, 1.3, 5.0]
    run = bouncing.simulate_batch(q0, np.zeros((9, 1)), tol=1e-9, times=times)
    for k in range(9):
        single = bouncing.simulate(q0[k], tol=1e-9, times=times)
        assert np.array_equal(run.q[k], single.q) and run.steps[k] == single.steps


def test_run_split_into_several_calls_is_identical(
    bouncing: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = bouncing.simulate()
    module = __import__(f"{bouncing.__name__}._runtime.integration", fromlist=["integration"])
    monkeypatch.setattr(module, "FIRST_CALL_STEPS", 1)
    monkeypatch.setattr(module, "MAX_STEPS_PER_CALL", 3)
    assert bouncing.simulate() == run


@pytest.mark.slow
def test_single_precision(modules: Modules) -> None:
    text = PENDULUM.replace("limited", "single").replace("1e-9", '1e-5\nreal = "float"')
    module, end = modules.unoptimised(text), CASES["limits"].end(1.0)
    for tol in (1e-3, 1e-4, 1e-5):
        assert abs(module.simulate(tol=tol).q[-1, 0] - end) < 10 * tol


@pytest.mark.parametrize(
    ("text", "mu"), tiers([(RUBBED, 3), (SLIDING, 0)], RUBBED), ids=["sticks", "slides"]
)
def test_forces_that_keep_jumping_end_the_run_early(text: str, mu: float, modules: Modules) -> None:
    module = modules.unoptimised(text)
    for tol in (1e-3, 1e-6, 1e-12):
        with pytest.warns(RuntimeWarning, match="stopped at t = "):
            run = module.simulate(tol=tol, params={"mu": mu})
        assert run.status == "no convergence" and run.steps + run.rejected < 20_000


STRIBECK = "-(1 + exp(-(x_dot/0.05)**2))*x_dot/(1 + 20*x_dot**2)/2"


@pytest.mark.slow
@pytest.mark.parametrize(
    "friction",
    ["-atan(x_dot/0.02)/3", "-x_dot/sqrt(x_dot**2 + 4e-4)/2", STRIBECK],
)
def test_steep_smoothed_friction_is_resolved(friction: str, modules: Modules) -> None:
    """Regression: the final error was 1e-3 or more at every tolerance."""
    text = RUBBED.replace("-mu*sign(x_dot)", friction).replace("rubbed", "smoothed")
    text = text.replace("[run]", '[run]\nmethod = "dp8"')
    module = modules.unoptimised(text)
    end = module.simulate(h=2e-5, method="dp8").x[-1]
    for tol in (1e-5, 1e-8, 1e-11):
        run = module.simulate(tol=tol)
        assert run.status == "ok" and np.abs(run.x[-1] - end).max() < 20 * tol


@pytest.mark.parametrize(
    ("potential", "force"),
    [
        pytest.param("sqrt(x**2 + 1e-6)", "0", marks=pytest.mark.slow),
        pytest.param("9.81*x + exp(-x/5e-4)/1000", "0", marks=pytest.mark.slow),
        pytest.param("x**2/2", "0.1/(1 + exp(-x/0.001))", marks=pytest.mark.slow),
        ("x**2/2", "0.1/(1 + exp(-(t - 2)/0.001))"),
    ],
)
def test_force_steep_in_position_or_time_is_resolved(
    potential: str, force: str, modules: Modules
) -> None:
    """Slowly decaying coefficients reveal it; a quadratic law was up to 1e6 tolerances off."""
    text = RUBBED.replace("-mu*sign(x_dot)", force).replace("8*x**2", potential)
    text = text.replace("[run]", '[run]\nmethod = "dp8"').replace("rubbed", "passing")
    module = modules.unoptimised(text)
    end = module.simulate(h=2e-5, method="dp8").x[-1]
    for tol in (1e-6, 1e-9):
        run = module.simulate(tol=tol)
        assert run.status == "ok" and np.abs(run.x[-1] - end).max() < 50 * tol


def test_kink_detection_is_compiled_only_for_non_smooth_scenes(tmp_path: Path) -> None:
    smooth = PENDULUM.replace("limits", "note").replace("[-1.5, 1.5]", '"free"')
    for text, expected in ((PENDULUM, True), (smooth, False)):
        files = eomc.sources(from_scene(parse(text, "x.toml")), "_x").files
        for name in ("limited_pendulum.c", "fast/limited_pendulum.c"):
            assert ("_kink_error" in files[name]) == expected
        for name in ("limited_pendulum.h", "limited_pendulum.c"):
            (tmp_path / name).write_text(files[name], encoding="utf-8")
        if expected:  # tests/c compiles scenes without kinks
            compiled(needs("gcc"), *STRICT, "-O1", "-c", "limited_pendulum.c", cwd=tmp_path)
