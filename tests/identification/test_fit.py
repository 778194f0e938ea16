"""Estimates from simulated logs: exact derivatives, statistics, errors, the command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

import eomc
from eomc.base.errors import EomcError
from eomc.cli.main import main
from eomc.identification import FitArguments, Residuals

pytest.importorskip("scipy")
pytestmark = pytest.mark.usefixtures("unoptimised_file")

SCENE = """eomc = 1
name = "fitted"
title = "Driven pendulum"
[coordinates]
theta = { unit = "rad", start = "a/2", rate = 0.3 }
[parameters]
m = 1.2
l = { value = 0.8, unit = "m" }
a = 0.5
c = 0.1
[inputs]
push = { unit = "N", signal = "sin(3*t)" }
[energy]
kinetic = "m*l**2*theta_dot**2/2"
potential = "-9.81*m*l*cos(theta)"
dissipation = "c*theta_dot**2/2"
[forces]
theta = "push*l"
[outputs]
height = { formula = "-l*cos(theta)", unit = "m" }
pull = "m*theta_ddot + push*a"
[run]
h = 0.02
"""
TRUTH = {"m": 1.3, "l": 0.7, "a": 0.6, "c": 0.15}
TIMES = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.09, 60))
PUSH = np.random.default_rng(1).uniform(-4, 4, 60)
COLUMNS = ("theta", "theta_dot", "height", "pull")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fit")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of the scene; its path belongs to the identity of a build."""
    file = tmp_path_factory.mktemp("scene") / "fitted.toml"
    file.write_text(SCENE, encoding="utf-8")
    return file


def simulated_log(
    scene: Path, root: Path, noise: float = 0.0, seed: int = 0, columns: Any = COLUMNS,
    push: Any = PUSH,
) -> dict[str, Any]:  # fmt: skip
    """Return a log at uneven times with an input held between them, by short steps of RK4."""
    module: Any = eomc.load(scene, root)
    params, draws = TRUTH, np.random.default_rng(seed)
    q, qd, rows = np.array([TRUTH["a"] / 2]), np.array([0.3]), []
    for k, t in enumerate(TIMES):
        at = {"t": t, "u": [push[k]], "params": params}
        rows.append([q[0], qd[0], *module.output(q, qd, **at)])
        span = TIMES[k + 1] - t if k + 1 < len(TIMES) else 0.01
        run = module.simulate(q, qd, h=span / 20, steps=20, u=[push[k]], params=params, t0=t)
        q, qd = run.q[-1], run.qd[-1]
    values = dict(zip(COLUMNS, np.array(rows).T, strict=True))
    size = {name: 1.0 + 4 * (name == "pull") for name in COLUMNS}
    noisy = {n: values[n] + noise * size[n] * draws.standard_normal(len(TIMES)) for n in columns}
    return {"t": TIMES, "push": push, **noisy}


@pytest.fixture(scope="module")
def simulated(scene: Path, root: Path) -> dict[str, Any]:
    """The log without noise, simulated once."""
    return simulated_log(scene, root)


@pytest.fixture
def log(simulated: dict[str, Any]) -> dict[str, Any]:
    """A copy of the log without noise, which a test may change."""
    return {name: x.copy() for name, x in simulated.items()}


@pytest.fixture
def two_logs(log: dict[str, Any]) -> list[dict[str, Any]]:
    """The beginning and the end of the log, which overlap; the second has two columns less."""
    return [
        {name: x[:35] for name, x in log.items()},
        {name: x[30:] for name, x in log.items() if name not in ("height", "theta_dot")},
    ]


@pytest.mark.parametrize("inputs", ["table", "signals", "two logs"])
def test_jacobian_equals_differences(
    scene: Path, root: Path, log: dict[str, Any], two_logs: list[dict[str, Any]], inputs: str
) -> None:
    """By parameters, by the start, and by a parameter on which the start depends."""
    if inputs == "signals":
        del log["push"]
    free, count = ("l", "theta_dot", "a", "c", "m"), 4 * len(TIMES)
    logs = two_logs if inputs == "two logs" else log
    problem = FitArguments(scene, free, {}, {}, None, root).prepare(logs)
    if inputs == "two logs":
        count = 4 * 35 + 2 * 30
        assert problem.free == ("l", "theta_dot[1]", "theta_dot[2]", "a", "c", "m")
    residuals = Residuals(problem, dict.fromkeys(COLUMNS, 2.0))
    values, width = problem.guess + 0.01, 1e-3
    J = residuals.jacobian(values)
    assert J.shape == (count, len(values))
    for k, direction in enumerate(width * np.eye(len(values))):
        expected = sum(
            w * (residuals(values + j * direction) - residuals(values - j * direction))
            for j, w in ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
        )
        np.testing.assert_allclose(J[:, k], expected / width, atol=1e-9 * np.abs(J).max())
        assert np.abs(J[:, k]).max() > 1e-3


def test_exact_log_gives_the_true_values(scene: Path, root: Path, log: dict[str, Any]) -> None:
    fit = eomc.fit(scene, log, h=0.002, root=root)
    assert fit.success and not fit.warnings
    assert fit.values == pytest.approx(TRUTH, rel=1e-6)
    assert all(x < 1e-6 for x in fit.rms.values())
    del log["theta_dot"]  # the initial guess is then that of the scene
    options: dict[str, Any] = {"free": ["theta", "theta_dot"], "values": TRUTH | {"theta": 0.1}}
    start = eomc.fit(scene, log, **options, h=0.002, root=root)
    assert start.values == pytest.approx({"theta": 0.3, "theta_dot": 0.3}, rel=1e-6)


def test_several_logs_have_their_own_initial_values(
    scene: Path, root: Path, log: dict[str, Any], two_logs: list[dict[str, Any]]
) -> None:
    first, logs = log, two_logs
    values = {"theta": 0.2, "theta[2]": 0.1, "theta_dot[2]": -0.5, "m": 1.0}
    free, limits = ["m", "l", "theta", "theta_dot"], {"theta_dot[2]": (-9.0, 9.0)}
    fit = eomc.fit(scene, logs, free=free, values=TRUTH | values, bounds=limits, h=0.002, root=root)
    starts = {f"{n}[{k}]": first[n][row] for n in free[2:] for k, row in ((1, 0), (2, 30))}
    expected = {"m": TRUTH["m"], "l": TRUTH["l"], **starts}
    assert fit.success and not fit.warnings
    assert fit.values == pytest.approx(expected, rel=1e-6)
    assert fit.starts == (0, 35) and len(fit.t) == len(fit.fitted["theta"]) == 65
    assert np.isnan(fit.measured["height"][35:]).all()
    assert "from 200 measured values" in str(fit) and "rad/s" in str(fit)
    pair = {"values": TRUTH | {"theta_dot[2]": starts["theta_dot[2]"]}, "h": 0.002, "root": root}
    guess = eomc.fit(scene, logs, free=["theta"], **pair)  # from the first row of each log
    assert guess.values["theta[2]"] == pytest.approx(first["theta"][30], rel=1e-6)
    right = {f"{n}[2]": starts[f"{n}[2]"] for n in free[2:]}
    fixed = eomc.fit(scene, logs, free=["l"], values=TRUTH | right | {"theta": 0.3}, root=root)
    assert fixed.rms["theta"] < 1e-5
    measured = [x["theta"][0] for x in logs]
    for guesses, expected in ({}, measured), ({"theta[2]": 0.4}, [measured[0], 0.4]):
        arguments = FitArguments(scene, ("theta",), guesses, {}, None, root)
        assert [*arguments.prepare(logs).guess] == expected
    logs[1]["t"] = logs[1]["t"][::-1]
    with pytest.raises(EomcError, match="t of log 2 must be finite and ascending"):
        eomc.fit(scene, logs, root=root)
    with pytest.raises(EomcError, match="bounds: 'theta' is not a value of the scene; did you mea"):
        eomc.fit(scene, logs[:1] * 2, free=["theta"], bounds={"theta": (0, 1)}, root=root)
    with pytest.raises(EomcError, match="give a log"):
        eomc.fit(scene, [], root=root)


def test_second_log_can_continue_the_first(scene: Path, root: Path) -> None:
    """With signals, which depend on time."""
    log = {"t": TIMES, "theta": 0 * TIMES, "theta_dot": 0 * TIMES}
    (whole, _) = FitArguments(scene, ("m",), {}, {}, None, root).prepare(log).simulate(np.ones(1))
    module: Any = eomc.load(scene, root)
    run = module.simulate(t0=TIMES[0], times=TIMES, h=0.001, params={"m": 1.0})
    np.testing.assert_allclose(whole["theta"], run["theta"], atol=1e-6)
    start = {f"{name}[2]": x[30] for name, x in whole.items()}
    logs = [log, {name: x[30:] for name, x in log.items()}]
    problem = FitArguments(scene, ("m",), start, {}, None, root).prepare(logs)
    both, _ = problem.simulate(np.ones(1))
    for name, x in whole.items():
        np.testing.assert_array_equal(both[name], [*x, *x[30:]])


@pytest.mark.slow
def test_standard_errors_are_those_of_repeated_experiments(scene: Path, root: Path) -> None:
    """The column with five times the noise has a smaller weight, so both noises are found."""
    free, count = ["m", "l", "c"], 60
    fits = [
        eomc.fit(scene, simulated_log(scene, root, 0.01, k, ("theta", "pull")), free=free,
                 values=TRUTH, root=root)
        for k in range(count)
    ]  # fmt: skip
    for name in free:
        values = np.array([fit.values[name] for fit in fits])
        errors = np.array([fit.standard_errors[name] for fit in fits])
        assert np.std(values) == pytest.approx(np.mean(errors), rel=0.3)
        assert abs(np.mean(values) - TRUTH[name]) < 4 * np.std(values) / np.sqrt(count)
    assert np.mean([fit.rms["theta"] for fit in fits]) == pytest.approx(0.01, rel=0.1)
    assert np.mean([fit.rms["pull"] for fit in fits]) == pytest.approx(0.05, rel=0.1)
    correlation = np.corrcoef([[fit.values[name] for fit in fits] for name in free])
    np.testing.assert_allclose(correlation, fits[0].correlation, atol=0.35)


def test_values_that_the_columns_do_not_determine_are_named(scene: Path, root: Path) -> None:
    log = simulated_log(scene, root, columns=("theta",), push=0 * PUSH)  # c/m matters, and l
    start = {"theta": 0.3}
    fit = eomc.fit(scene, log, values=start, root=root)
    assert fit.without_effect == ("a",) and fit.values["a"] == pytest.approx(0.5)
    assert set(fit.ambiguous) == {"m", "c"}
    assert np.isnan(fit.standard_errors["c"]) and np.isfinite(fit.standard_errors["l"])
    assert "'a' is not identifiable: no measured column depends on it" in str(fit)
    assert "m, c are not identifiable" in str(fit)
    determined = eomc.fit(scene, log, free=["l", "c"], values=start, root=root)
    assert not determined.warnings


def test_missing_values_and_other_columns_are_left_out(
    scene: Path, root: Path, log: dict[str, Any]
) -> None:
    log["theta"][::3] = np.nan
    log["height"][:40] = np.nan
    log["temperature"] = TIMES
    fit = eomc.fit(scene, log, h=0.002, root=root)
    assert fit.values == pytest.approx(TRUTH, rel=1e-6)
    assert fit.ignored == ("temperature",) and "ignored columns: temperature" in str(fit)
    assert np.isnan(fit.residuals["theta"][::3]).all()
    assert f"from {40 + 20 + 120} measured values" in str(fit)


def test_estimates_stay_within_bounds(scene: Path, root: Path, log: dict[str, Any]) -> None:
    fit = eomc.fit(
        scene, log, free=["l"], values=TRUTH | {"l": 1.0}, bounds={"l": (0.9, 2)}, root=root
    )
    assert fit.values["l"] == pytest.approx(0.9, abs=1e-6)


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({"t": None}, {}, "the log has no column t, but push, theta"),
        ({"t": TIMES[::-1]}, {}, "t of the log must be finite and ascending"),
        ({"t": TIMES[:-1]}, {}, "different lengths"),
        (dict.fromkeys(COLUMNS), {}, "no measured column: its columns are t, push, and the sce"),
        ({"push": np.where(TIMES > 1, np.nan, 1)}, {}, "a value of the input push is missing"),
        ({}, {"free": ["mm"]}, "free: 'mm' is not a value of the scene; did you mean 'm'"),
        ({}, {"free": ["m", "m"]}, "a name is given twice"),
        ({}, {"values": {"th": 1.0}}, "values: 'th' is not a value of the scene"),
        ({}, {"bounds": {"m": (2, 1)}}, "bounds of m: 2 is not less than 1"),
        ({}, {"h": -1.0}, "h = -1.0 is not a step size"),
        (
            {},
            {"values": {"m": 0.0}},
            "simulation with the initial guesses fails: .*D is not positive",
        ),
    ],
)
def test_invalid_arguments_are_refused(
    scene: Path, root: Path, log: dict[str, Any], changes: Any, options: Any, message: str
) -> None:
    changed = {k: x for k, x in (log | changes).items() if x is not None}
    with pytest.raises(EomcError, match=message):
        eomc.fit(scene, changed, root=root, **options)


def test_some_of_several_inputs_are_refused(tmp_path: Path, root: Path) -> None:
    file = tmp_path / "two.toml"
    text = SCENE.replace("[energy]", "brake = {}\n[energy]").replace("push*l", "push*l - brake")
    file.write_text(text.replace("fitted", "fitted_two"), encoding="utf-8")
    with pytest.raises(EomcError, match="columns of some inputs, but not of brake"):
        eomc.fit(file, {"t": TIMES, "theta": TIMES, "push": PUSH}, root=root)


def test_scenes_with_jumps_are_refused(tmp_path: Path, root: Path) -> None:
    file = tmp_path / "jumping.toml"
    event = (
        '[[event]]\nname = "stop"\nwhen = "theta - 1"\naction = "jump"\ntheta_dot = "-theta_dot"\n'
    )
    file.write_text(SCENE.replace("[run]", event + "[run]"), encoding="utf-8")
    with pytest.raises(EomcError, match=r"jumps at the event 'stop'.*before the first jump"):
        eomc.fit(file, {"t": TIMES, "theta": TIMES}, root=root)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a line with the names"),
        ("t,theta\n0,x\n", "row 1, column theta: 'x' is not a number"),
        ("t,theta\n0\n", "row 1 has 1 cells for 2 names"),
        ("t,t\n0,0\n", "two columns are named 't'"),
        (None, "can't be read"),
    ],
)
def test_faulty_files_are_refused(scene: Path, root: Path, text: str | None, message: str) -> None:
    file = scene.with_name("missing.csv" if text is None else "log.csv")
    if text is not None:
        file.write_text(text, encoding="utf-8")
    with pytest.raises(EomcError, match=message):
        eomc.fit(scene, file, root=root)


def command(scene: Path, root: Path, *words: str) -> Result:
    log = str(scene.with_name("log.csv"))
    return CliRunner().invoke(main, ["fit", str(scene), log, "--build", str(root), *words])


def test_command_prints_estimates_and_draws_the_fit(scene: Path, root: Path) -> None:
    log = simulated_log(scene, root, 0.001)
    rows = np.transpose([*log.values()]).tolist()
    cells = "\n".join(",".join(map(repr, row)) for row in rows)
    scene.with_name("log.csv").write_text(
        ",".join(log) + f"\n# comment\n{cells}\n", encoding="utf-8"
    )
    png = scene.with_name("fit.png")
    words = ["--free", "l, theta_dot", "--set", "m=1.3", "--set", "c=0.3/2", "--set", "a=0.6"]
    result = command(scene, root, *words, "--plot", str(png), "--bounds", "l=0:")
    assert result.exit_code == 0, result.output
    assert "Driven pendulum: 2 values from 240 measured values of theta, theta_dot" in result.output
    assert " ± " in result.output and "rad/s" in result.output and "correlation:" in result.output
    assert png.read_bytes().startswith(b"\x89PNG")
    summary = json.loads(command(scene, root, *words, "--json").output)
    assert summary["values"]["l"] == pytest.approx(0.7, abs=0.01)
    assert summary["success"] and summary["rms"].keys() == {*COLUMNS}
    log = str(scene.with_name("log.csv"))
    both = json.loads(command(scene, root, log, *words, "--json", "--plot", str(png)).output)
    assert both["values"].keys() == {"l", "theta_dot[1]", "theta_dot[2]"}
    assert both["values"]["theta_dot[2]"] == pytest.approx(both["values"]["theta_dot[1]"], abs=1e-9)
    unknown = command(scene, root, "--free", "l,k")
    assert unknown.exit_code == 2 and "free: 'k' is not a value of the scene" in unknown.output
    wrong = command(scene, root, "--bounds", "l=3")
    assert wrong.exit_code == 2 and "write --bounds NAME=LOW:HIGH" in wrong.output
