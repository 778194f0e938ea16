"""What eomc does for a built module, where it is installed; all else here needs nothing of it."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from .package import no_argument


def require_eomc(room: str, what: str = "runs are drawn") -> Any:
    """The module `room` of eomc. Raises ImportError with the remedy where there is none.

    It is asked for by its name where a picture is wanted, or events that the scene has not.
    """
    try:
        return import_module(f"eomc.{room}")
    except ModuleNotFoundError as fault:
        if not str(fault.name).startswith("eomc"):
            raise
        raise ImportError(
            f"{what} by eomc, which is not here: in its clone 'pip install .' "
            "installs it, elsewhere 'pip install' with the file of its wheel"
        ) from None


def with_events(call: Callable[..., Any], given: dict[str, Any]) -> Any:
    """The model in `given` with the events there besides its own, and the call's other arguments.

    Of parameters the other has fewer where a jump sets some: what differs from the scene is given.
    Raises TypeError of arguments that the call has not.
    """
    model, events, unknown = (given.pop(name) for name in ("self", "events", "unknown"))
    if unknown:
        raise no_argument(model, call, unknown)
    other = eventful(model, events)
    if hasattr(params := given["params"], "_names"):
        values = {name: getattr(params, name) for name in params._names}
        given["params"] = {k: x for k, x in values.items() if x != model.defaults[k]}
    return other, given


def eventful(model: Any, events: Any) -> Any:
    """The model with events besides its own, built where it is not there yet."""
    known = vars(model).setdefault("_eventful", {})
    if (key := repr(events)) not in known:
        build = require_eomc("pipeline", "events of a run are compiled").with_events
        known[key] = build(model, events, Path(__file__).parents[1])._model
        vars(known[key])["_asked"] = model, events  # for files of its runs
    return known[key]
