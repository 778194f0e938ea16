"""Cache texts that take SymPy seconds to produce, on disk beside the built modules."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from eomc.runtime.atomic_write import atomic_write
from eomc.toolchain.cache import generator_digest


def cached_texts(
    root: Path, name: str, kind: str, scene_digest: str, make: Callable[[], dict[str, str]]
) -> dict[str, str]:
    """Return the texts that `make` produces, from a cache on disk if they are up to date.

    They are up to date if the scene, eomc and the version of SymPy have not changed since.

    Parameters
    ----------
    root : Path
        Build directory; the cache is its subfolder .shown.
    name : str
        Name of the scene; "" disables the cache.
    kind : str
        Kind of texts; it is part of the name of the cache's file.
    scene_digest : str
        Digest of the scene's text.
    make : callable
        Returns the texts by name. It is called if they are not in the cache, or out of date.

    Returns
    -------
    dict
        The texts by name. They are returned without being cached if the folder can't be written.
    """
    file = root / ".shown" / f"{name}.{kind}.json"
    parts = (scene_digest, kind, generator_digest(), version("sympy"))
    key = hashlib.sha256("\0".join(parts).encode()).hexdigest()
    if name:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            stored = json.loads(file.read_text(encoding="utf-8"))
            if stored["key"] == key:
                return {str(k): str(v) for k, v in stored["texts"].items()}
    results = make()
    if name:
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(file, cached=True) as new:
                new.write_text(json.dumps({"key": key, "texts": results}), encoding="utf-8")
    return results
