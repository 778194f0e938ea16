"""Test every command after installation by pip, from the wheel, the sdist and a clone."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest
from support.cases import SCENES
from support.session import ROOT
from toolchain.test_packaging import build_distribution

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
    """Return the environment without variables that make the clone visible to Python."""
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "EOMC_CFLAGS")
    return {name: value for name, value in os.environ.items() if name not in hidden}


def pip(python: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [str(python), "-m", "pip", "install", "--quiet", "--retries", "0", *words]
    return subprocess.run(
        command, capture_output=True, text=True, env=environment(), cwd=python.parent
    )


def create_environment(folder: Path) -> Path:
    """Create a virtual environment and return its Python."""
    venv.create(folder, with_pip=True)
    return folder / "bin" / "python"


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the Python of an environment with the wheel, its dependencies and matplotlib."""
    folder = tmp_path_factory.mktemp("installed")
    wheel = build_distribution("wheel", ROOT, folder, "")
    executable = create_environment(folder / "venv")
    result = pip(executable, f"{wheel}[plot]")
    if result.returncode:
        pytest.skip(f"its dependencies can't be installed: {result.stderr.strip()[-200:]}")
    return executable


def interpreter(version: str) -> str:
    """Return another Python, of the system or of pyenv; skip the test if there is none."""
    pyenv_versions = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    for candidate in (
        shutil.which(f"python{version}"),
        *pyenv_versions.glob(f"{version}.*/bin/python"),
    ):
        code = "import sys; print('%d.%d' % sys.version_info[:2])"
        result = subprocess.run([candidate or "false", "-c", code], capture_output=True, text=True)
        if result.stdout.strip() == version:
            return str(candidate)
    pytest.skip(f"there is no Python {version}")


def assert_output(python: Path, folder: Path, words: str, expected: str) -> None:
    """Run a command in a folder by the eomc of that Python, and check its output."""
    result = subprocess.run(
        [str(python.parent / "eomc"), *words.split()], capture_output=True, text=True,
        cwd=folder, env=environment(), stdin=subprocess.DEVNULL,
    )  # fmt: skip
    assert result.returncode == 0, f"{words}: {result.stdout}{result.stderr}"
    assert expected in result.stdout, f"{words}: {result.stdout}"


@pytest.mark.parametrize("version", ["3.12", "3.13", "3.14"])
def test_other_python_versions_build_and_run(
    version: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Build scenes, and the wheel of a model, which this Python builds."""
    other = interpreter(version)
    subprocess.run([other, "-m", "venv", str(tmp_path / "venv")], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    result = pip(python, str(build_distribution("wheel", ROOT, tmp_path, "")))
    if result.returncode:
        pytest.skip(f"its dependencies can't be installed: {result.stderr.strip()[-200:]}")
    (tmp_path / "work").mkdir()
    for words, expected in COMMANDS:
        if words.split()[0] in ("new", "build", "check", "show"):
            assert_output(python, tmp_path / "work", words, expected)
    monkeypatch.setenv("EOMC_CFLAGS", "-O1")
    wheel = pipeline.write_wheel(SCENES / "furuta_pendulum.toml", tmp_path)
    assert pip(python, "--no-deps", str(wheel)).returncode == 0
    code = "import furuta_pendulum; print(furuta_pendulum.simulate(steps=100).status)"
    result = subprocess.run(
        [python, "-c", code], capture_output=True, text=True, cwd=tmp_path, env=environment()
    )
    assert result.stdout == "ok\n", result.stderr


@pytest.mark.parametrize("kind", ["wheel", "sdist", "clone"])
def test_every_command_works_after_installation_by_pip(
    kind: str, python: Path, tmp_path: Path
) -> None:
    if kind != "wheel":
        what = ROOT if kind == "clone" else build_distribution("sdist", ROOT, tmp_path, "")
        result = pip(python, "--no-deps", "--force-reinstall", str(what))
        assert result.returncode == 0, result.stderr
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "arm.urdf").write_text(ROBOT, encoding="utf-8")
    for words, expected in COMMANDS:
        assert_output(python, tmp_path / "work", words, expected)


def test_version_is_written_in_one_place(python: Path) -> None:
    output = subprocess.run(
        [str(python.parent / "eomc"), "--version"], capture_output=True, text=True,
        env=environment(),
    ).stdout  # fmt: skip
    code = "from importlib.metadata import version; print(version('eomc'))"
    command = [str(python), "-c", code]
    version = subprocess.run(command, capture_output=True, text=True, env=environment()).stdout
    assert re.fullmatch(r"eomc, version (\S+)\n", output)
    assert output.split()[-1] == version.strip() and sys.version_info >= (3, 11)
