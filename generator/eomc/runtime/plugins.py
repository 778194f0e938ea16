"""Functions that need an installed eomc; the rest of a built module works without it."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from .package import no_argument


def require_eomc(module: str, what: str = "runs are drawn") -> Any:
    """Import and return the module `eomc.<module>` of the installed package eomc.

    A built package needs eomc only for pictures and for events that the scene does not define.
    what: the purpose, as the beginning of the error message. Raises ImportError, with a remedy, if
    eomc is not installed.
    """
    try:
        return import_module(f"eomc.{module}")
    except ModuleNotFoundError as fault:
        if not str(fault.name).startswith("eomc"):
            raise
        raise ImportError(
            f"{what} by eomc, which is not here: in its clone 'pip install .' "
            "installs it, elsewhere 'pip install' with the file of its wheel"
        ) from None


def with_events(call: Callable[..., Any], arguments: dict[str, Any]) -> Any:
    """Return the model extended by a call's additional events, and the other arguments of the call.

    call: the method that the user called. arguments: all its local variables, including "self",
    "events" and "unknown" (arguments that the method does not have). Raises TypeError for unknown
    arguments.

    A parameter that a jump of an additional event sets is a state of the extended model, not a
    parameter. Therefore only the parameters that differ from the scene's values are passed on.
    """
    model, events, unknown = (arguments.pop(name) for name in ("self", "events", "unknown"))
    if unknown:
        raise no_argument(model, call, unknown)
    other = eventful(model, events)
    if hasattr(params := arguments["params"], "_names"):
        values = {name: getattr(params, name) for name in params._names}
        arguments["params"] = {k: x for k, x in values.items() if x != model.defaults[k]}
    return other, arguments


def eventful(model: Any, events: Any) -> Any:
    """Return the model extended by additional events.

    events: mapping of the events by name, each a formula or a table such as [[event]] of a scene.
    The extended model is compiled at the first call and reused afterwards.
    """
    known = vars(model).setdefault("_eventful", {})
    if (key := repr(events)) not in known:
        build = require_eomc("pipeline", "events of a run are compiled").with_events
        known[key] = build(model, events, Path(__file__).parents[1])._model
        vars(known[key])["_asked"] = model, events  # for files of its runs
    return known[key]
