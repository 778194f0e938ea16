"""Runs as values: their fields, equality and copies, and .npz files of arrays without pickles."""

from __future__ import annotations

import json
import math
import os
import zipfile
import zlib
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import Field, fields
from pathlib import Path
from typing import Any

import numpy as np

from .arguments import Array
from .atomic_write import File, atomic_write
from .interfaces import CompiledModel
from .package import eventful, own_model, warn
from .requests import Request, count_steps

LEFT_OUT = "u was a function, which a pickled or saved run does not contain: simulate again"
NOT_STORED = "u was a function, and its values between rows are not stored: take every=1"
# names of classes in files, of this version and of earlier ones
KINDS = {
    "Trajectory 2": "Trajectory",
    "BatchTrajectory 2": "BatchTrajectory",
    "Run 1": "Trajectory",
    "TimedRun 1": "Trajectory",
    "AdaptiveRun 1": "Trajectory",
    "SteppedRun 1": "Trajectory",
    "BatchRun 1": "BatchTrajectory",
    "TimedBatchRun 1": "BatchTrajectory",
    "AdaptiveBatchRun 1": "BatchTrajectory",
}
_WRITTEN = 'load_run reads what run.save("NAME.npz") wrote'


def field_values(run: Any) -> dict[str, Any]:
    """Return the values of all fields of a run by name."""
    return {field.name: getattr(run, field.name) for field in fields(run)}


def deep_copies(run: Any, memo: dict[int, Any]) -> dict[str, Any]:
    """Return copies of the values of all fields; the model is the same one."""
    values = field_values(run)
    return {"model": values.pop("model")} | deepcopy(values, memo)


def pickled_values(run: Any) -> dict[str, Any]:
    """Return the values of the fields that a pickle contains: without the model and functions.

    The build that reads the pickle has its own model. The request becomes a tuple.
    """
    values = field_values(run)
    del values["model"]
    return values | {"request": tuple(_without_function(values["request"]))}


def completed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of fields, from a pickle or a file, with a model and a request."""
    model = values.get("model") or own_model()
    return {**values, "model": model, "request": Request(*values["request"])}


def _without_function(request: Request) -> Request:
    return request.replace(u=LEFT_OUT) if callable(request.u) else request


def are_equal(run: Any, other: Any) -> bool:
    """Return True if two runs of the same class have the same scene and equal fields."""
    ours, theirs = run.model.info, other.model.info
    return (ours.name, ours.digest) == (theirs.name, theirs.digest) and all(
        _is_same(getattr(run, name), getattr(other, name))
        for field in _stored_fields(run)
        if field.compare
        for name in (("q", "qd") if field.name == "rows" else (field.name,))
    )


def _is_same(a: Any, b: Any) -> bool:
    """Return True if two values are equal, bit by bit; of requests all but the inputs."""
    if isinstance(a, Request) and isinstance(b, Request):
        a, b = (tuple(x.replace(u=None, period=0.0, periods=0)) for x in (a, b))
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_is_same, a, b))
    if isinstance(a, float) and math.isnan(a):
        return isinstance(b, float) and math.isnan(b)
    return type(a) is type(b) and bool(a == b)


def _stored_fields(run: Any) -> list[Field[Any]]:
    """Return the fields of a run that are saved."""
    return [field for field in fields(run) if field.name not in ("model", "error")]


def write(run: Any, path: Path) -> None:
    """Write a run or batch to an .npz file: its columns, and the fields that reproduce it.

    Fields of the request have the prefix "request_"; a tuple becomes one array for each entry.
    """
    model, info = run.model, run.model.info
    arrays: dict[str, Any] = {
        "kind": f"eomc {type(run).__name__} 2", "scene": info.name, "digest": info.digest,
        "coordinates": info.coordinates, "parameters": info.parameters, "inputs": info.inputs,
        "events": info.events, "t": run.t, "energy": run.energy, "u": run.u, "q": run.q,
        "qd": run.qd,
    }  # fmt: skip
    if additional := model.extension_of:
        arrays |= {"own": additional[0].info.digest, "asked": _text(additional[1])}
    if model.functions.has_jacobi:
        arrays["jacobi"] = run.jacobi
    request = _without_function(run.request)
    arrays |= request.to_mapping("request_")
    names = (field.name for field in _stored_fields(run) if field.name not in ("rows", "request"))
    for name in names:
        value = getattr(run, name)
        if isinstance(value, tuple):
            arrays |= {f"{name}_{k}": part for k, part in enumerate(value)}
        else:
            arrays[name] = value
    converted: Any = {name: np.asarray(x) for name, x in arrays.items() if x is not None}
    with atomic_write(path) as new, new.open("wb") as file:
        np.savez(file, **converted)


def from_arrays(run_class: Any, model: CompiledModel, arrays: Mapping[str, Any]) -> Any:
    """Create a run from the arrays and numbers of a file."""
    if "request_t0" not in arrays:
        arrays = _present_arrays(model, arrays)
    values: dict[str, Any] = {"model": model, "rows": (arrays["q"], arrays["qd"])}
    values["request"] = Request.from_mapping(arrays, "request_")
    for field in fields(run_class):
        if field.name in arrays:
            values[field.name] = arrays[field.name]
        elif f"{field.name}_0" in arrays:
            parts = (f"{field.name}_{k}" for k in range(len(arrays)))
            values[field.name] = tuple(arrays[part] for part in parts if part in arrays)
    return run_class.restore(values)


# fields by the names that earlier versions gave them
_EARLIER_NAMES = {
    "q": "q", "qd": "qd", "steps": "steps", "status": "status", "status_codes": "codes",
    "evaluations": "evaluations", "times": "times", "rejected": "rejected",
    "stiff_steps": "stiff_steps", "stopped": "stopped", "limit": "limit", "end_time": "reached",
    "singular_steps": "singular_steps", "first_singular": "first_singular",
    "period_inputs": "values", "request_t0": "t0", "request_t_end": "t_end",
    "request_every": "every", "request_u": "held", "request_period": "period",
    "request_periods": "periods", "request_p": "params", "request_method": "method",
    "request_tol": "tol", "request_stiff": "stiff",
    "request_max_evaluations": "_max_evaluations",
}  # fmt: skip


def _present_arrays(model: CompiledModel, old: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the arrays of a file that an earlier version wrote to those of this version."""
    prefixed = {"_times": "times", "_begin": "begin", "_h_most": "h_most", "_stiff": "stiff",
                "_period": "period", "_by": "by"}  # fmt: skip
    old = {prefixed.get(name, name): value for name, value in old.items()}
    new = {now: old[name] for now, name in _EARLIER_NAMES.items() if name in old}
    is_batch, has_equal_steps = "codes" in old, "h_most" not in old
    is_adaptive = not (has_equal_steps or old.get("by"))
    h = 0.0 if is_adaptive else old["h" if has_equal_steps else "h_most"]
    steps, times = old.get("wanted", old["steps"]), np.asarray(old.get("times", ()))
    if is_adaptive:
        steps = 0
    elif len(times):
        steps = count_steps(times, old["t0"], h)
    begin = old.get("begin", (old["q"][..., 0, :], old["qd"][..., 0, :]))
    new |= {
        "request_q": begin[0], "request_qd": begin[1], "request_h": h, "request_steps": steps,
        "request_max_step": old["h_most"] if is_adaptive else 0.0,
        "request_detects_events": not has_equal_steps and len(old.get("events", ())) > 0,
    }  # fmt: skip
    for name, value in (("every", 1), ("period", 0.0), ("periods", 0)):
        new.setdefault(f"request_{name}", value)
    new.setdefault("request_t_end", old["t0"] + h * steps if has_equal_steps else float(times[-1]))
    if is_batch:
        new["request_u"] = old.get("_u", old.get("held"))
        stages = model.info.method_table.get(old["method"])
        new.setdefault("evaluations", stages and stages.stages * old["steps"])
        new["stopped_codes"] = new.pop("stopped", None)
    else:
        if not has_equal_steps:
            new["end_time"] = old["t0"] + old["h"] * old["steps"] if is_adaptive else old["t_end"]
        if (applied := old.get("applied")) is not None and "values" not in old:
            # inputs at the rows are those of the steps if there is a row after each step
            new |= {"period_inputs": applied, "request_period": h * old["every"]}
            new["request_u"] = LEFT_OUT if old["every"] == 1 else NOT_STORED
        elif "values" in old and "held" not in old:
            new["request_u"] = LEFT_OUT
    if "which" in old:
        parts = (old.get("event_instances"), old["which"], old["event_rows"])[not is_batch :]
        new |= {f"event_data_{k}": part for k, part in enumerate(parts)}
    return {name: value for name, value in new.items() if value is not None}


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
    kind = KINDS.get(str(arrays.get("kind")).removeprefix("eomc "))
    if kind is None:
        raise ValueError(f"{file}: was not written by run.save in this version of eomc")
    if arrays["scene"] != model.info.name:
        raise ValueError(f"{file}: is a run of {arrays['scene']}, not of {model.info.name}")
    if str(arrays.get("own", arrays["digest"])) != model.info.digest:
        warn(
            f"{model.info.name}: {file}: was saved from another version of the scene; what is "
            "computed from it now is of the present version"
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
    return model, kind, {name: x.item() if x.ndim == 0 else x for name, x in arrays.items()}


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
