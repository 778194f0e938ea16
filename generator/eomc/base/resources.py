"""What is installed with eomc: its version, templates, hand-written C, scenes and runtime files.

The files are inside the package, or above it in a clone of the repository.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

__version__ = "0.2.0.dev0"  # the only place

PACKAGE = Path(__file__).resolve().parent.parent


def folder(kind: str) -> Path:
    """Return the path of one of the folders of data files that are installed with eomc.

    kind: "templates" (Jinja templates), "csrc" (C source files) or "scenes" (example scenes).
    """
    installed = PACKAGE / kind
    return installed if installed.is_dir() else PACKAGE.parent.parent / kind


def text(kind: str, name: str) -> str:
    """Return the contents of a data file that is installed with eomc.

    kind: the folder "templates", "csrc" or "scenes". name: name of the file in this folder.
    """
    return (folder(kind) / name).read_text(encoding="utf-8")


def scenes() -> dict[str, Path]:
    """Return a dict from the name of each scene that comes with eomc to the path of its file."""
    return {file.stem: file for file in sorted(folder("scenes").glob("*.toml"))}


def runtime(batch: bool) -> dict[str, str]:
    """Return the files of eomc's runtime package, which are copied into each built Python module.

    The result is a dict from the path of a file, relative to the folder of the module, to its text.
    batch: True to include the files for simulating batches of trajectories.
    """
    files = sorted((PACKAGE / "runtime").glob("*.py"))
    return {
        f"_runtime/{f.name}": f.read_text(encoding="utf-8")
        for f in files
        if batch or not f.stem.startswith("batch")
    }


def parts() -> Iterator[tuple[str, Path]]:
    """Yield a pair (name, path) for each file of eomc on which the result of a build depends.

    The name is the path relative to the installed package, such as "csrc/sincos/sincos.h".
    """
    for kind, root, suffix in (
        ("eomc", PACKAGE, ".py"),
        ("templates", folder("templates"), ".jinja"),
        ("csrc", folder("csrc"), ".[ch]"),
    ):
        for file in sorted(root.rglob("*" + suffix)):
            yield f"{kind}/{file.relative_to(root).as_posix()}", file


@lru_cache(maxsize=1)
def generator_digest() -> str:
    """Return the SHA-256, in hexadecimal, of the version and the source files of eomc."""
    total = hashlib.sha256(__version__.encode())
    for name, file in parts():
        total.update(name.encode() + file.read_bytes())
    return total.hexdigest()


def generator_version() -> str:
    """Return the version with a digest of the source files, such as "0.2.0.dev0+1f0c9a3e".

    It tells two generators apart between releases, and is the same wherever the files are.
    """
    return f"{__version__}+{generator_digest()[:8]}"
