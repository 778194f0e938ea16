"""Test eomc export fmu: its files, its messages, and what prevents an export."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from click.testing import CliRunner
from support.cases import SCENES
from support.fmus import needs_fmpy
from support.session import ROOT

import eomc
from eomc.base.errors import EomcError
from eomc.cli.main import main

BUILT = ROOT / "build" / "tests" / "fmu"
DOCUMENT = (ROOT / "docs" / "fmu.md").read_text(encoding="utf-8")


@pytest.fixture
def scene_folder(tmp_path: Path) -> Path:
    text = (SCENES / "simple_pendulum.toml").read_text(encoding="utf-8")
    (tmp_path / "simple_pendulum.toml").write_text(text, encoding="utf-8")
    return tmp_path


def export(scene_folder: Path, *words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "eomc", "export", "fmu", *words]
    return subprocess.run(
        command, cwd=scene_folder, capture_output=True, text=True, env=os.environ | variables
    )


@pytest.mark.parametrize(
    "version, binary",
    [
        pytest.param("2", "binaries/linux64/", marks=pytest.mark.slow),
        pytest.param("3", "binaries/x86_64-linux/", marks=pytest.mark.slow),
    ],
)
@pytest.mark.skipif(os.uname().machine != "x86_64", reason="names of other processors")
def test_fmu_contains_binary_and_sources(version: str, binary: str, scene_folder: Path) -> None:
    result = export(scene_folder, "simple_pendulum.toml", "--fmi", version, EOMC_CFLAGS="-O0")
    assert result.returncode == 0, result.stderr
    folder = binary.split("/")[1]
    assert result.stdout == (
        f"simple_pendulum.fmu: FMI {version}.0, sources and a binary for {folder}\n"
    )
    with zipfile.ZipFile(scene_folder / "simple_pendulum.fmu") as archive:
        names = set(archive.namelist())
        assert {e.date_time for e in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    assert {f"{binary}simple_pendulum.so", "modelDescription.xml", "sources/simple_pendulum.c",
            "sources/fmi/unit.h", "documentation/licenses/fmi-headers.txt"} <= names  # fmt: skip
    first = (scene_folder / "simple_pendulum.fmu").read_bytes()
    export(scene_folder, "simple_pendulum.toml", "--fmi", version, "-q", EOMC_CFLAGS="-O0")
    assert (scene_folder / "simple_pendulum.fmu").read_bytes() == first
    assert [p.name for p in scene_folder.iterdir() if p.name.startswith(".")] == []


def test_export_does_not_overwrite_other_files(
    scene_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(scene_folder)
    scene = Path("simple_pendulum.toml")
    before = scene.read_bytes()
    Path("copied.fmu").write_bytes(before)
    Path("notes.fmu").write_text("notes", encoding="utf-8")
    for name, message in (
        ("simple_pendulum.toml", "give a name that ends in .fmu"),
        ("unit.zip", "give a name that ends in .fmu"),
        ("copied.fmu", "is a scene, and stays"),
        ("notes.fmu", "is no .fmu file, and stays"),
    ):
        words = ["export", "fmu", str(scene), "--sources", "--out", name]
        result = CliRunner().invoke(main, words)
        assert result.exit_code == 2 and message in result.output, result.output
    assert scene.read_bytes() == before == Path("copied.fmu").read_bytes()
    assert Path("notes.fmu").read_text(encoding="utf-8") == "notes"
    with pytest.raises(EomcError, match=r"written as \.fmu"):
        eomc.export_fmu(scene, scene, binary=False)
    for _ in range(2):  # an existing unit is replaced
        eomc.export_fmu(scene, "unit.fmu", binary=False)
    assert Path("unit.fmu").read_bytes()[:2] == b"PK"
    result = CliRunner().invoke(main, ["report", str(scene), "--json", str(scene)])
    assert result.exit_code == 2 and "give a name that ends in .json" in result.output
    Path("run.csv").write_bytes(before)
    result = CliRunner().invoke(main, ["run", str(scene), "--out", "run.csv"])
    assert result.exit_code == 2 and "is a scene, and stays" in result.output
    assert scene.read_bytes() == before == Path("run.csv").read_bytes()


@pytest.mark.slow
def test_export_of_sources_needs_no_compiler(scene_folder: Path) -> None:
    (scene_folder / "none").mkdir()
    code = "import eomc.toolchain.compiler as c; c.importlib.util.find_spec = lambda _: None"
    words = "from eomc.cli.main import main; main(['export', 'fmu', 'simple_pendulum.toml'{}])"
    for options, message in (("", "sources only: no C compiler found"), (", '--sources'", "")):
        process = subprocess.run(
            [sys.executable, "-c", f"{code}; {words.format(options)}"], cwd=scene_folder,
            capture_output=True, text=True,
            env=os.environ | {"PATH": str(scene_folder / "none"), "CC": ""},
        )  # fmt: skip
        assert process.returncode == 0 and process.stderr.startswith(message), process.stderr
        assert process.stdout == "simple_pendulum.fmu: FMI 2.0, sources\n"
        names = zipfile.ZipFile(scene_folder / "simple_pendulum.fmu").namelist()
        assert not [n for n in names if n.startswith("binaries/")]
        (scene_folder / "simple_pendulum.fmu").unlink()


@pytest.mark.slow
def test_obstacles_to_an_export_are_named(scene_folder: Path) -> None:
    (scene_folder / "folder.fmu").mkdir()
    (scene_folder / "file").write_text("", encoding="utf-8")
    (scene_folder / "fails").write_text("#!/bin/sh\necho no such luck\nexit 1\n", encoding="utf-8")
    (scene_folder / "lies").write_text("#!/bin/sh\nfor x; do :; done\ntouch $x\n", encoding="utf-8")
    for name in ("fails", "lies"):
        (scene_folder / name).chmod(0o755)
    scene = "simple_pendulum.toml"
    for words, variables, message in (
        ([scene, "--out", "folder.fmu"], {}, "is a folder: name a file, --out simple_pendulum.fmu"),
        ([scene, "--out", "file/x.fmu"], {}, "file/x.fmu: can't be written"),
        ([scene], {"CC": "nonesuch"}, "the C compiler CC='nonesuch' is not there"),
        ([scene], {"CC": str(scene_folder / "fails")}, "no such luck"),
        ([scene], {"CC": str(scene_folder / "lies")}, "can't be loaded"),
        ([scene, "--fmi", "1"], {}, "'1' is not one of '2', '3'"),
        (["none.toml"], {}, "none.toml"),
    ):
        result = export(scene_folder, *words, **variables)
        assert result.returncode == 2 and message in result.stderr, result.stderr
        assert "Traceback" not in result.stderr
    left = {p.name for p in scene_folder.iterdir()}
    assert left == {scene, "folder.fmu", "file", "fails", "lies"}


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="there is no /proc")
def test_export_to_unwritable_folder_is_refused(scene_folder: Path) -> None:
    """Not even root can write there."""
    result = export(scene_folder, "simple_pendulum.toml", "--out", "/proc/x.fmu", "--sources")
    assert result.returncode == 2 and "/proc/x.fmu: can't be written" in result.stderr


@pytest.mark.slow
def test_commands_of_the_export_page_run(tmp_path: Path) -> None:
    needs_fmpy()
    commands = [c for b in re.findall(r"```sh\n(.*?)```", DOCUMENT, re.S) for c in b.splitlines()]
    (program,) = re.findall(r"```python\n(.*?)```", DOCUMENT, re.S)
    (tmp_path / "page.py").write_text(program, encoding="utf-8")
    place = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for command in [*commands[:2], f"{sys.executable} page.py", *commands[2:]]:
        process = subprocess.run(
            command, cwd=tmp_path, shell=True, capture_output=True, text=True,
            env=os.environ | {"PATH": place},
        )  # fmt: skip
        assert process.returncode == 0, process.stderr
        if "page.py" in command:
            angle, energy = map(float, process.stdout.split())
            import eomc

            module = eomc.load(SCENES / "double_pendulum.toml", BUILT, form="plain")
            run = module.simulate(duration=2.0, params={"m1": 1.5})
            assert angle == pytest.approx(run.q[-1, 0], rel=1e-13)
            assert energy == pytest.approx(run.energy[-1], rel=1e-13)
    assert (tmp_path / "unit" / "double_pendulum.so").is_file()
