"""Test free text on terminals, in pages and figures, and in scenes imported from robots."""

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
from click.testing import CliRunner
from support.cases import SCENES
from support.fake_module import FakeRun
from support.payloads import (
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
from support.session import tiers

import eomc
from eomc.base import texts
from eomc.cli import build, options
from eomc.cli.main import main
from eomc.model.system import System
from eomc.report import cost_of_digits, page, plot
from eomc.scene import read as scene
from eomc.toolchain.cache import Built


@pytest.fixture(autouse=True)
def no_payload_runs() -> Iterator[None]:
    with nothing_ran():
        yield


# --- pages, figures -------------------------------------------------------------------------------


class Tags(HTMLParser):
    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[Any] = []
        self.titles: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.tags.append((tag, attrs))

    def handle_data(self, data: str) -> None:
        if self.tags and self.tags[-1][0] in ("title", "h1"):
            self.titles.append(data)


@pytest.mark.slow
def test_report_page_escapes_titles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "without_pictures", lambda: "no pictures")
    measured = cost_of_digits.measure(
        derived().system, tmp_path, longest=0.002, methods=("rk4", "dp8")
    )
    plain = Tags(page.write_page(replace(measured, title="plain"))).tags
    for name, payload in PAYLOADS.items():
        text = page.write_page(replace(measured, title=payload))
        assert not RAW.search(text), name
        tags = Tags(text)
        assert tags.tags == plain, name
        assert texts.line(payload) in "".join(tags.titles), name


def figure_with(title: str, unit: str) -> Any:
    system = with_texts(derived().system, unit)
    return plot.make_figure(replace(system, title=title), curves(system))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["latex", "dollar", "dollar behind a backslash", "escape", "NUL"])
def test_figures_with_hostile_texts_are_valid_svg(name: str, tmp_path: Path) -> None:
    text = PAYLOADS[name]
    figure_with(text, text).savefig(tmp_path / "figure.svg")
    system = with_texts(derived().system, text)
    plot.write_figure(system, curves(system), tmp_path / "drawn.svg", title=text)
    for file in ("figure.svg", "drawn.svg"):
        ElementTree.parse(tmp_path / file)


def curves(system: System) -> FakeRun:
    t = np.linspace(0, 1, 11)
    q = np.cos(t)[:, None]
    others = {x.name: t for x in (*system.inputs, *system.outputs)}
    return FakeRun(system, t, q, q, 5 + 0 * t, others=others)


def test_figure_text_is_not_read_as_mathematics_or_latex() -> None:
    import matplotlib
    from matplotlib.cbook import is_math_text

    all_payloads = " ".join(PAYLOADS.values())
    with matplotlib.rc_context({"text.usetex": True}):
        figure = figure_with(all_payloads, "m")
    texts_of_figure = [text for text in figure.findobj(matplotlib.text.Text) if text.get_text()]
    assert texts_of_figure and not any(text.get_usetex() for text in texts_of_figure)
    for payload in PAYLOADS.values():
        shown = texts.figure(payload)
        assert not is_math_text(shown) and not RAW.search(shown)
        assert shown.replace(r"\$", "$") == texts.line(payload)  # as matplotlib draws the text
        assert is_math_text(f"$x$ ({shown})")  # the name before a unit is still mathematics


# --- the command ----------------------------------------------------------------------------------


def output_of(*words: str, status: int = 0) -> str:
    """Return the output of the command, which contains no terminal control sequence."""
    result = CliRunner().invoke(main, words)
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code == status, result.output
    assert not RAW.search(result.output), result.output
    return result.output


def file_name(payload: str) -> str:
    """Return a payload as a file name."""
    return os.fsdecode(
        payload.replace("/", "∕").replace("\0", "").replace("\ud800", "")
        .encode("utf-8", "surrogateescape")[:150].decode("utf-8", "surrogateescape")
        .encode("utf-8", "surrogateescape") + b"\xff"
    )  # fmt: skip


@pytest.fixture
def work_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    return tmp_path


def test_hostile_file_names_are_escaped(work_folder: Path) -> None:
    for payload in PAYLOADS.values():
        file = file_name(payload) + ".toml"
        Path(file).write_text(filled({}), encoding="utf-8")
        system = eomc.read(Path(file))
        assert system.file.isprintable() and not RAW.search(system.file)
        Path(file).write_text(filled({}).replace('"m"', '"mm"'), encoding="utf-8")
        assert "'mm' is not declared" in output_of("build", file, status=2)
        output = output_of("build", "no " + file, status=2)
        assert len(output.splitlines()) == 1 and "there is no such file" in output
        assert "one would replace" in output_of("build", file, str(work_folder / file), status=2)
    assert len(output_of("list", ".").splitlines()) == len(PAYLOADS)
    assert len(json.loads(output_of("list", ".", "--json"))) == len(PAYLOADS)


@pytest.mark.slow
def test_commands_escape_all_texts(work_folder: Path) -> None:
    """The scene has all texts that the reader accepts, and a file name with control sequences."""
    all_payloads = " ".join(PLAIN.values())
    file = "f\x1b]0;owned\x07[red]\n'\".toml"
    Path(file).write_text(filled({k: all_payloads for k, _ in fields()}), encoding="utf-8")
    assert "built in" in output_of("build", file)
    out = output_of(
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
    assert out.startswith(all_payloads)
    assert json.loads(output_of("run", file, "--json"))["scene"] == "fields"
    # the header contains names only
    assert Path("x.csv").read_text().splitlines()[0] == "t,x,x_dot,u,y,energy"
    ElementTree.parse("x.svg")
    page = Path("x.html").read_text(encoding="utf-8")
    assert str(texts.html(all_payloads)) in page and all_payloads not in page
    for form in ([], ["--cost"], ["--python"], ["--latex"]):
        output_of("show", file, *form)
    namespace: dict[str, Any] = {}
    exec(output_of("show", file, "--python"), namespace)
    output_of("check", file)
    output_of("dof", file)
    assert (
        all_payloads in output_of("list")
        and json.loads(output_of("list", ".", "--json"))[0]["title"] == all_payloads
    )


def test_only_the_terminal_module_prints() -> None:
    for file in Path(options.__file__).parent.glob("*.py"):
        source = file.read_text(encoding="utf-8")
        assert source.count("click.echo(") == 2 * (file.name == "options.py")
        assert not re.search(r"^\s*print\(", source, re.M)


TERMINAL = """
import time
from eomc.cli import options
with options.status_line({given!r}, False):
    time.sleep(0.2)
times = iter(range(0, 1000, 10))
options.time.monotonic = lambda: next(times)
with options.progress_bar({given!r}, False) as progress:
    progress(0, 2)
    progress(1, 2)
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["markup", "escape"])
def test_progress_shows_texts_literally(name: str) -> None:
    """Rich writes its own markup and controls; those in a file name are text."""
    payload = PAYLOADS[name][:40]
    terminal_output = terminal_output_of("-c", TERMINAL.format(given=payload))
    assert terminal_output.count(texts.line(payload).encode()) >= 2
    assert b"\x1b]0" not in terminal_output and b"\x1b]8" not in terminal_output


def test_build_shows_which_scene_is_built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Deriving the equations of a robot takes a minute."""
    files = [tmp_path / "one.toml", tmp_path / "two.toml"]
    for file in files:
        text = (SCENES / "mass_spring.toml").read_text(encoding="utf-8")
        file.write_text(text.replace("mass_spring", file.stem), encoding="utf-8")
    messages: list[str] = []

    def fake_build(scene: Path, root: Path, **_: Any) -> Built:
        return Built(scene.stem, root / scene.stem, False, "")

    monkeypatch.setattr(build.pipeline, "build", fake_build)
    monkeypatch.setattr(
        build, "status_line", lambda what, _: messages.append(what) or nullcontext()
    )
    for names in (files, files[:1]):
        assert CliRunner().invoke(main, ["build", *map(str, names)]).exit_code == 0
    assert messages == ["building one, 1 of 2", "building two, 2 of 2", "building one"]


def terminal_output_of(*words: str) -> bytes:
    """Return what Python writes to an interactive terminal."""
    controller, terminal_end = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "200"}
    process = subprocess.Popen([sys.executable, *words], stderr=terminal_end, env=environment)
    os.close(terminal_end)
    shown = b""
    while True:
        try:
            shown += os.read(controller, 65536)
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
def test_robot_files_with_hostile_names_are_imported(kind: str, work_folder: Path) -> None:
    imported = 0
    for k, (name, payload) in enumerate(PAYLOADS.items()):
        file = file_name(payload) + ".xml"
        # XML cannot represent these characters
        if re.search(r"[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff]", payload):
            data = kind.format(attribute("\x01"), attribute("b"))
            Path(file).write_text(data, encoding="utf-8")
            assert "not XML" in output_of("import", file, status=2), name
            continue
        data = kind.format(attribute(payload), attribute(payload + "b"))
        Path(file).write_text(data, encoding="utf-8")
        output = output_of("import", file, "--out", f"s{k}.toml")
        assert "wrote" in output, name
        imported_scene = scene.read(f"s{k}.toml")
        assert imported_scene.title.startswith(texts.line(payload)), name
        wrong = data.replace('type="revolute"', 'type="none"').replace('"hinge"', '"none"')
        Path(file).write_text(wrong, encoding="utf-8")
        output_of("import", file, status=2)
        imported += 1
    assert imported >= len(PLAIN) + 8


@pytest.mark.slow
@pytest.mark.parametrize("kind", tiers([URDF, MJCF], MJCF), ids=["urdf", "mjcf"])
@pytest.mark.parametrize(
    "name",
    tiers(
        ["docstring", "comment", "lines", "spliced", "spliced by a trigraph"],
        "docstring", "spliced by a trigraph",
    ),
)  # fmt: skip
def test_imported_robots_with_hostile_names_run(kind: str, name: str, work_folder: Path) -> None:
    payload = PAYLOADS[name]
    Path("r.xml").write_text(kind.format(attribute(payload), attribute("b")), encoding="utf-8")
    output_of("import", "r.xml", "--out", "r.toml")
    system = eomc.read("r.toml")
    files = eomc.sources(system).files
    bare = {name: text for name, text in files.items() if not name.endswith(".py")}
    assert "constructor" not in tokens(bare, work_folder)
    docstring = ast.get_docstring(ast.parse(files["__init__.py"]))
    assert docstring is not None and texts.line(payload) in docstring
    if name == "spliced by a trigraph":
        output_of("run", "r.toml", "--duration", "0.01", "--build", str(work_folder / "built"))
