"""docs/SECURITY.md lists what is shipped and its dependencies, with up-to-date licences."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, metadata, requires
from pathlib import Path

from packaging.requirements import Requirement
from support.session import ROOT
from test_architecture import modules, nodes

import eomc

PAGE = (ROOT / "docs" / "SECURITY.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| ([\w-]+) \| (>=[\d.]+) \| (MIT|BSD|PSF|Apache) \| (.+) \|$", PAGE, re.M)
EXTRAS = {
    "plot": "eomc[plot]",
    "cc": "eomc[cc]",
    "sweep": "eomc[sweep]",
    "cluster": "eomc[cluster]",
}
SHIPPED = [f for part in ("generator/eomc", "templates", "csrc", "scenes") for f in
           (ROOT / part).rglob("*") if f.is_file() and "__pycache__" not in f.parts]  # fmt: skip


def licences(package: str) -> str:
    """Return the licence fields of a package's metadata."""
    fields = metadata(package)
    classified = [c for c in fields.get_all("Classifier", []) if c.startswith("License")]
    words = " ".join([fields.get("License-Expression", ""), fields.get("License", ""), *classified])
    return words.replace("Python Software Foundation", "PSF")


def test_table_lists_the_declared_dependencies() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    expected = dict.fromkeys(project["dependencies"], "")
    for extra, words in EXTRAS.items():
        packages = project["optional-dependencies"][extra]
        expected |= {package: words for package in packages if not package.startswith("eomc[")}
    assert {name + bound for name, bound, *_ in ROWS} == set(expected)
    for name, bound, _, use in ROWS:
        assert (f"(`{expected[name + bound]}`)" in use) == bool(expected[name + bound])


def test_licences_are_those_of_the_packages() -> None:
    count = 0
    for name, _, licence, _ in ROWS:
        try:
            words = licences(name)
        except PackageNotFoundError:
            continue
        assert licence in words, (name, words)
        count += 1
    assert count >= 8


def test_indirect_dependencies_are_listed() -> None:
    """Without extras, and including those that eomc itself requires."""
    listed = {name.strip().lower() for name in PAGE.split("need (")[1].split("):")[0].split(",")}
    direct = {name for name, *_, use in ROWS if "eomc[" not in use}
    needed: set[str] = set()
    waiting = sorted(direct)
    while waiting:
        for text in requires(waiting.pop()) or []:
            one = Requirement(text)
            if one.marker is None or one.marker.evaluate({"extra": ""}):
                name = one.name.lower().replace("_", "-")
                if name not in needed | direct:
                    needed.add(name)
                    waiting.append(name)
    assert needed <= {name.replace("\n", " ").strip() for name in listed}


def test_only_listed_packages_are_imported() -> None:
    imported = set()
    for name in modules():
        for node in nodes(name):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                imported.add(str(node.module).split(".")[0])
    others = imported - sys.stdlib_module_names - {"eomc"}
    own = {
        "_cffi_backend": "cffi",
        "mpmath": "sympy",
        "markupsafe": "jinja2",
        "PIL": "matplotlib",
    }
    assert {own.get(name, name) for name in others} == {name for name, *_ in ROWS}


def test_third_party_work_is_named() -> None:
    theirs = {f.relative_to(ROOT) for f in SHIPPED if b"Copyright" in f.read_bytes()}
    assert theirs == {Path(f"csrc/fmi/{name}") for name in [
        "LICENSE.txt", "fmi2FunctionTypes.h", "fmi2Functions.h", "fmi2TypesPlatform.h",
        "fmi3FunctionTypes.h", "fmi3Functions.h", "fmi3PlatformTypes.h",
    ]}  # fmt: skip
    texts = {".py", ".jinja", ".h", ".c", ".toml", ".txt", ".typed"}
    assert {f.suffix for f in SHIPPED} <= texts  # nothing compiled, minified or packed


def test_pages_load_no_external_resources() -> None:
    for page in (ROOT / "templates" / "report").glob("*.html.jinja"):
        text = page.read_text(encoding="utf-8")
        assert "default-src 'none'" in text, page
        assert not re.search(r"<script[^>]* src|<link|@import|url\((?!data:)|//[\w.]+/", text), page


def test_citation_has_the_version_and_the_licence_of_the_package() -> None:
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    fields = dict(re.findall(r'^([\w-]+): "?([^"\n>]+)"?$', text, re.MULTILINE))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert fields["version"] == eomc.__version__
    assert fields["license"] == project["license"]
    assert f'- name: "{project["authors"][0]["name"]}"' in text
