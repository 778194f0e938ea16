"""Save and load runs as .npz files: arrays only, no pickles, and the scene's identity."""

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
from .interfaces import CompiledModel
from .package import eventful, warn

KINDS = {  # names of classes in files, and the classes
    "Run": "Run",
    "AdaptiveRun": "AdaptiveRun",
    "SteppedRun": "AdaptiveRun",  # fixed steps with events, in files of earlier versions
    "TimedRun": "TimedRun",
    "BatchRun": "BatchRun",
    "TimedBatchRun": "TimedBatchRun",
    "AdaptiveBatchRun": "AdaptiveBatchRun",
}
_WRITTEN = 'load_run reads what run.save("NAME.npz") wrote'
_KIND = "eomc {} 1"  # name of the class and version of the format


def write(run: Any, path: Path) -> None:
    """Write a run or batch to an .npz file: its columns, and the arguments that reproduce it."""
    model = run.model
    info = model.info
    arrays: dict[str, Any] = {
        "kind": _KIND.format(type(run).__name__), "scene": info.name, "digest": info.digest,
        "coordinates": info.coordinates, "parameters": info.parameters, "inputs": info.inputs,
        "events": info.events,
        "t": run["t"], "energy": run.energy, "u": run.u,
    }  # fmt: skip
    if additional := model.extension_of:
        arrays |= {"own": additional[0].info.digest, "asked": _text(additional[1])}
    if model.functions.has_jacobi:
        arrays["jacobi"] = run.jacobi
    arrays |= {name: value for name, value in run.to_arrays().items() if value is not None}
    converted: Any = {name: np.asarray(value) for name, value in arrays.items()}
    with atomic_write(path) as new, new.open("wb") as file:
        np.savez(file, **converted)


def _text(events: Any) -> str:
    """Return the events of a call as JSON; "" if a formula is a SymPy expression."""
    try:
        return json.dumps(events)
    except TypeError:
        return ""


def read(model: CompiledModel, file: File) -> tuple[Any, str, dict[str, Any]]:
    """Read an .npz file that `run.save` has written.

    Return the model, the name of the run's class and the arrays by name. The
    returned model is extended by events if the run had additional events. A warning is issued if
    the run is of another version of the scene. Raises ValueError if the file is not a saved run of
    the scene, OSError if it cannot be read.
    """
    arrays = _arrays(file)
    kind = next((k for k in KINDS if str(arrays.get("kind")) == _KIND.format(k)), "")
    if not kind:
        raise ValueError(f"{file}: was not written by run.save in this version of eomc")
    if arrays["scene"] != model.info.name:
        raise ValueError(f"{file}: is a run of {arrays['scene']}, not of {model.info.name}")
    if str(arrays.get("own", arrays["digest"])) != model.info.digest:
        warn(
            f"{model.info.name}: {file}: was saved from another version of the scene; what is "
            "computed "
            "from it now is of the present version"
        )
    if "asked" in arrays:
        model = _model_with_events(model, arrays, file)
    for what in ("coordinates", "parameters", "inputs", "events"):
        own = getattr(model.info, what)
        saved = tuple(arrays.get(what, np.array(own)).tolist())  # old files have no events
        if saved != own:
            raise ValueError(
                f"{file}: is a run of another version of {model.info.name}, whose {what} were "
                f"{', '.join(saved) or 'none'}; here they are {', '.join(own) or 'none'}"
            )
    if arrays["q"].dtype != model.info.dtype:
        raise ValueError(
            f"{file}: has numbers of {arrays['q'].dtype}, {model.info.name} {model.info.dtype}"
        )
    return model, KINDS[kind], {name: x.item() if x.ndim == 0 else x for name, x in arrays.items()}


def _model_with_events(model: CompiledModel, arrays: dict[str, Array], file: File) -> Any:
    """Return the model with the additional events of a saved run."""
    known = model.extensions.values()
    if same := [other for other in known if other.info.digest == arrays["digest"]]:
        return same[0]
    if not (text := str(arrays["asked"])):
        raise ValueError(
            f"{file}: its events= had formulas of SymPy, which files don't keep: call "
            f"{model.info.name}.simulate(events=...) with the same ones first; numpy.load reads "
            "its rows"
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
    """Read the arrays of an .npz file. Raises ValueError for other files, and OSError."""
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
