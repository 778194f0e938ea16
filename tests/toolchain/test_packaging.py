"""The wheel contains all files that a build needs, and so does a wheel built from the sdist."""

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
from support.cases import SCENES
from support.session import ROOT

pytestmark = pytest.mark.slow
RUN = "import eomc; print(eomc.__file__); print(eomc.load('cartpole.toml').simulate().status)"


def run_command(*command: str, at: Path, **variables: str) -> str:
    process = subprocess.run(
        command, cwd=at, capture_output=True, text=True, env={**os.environ, **variables}
    )
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


def package_files() -> set[str]:
    """Return the files of the package, named as in a wheel."""
    targets = {ROOT / "generator/eomc": "eomc"}
    targets |= {ROOT / kind: f"eomc/{kind}" for kind in ("templates", "csrc", "scenes")}
    return {
        f"{target}/{file.relative_to(folder).as_posix()}"
        for folder, target in targets.items()
        for file in folder.rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    }


@pytest.fixture(scope="module")
def backend(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return a PYTHONPATH that contains hatchling."""
    if importlib.util.find_spec("hatchling") is not None:
        return ""
    folder = tmp_path_factory.mktemp("backend")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--target", str(folder), "hatchling"]
    process = subprocess.run([*pip, "--retries", "0"], capture_output=True, text=True)
    if process.returncode:
        pytest.skip(
            f"hatchling is not here and can't be installed: {process.stderr.strip()[-200:]}"
        )
    return str(folder)


def build_distribution(kind: str, source: Path, out: Path, backend: str) -> Path:
    """Build a wheel or sdist of a source tree and return its path."""
    code = f"from hatchling.build import build_{kind} as b; print(b({str(out)!r}))"
    name = run_command(sys.executable, "-c", code, at=source, PYTHONPATH=backend)
    return out / name.splitlines()[-1]


def test_wheels_of_the_clone_and_of_the_sdist_are_equal(tmp_path: Path, backend: str) -> None:
    """A scene also builds from the installed wheel, beside a folder called eomc."""
    wheel = build_distribution("wheel", ROOT, tmp_path, backend)
    sdist = build_distribution("sdist", ROOT, tmp_path, backend)
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    (tmp_path / "second").mkdir()
    second = build_distribution("wheel", unpacked, tmp_path / "second", backend)
    names = set(zipfile.ZipFile(wheel).namelist())
    assert names == set(zipfile.ZipFile(second).namelist())
    assert {
        name for name in names if not name.split("/")[0].endswith(".dist-info")
    } == package_files()
    assert "eomc/py.typed" in names

    site, empty = tmp_path / "site", tmp_path / "empty"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target"]
    run_command(*pip, str(site), str(second), at=tmp_path)
    (empty / "eomc").mkdir(parents=True)
    shutil.copy(SCENES / "cartpole.toml", empty)
    how = {"PYTHONPATH": str(site), "EOMC_CFLAGS": "-O0"}
    output = run_command(sys.executable, "-m", "eomc", "build", "cartpole.toml", at=empty, **how)
    assert output.startswith("build/cartpole/: built in ")
    place, status = run_command(sys.executable, "-c", RUN, at=empty, **how).split()
    assert Path(place).is_relative_to(site) and status == "ok"
    script = (site / "bin" / "eomc").read_text(encoding="utf-8")
    assert "from eomc.cli.main import main" in script


@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_same_sources_give_the_same_bytes(kind: str, tmp_path: Path, backend: str) -> None:
    """In another folder, with other dates and permissions: the archives contain no date."""
    keep = "generator templates csrc scenes README.md LICENSE CHANGELOG.md pyproject.toml".split()
    archives = []
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
        build_distribution(kind, source, tmp_path / place / "out", backend)
        (file,) = (tmp_path / place / "out").iterdir()
        archives.append((file.name, file.read_bytes()))
    assert archives[0] == archives[1]
