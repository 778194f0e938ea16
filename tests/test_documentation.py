"""The pages of the documentation form a site, with its generated parts."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest
from support.session import ROOT, needs

import eomc
from eomc.base import resources
from eomc.scene import schema

DOCS = ROOT / "docs"
LISTED = re.compile(r"^- \[[^\]]*\]\((?!\.\.)([^)#:]+\.(?:md|ipynb))\)", re.MULTILINE)
SECTIONS = ("README.md", "tutorials.md", "how-to.md", "reference.md", "explanation.md")


@pytest.fixture(scope="module")
def pages() -> ModuleType:
    """The module that writes the generated parts of pages."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS / "site"))
        import scene_pages
    return scene_pages


def test_every_page_is_listed_in_one_section() -> None:
    """Add a new page to docs/tutorials.md, how-to.md, reference.md or explanation.md."""
    listed = Counter(
        page for name in SECTIONS for page in LISTED.findall((DOCS / name).read_text("utf-8"))
    )
    files = [file for pattern in ("*.md", "*.ipynb") for file in DOCS.rglob(pattern)]
    names = {file.relative_to(DOCS).as_posix() for file in files}
    assert listed == Counter(names - {"README.md"})


def test_reference_has_every_key_of_a_scene(pages: ModuleType) -> None:
    text = pages.describe_keys()
    sections = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL))
    for name, key in schema.keys(schema.Document).items():
        if key.type and not key.container:
            assert f"| `{name}` | {key.type.name} |" in sections["Top of the file"]
            continue
        section = sections[f"`[[{name}]]`" if key.container == "array" else f"`[{name}]`"]
        assert key.about in section
        rows = re.findall(r"^\| `(\w+)` \| .* \| ([^|]+) \|$", section, re.MULTILINE)
        inner = schema.keys(key.table) if key.table else {}
        assert rows == [(own, each.about) for own, each in inner.items()]
    assert all(
        f"| {key.type.name} | {key.type.words} |" in sections["Types of values"]
        for key in schema.keys(schema.Document).values()
        if key.type
    )


def test_guide_to_scenes_has_the_keys_and_defaults_of_the_schema(pages: ModuleType) -> None:
    text = (DOCS / "scenes.md").read_text(encoding="utf-8")
    tables = schema.keys(schema.Document)
    compared = set()
    # a table of the page, or the rows of one that follow the name of a table of the scene
    head = r"^\| (?:key of `|\*\*`)\[+(\w+)\]+`.*\n"
    for name, rows in re.findall(rf"{head}((?:\| `\.?\w.*\n|\|-.*\n)+)", text, re.MULTILINE):
        model = tables[name].table
        generated = find_defaults("\n".join(pages._table(model, schema.keys(model))))
        own = find_defaults(rows)
        assert own == {key: generated[key] for key in own}, name
        assert generated.keys() - own.keys() <= {"unit", "note"}, name
        compared.add(name)
    assert compared >= {"coordinates", "inputs", "energy", "run", "body", "spring", "force"}


def find_defaults(table: str) -> dict[str, str]:
    """Return the first word of the default of each key in the rows of a table."""
    words = {"empty": "none", "origins": "origin"}
    rows = [re.split(r" *(?<!\\)\| *", line)[1:] for line in table.splitlines()]
    return {
        key: words.get(first, first)
        for keys, _, default, *_ in rows
        if (first := default.removeprefix("the ").strip("`").split(" ")[0].strip(","))
        for key in re.findall(r"`\.?(\w+)`", keys)
    }


def test_reference_has_every_function_of_the_header(pages: ModuleType) -> None:
    file = DOCS / "reference" / "every_function.toml"
    scene = eomc.read(file)
    header = eomc.sources(scene).files["arm.h"]
    names = re.findall(r"\b(arm_\w+)\((?=[^;{]*\);)", re.sub(r"/\*.*?\*/", "", header, flags=re.S))
    text = pages.describe_c_functions(file)
    assert re.findall(r"c:function\} .*?(arm_\w+)\(", text) == names
    assert header in text and len(names) > 25
    settings = {name for name, key in schema.keys(schema.RunSettings).items()} - {
        "real",
        "friction",
    }
    written = {*tomllib.loads(file.read_text(encoding="utf-8"))["run"]}
    assert settings - written == {"h", "duration", "batch"}


def test_equations_of_a_scene_are_in_the_gallery(pages: ModuleType, tmp_path: Path) -> None:
    pytest.importorskip("latex2mathml")
    pytest.importorskip("matplotlib")
    text = pages.describe_scene(resources.scenes()["simple_pendulum"], tmp_path, tmp_path / "a.svg")
    assert "<math" in text and "</details>" in text
    assert "eomc run scenes/simple_pendulum.toml --plot a.svg" in text
    assert (tmp_path / "a.svg").read_text(encoding="utf-8").startswith("<?xml")


@pytest.mark.slow
def test_site_is_built_without_warnings_and_its_search_finds_tasks(tmp_path: Path) -> None:
    for package in ("sphinx", "myst_nb", "numpydoc", "pydata_sphinx_theme", "sphinx_click"):
        pytest.importorskip(package, reason=f"{package} is not installed: pip install '.[docs]'")
    site = tmp_path / "site"
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    process = subprocess.run(
        [*command, "-d", tmp_path / "cache", DOCS, site], capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr
    assert (site / "index.html").is_file()
    for page in site.rglob("*.html"):
        check_page(page)
    text = (site / "searchindex.js").read_text(encoding="utf-8")
    index = json.loads(text.removeprefix("Search.setIndex(").removesuffix(")"))
    objects = {f"{part}.{row[4]}" for part, rows in index["objects"].items() for row in rows}
    assert {".arm_integrate", "eomc.load"} <= objects
    check_search(site)


def check_page(page: Path) -> None:
    """Check that a page loads nothing from elsewhere, and that what it loads exists."""
    text = page.read_text(encoding="utf-8")
    loaded = re.findall(r"<(?:script|link|img|iframe)[^>]* (?:src|href)=\"(https?:[^\"]*)", text)
    assert not loaded, f"{page.name} loads {loaded} from elsewhere"
    images = re.findall(r'<img[^>]* src="(?!data:)([^"]+)"', text)
    scripts = re.findall(r'<script defer="defer" src="([^"?]+)', text)
    assert all((page.parent / file).exists() for file in (*images, *scripts)), page.name


def check_search(site: Path) -> None:
    """Check that the first result of the search answers nine in ten tasks of users."""
    lines = (ROOT / "tests" / "site_searches.txt").read_text(encoding="utf-8").splitlines()
    tasks = dict(line.split(" | ") for line in lines if " | " in line and line[0] != "#")
    process = subprocess.run(
        [needs("node"), ROOT / "tests" / "support" / "search_site.js", site / "_static"],
        input="\n".join(tasks), capture_output=True, text=True, check=True,
    )  # fmt: skip
    firsts = [(pages or ["nothing"])[0].partition("#")[0] for pages in json.loads(process.stdout)]
    wrong = {
        task: first
        for (task, right), first in zip(tasks.items(), firsts, strict=True)
        if first not in right.split()
    }
    assert len(wrong) <= 0.1 * len(tasks), wrong
