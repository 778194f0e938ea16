"""Templates, hand-written C, scenes, runtime files: inside the package, or above it in a clone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent


def folder(kind: str) -> Path:
    """Return the folder `templates`, `csrc` or `scenes`."""
    installed = PACKAGE / kind
    return installed if installed.is_dir() else PACKAGE.parent.parent / kind


def text(kind: str, name: str) -> str:
    """Return the text of a file of such a folder."""
    return (folder(kind) / name).read_text(encoding="utf-8")


def scenes() -> dict[str, Path]:
    """Return the files of the scenes that come with eomc, by name."""
    return {file.stem: file for file in sorted(folder("scenes").glob("*.toml"))}


def runtime(batch: bool) -> dict[str, str]:
    """Return the text of each file of runtime/, by its path in the folder of a built module.

    The modules of batches are included only if `batch` is true.
    """
    files = sorted((PACKAGE / "runtime").glob("*.py"))
    return {
        f"_runtime/{f.name}": f.read_text(encoding="utf-8")
        for f in files
        if batch or not f.stem.startswith("batch")
    }


def parts() -> Iterator[tuple[str, Path]]:
    """Yield all files on which a build depends: name relative to the installation, path."""
    for kind, root, suffix in (
        ("eomc", PACKAGE, ".py"),
        ("templates", folder("templates"), ".jinja"),
        ("csrc", folder("csrc"), ".h"),
    ):
        for file in sorted(root.rglob("*" + suffix)):
            yield f"{kind}/{file.relative_to(root).as_posix()}", file
