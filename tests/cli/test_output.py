"""No command line ends in a traceback, wherever its output goes and whatever its numbers are."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cases import SCENES
from click.testing import CliRunner, Result

from eomc import pipeline
from eomc.cli.main import main
from eomc.verify import check
from eomc.verify.report import CheckReport, CheckResult


@pytest.fixture
def there(here: Path, pendulum: tuple[Path, float]) -> Path:
    """As `here`, the module built."""
    shutil.copytree(pendulum[0], here / "build" / "simple_pendulum")
    return here


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty directory with a scene, in which the command is run."""
    shutil.copy(SCENES / "simple_pendulum.toml", tmp_path / "p.toml")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    return tmp_path


def eomc(*words: str) -> Result:
    return CliRunner().invoke(main, words)


def shell(line: str) -> subprocess.CompletedProcess[str]:
    """A line of a shell, in which `eomc` is the command."""
    command = f'eomc() {{ "{sys.executable}" -m eomc "$@"; }}; {line}'
    return subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    ("words", "said"),
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
def test_numbers_that_make_no_run(there: Path, words: list[str], said: str) -> None:
    done = eomc(*words)
    assert (done.exit_code, said in done.output) == (2, True), done.output


def test_a_step_longer_than_the_run_is_said(there: Path) -> None:
    done = eomc("run", "p.toml", "--h", "0.3", "--duration", "0.1")
    assert done.exit_code == 0
    assert "  h = 0.3 s is longer than the duration, 0.1 s: the run is one step of" in done.output
    said = json.loads(eomc("run", "p.toml", "--h", "0.3", "--duration", "0.1", "--json").output)
    assert said["beyond_duration"].startswith("h = 0.3 s") and said["beyond_stability"] is None


def test_no_number_is_minus_zero(here: Path) -> None:
    """Friction at rest, -b*theta_dot, and a start below zero."""
    text = Path("p.toml").read_text(encoding="utf-8")
    outputs = '[outputs]\ntau = { formula = "-0.1*theta_dot" }\n'
    Path("p.toml").write_text(f"{text}\n{outputs}", encoding="utf-8")
    words = ["run", "p.toml", "--start", "theta=0", "--start", "theta_dot=-0.0", "--duration", "0"]
    made = eomc(*words, "--out", "p.csv").output, eomc(*words, "--json").output
    html = pipeline.load("p.toml").simulate([-0.0], [-0.0], steps=0)._repr_html_()
    for shown in (*made, Path("p.csv").read_text(encoding="utf-8"), html):
        assert "theta" in shown and not re.search(r"-0(\.0)?\b", shown), shown


def test_a_run_of_no_step_has_no_speed(there: Path) -> None:
    done = eomc("run", "p.toml", "--duration", "0")
    assert done.exit_code == 0 and "Simple pendulum: 0 steps of rk4" in done.output
    assert done.output.endswith(" ms, 0 steps a second\n")


def test_of_a_run_without_a_right_digit_no_growth_is_told(there: Path) -> None:
    """It would be that of the wrong motion, 1 where a linear one blows up."""
    lost = eomc("run", "p.toml", "--h", "0.9", "--duration", "100").output
    assert "  right digits: theta 0\n" in lost
    good = eomc("run", "p.toml", "--h", "0.01", "--duration", "1").output
    assert "; a difference at the start has become " in good


def test_what_is_not_finite_at_the_start_is_named(here: Path) -> None:
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
    (here / "poles.toml").write_text(scene)
    for name, what in (
        ("b", "the kinetic energy"), ("c", "the potential energy"), ("d", "an acceleration")
    ):  # fmt: skip
        for way in ([], ["--json"]):
            done = eomc("run", "poles.toml", "--set", f"{name}=0.1", *way)
            assert done.exit_code == 1
            assert f"{what} is not finite at the start" in done.output
            assert "step may be too long" not in done.output, name
        assert " nan" not in done.output.lower() and "inf " not in done.output.lower()
        figures = json.loads(done.stdout, parse_constant=pytest.fail)
        assert (figures["energy"]["start"] is None) == (name != "d")


@pytest.mark.parametrize("words", ["", "rows of 4 numbers don't fit in memory"])
def test_memory_that_does_not_suffice_is_said(
    words: str, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise MemoryError(*[words] * bool(words))

    monkeypatch.setattr(pipeline, "load", full)
    done = eomc("run", "p.toml")
    assert done.exit_code == 2
    assert done.output == f"eomc: {words or 'not enough memory'}\n"


def test_fewer_rows_than_one_in_all_steps(there: Path) -> None:
    done = eomc("run", "p.toml", "--every", "9" * 20, "--duration", "0.1", "--out", "run.csv")
    assert done.exit_code == 0, done.output
    assert len((there / "run.csv").read_text().splitlines()) == 3  # names, start and end


@pytest.mark.parametrize("number", ["0x" + "f" * 6000, "9" * 6000, "9" * 400, "-0b" + "1" * 1100])
@pytest.mark.parametrize("key", ["eomc  =", "start =", "m = { value =", "h        =", "batch ="])
def test_huge_whole_numbers(here: Path, number: str, key: str) -> None:
    text = (here / "p.toml").read_text(encoding="utf-8").replace("[run]\n", "[run]\nbatch = 1\n")
    old = next(line for line in text.splitlines() if key in line)
    start = old.index(key) + len(key)
    new = old[:start] + " " + number.replace("-0b", "0b") + (" }" if "{" in old else "")
    (here / "p.toml").write_text(text.replace(old, new), encoding="utf-8")
    done = eomc("build", "p.toml")
    assert done.exit_code == 2 and "a number has hundreds of digits" in done.output, done.output


@pytest.mark.parametrize(
    "value", ["[" * 20_000 + "]" * 20_000, "{a=" * 20_000 + "1" + "}" * 20_000]
)
def test_deep_nesting(here: Path, value: str) -> None:
    with (here / "p.toml").open("a", encoding="utf-8") as file:
        file.write(f"x = {value}\n")
    done = eomc("build", "p.toml")
    assert done.exit_code == 2 and "nested too deeply" in done.output
    assert eomc("list").exit_code == 0


def test_list_takes_whatever_calls_itself_a_scene(here: Path) -> None:
    text = 'eomc = 1\nname = "odd"\ncoordinates = 3\ninputs = [1]\n'
    (here / "odd.toml").write_text(text, encoding="utf-8")
    done = eomc("list")
    assert done.exit_code == 0 and "odd.toml" in done.output, done.output


@pytest.mark.slow
def test_a_full_output(here: Path) -> None:
    """Every command that prints; in processes of their own, whose end would fail once more."""
    assert eomc("build", "p.toml").exit_code == 0
    shutil.copy(SCENES / "cartpole_bodies.toml", here / "b.toml")
    for words in (
        "--help", "--version", "run --help", "list", "list --json", "new a", "dof b.toml",
        "dof b.toml --json", "show p.toml", "show p.toml --latex", "show p.toml --python",
        "show p.toml --cost", "build p.toml", "build p.toml --json", "run p.toml",
        "run p.toml --json", "check p.toml", "check p.toml --json",
    ):  # fmt: skip
        done = shell(f"eomc {words} >/dev/full")
        assert done.returncode == 2, words
        said = "eomc: the output: can't be written (No space left on device)\n"
        assert done.stderr == said, (words, done.stderr)
        assert shell(f"eomc {words} >/dev/full 2>/dev/full").returncode == 2, words


@pytest.mark.slow
def test_a_full_device_for_files(here: Path) -> None:
    for name in ("f.csv", "f.npz", "f.png", "f.svg"):
        (here / name).symlink_to("/dev/full")
        option = "--plot" if name > "f.o" else "--out"
        done = shell(f"eomc run p.toml {option} {name}")
        assert done.returncode == 2, done.stderr
        assert done.stderr == f"eomc: {name}: can't be written (No space left on device)\n"
    done = shell("ulimit -f 0; eomc new b")
    assert done.returncode == 2 and not (here / "b.toml").exists(), done.stderr
    done = shell("ulimit -f 0; eomc build p.toml --build other")
    assert done.returncode == 2 and "other" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.slow
def test_an_output_that_is_closed(here: Path) -> None:
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
        done = shell(line)
        assert (done.returncode, done.stderr) == (status, ""), (line, done.stderr)


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_without_an_output_at_all(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where the caller has closed it before Python began."""
    monkeypatch.setattr(sys, name, None)
    with pytest.raises(SystemExit) as ended:
        main(["list", "nowhere"])
    assert ended.value.code == 2
    with getattr(sys, name) as stream:
        assert stream.name == os.devnull


@pytest.mark.slow
def test_letters_that_the_output_has_not(here: Path) -> None:
    """In Latin-1, and of a file whose name is no text."""
    shutil.copy("p.toml", os.fsdecode(b"\xff.toml"))
    done = shell("PYTHONIOENCODING=latin-1 eomc show p.toml")
    assert "Traceback" not in done.stderr and "\\u03b8" in done.stdout, done.stderr
    done = shell(os.fsdecode(b"eomc build \xfe.toml; unset HOME; eomc run \xff.toml --plot x.png"))
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr


@pytest.mark.parametrize("command", ["build", "check", "report"])
def test_a_command_without_a_scene_says_what_is_missing(command: str, here: Path) -> None:
    done = eomc(command)
    assert done.exit_code == 2 and "Missing argument" in done.output, done.output


@pytest.mark.parametrize("quiet", [(), ("--quiet",)])
def test_a_check_that_fails_names_the_scene(
    quiet: tuple[str, ...], here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = CheckReport(
        "simple_pendulum", (CheckResult("D", 7.0, 1.0, False, "units"),), 1, 0, "none"
    )
    monkeypatch.setattr(check, "check", lambda *_, **__: report)
    monkeypatch.setattr(pipeline, "load", lambda *_, **__: None)
    done = eomc("check", "p.toml", *quiet)
    assert done.exit_code == 1 and done.output.endswith("\nFAILED: simple_pendulum\n"), done.output
