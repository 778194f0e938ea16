"""Extension of Sphinx for the site of eomc.

- The pages of a section are those that its page lists, `- [title](page.md): ...`. The lists are
  read on code-hosting sites too, which show no `toctree`.
- Links to examples download them. Links to other files of the repository become their paths.
- Directives write what is generated: `scene-keys`, `gallery` and `c-functions`.
- Formulas are MathML, which needs no script.
- The search ranks sections (static/search.js), also by the terms of the glossary that lead to them.
"""

from __future__ import annotations

import json
import os
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docutils import nodes
from scene_pages import describe_c_functions, describe_keys, describe_scenes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs" / "examples"
SECTIONS = ("README", "tutorials", "how-to", "reference", "explanation")
# generated pages and those for developers are less often what a user looks for
SEARCH_WEIGHTS = {"reference/": 0.7, "explanation": 0.6, "glossary": 0.8}
LISTED = re.compile(r"^- \[[^\]]*\]\((?!\.\.)([^)#:]+)\.(?:md|ipynb)\)", re.MULTILINE)
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#:]+)(#[^)\s]*)?\)")
CODE = re.compile(r"(^```.*?^```)", re.MULTILINE | re.DOTALL)


def read_page(app: Sphinx, page: str, source: list[str]) -> None:
    """Add the list of a section's pages to the navigation, and replace links to files."""
    pages = LISTED.findall(source[0])
    parts = CODE.split(source[0])
    parts[::2] = [LINK.sub(lambda match: _link(app, page, match), part) for part in parts[::2]]
    source[0] = "".join(parts)
    if page in SECTIONS:
        listed = "\n".join(f"/{posixpath.normpath(one)}" for one in pages)
        source[0] += f"\n\n```{{toctree}}\n:hidden:\n\n{listed}\n```\n"


def _link(app: Sphinx, page: str, match: re.Match[str]) -> str:
    """Return a link as it is, or the text and path of a file that is no page of the site."""
    image, words, target, _ = match.groups()
    path = Path(os.path.normpath(Path(app.srcdir, page).parent / target))
    inside = path.is_relative_to(app.srcdir) and app.project.path2doc(str(path)) is not None
    if image or (inside and path.suffix in (".md", ".ipynb")):
        return match[0]
    if path.is_relative_to(EXAMPLES):
        return _downloads(app, words.replace("`", ""), path)
    shown = path.relative_to(ROOT).as_posix() + ("/" if path.is_dir() else "")
    if words.strip("`").rstrip("/").endswith(Path(shown).name):
        return f"`{shown}`"
    return f"{words} (`{shown}`)"


def _downloads(app: Sphinx, words: str, path: Path) -> str:
    """Return a link that downloads an example, or the words and such links to a folder's files."""
    files = [path] if path.is_file() else sorted(each for each in path.iterdir() if each.is_file())
    links = [
        f"{{download}}`{words if path.is_file() else file.name} "
        f"</{file.relative_to(app.srcdir).as_posix()}>`"
        for file in files
    ]
    return links[0] if path.is_file() else f"{words} ({', '.join(links)})"


class Generated(SphinxDirective):
    """Directive that parses generated text as a part of its page."""

    has_content = False
    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the nodes of the generated text."""
        return self.parse_text_to_nodes(self.text(), allow_section_headings=True)

    def text(self) -> str:
        """Return the text, in the markup of the page."""
        raise NotImplementedError


class SceneKeys(Generated):
    """Tables of the keys of a scene, from the schema."""

    def text(self) -> str:
        """Return the tables as Markdown."""
        return describe_keys()


class Gallery(Generated):
    """A picture, the equations and the code of each scene that comes with eomc."""

    def text(self) -> str:
        """Return a section for each scene; pictures are drawn into a folder of the output."""
        pictures = Path(self.env.app.outdir) / "_images" / "gallery"
        return describe_scenes(ROOT / "build" / "docs-modules", pictures)


class CFunctions(Generated):
    """The C functions and types of the header of a scene."""

    required_arguments, optional_arguments = 1, 0

    def text(self) -> str:
        """Return a section for each function of the header."""
        self.env.note_dependency(path := str(Path(self.env.srcdir) / self.arguments[0]))
        return describe_c_functions(Path(path))


def show_examples(app: Sphinx, context: Any, lines: list[str]) -> None:
    """Set the lines of examples in the help of a command as code."""
    lines[:] = [re.sub(r"^\| (?=\S)(.*)$", r"| ``\1``", line) for line in lines]


def visit_math(writer: Any, node: nodes.math | nodes.math_block) -> None:
    """Write a formula as MathML."""
    from latex2mathml.converter import convert

    display = "block" if isinstance(node, nodes.math_block) else "inline"
    writer.body.append(convert(node.astext(), display=display))
    raise nodes.SkipNode


def write_front_page(app: Sphinx, error: Exception | None) -> None:
    """Give the first page the name that servers of files expect too."""
    first = Path(app.outdir) / f"{app.config.root_doc}.html"
    if error is None and first.is_file():
        (first.parent / "index.html").write_text(first.read_text(encoding="utf-8"), "utf-8")


def write_sections(app: Sphinx, error: Exception | None) -> None:
    """Write the sections of the pages for the search: page, anchor, titles, names and text."""
    if error is not None or app.builder.format != "html":
        return
    names: dict[str, list[str]] = {}
    for page in (*SECTIONS, "glossary"):
        tree = app.env.get_and_resolve_doctree(page, app.builder)
        for target, name in _find_names(tree, page):
            names.setdefault(target, []).append(name)
    sections = []
    for page in sorted(app.env.found_docs - set(SECTIONS)):
        title = app.env.titles[page].astext()
        kind = "explanation" if page in app.env.toctree_includes["explanation"] else page
        weight = next((w for name, w in SEARCH_WEIGHTS.items() if kind.startswith(name)), 1)
        for section in app.env.get_doctree(page).findall(nodes.section):
            anchor = "" if section.parent.parent is None else section["ids"][0]
            heading, *body = (each for each in section if not isinstance(each, nodes.section))
            text = "" if page == "glossary" else " ".join(_text(each) for each in body)
            known = names.get(f"{page}.html" + (f"#{anchor}" if anchor else ""), [])
            sections.append([page, anchor, title, heading.astext(), known, text, weight])
    file = Path(app.outdir, "_static", "sections.js")
    file.write_text(f"const siteSections = {json.dumps(sections, ensure_ascii=False)};\n", "utf-8")


def _find_names(tree: nodes.document, page: str) -> Iterator[tuple[str, str]]:
    """Yield the targets and the names that tables of terms and lists of pages give to them."""
    for row in tree.findall(nodes.row):
        links = [link["refuri"] for link in row.findall(nodes.reference)]
        if not links and isinstance(section := row.parent.parent.parent.parent, nodes.section):
            links = [f"{page}.html#{section['ids'][0]}"]  # what eomc does not have
        for link in links:
            yield from ((link, name) for name in _text(row[0]).split(","))
    for item in tree.findall(nodes.list_item):
        link = next(iter(item.findall(nodes.reference)), None)
        if link is not None:
            title, _, words = _text(item).partition(":")
            yield from ((link.get("refuri", ""), name) for name in (title, *words.split(",")))


def _text(node: nodes.Node) -> str:
    """Return the text of a node without HTML."""
    return " ".join(
        each.astext() for each in node.findall(nodes.Text) if not isinstance(each.parent, nodes.raw)
    )


def load_search(app: Sphinx, page: str, *_: Any) -> None:
    """Let the page of the search load our scripts after those of Sphinx."""
    if page == "search":
        for name in ("sections.js", "search.js"):
            app.add_js_file(name, loading_method="defer")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the parts of the extension."""
    app.connect("source-read", read_page)
    app.connect("sphinx-click-process-description", show_examples)
    app.connect("build-finished", write_front_page)
    app.connect("build-finished", write_sections)
    app.connect("html-page-context", load_search)
    app.add_directive("scene-keys", SceneKeys)
    app.add_directive("gallery", Gallery)
    app.add_directive("c-functions", CFunctions)
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_math, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
