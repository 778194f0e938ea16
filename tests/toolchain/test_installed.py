"""What pip installs is enough: wheel, sdist and clone in a fresh environment, by every command."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest
from cases import SCENES
from conftest import ROOT
from toolchain.test_packaging import made

from eomc import pipeline

pytestmark = pytest.mark.slow
ROBOT = """<robot name="arm">
<link name="base"/>
<link name="rod"><inertial><origin xyz="0 0 -0.5"/><mass value="2"/>
<inertia ixx="0.2" iyy="0.2" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="1 0 0"/>
</joint></robot>
"""
COMMANDS = (
    ("new --from cartpole", "wrote cartpole.toml"),
    ("new", "wrote pendulum.toml"),
    ("list", "tumbling_box"),
    ("build cartpole.toml", "built in"),
    ("check cartpole.toml", "passed"),
    ("run cartpole.toml --out run.csv --plot run.png", "wrote run.png"),
    ("show cartpole.toml", "theta"),
    ("export fmu cartpole.toml", "sources and a binary"),
    ("import arm.urdf", "arm.toml"),
    ("dof arm.toml", "1"),
    ("report cartpole.toml --digits 3", "digits"),
)


def environment() -> dict[str, str]:
    """Ours without what would show a clone to Python."""
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "EOMC_CFLAGS")
    return {name: value for name, value in os.environ.items() if name not in hidden}


def pip(python: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [str(python), "-m", "pip", "install", "--quiet", "--retries", "0", *words]
    return subprocess.run(
        command, capture_output=True, text=True, env=environment(), cwd=python.parent
    )


def fresh(folder: Path) -> Path:
    """The Python of a new environment."""
    venv.create(folder, with_pip=True)
    return folder / "bin" / "python"


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with what the wheel asks for, with pictures."""
    folder = tmp_path_factory.mktemp("installed")
    wheel = made("wheel", ROOT, folder, "")
    found = fresh(folder / "venv")
    done = pip(found, f"{wheel}[plot]")
    if done.returncode:
        pytest.skip(f"its dependencies can't be installed: {done.stderr.strip()[-200:]}")
    return found


def interpreter(version: str) -> str:
    """Another Python, of the system or of pyenv; the test is skipped where there is none."""
    kept = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    for found in (shutil.which(f"python{version}"), *kept.glob(f"{version}.*/bin/python")):
        code = "import sys; print('%d.%d' % sys.version_info[:2])"
        done = subprocess.run([found or "false", "-c", code], capture_output=True, text=True)
        if done.stdout.strip() == version:
            return str(found)
    pytest.skip(f"there is no Python {version}")


def assert_says(python: Path, folder: Path, words: str, said: str) -> None:
    """The command in a folder, by the eomc beside that Python."""
    done = subprocess.run(
        [str(python.parent / "eomc"), *words.split()], capture_output=True, text=True,
        cwd=folder, env=environment(), stdin=subprocess.DEVNULL,
    )  # fmt: skip
    assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
    assert said in done.stdout, f"{words}: {done.stdout}"


@pytest.mark.parametrize("version", ["3.12", "3.13", "3.14"])
def test_other_pythons_build_and_run(
    version: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scenes, and the wheel of a model that this Python has made."""
    other = interpreter(version)
    subprocess.run([other, "-m", "venv", str(tmp_path / "venv")], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    done = pip(python, str(made("wheel", ROOT, tmp_path, "")))
    if done.returncode:
        pytest.skip(f"its dependencies can't be installed: {done.stderr.strip()[-200:]}")
    (tmp_path / "work").mkdir()
    for words, said in COMMANDS:
        if words.split()[0] in ("new", "build", "check", "show"):
            assert_says(python, tmp_path / "work", words, said)
    monkeypatch.setenv("EOMC_CFLAGS", "-O1")
    wheel = pipeline.write_wheel(SCENES / "furuta_pendulum.toml", tmp_path)
    assert pip(python, "--no-deps", str(wheel)).returncode == 0
    code = "import furuta_pendulum; print(furuta_pendulum.simulate(steps=100).status)"
    done = subprocess.run(
        [python, "-c", code], capture_output=True, text=True, cwd=tmp_path, env=environment()
    )
    assert done.stdout == "ok\n", done.stderr


@pytest.mark.parametrize("kind", ["wheel", "sdist", "clone"])
def test_every_command_works_where_pip_has_installed_it(
    kind: str, python: Path, tmp_path: Path
) -> None:
    if kind != "wheel":
        what = ROOT if kind == "clone" else made("sdist", ROOT, tmp_path, "")
        done = pip(python, "--no-deps", "--force-reinstall", str(what))
        assert done.returncode == 0, done.stderr
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "arm.urdf").write_text(ROBOT, encoding="utf-8")
    for words, said in COMMANDS:
        assert_says(python, tmp_path / "work", words, said)


def test_the_version_is_written_in_one_place(python: Path) -> None:
    said = subprocess.run(
        [str(python.parent / "eomc"), "--version"], capture_output=True, text=True,
        env=environment(),
    ).stdout  # fmt: skip
    code = "from importlib.metadata import version; print(version('eomc'))"
    command = [str(python), "-c", code]
    version = subprocess.run(command, capture_output=True, text=True, env=environment()).stdout
    assert re.fullmatch(r"eomc, version (\S+)\n", said)
    assert said.split()[-1] == version.strip() and sys.version_info >= (3, 11)
