"""Call the command as a user does and check its output and its exit status."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sympy
from click.testing import CliRunner, Result
from support.builds import REUSED_BUILDS

from eomc import pipeline
from eomc.base.errors import EomcError
from eomc.cli import run
from eomc.cli.main import main

SCENES = Path(__file__).parents[2] / "scenes"


@pytest.fixture
def scene_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quickly_compiled: None) -> Path:
    """Change to a new folder with two scenes, in which the command is run."""
    for name in ("cartpole", "kapitza_pendulum"):
        shutil.copy(SCENES / f"{name}.toml", tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def built_folder(scene_folder: Path) -> Path:
    """Return `scene_folder` with the cart-pole built."""
    return folder_with_module(scene_folder, "cartpole")


def folder_with_module(scene_folder: Path, name: str) -> Path:
    """Return `scene_folder` with the module of a scene."""
    shutil.copytree(
        pipeline.build(SCENES / f"{name}.toml", REUSED_BUILDS).folder, scene_folder / "build" / name
    )
    return scene_folder


def eomc(*words: str) -> Result:
    return CliRunner().invoke(main, words)


@pytest.mark.slow
def test_new_scene_runs_unchanged(scene_folder: Path) -> None:
    assert eomc("new", "crane").exit_code == 0
    ran = eomc("run", "crane.toml", "--out", "run.csv", "--plot", "run.png", "--animate", "a.html")
    assert ran.exit_code == 0, ran.output
    assert "estimated error at the end:" in ran.output and "steps per second" in ran.output
    rows = np.genfromtxt("run.csv", delimiter=",", names=True)
    assert rows.dtype.names == ("t", "theta", "theta_dot", "torque", "energy") and len(rows) == 2001
    assert (scene_folder / "run.png").read_bytes().startswith(b"\x89PNG")
    page = (scene_folder / "a.html").read_text(encoding="utf-8")
    assert "<h1>Crane</h1>" in page and '"bob"' in page and "wrote a.html" in ran.output
    again = eomc("new", "crane")
    assert again.exit_code == 2 and "is there already" in again.output


def test_new_scene_explains_how_to_set_a_tolerance(scene_folder: Path) -> None:
    assert eomc("new", "crane").exit_code == 0
    text = (scene_folder / "crane.toml").read_text(encoding="utf-8")
    (scene_folder / "crane.toml").write_text(
        text.replace("# tolerance", "tolerance"), encoding="utf-8"
    )
    assert pipeline.read("crane.toml").run.tolerance == 1e-9


def test_included_scenes_are_listed_and_copied(scene_folder: Path) -> None:
    shipped = {file.stem for file in SCENES.glob("*.toml")}
    own, others = eomc("list").output.split("with eomc come")
    assert "cartpole.toml" in own and "acrobot" not in own
    assert {line.split()[0] for line in others.splitlines()[1:]} == shipped
    entries = json.loads(eomc("list", "--json").output)
    assert {row["name"] for row in entries if row["shipped"]} == shipped
    assert not [row for row in json.loads(eomc("list", ".", "--json").output) if row["shipped"]]
    for words, name in ((["--from", "acrobot"], "acrobot"), (["arm", "--from", "acrobot"], "arm")):
        assert eomc("new", *words).exit_code == 0
        text = (scene_folder / f"{name}.toml").read_text(encoding="utf-8")
        assert pipeline.read(scene_folder / f"{name}.toml").name == name
        assert text.replace(f'"{name}"', '"acrobot"', 1) == (SCENES / "acrobot.toml").read_text()
    assert (
        eomc("new").exit_code == 0
        and pipeline.read(scene_folder / "pendulum.toml").name == "pendulum"
    )


def test_every_included_scene_is_named_in_one_place(scene_folder: Path) -> None:
    for file in SCENES.glob("*.toml"):
        (scene_folder / "renamed.toml").unlink(missing_ok=True)
        assert eomc("new", "renamed", "--from", file.stem).exit_code == 0
        assert pipeline.name_and_digest(scene_folder / "renamed.toml")[0] == "renamed"


def test_build_check_and_list(scene_folder: Path) -> None:
    assert "built in" in eomc("build", "cartpole.toml").output
    assert "up to date" in eomc("build", "cartpole.toml").output
    checked = eomc("check", "cartpole.toml", "--json")
    assert checked.exit_code == 0 and json.loads(checked.output)[0]["passed"] is True
    entries = json.loads(eomc("list", "--json").output)
    rows = {row["name"]: row["built"] for row in entries if not row["shipped"]}
    assert rows == {"cartpole": True, "kapitza_pendulum": False}
    scene = scene_folder / "cartpole.toml"
    scene.write_text(scene.read_text(encoding="utf-8") + "# changed\n", encoding="utf-8")
    assert not json.loads(eomc("list", "--json").output)[0]["built"]


LIGHT = """
import sys
from eomc.cli.main import main
main(sys.argv[1:], standalone_mode=False)
slow = {"sympy", "numpy", "rich", "jinja2", "cffi"}
sys.exit(", ".join(slow & set(sys.modules)) or 0)
"""


def test_help_and_current_build_import_no_slow_module(built_folder: Path) -> None:
    """Help, and the build of a current module, finish in a tenth of a second."""
    for words in (["--help"], ["build", "cartpole.toml"]):
        command = [sys.executable, "-c", LIGHT, *words]
        process = subprocess.run(command, capture_output=True, text=True)
        assert (process.returncode, process.stderr) == (0, "")
    assert "is up to date" in process.stdout


@pytest.mark.slow
def test_energy_balance_is_printed(built_folder: Path) -> None:
    assert "J, changed by at most" in eomc("run", "cartpole.toml").output
    folder_with_module(built_folder, "kapitza_pendulum")
    output = eomc("run", "kapitza_pendulum.toml").output
    assert "energy K + P 8.73323504 J, changed by at most 18 J; it is not conserved\n" in output
    assert (
        "Jacobi's integral 8.6428537 J: work of forces -1.71 J; numerical error 8.4e-08 J\n"
        in output
    )
    words = ["--json", "--every", "99"]
    balance = json.loads(eomc("run", "kapitza_pendulum.toml", *words).output)["energy"]["balance"]
    assert balance["is_resolved"] and balance["forces"] == pytest.approx(-1.71, abs=1e-3)


def test_parameters_and_initial_values_on_the_command_line(built_folder: Path) -> None:
    words = ["--set", "m_c=1+2", "--start", "theta=pi/3", "--start", "x_dot=-l", "--json"]
    summary = json.loads(eomc("run", "cartpole.toml", "--duration", "0", *words).output)
    assert summary["q"] == {"x": 0.0, "theta": pytest.approx(np.pi / 3)}
    assert summary["qd"] == {"x": -2.0, "theta": 0.0}


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("force=30", "but an input: --input force=30"),
        ("theta=1", "but a coordinate: --start theta=1"),
        ("theta_dot=2", "but a velocity: --start theta_dot=2"),
    ],
)
def test_names_that_are_no_parameters_are_refused_with_the_right_option(
    driven: ModuleType, assignment: str, message: str
) -> None:
    with pytest.raises(EomcError, match=f"is not a parameter, {message}"):
        run._overrides(Path("driven.toml"), driven, [assignment], [])


INPUTS = """eomc = 1
name = "inputs"
[coordinates]
x = {}
[parameters]
m = 2.0
[inputs]
f = { signal = "half" }
free = {}
w = { signal = "sin(t)" }
[definitions]
half = "m/2"
[energy]
kinetic = "m*x_dot**2/2"
potential = "0"
[forces]
x = "f + free + w"
"""


def test_constant_inputs_on_the_command_line(built_folder: Path, driven: ModuleType) -> None:
    folder_with_module(built_folder, "cartpole_driven")
    shutil.copy(SCENES / "cartpole_driven.toml", built_folder)
    words = ["--input", "force=m_c/4", "--set", "m_c=4", "--duration", "0.5", "--json"]
    result = json.loads(eomc("run", "cartpole_driven.toml", *words).output)
    alone = driven.simulate(u=1.0, duration=0.5, params={"m_c": 4.0})
    assert [*result["q"].values()] == pytest.approx(alone.q[-1], rel=1e-12)
    for assignment, message in (
        ("Force=1", "--input: 'Force' is not an input; did you mean 'force'"),
        ("push=1", "--input: 'push' is not an input; there are force"),
        ("force", "write --input NAME=VALUE"),
    ):
        assert message in eomc("run", "cartpole_driven.toml", "--input", assignment).output
    assert (
        "'x' is not an input: there are none"
        in eomc("run", "cartpole.toml", "--input", "x=1").output
    )


def test_unset_inputs_take_their_constant_signals(tmp_path: Path) -> None:
    scene = tmp_path / "inputs.toml"
    scene.write_text(INPUTS, encoding="utf-8")
    module: Any = SimpleNamespace(inputs=("f", "free", "w"), defaults={"m": 2.0}, start=(0, 0))
    module.signal = lambda q, qd, params: np.array([0.5 * params["m"], 0.0, 0.7])
    assert run._fixed_inputs(scene, module, ["w=3"], {"m": 4.0}) == {
        "f": 2.0,
        "free": 0.0,
        "w": 3.0,
    }
    assert run._fixed_inputs(scene, module, [], {}) is None
    with pytest.raises(EomcError, match=r"signal of w changes, .*: give w a value too"):
        run._fixed_inputs(scene, module, ["f=1"], {})


@pytest.mark.parametrize(
    ("option", "message"),
    [("--rate", "--start NAME_dot=VALUE"), ("--params", "--set NAME=VALUE"), ("--dt", "is --h")],
)
def test_common_names_of_options_suggest_the_option_of_eomc(option: str, message: str) -> None:
    result = eomc("run", "cartpole.toml", option, "x=1")
    assert result.exit_code == 2 and f"No such option '{option}': " in result.output
    assert message in result.output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "cartpole.toml", "--set", "mc=3"], "did you mean 'm_c'?"),
        (["run", "cartpole.toml", "--set", "Q=1"], "is not a parameter; there are m_c, m_p, l"),
        (["run", "cartpole.toml", "--start", "phi=1"], "; there are x, theta, x_dot, theta_dot"),
        (["run", "cartpole.toml", "--set", "m_c"], "write --set NAME=VALUE"),
        (["run", "cartpole_bodies.toml", "--set", "m_p=-1"], "body.pole.mass: is -1, and"),
        (["run", "cartpole.toml", "--start", "theta=1/0"], "divides by zero"),
        (["run", "cartpole.toml", "--h", "0"], "h: 0 is not a step size"),
        (["run", "cartpole.toml", "--method", "dp8"], "which has rk4"),
        (["run", "cartpole.toml", "--out", "run.dat"], ".csv or .npz"),
        (["run", "cartpole.toml", "--animate", "run.avi"], ".html or .gif or .mp4"),
        (["run", "cartpole.toml", "--animate", "nowhere/a.html"], "can't be written"),
        (["build", "cartpol.toml"], "did you mean 'cartpole.toml'?"),
        (["build", "cartpole.toml", "--build", "cartpole.toml/x"], "can't be written"),
        (["new", "class"], "Python keyword"),
        (["new", "--from", "cartpol"], "did you mean 'cartpole'?"),
        (["new", "--from", "../scenes/cartpole"], "is no scene that comes with eomc"),
        (["new", "import", "--from", "cartpole"], "Python keyword"),
        (["list", "nowhere"], "is not a folder"),
    ],
)
def test_bad_input_exits_with_status_2_and_a_remedy(
    built_folder: Path, words: list[str], message: str
) -> None:
    if "cartpole_bodies.toml" in words:
        shutil.copy(
            SCENES / "cartpole_bodies.toml", folder_with_module(built_folder, "cartpole_bodies")
        )
    result = eomc(*words)
    assert result.exit_code == 2, result.output
    assert message in result.output


def test_run_prints_requested_events(built_folder: Path) -> None:
    options = ["--duration", "3", "--event", "level = theta - pi", "--event", "far=x+0.4"]
    summary = json.loads(eomc("run", "cartpole.toml", *options, "--json").output)
    level, far = summary["events"]["level"], summary["events"]["far"]
    assert len(level) == len(far) == 2
    module = pipeline.load(built_folder / "cartpole.toml", built_folder / "build")
    for times, column, value in ((level, "theta", np.pi), (far, "x", -0.4)):
        states = module.simulate(h=1e-3, duration=3.0)(np.array(times))[0]
        assert states[:, module.coordinates.index(column)] == pytest.approx(value, abs=1e-8)
    output = eomc("run", "cartpole.toml", "--duration", "1.5", *options[2:]).output
    assert re.search(r"event level: 1 time, at t = [\d.]+ s\n", output), output
    wrong = eomc("run", "cartpole.toml", "--event", "level=thta")
    assert wrong.exit_code == 2
    assert (
        "--event: error: level.when: 'thta' is not declared; did you mean 'theta'?" in wrong.output
    )
    assert eomc("run", "cartpole.toml", "--event", "level").exit_code == 2


@pytest.mark.slow
def test_event_that_stops_a_run_is_printed(scene_folder: Path) -> None:
    scene = """eomc = 1
name = "dropped"
[coordinates]
y = { unit = "m", start = 1.0 }
[energy]
kinetic = "y_dot**2/2"
potential = "9.81*y"
[[event]]
name = "half"
when = "y - 0.5"
[[event]]
name = "ground"
when = "y"
action = "stop"
[run]
tolerance = 1e-9
"""
    (scene_folder / "dropped.toml").write_text(scene, encoding="utf-8")
    output = eomc("run", "dropped.toml").output
    assert re.search(r"event half: 1 time, at t = 0.319\d* s\n", output), output
    assert re.search(r"event ground: 1 time, at t = 0.4515\d* s, which ends the run\n", output), (
        output
    )


def test_scenes_of_the_same_name_do_not_replace_each_other(scene_folder: Path) -> None:
    shutil.copy("cartpole.toml", "copy.toml")
    result = eomc("build", "cartpole.toml", "copy.toml")
    assert result.exit_code == 2 and "both named 'cartpole'" in result.output
    assert not (scene_folder / "build").exists()


def test_run_that_fails_exits_with_status_1(built_folder: Path) -> None:
    result = eomc("run", "cartpole.toml", "--h", "3", "--duration", "30")
    assert result.exit_code == 1 and "would no longer be finite" in result.output


def test_show_prints_equations_in_every_format(scene_folder: Path) -> None:
    text = eomc("show", "kapitza_pendulum.toml").output
    assert "mass matrix" in text and "Jacobi integral" in text
    assert r"\begin{align*}" in eomc("show", "kapitza_pendulum.toml", "--latex").output
    space: dict[str, object] = {}
    # the output is valid Python
    exec(eomc("show", "kapitza_pendulum.toml", "--python").output, space)
    assert str(space["D"]) == "Matrix([[l**2*m]])"
    assert "1 division, 1 sincos" in eomc("show", "cartpole.toml", "--cost").output


@pytest.mark.slow
def test_rationals_are_exact_in_python_output(scene_folder: Path) -> None:
    """Python itself would divide the numbers of a sum or an exponent."""
    text = (scene_folder / "cartpole.toml").read_text(encoding="utf-8")
    text = text.replace('kinetic   = "', 'kinetic   = "x_dot**2/20 + ')
    text = text.replace('potential = "', 'potential = "m_p*(1 + x**2)**(3/10) + ')
    (scene_folder / "odd.toml").write_text(text, encoding="utf-8")
    space: dict[str, Any] = {}
    exec(eomc("show", "odd.toml", "--python").output, space)
    assert not any(x.has(sympy.Float) for x in (space["D"], space["g_"], space["potential"]))
    assert space["D"][0].subs({space["m_c"]: 0, space["m_p"]: 0}) == sympy.Rational(1, 10)


SLANTED = """
eomc = 1
name = "slanted"
gravity = [0, 0, -9.81]
[coordinates]
q = {}
[parameters]
m = 1
[[body]]
name = "flap"
joint = "revolute"
coordinates = "q"
axis = [1, 2, 3]
mass = "m"
center = [0.1, 0.2, -0.1]
inertia = [0.1, 0.2, 0.3]
"""


@pytest.mark.slow  # SymPy simplifies for most of a minute
def test_long_rationals_of_skew_axes_are_printed_as_decimals(scene_folder: Path) -> None:
    """D = n.J n + m |n x c|^2 with n = (1, 2, 3)/sqrt(14), which has no short fraction."""
    (scene_folder / "slanted.toml").write_text(SLANTED, encoding="utf-8")
    for form in ([], ["--latex"], ["--python"]):
        text = eomc("show", "slanted.toml", *form).output
        assert "mass matrix" in text or form
        assert not re.search(r"\d{18}", text), text
    space: dict[str, Any] = {}
    exec(text, space)
    n, c = np.array([1, 2, 3]) / np.sqrt(14), np.array([0.1, 0.2, -0.1])
    expected = n**2 @ [0.1, 0.2, 0.3] + 2 * np.sum(np.cross(n, c) ** 2)
    # 15 digits
    assert float(space["D"][0].subs(space["m"], 2)) == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("command", ["new", "build", "check", "run", "show", "list"])
def test_help_contains_an_example(command: str) -> None:
    assert f"eomc {command}" in eomc(command, "--help").output


def test_scene_name_without_suffix_suggests_the_file(scene_folder: Path) -> None:
    result = eomc("run", "cartpole")
    assert result.exit_code == 2
    assert "cartpole: there is no such file; did you mean 'cartpole.toml'?" in result.output


def test_name_of_an_included_scene_suggests_new_from(scene_folder: Path) -> None:
    """A file of that name in the current folder takes precedence."""
    for name in ("bricard", "bricard.toml"):
        result = eomc("run", name)
        assert result.exit_code == 2
        message = (
            f"{name}: there is no such file; eomc new --from bricard writes the one that comes"
        )
        assert message in result.output
    eomc("new", "--from", "bricard")
    assert "did you mean 'bricard.toml'?" in eomc("check", "bricard").output


def test_unknown_command_suggests_the_nearest_one(scene_folder: Path) -> None:
    for name, message in (
        ("runn", "'runn'; did you mean 'run'?"),
        ("simulate", "'simulate': they are build, check,"),
        ("cartpole.toml", "'cartpole.toml': they are build, check,"),
    ):
        result = eomc(name, "cartpole.toml")
        assert result.exit_code == 2 and f"No such command {message}" in result.output


def test_build_folder_that_is_a_file_suggests_the_option(scene_folder: Path) -> None:
    (scene_folder / "file").write_text("", encoding="utf-8")
    result = eomc("build", "cartpole.toml", "--build", "file")
    assert result.exit_code == 2
    assert "choose another place with --build DIR" in result.output and "root=" not in result.output
