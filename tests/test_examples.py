"""The scripts of docs/examples run as documented."""

from __future__ import annotations

import importlib.util
import re
import runpy
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.session import ROOT

pytestmark = pytest.mark.usefixtures("unoptimised_file")
EXAMPLES = ROOT / "docs" / "examples"
FOLDER = ROOT / "build" / "tests" / "examples"  # their scenes are built there once
needs_gymnasium = pytest.mark.skipif(
    importlib.util.find_spec("gymnasium") is None, reason="gymnasium is not installed"
)
needs_scipy = pytest.mark.skipif(
    importlib.util.find_spec("scipy") is None, reason="SciPy is not installed"
)
needs_casadi = pytest.mark.skipif(
    importlib.util.find_spec("casadi") is None, reason="CasADi is not installed"
)
needs_jax = pytest.mark.skipif(
    importlib.util.find_spec("jax") is None, reason="JAX is not installed: pip install '.[jax]'"
)


@cache
def run_script(name: str) -> str:
    """Run a script without errors or warnings; return its output."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    process = subprocess.run(
        [sys.executable, "-W", "error", str(EXAMPLES / name)], cwd=FOLDER, capture_output=True,
        text=True,
    )  # fmt: skip
    assert (process.returncode, process.stderr) == (0, ""), process.stderr
    return process.stdout


def numbers(text: str, pattern: str) -> list[float]:
    """Return the groups of the pattern as numbers, for all matches in order."""
    matches = re.findall(pattern, text)
    assert matches, text
    return [float(x) for match in matches for x in ([match] if isinstance(match, str) else match)]


@needs_scipy
@pytest.mark.slow
def test_pole_is_balanced_within_the_limits() -> None:
    text = run_script("lqr.py")
    low, high = numbers(text, r"force between (\S+) and (\S+) N")
    assert low == -10 and high <= 10
    beyond, rows = numbers(text, r"at (\d+) of (\d+) rows")
    assert 0 < beyond < rows == 1201
    x, theta = numbers(text, r"x = (\S+) m, theta = (\S+) rad")
    assert abs(x) < 1e-3 and abs(theta) < 1e-3
    assert max(numbers(text.splitlines()[0], r"0\.\d+")) < 1
    assert numbers(text, r"exact to (\S+)")[0] < 1e-9


@pytest.mark.slow
@needs_scipy
def test_quadrotor_reaches_hover() -> None:
    text = run_script("quadrotor.py")
    assert text.startswith("12 states")
    end = np.array(numbers(text.partition("[")[2].partition("]")[0], r"(\S+)"))
    assert np.allclose(end, [0, 0, 1, 1, 0, 0, 0], atol=1e-3)
    assert all(x < 1e-9 for x in numbers(text, r"within (\S+), the run is exact to (\S+)"))


@pytest.mark.slow
@needs_scipy
def test_pole_is_swung_up() -> None:
    text = run_script("swing_up.py")
    assert numbers(text, r"upright from t = (\S+) s")[0] < 10
    x, y = numbers(text, r"tip is at (\S+) m, (\S+) m")
    assert abs(x) < 1e-3 and y == pytest.approx(1, abs=1e-3)
    assert 0 < numbers(text, r"saturated (\d+)%")[0] < 50


@needs_scipy
@pytest.mark.slow
def test_parameters_of_a_drive_are_identified() -> None:
    text = run_script("identification.py")
    errors = numbers(text.partition("errors in standard errors:")[2].splitlines()[0], r"(-?\d\.\d)")
    assert len(errors) == 5 and all(abs(x) < 4 for x in errors)
    assert 0 < numbers(text, r"k +(\S+) ±")[0] - 7.95 < 0.1
    assert numbers(text, r"noise (\S+) rad")[0] == pytest.approx(0.002, rel=0.05)
    assert (FOLDER / "drive_fit.png").exists()


@needs_casadi
@pytest.mark.slow
def test_model_predictive_control_keeps_the_double_pendulum_upright() -> None:
    text = run_script("mpc.py")
    assert "75 problems of 181 variables: Solve_Succeeded," in text
    mean, most = numbers(text, r"(\S+) iterations each, at most (\d+)")
    assert 3 <= mean <= most <= 12
    travel, force = numbers(text, r"up to (\S+) m, force up to (\S+) N")
    assert travel < 0.8 and 5 < force <= 30
    assert all(abs(x) < 0.05 for x in numbers(text, r"= (\S+) m, a1 = (\S+) rad, a2 = (\S+) rad"))


@pytest.mark.slow
def test_pole_is_swung_up_by_ilqr() -> None:
    text = run_script("ilqr.py")
    count, cost, force = numbers(text, r"(\d+) iterations, cost (\S+), force up to (\S+) N")
    assert count < 150 and cost < 3.2 and force <= 9.5
    x, theta = numbers(text, r"x = (\S+) m, theta = (\S+) rad")
    assert abs(x) < 0.02 and abs(theta) < 0.02
    own, without = numbers(text, r"theta = (\S+) rad, without feedback (\S+) rad")
    assert abs(own) < 0.1 < abs(without)


@needs_jax
@pytest.mark.slow
def test_policy_gradient_learns_to_balance() -> None:
    text = run_script("policy_gradient.py")
    first, last = numbers(text, r"cost (\S+) before and (\S+) after")
    assert first > 1 and last < 0.1
    x, theta = numbers(text, r"x = (\S+) m, theta = (\S+) rad")
    assert abs(x) < 0.2 and abs(theta) < 0.02


@pytest.mark.slow
def test_region_of_attraction_shrinks_for_a_heavier_pole() -> None:
    lines = np.reshape(numbers(run_script("sweep.py"), r"(\S+) kg: up to (\S+) rad"), (-1, 2))
    assert lines[:, 0].tolist() == pytest.approx(np.linspace(0.1, 0.8, 8))
    assert np.all(np.diff(lines[:, 1]) < 0) and 0.2 < lines[-1, 1] < lines[0, 1] < 1


@needs_gymnasium
@pytest.mark.slow
def test_feedback_balances_many_poles() -> None:
    text = run_script("vector_env.py")
    assert text.startswith("observed: cart tip_x tip_y speed turn swing")
    by_chance, by_feedback = numbers(text, r"forces: (\S+) falls[^:]*feedback: (\S+) falls")
    assert by_chance > 3 and by_feedback < 0.1


@needs_gymnasium
def test_environment_satisfies_gymnasium(monkeypatch: pytest.MonkeyPatch) -> None:
    from gymnasium.wrappers.vector import RecordEpisodeStatistics

    FOLDER.mkdir(parents=True, exist_ok=True)
    monkeypatch.chdir(FOLDER)
    namespace = runpy.run_path(str(EXAMPLES / "vector_env.py"))
    poles = namespace["CartPoles"](8)
    env = RecordEpisodeStatistics(poles)
    first, _ = env.reset(seed=3)
    assert poles.observation_space.contains(first)
    assert np.array_equal(env.reset(seed=3)[0], first)
    push = np.full((8, 1), 10.0)
    assert poles.action_space.contains(push)
    for _ in range(60):
        observation, rewards, over, late, info = env.step(push)
        assert poles.observation_space.contains(observation) and rewards.shape == over.shape == (8,)
        if over.any():
            break
    assert over.any() and not late.any()
    lean = np.arccos(info["final_obs"][:, 2])
    assert np.array_equal(lean > 0.5, over) and np.all(np.arccos(observation[over, 2]) < 0.1)
    assert info["episode"]["l"][over].min() > 5


@pytest.mark.slow
def test_path_of_the_tip_is_in_the_file() -> None:
    text = run_script("tip_path.py")
    table = np.genfromtxt(FOLDER / "path.csv", delimiter=",", names=True)
    (x, y, fastest), (change,) = (
        numbers(text, r"x = (\S+) m, y = (\S+) m; fastest (\S+)"),
        numbers(text, r"changed by (\S+) J"),
    )
    assert len(table) == 251 and change < 1e-5
    assert (table["x"][-1], table["y"][-1]) == pytest.approx((x, y), abs=1e-6)
    assert table["speed"].max() == pytest.approx(fastest, abs=1e-3)
    upper, lower = table["upper_angle"], table["upper_angle"] + table["lower_angle"]
    assert table["x"] == pytest.approx(np.sin(upper) + np.sin(lower), abs=1e-12)
    assert table["y"] == pytest.approx(-np.cos(upper) - np.cos(lower), abs=1e-12)


@pytest.mark.skipif(
    not all(map(importlib.util.find_spec, ("fmpy", "pythonfmu3"))),
    reason="FMPy and PythonFMU3 are not installed: pip install '.[fmu]'",
)
@pytest.mark.slow
def test_controller_in_another_fmu_balances_the_arm() -> None:
    text = run_script("fmu_pid.py")
    angle, highest = numbers(text, r"at (\S+) rad, at most (\S+);")
    assert angle == pytest.approx(1.2, abs=1e-3) and 1.2 < highest < 1.5
    motor, weight = numbers(text, r"holds (\S+) N m, the weight pulls (\S+) N m")
    assert motor == pytest.approx(weight, abs=1e-2)
    assert weight == pytest.approx(1.5 * 9.81 * 0.5 * np.sin(angle), abs=1e-3)
    assert text.strip() in (ROOT / "docs" / "fmu.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_arm_is_controlled_against_a_push(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco", reason="robot files come with pip install '.[robots]'")
    from robots.test_robots_mujoco import robot_data

    file = robot_data("/ur5_robot.urdf")
    (tmp_path / file.name).write_bytes(file.read_bytes())
    monkeypatch.chdir(tmp_path)
    script = EXAMPLES / "arm.py"
    first, second = re.findall(
        r"^    (eomc import .*)\n    (printf .*)$", script.read_text(), re.M
    )[0]
    eomc = f"{sys.executable} -m {first}"
    for command in (eomc, second, f"{sys.executable} -W error {script} ur5.toml"):
        process = subprocess.run(command, shell=True, capture_output=True, text=True)
        assert process.returncode == 0, process.stderr
    assert numbers(process.stdout, r"then: (\S+) rad")[0] < 1e-10
    assert numbers(process.stdout, r"f to (\S+) N m")[0] < 1e-12
    assert "[ 0.   0.   0.1  0.   0.   0. ]" in process.stdout.replace("-0. ", " 0. ")


def test_script_without_its_scene_prints_its_usage() -> None:
    words = [sys.executable, EXAMPLES / "arm.py"]
    process = subprocess.run(words, capture_output=True, text=True, check=False)
    assert process.returncode == 1 and "python docs/examples/arm.py ur5.toml\n" in process.stderr
    assert "Traceback" not in process.stderr


def test_documentation_names_every_example() -> None:
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    for file in sorted(EXAMPLES.iterdir()):
        assert f"](examples/{file.name})" in text, file.name


def test_examples_are_self_contained() -> None:
    """Each example says how to run it and has its scene in the same folder."""
    for file in sorted(EXAMPLES.glob("*.py")):
        how = "pythonfmu3 build -f" if file.name.endswith("_unit.py") else "python"
        assert f"{how} docs/examples/{file.name}" in file.read_text(encoding="utf-8")
    assert Path(EXAMPLES / "balance.toml").is_file()
