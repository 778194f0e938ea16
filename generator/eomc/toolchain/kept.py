"""Texts that take SymPy seconds to make, kept beside the built modules."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from eomc.runtime.written import replacing
from eomc.toolchain.cache import generator_digest


def texts(
    root: Path, name: str, what: str, scene_digest: str, make: Callable[[], dict[str, str]]
) -> dict[str, str]:
    """What `make` returns: texts by name; read from `root`/.shown/ where nothing has changed.

    name: the scene's; "" where it can't be kept. scene_digest: of its text. Where the folder can't
    be written nothing is kept.
    """
    file = root / ".shown" / f"{name}.{what}.json"
    parts = (scene_digest, what, generator_digest(), version("sympy"))
    key = hashlib.sha256("\0".join(parts).encode()).hexdigest()
    if name:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            found = json.loads(file.read_text(encoding="utf-8"))
            if found["key"] == key:
                return {str(k): str(v) for k, v in found["texts"].items()}
    made = make()
    if name:
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            with replacing(file, cached=True) as new:
                new.write_text(json.dumps({"key": key, "texts": made}), encoding="utf-8")
    return made
