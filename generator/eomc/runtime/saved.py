"""Runs as .npz files: arrays only, nothing pickled, and of which scene they are."""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from .arguments import Array
from .atomic_write import File, atomic_write
from .metadata import ModelInfo
from .package import warn
from .plugins import eventful

KINDS = (
    "Run",
    "AdaptiveRun",
    "SteppedRun",
    "TimedRun",
    "BatchRun",
    "TimedBatchRun",
    "AdaptiveBatchRun",
)
_WRITTEN = 'load_run reads what run.save("NAME.npz") wrote'
_KIND = "eomc {} 1"  # and the version of what such a file holds


def write(run: Any, path: Path) -> None:
    """All of a run or batch: its columns q, qd, u, energies and what makes it again."""
    model = run._model
    arrays: dict[str, Any] = {
        "kind": _KIND.format(type(run).__name__), "scene": model.name, "digest": model.digest,
        "coordinates": model.coordinates, "parameters": model.parameters, "inputs": model.inputs,
        "events": model.events,
        "t": run["t"], "energy": run.energy, "u": run.u,
    }  # fmt: skip
    if asked := vars(model).get("_asked"):
        arrays |= {"own": asked[0].digest, "asked": _text(asked[1])}
    if model.has_jacobi:
        arrays["jacobi"] = run.jacobi
    arrays |= {name: value for name, value in run._to_arrays().items() if value is not None}
    made: Any = {name: np.asarray(value) for name, value in arrays.items()}
    with atomic_write(path) as new, new.open("wb") as file:
        np.savez(file, **made)


def _text(events: Any) -> str:
    """Events that a call asked for; "" where formulas are SymPy's, which are no text."""
    try:
        return json.dumps(events)
    except TypeError:
        return ""


def read(model: ModelInfo, file: File) -> tuple[Any, str, dict[str, Any]]:
    """The model of a saved run, its kind, one of KINDS, and what it kept.

    The model is another than was given where a call had asked for events.

    Raises ValueError where the file is none, or of another scene; warns where it is of another
    version of the scene.
    """
    found = _arrays(file)
    kind = next((k for k in KINDS if str(found.get("kind")) == _KIND.format(k)), "")
    if not kind:
        raise ValueError(f"{file}: was not written by run.save in this version of eomc")
    if found["scene"] != model.name:
        raise ValueError(f"{file}: is a run of {found['scene']}, not of {model.name}")
    if str(found.get("own", found["digest"])) != model.digest:
        warn(
            f"{model.name}: {file}: was saved from another version of the scene; what is computed "
            "from it now is of the present version"
        )
    if "asked" in found:
        model = _asked(model, found, file)
    for what in ("coordinates", "parameters", "inputs", "events"):
        own = getattr(model, what)
        saved = tuple(found.get(what, np.array(own)).tolist())  # old files have no events
        if saved != own:
            raise ValueError(
                f"{file}: is a run of another version of {model.name}, whose {what} were "
                f"{', '.join(saved) or 'none'}; here they are {', '.join(own) or 'none'}"
            )
    if found["q"].dtype != model.dtype:
        raise ValueError(f"{file}: has numbers of {found['q'].dtype}, {model.name} {model.dtype}")
    return model, kind, {name: x.item() if x.ndim == 0 else x for name, x in found.items()}


def _asked(model: ModelInfo, found: dict[str, Array], file: File) -> Any:
    """The model with the events that a saved run's call asked for."""
    known = vars(model).get("_eventful", {}).values()
    if same := [other for other in known if other.digest == found["digest"]]:
        return same[0]
    if not (text := str(found["asked"])):
        raise ValueError(
            f"{file}: its events= had formulas of SymPy, which files don't keep: call "
            f"{model.name}.simulate(events=...) with the same ones first; numpy.load reads its rows"
        )
    try:
        return eventful(model, json.loads(text))
    except Exception as fault:
        fault.add_note(
            f"{file}: was made with events=, which are compiled to load it; numpy.load reads its "
            "rows without"
        )
        raise


def _arrays(file: File) -> dict[str, Array]:
    """What an .npz file holds; a ValueError where it is none, OSError where it can't be read."""
    try:
        with np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except OSError as fault:
        if fault.strerror is None:
            raise
        raise OSError(fault.errno, f"{fault.strerror}: {_WRITTEN}", os.fspath(file)) from None
    except (ValueError, EOFError, AttributeError, TypeError, zipfile.BadZipFile, zlib.error):
        csv = "; of a .csv it has too little" if str(file).endswith(".csv") else ""
        raise ValueError(f"{file}: is no whole .npz file of a run: {_WRITTEN}{csv}") from None
