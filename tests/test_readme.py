"""The code and output in the README are correct."""

from __future__ import annotations

import doctest
import re
import subprocess
import tomllib
from pathlib import Path

from support.cases import SCENES
from support.session import MODULES, needs

import eomc

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    """Return the code blocks of a language, in order."""
    return re.findall(rf"```{language}\n(.*?)```", README, re.S)


def test_scene_is_the_shipped_one() -> None:
    (shown,) = map(tomllib.loads, blocks("toml"))
    whole = tomllib.loads((SCENES / "cartpole.toml").read_text(encoding="utf-8"))
    for table in ("energy", "definitions", "run"):
        assert shown[table] == whole[table]
    assert shown["parameters"] == {name: p["value"] for name, p in whole["parameters"].items()}
    for name, coordinate in shown["coordinates"].items():
        assert coordinate.items() <= whole["coordinates"][name].items()


def test_c_code_is_generated_and_program_prints_the_output(tmp_path: Path) -> None:
    files = eomc.sources(eomc.read(SCENES / "cartpole.toml")).files
    function, program = blocks("c")
    assert function in files["cartpole.c"]
    for name in ("cartpole.h", "cartpole.c"):
        (tmp_path / name).write_text(files[name], encoding="utf-8")
    (tmp_path / "main.c").write_text(program, encoding="utf-8")
    command, output = next(b for b in blocks("sh") if "a.out" in b).strip().split("\n")
    command = command.removeprefix("$ ").replace("cc ", needs("cc") + " ", 1)
    process = subprocess.run(command, shell=True, cwd=tmp_path, capture_output=True, text=True)
    assert process.stdout.strip() == output


def test_python_prints_the_output() -> None:
    (session,) = (b for b in blocks("python") if ">>>" in b)
    where = f"{str(SCENES / 'cartpole.toml')!r}, {str(MODULES)!r}"
    session = session.replace('"scenes/cartpole.toml"', where)
    test = doctest.DocTestParser().get_doctest(session, {}, "README.md", None, 0)
    assert doctest.DocTestRunner().run(test).failed == 0


def test_no_page_installs_eomc_from_a_package_index() -> None:
    """No index has a package of that name: clones and wheels are installed by path."""
    by_name = re.compile(r"""pip3? install (?:-\S+ )*\\?["']?eomc(?![\w./*-])""")
    assert by_name.search("pip install " + '"eomc[plot]"')
    assert not by_name.search("pip install dist/eomc-*.whl")
    root = Path(__file__).parents[1]
    places = [root / "README.md", root / "CONTRIBUTING.md"]
    for folder in ("docs", "generator", "templates", "tests", "benchmarks"):
        places += (root / folder).rglob("*")
    texts = (f for f in places if f.suffix in (".md", ".py", ".jinja", ".ipynb") and f.is_file())
    assert [f.name for f in texts if by_name.search(f.read_text(encoding="utf-8"))] == []


def headings(page: Path) -> set[str]:
    """Return the anchors of a page's headings, outside code blocks."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    titles = re.findall(r"^#+ +(.+?) *$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_links_between_pages_have_targets() -> None:
    root = Path(__file__).parents[1]
    broken = []
    for page in sorted([*root.glob("*.md"), *root.glob("docs/**/*.md")]):
        for to in re.findall(r"\]\(([^)\s:]+)\)", page.read_text(encoding="utf-8")):
            file, _, anchor = to.partition("#")
            there = (page.parent / file).resolve() if file else page
            if not there.exists() or (anchor and anchor not in headings(there)):
                broken.append(f"{page.name}: {to}")
    assert not broken
