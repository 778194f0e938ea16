"""eomc export fmu: files, messages, and what stands in the way."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from cases import SCENES
from click.testing import CliRunner
from conftest import ROOT
from fmus import needs_fmpy

import eomc
from eomc.base.errors import EomcError
from eomc.cli.main import main

BUILT = ROOT / "build" / "tests" / "fmu"
DOCUMENT = (ROOT / "docs" / "fmu.md").read_text(encoding="utf-8")


@pytest.fixture
def here(tmp_path: Path) -> Path:
    text = (SCENES / "simple_pendulum.toml").read_text(encoding="utf-8")
    (tmp_path / "simple_pendulum.toml").write_text(text, encoding="utf-8")
    return tmp_path


def export(here: Path, *words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "eomc", "export", "fmu", *words]
    return subprocess.run(
        command, cwd=here, capture_output=True, text=True, env=os.environ | variables
    )


@pytest.mark.parametrize(
    "version, binary",
    [
        pytest.param("2", "binaries/linux64/", marks=pytest.mark.slow),
        pytest.param("3", "binaries/x86_64-linux/", marks=pytest.mark.slow),
    ],
)
@pytest.mark.skipif(os.uname().machine != "x86_64", reason="names of other processors")
def test_it_holds_a_binary_and_sources(version: str, binary: str, here: Path) -> None:
    done = export(here, "simple_pendulum.toml", "--fmi", version, EOMC_CFLAGS="-O0")
    assert done.returncode == 0, done.stderr
    folder = binary.split("/")[1]
    assert done.stdout == (
        f"simple_pendulum.fmu: FMI {version}.0, sources and a binary for {folder}\n"
    )
    with zipfile.ZipFile(here / "simple_pendulum.fmu") as archive:
        names = set(archive.namelist())
        assert {e.date_time for e in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    assert {f"{binary}simple_pendulum.so", "modelDescription.xml", "sources/simple_pendulum.c",
            "sources/fmi/unit.h", "documentation/licenses/fmi-headers.txt"} <= names  # fmt: skip
    first = (here / "simple_pendulum.fmu").read_bytes()
    export(here, "simple_pendulum.toml", "--fmi", version, "-q", EOMC_CFLAGS="-O0")
    assert (here / "simple_pendulum.fmu").read_bytes() == first
    assert [p.name for p in here.iterdir() if p.name.startswith(".")] == []


def test_a_scene_or_a_file_that_is_no_unit_stays(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(here)
    scene = Path("simple_pendulum.toml")
    before = scene.read_bytes()
    Path("copied.fmu").write_bytes(before)
    Path("notes.fmu").write_text("notes", encoding="utf-8")
    for name, said in (
        ("simple_pendulum.toml", "give a name that ends in .fmu"),
        ("unit.zip", "give a name that ends in .fmu"),
        ("copied.fmu", "is a scene, and stays"),
        ("notes.fmu", "is no .fmu file, and stays"),
    ):
        words = ["export", "fmu", str(scene), "--sources", "--out", name]
        done = CliRunner().invoke(main, words)
        assert done.exit_code == 2 and said in done.output, done.output
    assert scene.read_bytes() == before == Path("copied.fmu").read_bytes()
    assert Path("notes.fmu").read_text(encoding="utf-8") == "notes"
    with pytest.raises(EomcError, match=r"written as \.fmu"):
        eomc.export_fmu(scene, scene, binary=False)
    for _ in range(2):  # a unit that is there is written anew
        eomc.export_fmu(scene, "unit.fmu", binary=False)
    assert Path("unit.fmu").read_bytes()[:2] == b"PK"
    done = CliRunner().invoke(main, ["report", str(scene), "--json", str(scene)])
    assert done.exit_code == 2 and "give a name that ends in .json" in done.output
    Path("run.csv").write_bytes(before)
    done = CliRunner().invoke(main, ["run", str(scene), "--out", "run.csv"])
    assert done.exit_code == 2 and "is a scene, and stays" in done.output
    assert scene.read_bytes() == before == Path("run.csv").read_bytes()


@pytest.mark.slow
def test_sources_alone_need_no_compiler(here: Path) -> None:
    (here / "none").mkdir()
    code = "import eomc.toolchain.compiler as c; c.importlib.util.find_spec = lambda _: None"
    words = "from eomc.cli.main import main; main(['export', 'fmu', 'simple_pendulum.toml'{}])"
    for more, said in (("", "sources only: no C compiler found"), (", '--sources'", "")):
        done = subprocess.run(
            [sys.executable, "-c", f"{code}; {words.format(more)}"], cwd=here, capture_output=True,
            text=True, env=os.environ | {"PATH": str(here / "none"), "CC": ""},
        )  # fmt: skip
        assert done.returncode == 0 and done.stderr.startswith(said), done.stderr
        assert done.stdout == "simple_pendulum.fmu: FMI 2.0, sources\n"
        names = zipfile.ZipFile(here / "simple_pendulum.fmu").namelist()
        assert not [n for n in names if n.startswith("binaries/")]
        (here / "simple_pendulum.fmu").unlink()


@pytest.mark.slow
def test_what_stands_in_the_way_is_named(here: Path) -> None:
    (here / "folder.fmu").mkdir()
    (here / "file").write_text("", encoding="utf-8")
    (here / "fails").write_text("#!/bin/sh\necho no such luck\nexit 1\n", encoding="utf-8")
    (here / "lies").write_text("#!/bin/sh\nfor x; do :; done\ntouch $x\n", encoding="utf-8")
    for name in ("fails", "lies"):
        (here / name).chmod(0o755)
    scene = "simple_pendulum.toml"
    for words, variables, said in (
        ([scene, "--out", "folder.fmu"], {}, "is a folder: name a file, --out simple_pendulum.fmu"),
        ([scene, "--out", "file/x.fmu"], {}, "file/x.fmu: can't be written"),
        ([scene], {"CC": "nonesuch"}, "the C compiler CC='nonesuch' is not there"),
        ([scene], {"CC": str(here / "fails")}, "no such luck"),
        ([scene], {"CC": str(here / "lies")}, "can't be loaded"),
        ([scene, "--fmi", "1"], {}, "'1' is not one of '2', '3'"),
        (["none.toml"], {}, "none.toml"),
    ):
        done = export(here, *words, **variables)
        assert done.returncode == 2 and said in done.stderr, done.stderr
        assert "Traceback" not in done.stderr
    left = {p.name for p in here.iterdir()}
    assert left == {scene, "folder.fmu", "file", "fails", "lies"}


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="there is no /proc")
def test_a_folder_that_can_not_be_written(here: Path) -> None:
    """Not even by root."""
    done = export(here, "simple_pendulum.toml", "--out", "/proc/x.fmu", "--sources")
    assert done.returncode == 2 and "/proc/x.fmu: can't be written" in done.stderr


@pytest.mark.slow
def test_the_page_is_followed_as_written(tmp_path: Path) -> None:
    needs_fmpy()
    commands = [c for b in re.findall(r"```sh\n(.*?)```", DOCUMENT, re.S) for c in b.splitlines()]
    (program,) = re.findall(r"```python\n(.*?)```", DOCUMENT, re.S)
    (tmp_path / "page.py").write_text(program, encoding="utf-8")
    place = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for command in [*commands[:2], f"{sys.executable} page.py", *commands[2:]]:
        done = subprocess.run(
            command, cwd=tmp_path, shell=True, capture_output=True, text=True,
            env=os.environ | {"PATH": place},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        if "page.py" in command:
            angle, energy = map(float, done.stdout.split())
            import eomc

            module = eomc.load(SCENES / "double_pendulum.toml", BUILT, form="plain")
            run = module.simulate(duration=2.0, params={"m1": 1.5})
            assert angle == pytest.approx(run.q[-1, 0], rel=1e-13)
            assert energy == pytest.approx(run.energy[-1], rel=1e-13)
    assert (tmp_path / "unit" / "double_pendulum.so").is_file()
