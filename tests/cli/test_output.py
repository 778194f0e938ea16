"""Check that no command ends with a traceback, whatever its output and its numbers."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from support.cases import SCENES

from eomc import pipeline
from eomc.cli.main import main
from eomc.verify import check
from eomc.verify.comparison import CheckReport, CheckResult


@pytest.fixture
def built_folder(scene_folder: Path, pendulum: tuple[Path, float]) -> Path:
    """Return `scene_folder` with the module built."""
    shutil.copytree(pendulum[0], scene_folder / "build" / "simple_pendulum")
    return scene_folder


@pytest.fixture
def scene_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Change to a new folder with a scene, in which the command is run."""
    shutil.copy(SCENES / "simple_pendulum.toml", tmp_path / "p.toml")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    return tmp_path


def eomc(*words: str) -> Result:
    return CliRunner().invoke(main, words)


def shell(line: str) -> subprocess.CompletedProcess[str]:
    """Run a line in a shell in which `eomc` is the command."""
    command = f'eomc() {{ "{sys.executable}" -m eomc "$@"; }}; {line}'
    return subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["run", "p.toml", "--h", "1e-300", "--duration", "1e300"],
            "take a larger h, or a shorter",
        ),
        (["run", "p.toml", "--h", "-1"], "h: -1 is not a step size"),
        (["run", "p.toml", "--h", "nan"], "h: nan is not a finite number"),
        (["run", "p.toml", "--duration", "-3"], "duration: -3.0 is not a time"),
        (["check", "p.toml", "--seed", "-5"], "-5 is not in the range x>=0"),
    ],
)
def test_options_with_invalid_numbers_are_refused(
    built_folder: Path, words: list[str], message: str
) -> None:
    result = eomc(*words)
    assert (result.exit_code, message in result.output) == (2, True), result.output


def test_step_longer_than_the_run_is_reported(built_folder: Path) -> None:
    result = eomc("run", "p.toml", "--h", "0.3", "--duration", "0.1")
    assert result.exit_code == 0
    assert "  h = 0.3 s is longer than the duration, 0.1 s: the run is one step of" in result.output
    summary = json.loads(eomc("run", "p.toml", "--h", "0.3", "--duration", "0.1", "--json").output)
    assert (
        summary["beyond_duration"].startswith("h = 0.3 s") and summary["beyond_stability"] is None
    )


def test_negative_zero_is_not_printed(scene_folder: Path) -> None:
    """Friction at rest, -b*theta_dot, and an initial value below zero."""
    text = Path("p.toml").read_text(encoding="utf-8")
    outputs = '[outputs]\ntau = { formula = "-0.1*theta_dot" }\n'
    Path("p.toml").write_text(f"{text}\n{outputs}", encoding="utf-8")
    words = ["run", "p.toml", "--start", "theta=0", "--start", "theta_dot=-0.0", "--duration", "0"]
    texts = eomc(*words, "--out", "p.csv").output, eomc(*words, "--json").output
    html = pipeline.load("p.toml").simulate([-0.0], [-0.0], steps=0)._repr_html_()
    for shown in (*texts, Path("p.csv").read_text(encoding="utf-8"), html):
        assert "theta" in shown and not re.search(r"-0(\.0)?\b", shown), shown


def test_run_of_zero_steps_reports_no_speed(built_folder: Path) -> None:
    result = eomc("run", "p.toml", "--duration", "0")
    assert result.exit_code == 0 and "Simple pendulum: 0 steps of rk4" in result.output
    assert result.output.endswith(" ms, 0 steps per second\n")


def test_growth_of_perturbations_is_not_reported_without_correct_digits(built_folder: Path) -> None:
    """It would be that of the wrong motion: 1 where a linear one diverges."""
    output = eomc("run", "p.toml", "--h", "0.9", "--duration", "100").output
    assert "  correct digits: theta 0\n" in output
    good = eomc("run", "p.toml", "--h", "0.01", "--duration", "1").output
    assert "; perturbations of the start grow by a factor of " in good


def test_quantities_not_finite_at_the_initial_state_are_named(scene_folder: Path) -> None:
    scene = """eomc = 1
name = "poles"
[coordinates]
x = { start = 0.1 }
[parameters]
b = 9
c = 9
d = 9
[energy]
kinetic = "x_dot**2/2 + x_dot**2/(x - b)**2"
potential = "1/(x - c)"
[forces]
x = "1/(x - d)"
"""
    (scene_folder / "poles.toml").write_text(scene)
    for name, what in (
        ("b", "the kinetic energy"), ("c", "the potential energy"), ("d", "an acceleration")
    ):  # fmt: skip
        for options in ([], ["--json"]):
            result = eomc("run", "poles.toml", "--set", f"{name}=0.1", *options)
            assert result.exit_code == 1
            assert f"{what} is not finite at the start" in result.output
            assert "step may be too long" not in result.output, name
        assert " nan" not in result.output.lower() and "inf " not in result.output.lower()
        figures = json.loads(result.stdout, parse_constant=pytest.fail)
        assert (figures["energy"]["start"] is None) == (name != "d")


@pytest.mark.parametrize("words", ["", "rows of 4 numbers don't fit in memory"])
def test_insufficient_memory_is_reported(
    words: str, scene_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def raise_memory_error(*_: object, **__: object) -> None:
        raise MemoryError(*[words] * bool(words))

    monkeypatch.setattr(pipeline, "load", raise_memory_error)
    result = eomc("run", "p.toml")
    assert result.exit_code == 2
    assert result.output == f"eomc: {words or 'not enough memory'}\n"


def test_every_longer_than_the_run_writes_first_and_last_row(built_folder: Path) -> None:
    result = eomc("run", "p.toml", "--every", "9" * 20, "--duration", "0.1", "--out", "run.csv")
    assert result.exit_code == 0, result.output
    # names, initial and final state
    assert len((built_folder / "run.csv").read_text().splitlines()) == 3


@pytest.mark.parametrize("number", ["0x" + "f" * 6000, "9" * 6000, "9" * 400, "-0b" + "1" * 1100])
@pytest.mark.parametrize("key", ["eomc  =", "start =", "m = { value =", "h        =", "batch ="])
def test_huge_integers_in_a_scene_are_refused(scene_folder: Path, number: str, key: str) -> None:
    text = (
        (scene_folder / "p.toml")
        .read_text(encoding="utf-8")
        .replace("[run]\n", "[run]\nbatch = 1\n")
    )
    old = next(line for line in text.splitlines() if key in line)
    start = old.index(key) + len(key)
    new = old[:start] + " " + number.replace("-0b", "0b") + (" }" if "{" in old else "")
    (scene_folder / "p.toml").write_text(text.replace(old, new), encoding="utf-8")
    result = eomc("build", "p.toml")
    assert result.exit_code == 2 and "a number has hundreds of digits" in result.output, (
        result.output
    )


@pytest.mark.parametrize(
    "value", ["[" * 20_000 + "]" * 20_000, "{a=" * 20_000 + "1" + "}" * 20_000]
)
def test_deep_nesting_in_a_scene_is_refused(scene_folder: Path, value: str) -> None:
    with (scene_folder / "p.toml").open("a", encoding="utf-8") as file:
        file.write(f"x = {value}\n")
    result = eomc("build", "p.toml")
    assert result.exit_code == 2 and "nested too deeply" in result.output
    assert eomc("list").exit_code == 0


def test_list_accepts_every_file_that_declares_itself_a_scene(scene_folder: Path) -> None:
    text = 'eomc = 1\nname = "odd"\ncoordinates = 3\ninputs = [1]\n'
    (scene_folder / "odd.toml").write_text(text, encoding="utf-8")
    result = eomc("list")
    assert result.exit_code == 0 and "odd.toml" in result.output, result.output


@pytest.mark.slow
def test_full_output_device_is_reported(scene_folder: Path) -> None:
    """Every command that prints runs in its own process: closing its output fails once more."""
    assert eomc("build", "p.toml").exit_code == 0
    shutil.copy(SCENES / "cartpole_bodies.toml", scene_folder / "b.toml")
    for words in (
        "--help", "--version", "run --help", "list", "list --json", "new a", "dof b.toml",
        "dof b.toml --json", "show p.toml", "show p.toml --latex", "show p.toml --python",
        "show p.toml --cost", "build p.toml", "build p.toml --json", "run p.toml",
        "run p.toml --json", "check p.toml", "check p.toml --json",
    ):  # fmt: skip
        result = shell(f"eomc {words} >/dev/full")
        assert result.returncode == 2, words
        message = "eomc: the output: can't be written (No space left on device)\n"
        assert result.stderr == message, (words, result.stderr)
        assert shell(f"eomc {words} >/dev/full 2>/dev/full").returncode == 2, words


@pytest.mark.slow
def test_full_device_for_files_is_reported(scene_folder: Path) -> None:
    for name in ("f.csv", "f.npz", "f.png", "f.svg"):
        (scene_folder / name).symlink_to("/dev/full")
        option = "--plot" if name > "f.o" else "--out"
        result = shell(f"eomc run p.toml {option} {name}")
        assert result.returncode == 2, result.stderr
        assert result.stderr == f"eomc: {name}: can't be written (No space left on device)\n"
    result = shell("ulimit -f 0; eomc new b")
    assert result.returncode == 2 and not (scene_folder / "b.toml").exists(), result.stderr
    result = shell("ulimit -f 0; eomc build p.toml --build other")
    assert result.returncode == 2 and "other" in result.stderr and "Traceback" not in result.stderr


@pytest.mark.slow
def test_closed_output_ends_without_traceback(scene_folder: Path) -> None:
    assert eomc("build", "p.toml").exit_code == 0
    for line, status in {
        "eomc show p.toml >&-": 0,
        "eomc show p.toml 2>&-": 0,
        "eomc run p.toml <&- >&- 2>&-": 0,
        "eomc build nowhere.toml 2>&-": 2,
        "eomc build nowhere.toml 2>/dev/full": 2,
        "eomc check p.toml | head -1": 0,
        "eomc show p.toml | true": 0,
    }.items():
        result = shell(line)
        assert (result.returncode, result.stderr) == (status, ""), (line, result.stderr)


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_missing_standard_stream_is_replaced(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The caller may have closed it before Python started."""
    monkeypatch.setattr(sys, name, None)
    with pytest.raises(SystemExit) as exit_info:
        main(["list", "nowhere"])
    assert exit_info.value.code == 2
    with getattr(sys, name) as stream:
        assert stream.name == os.devnull


@pytest.mark.slow
def test_characters_outside_the_output_encoding_are_escaped(scene_folder: Path) -> None:
    """In Latin-1, and for a file whose name is not valid UTF-8."""
    shutil.copy("p.toml", os.fsdecode(b"\xff.toml"))
    result = shell("PYTHONIOENCODING=latin-1 eomc show p.toml")
    assert "Traceback" not in result.stderr and "\\u03b8" in result.stdout, result.stderr
    result = shell(
        os.fsdecode(b"eomc build \xfe.toml; unset HOME; eomc run \xff.toml --plot x.png")
    )
    assert result.returncode == 0 and "Traceback" not in result.stderr, result.stderr


@pytest.mark.parametrize("command", ["build", "check", "report"])
def test_command_without_a_scene_names_the_missing_argument(
    command: str, scene_folder: Path
) -> None:
    result = eomc(command)
    assert result.exit_code == 2 and "Missing argument" in result.output, result.output


@pytest.mark.parametrize("quiet", [(), ("--quiet",)])
def test_failed_check_names_the_scene(
    quiet: tuple[str, ...], scene_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = CheckReport(
        "simple_pendulum", (CheckResult("D", 7.0, 1.0, False, "units"),), 1, 0, "none"
    )
    monkeypatch.setattr(check, "check", lambda *_, **__: report)
    monkeypatch.setattr(pipeline, "load", lambda *_, **__: None)
    result = eomc("check", "p.toml", *quiet)
    assert result.exit_code == 1 and result.output.endswith("\nFAILED: simple_pendulum\n"), (
        result.output
    )
