"""Free text as it is shown: on terminals, in pages and figures, in the scenes of robots."""

from __future__ import annotations

import ast
import json
import os
import pty
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest
from cases import SCENES
from click.testing import CliRunner
from conftest import tiers
from markupsafe import Markup
from payloads import (
    PAYLOADS,
    PLAIN,
    RAW,
    derived,
    fields,
    filled,
    nothing_ran,
    tokens,
    with_texts,
)

import eomc
from eomc.base import texts
from eomc.cli import build, terminal
from eomc.cli.main import main
from eomc.report import cost_of_digits, page, plot
from eomc.scene import read as scene
from eomc.toolchain.cache import Built


@pytest.fixture(autouse=True)
def harmless() -> Iterator[None]:
    with nothing_ran():
        yield


# --- pages, figures -------------------------------------------------------------------------------


class Tags(HTMLParser):
    def __init__(self, page: str) -> None:
        super().__init__()
        self.seen: list[Any] = []
        self.titles: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.seen.append((tag, attrs))

    def handle_data(self, data: str) -> None:
        if self.seen and self.seen[-1][0] in ("title", "h1"):
            self.titles.append(data)


@pytest.mark.slow
def test_the_page_of_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "_svg", lambda draw, size: Markup("<svg></svg>"))  # no texts
    measured = cost_of_digits.measure(
        derived().system, tmp_path, longest=0.002, methods=("rk4", "dp8")
    )
    plain = Tags(page.write_page(replace(measured, title="plain"))).seen
    for name, given in PAYLOADS.items():
        text = page.write_page(replace(measured, title=given))
        assert not RAW.search(text), name
        read = Tags(text)
        assert read.seen == plain, name
        assert texts.line(given) in "".join(read.titles), name


def drawn(title: str, unit: str) -> Any:
    made = with_texts(derived().system, unit)
    return plot.make_figure(replace(made, title=title), curves())


@pytest.mark.slow
@pytest.mark.parametrize("given", ["latex", "dollar", "dollar behind a backslash", "escape", "NUL"])
def test_figures(given: str, tmp_path: Path) -> None:
    text = PAYLOADS[given]
    drawn(text, text).savefig(tmp_path / "figure.svg")
    made = with_texts(derived().system, text)
    plot.write_figure(made, curves(), tmp_path / "drawn.svg", title=text)
    for file in ("figure.svg", "drawn.svg"):
        ElementTree.parse(tmp_path / file)


def curves() -> plot.RunCurves:
    t = np.linspace(0, 1, 11)
    q = np.cos(t)[:, None]
    return plot.RunCurves(t, q, q, 5 + 0 * t)


def test_no_text_of_a_figure_is_mathematics_or_latex() -> None:
    import matplotlib
    from matplotlib.cbook import is_math_text

    every = " ".join(PAYLOADS.values())
    with matplotlib.rc_context({"text.usetex": True}):
        made = drawn(every, "m")
    found = [text for text in made.findobj(matplotlib.text.Text) if text.get_text()]
    assert found and not any(text.get_usetex() for text in found)
    for given in PAYLOADS.values():
        shown = texts.figure(given)
        assert not is_math_text(shown) and not RAW.search(shown)
        assert shown.replace(r"\$", "$") == texts.line(given)  # as matplotlib draws it
        assert is_math_text(f"$x$ ({shown})")  # and the name before a unit stays mathematics


# --- the command ----------------------------------------------------------------------------------


def said(*words: str, status: int = 0) -> str:
    """What the command prints, which never steers a terminal."""
    done = CliRunner().invoke(main, words)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    assert done.exit_code == status, done.output
    assert not RAW.search(done.output), done.output
    return done.output


def file_name(given: str) -> str:
    """A payload as the name of a file."""
    return os.fsdecode(
        given.replace("/", "∕").replace("\0", "").replace("\ud800", "")
        .encode("utf-8", "surrogateescape")[:150].decode("utf-8", "surrogateescape")
        .encode("utf-8", "surrogateescape") + b"\xff"
    )  # fmt: skip


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    return tmp_path


def test_hostile_file_names(here: Path) -> None:
    for given in PAYLOADS.values():
        file = file_name(given) + ".toml"
        Path(file).write_text(filled({}), encoding="utf-8")
        made = eomc.read(Path(file))
        assert made.file.isprintable() and not RAW.search(made.file)
        Path(file).write_text(filled({}).replace('"m"', '"mm"'), encoding="utf-8")
        assert "'mm' is not declared" in said("build", file, status=2)
        output = said("build", "no " + file, status=2)
        assert len(output.splitlines()) == 1 and "there is no such file" in output
        assert "one would replace" in said("build", file, str(here / file), status=2)
    assert len(said("list", ".").splitlines()) == len(PAYLOADS)
    assert len(json.loads(said("list", ".", "--json"))) == len(PAYLOADS)


@pytest.mark.slow
def test_the_commands_print_no_text_raw(here: Path) -> None:
    """A scene with all that the reader lets through, under a name that steers terminals."""
    every = " ".join(PLAIN.values())
    file = "f\x1b]0;owned\x07[red]\n'\".toml"
    Path(file).write_text(filled({k: every for k, _ in fields()}), encoding="utf-8")
    assert "built in" in said("build", file)
    out = said(
        "run",
        file,
        "--out",
        "x.csv",
        "--plot",
        "x.svg",
        "--animate",
        "x.html",
        "--build",
        "b\x1b[31m",
    )
    assert out.startswith(every)
    assert json.loads(said("run", file, "--json"))["scene"] == "fields"
    assert Path("x.csv").read_text().splitlines()[0] == "t,x,x_dot,u,y,energy"  # names only
    ElementTree.parse("x.svg")
    page = Path("x.html").read_text(encoding="utf-8")
    assert str(texts.html(every)) in page and every not in page
    for form in ([], ["--cost"], ["--python"], ["--latex"]):
        said("show", file, *form)
    namespace: dict[str, Any] = {}
    exec(said("show", file, "--python"), namespace)
    said("check", file)
    said("dof", file)
    assert every in said("list") and json.loads(said("list", ".", "--json"))[0]["title"] == every


def test_the_command_prints_through_its_border_alone() -> None:
    for file in Path(terminal.__file__).parent.glob("*.py"):
        source = file.read_text(encoding="utf-8")
        assert source.count("click.echo(") == 2 * (file.name == "terminal.py")
        assert not re.search(r"^\s*print\(", source, re.M)


TERMINAL = """
import time
from eomc.cli import terminal
with terminal.status_line({given!r}, False):
    time.sleep(0.2)
times = iter(range(0, 1000, 10))
terminal.time.monotonic = lambda: next(times)
with terminal.progress_bar({given!r}, False) as progress:
    progress(0, 2)
    progress(1, 2)
"""


@pytest.mark.parametrize("name", ["markup", "escape"])
def test_what_is_going_on_is_shown_as_it_is(name: str) -> None:
    """Rich's own markup and controls are its business; those of a file's name are text."""
    given = PAYLOADS[name][:40]
    shown = watched("-c", TERMINAL.format(given=given))
    assert shown.count(texts.line(given).encode()) >= 2
    assert b"\x1b]0" not in shown and b"\x1b]8" not in shown


def test_a_build_says_what_is_going_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Deriving a robot's equations takes a minute."""
    files = [tmp_path / "one.toml", tmp_path / "two.toml"]
    for file in files:
        text = (SCENES / "mass_spring.toml").read_text(encoding="utf-8")
        file.write_text(text.replace("mass_spring", file.stem), encoding="utf-8")
    said: list[str] = []

    def built(scene: Path, root: Path, **_: Any) -> Built:
        return Built(scene.stem, root / scene.stem, False, "")

    monkeypatch.setattr(build.pipeline, "build", built)
    monkeypatch.setattr(build, "status_line", lambda what, _: said.append(what) or nullcontext())
    for names in (files, files[:1]):
        assert CliRunner().invoke(main, ["build", *map(str, names)]).exit_code == 0
    assert said == ["building one, 1 of 2", "building two, 2 of 2", "building one"]


def watched(*words: str) -> bytes:
    """What Python shows where a person is watching."""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "200"}
    process = subprocess.Popen([sys.executable, *words], stderr=theirs, env=environment)
    os.close(theirs)
    shown = b""
    while True:
        try:
            shown += os.read(ours, 65536)
        except OSError:
            break
    assert process.wait() == 0, shown
    return shown


# --- robot files ----------------------------------------------------------------------------------

URDF = """<robot name={0}>
<link name={0}/>
<link name={1}><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>
</inertial></link>
<joint name={1} type="revolute"><parent link={0}/><child link={1}/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<material name={0}/><sensor name={0}/>
</robot>
"""
MJCF = """<mujoco model={0}><worldbody><body name={0}>
<joint name={1} type="hinge" axis="0 0 1"/>
<geom name={0} type="sphere" size="0.1" mass="1"/><site name={0}/>
<body name={1}><joint name={0} type="slide" axis="1 0 0"/><inertial pos="0 0 0" mass="1"
diaginertia="1 1 1"/></body></body></worldbody>
<actuator><motor name={0} joint={1}/></actuator>
<sensor><jointpos name={0} joint={1}/></sensor></mujoco>
"""


def attribute(text: str) -> str:
    return quoteattr(text, {"\n": "&#10;", "\r": "&#13;", "\t": "&#9;"})


@pytest.mark.parametrize("kind", tiers([URDF, MJCF], URDF), ids=["urdf", "mjcf"])
def test_robot_files_with_hostile_names(kind: str, here: Path) -> None:
    imported = 0
    for k, (name, given) in enumerate(PAYLOADS.items()):
        file = file_name(given) + ".xml"
        if re.search(r"[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff]", given):  # which XML can't hold
            data = kind.format(attribute("\x01"), attribute("b"))
            Path(file).write_text(data, encoding="utf-8")
            assert "not XML" in said("import", file, status=2), name
            continue
        data = kind.format(attribute(given), attribute(given + "b"))
        Path(file).write_text(data, encoding="utf-8")
        output = said("import", file, "--out", f"s{k}.toml")
        assert "wrote" in output, name
        read = scene.read(f"s{k}.toml")
        assert read.title.startswith(texts.line(given)), name
        wrong = data.replace('type="revolute"', 'type="none"').replace('"hinge"', '"none"')
        Path(file).write_text(wrong, encoding="utf-8")
        said("import", file, status=2)
        imported += 1
    assert imported >= len(PLAIN) + 8


@pytest.mark.parametrize("kind", tiers([URDF, MJCF], MJCF), ids=["urdf", "mjcf"])
@pytest.mark.parametrize(
    "name",
    tiers(
        ["docstring", "comment", "lines", "spliced", "spliced by a trigraph"],
        "docstring", "spliced by a trigraph",
    ),
)  # fmt: skip
def test_imported_robots_run(kind: str, name: str, here: Path) -> None:
    given = PAYLOADS[name]
    Path("r.xml").write_text(kind.format(attribute(given), attribute("b")), encoding="utf-8")
    said("import", "r.xml", "--out", "r.toml")
    made = eomc.read("r.toml")
    files = eomc.sources(made).files
    bare = {name: text for name, text in files.items() if not name.endswith(".py")}
    assert "constructor" not in tokens(bare, here)
    docstring = ast.get_docstring(ast.parse(files["__init__.py"]))
    assert docstring is not None and texts.line(given) in docstring
    if name == "spliced by a trigraph":
        said("run", "r.toml", "--duration", "0.01", "--build", str(here / "built"))
