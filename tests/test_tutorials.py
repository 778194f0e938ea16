"""The tutorials are followed as they are written, each in an empty folder."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.pages import blocks, follow
from support.session import ROOT, needs

TUTORIALS = {file.stem: file for file in sorted((ROOT / "docs" / "tutorials").glob("*.md"))}


@pytest.mark.slow
@pytest.mark.parametrize("name", TUTORIALS)
def test_tutorial_works_as_documented(name: str, tmp_path: Path) -> None:
    page = TUTORIALS[name].read_text(encoding="utf-8")
    needs("cc")
    for package in ("gymnasium", "matplotlib"):
        if f"import {package}" in page or "plot" in page:
            pytest.importorskip(package)
    follow(page, tmp_path)


@pytest.mark.parametrize("name", TUTORIALS)
def test_every_block_of_a_tutorial_is_run(name: str) -> None:
    each = list(blocks(TUTORIALS[name].read_text(encoding="utf-8")))
    assert each and not [block for block in each if block.reason]
    assert all(block.file or block.language in ("sh", "python", "text") for block in each)


def test_pages_are_followed_block_by_block(tmp_path: Path) -> None:
    page = "`a.txt`:\n\n```sh\n1\n```\n\n```sh\ncat a.txt\n```\n\n```text\n{}\n```\n"
    assert follow(page.format(1), tmp_path) == "1\n"
    with pytest.raises(AssertionError):
        follow(page.format(2), tmp_path)
    follow("```python\nx = 2\n```\n\n```python\nprint(x)\n```\n\n```text\n2\n```\n", tmp_path)
    with pytest.raises(AssertionError, match="is not run"):
        follow("```c\n```\n", tmp_path)
    (block,) = blocks("<!-- not run: needs a robot -->\n\n```sh\nfalse\n```\n")
    assert block.reason == "needs a robot"
    with pytest.raises(AssertionError):
        follow("```sh\nfalse\n```\n", tmp_path)


@pytest.mark.slow
def test_notebook_runs_and_displays_equations_plots_and_animation(tmp_path: Path) -> None:
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
    pytest.importorskip("ipykernel", reason="ipykernel is not installed")
    pytest.importorskip("matplotlib")
    notebook = nbformat.read(ROOT / "docs" / "tutorials" / "notebook.ipynb", 4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=300, resources=resources).execute()
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    data = {cell.source: output.get("data", {}) for cell in cells for output in cell.outputs}
    (equations,) = (each for source, each in data.items() if source.endswith("\nequations"))
    assert r"\ddot{r}" in equations["text/latex"]
    (plot,) = (each for source, each in data.items() if "run.plot" in source)
    assert plot["image/png"]
    assert "<iframe" in data["run.animate()"]["text/html"]
