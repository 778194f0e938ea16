"""The wheel holds all that a build needs, and so does the wheel made of the sdist."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from cases import SCENES
from conftest import ROOT

pytestmark = pytest.mark.slow
RUN = "import eomc; print(eomc.__file__); print(eomc.load('cartpole.toml').simulate().status)"


def ran(*command: str, at: Path, **variables: str) -> str:
    done = subprocess.run(
        command, cwd=at, capture_output=True, text=True, env={**os.environ, **variables}
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def expected() -> set[str]:
    """The files of the package, as a wheel has them."""
    places = {ROOT / "generator/eomc": "eomc"}
    places |= {ROOT / kind: f"eomc/{kind}" for kind in ("templates", "csrc", "scenes")}
    return {
        f"{place}/{file.relative_to(folder).as_posix()}"
        for folder, place in places.items()
        for file in folder.rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    }


@pytest.fixture(scope="module")
def backend(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A PYTHONPATH that has hatchling."""
    if importlib.util.find_spec("hatchling") is not None:
        return ""
    folder = tmp_path_factory.mktemp("backend")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--target", str(folder), "hatchling"]
    done = subprocess.run([*pip, "--retries", "0"], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"hatchling is not here and can't be installed: {done.stderr.strip()[-200:]}")
    return str(folder)


def made(kind: str, source: Path, out: Path, backend: str) -> Path:
    """A wheel or sdist of a source tree."""
    code = f"from hatchling.build import build_{kind} as b; print(b({str(out)!r}))"
    name = ran(sys.executable, "-c", code, at=source, PYTHONPATH=backend)
    return out / name.splitlines()[-1]


def test_a_wheel_and_one_of_the_sdist(tmp_path: Path, backend: str) -> None:
    """The same files, and a scene builds from the installed one, beside a folder called eomc."""
    wheel = made("wheel", ROOT, tmp_path, backend)
    sdist = made("sdist", ROOT, tmp_path, backend)
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    (tmp_path / "second").mkdir()
    second = made("wheel", unpacked, tmp_path / "second", backend)
    held = set(zipfile.ZipFile(wheel).namelist())
    assert held == set(zipfile.ZipFile(second).namelist())
    assert {name for name in held if not name.split("/")[0].endswith(".dist-info")} == expected()
    assert "eomc/py.typed" in held

    site, empty = tmp_path / "site", tmp_path / "empty"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target"]
    ran(*pip, str(site), str(second), at=tmp_path)
    (empty / "eomc").mkdir(parents=True)
    shutil.copy(SCENES / "cartpole.toml", empty)
    how = {"PYTHONPATH": str(site), "EOMC_CFLAGS": "-O0"}
    said = ran(sys.executable, "-m", "eomc", "build", "cartpole.toml", at=empty, **how)
    assert said.startswith("build/cartpole/: built in ")
    place, status = ran(sys.executable, "-c", RUN, at=empty, **how).split()
    assert Path(place).is_relative_to(site) and status == "ok"
    script = (site / "bin" / "eomc").read_text(encoding="utf-8")
    assert "from eomc.cli.main import main" in script


@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_the_same_sources_make_the_same_bytes(kind: str, tmp_path: Path, backend: str) -> None:
    """In another folder, with other times and rights of its files: no date goes in."""
    keep = "generator templates csrc scenes README.md LICENSE CHANGELOG.md pyproject.toml".split()
    found = []
    for place, mask, stamp in (
        ("one", 0o022, 1_000_000_000),
        ("other/deeper", 0o002, 1_500_000_000),
    ):
        source = tmp_path / place / "tree"
        source.mkdir(parents=True)
        for name in keep:
            skip = shutil.ignore_patterns("__pycache__")
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, source / name, ignore=skip)
            else:
                shutil.copy(ROOT / name, source / name)
        for file in source.rglob("*"):
            os.utime(file, (stamp, stamp))
            file.chmod(0o777 & ~mask if file.is_dir() else 0o666 & ~mask)
        (tmp_path / place / "out").mkdir()
        made(kind, source, tmp_path / place / "out", backend)
        (file,) = (tmp_path / place / "out").iterdir()
        found.append((file.name, file.read_bytes()))
    assert found[0] == found[1]
