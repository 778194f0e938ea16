"""Pictures of runs: drawn by eomc, where it is installed; all else here needs nothing of it."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def by_eomc(room: str) -> Any:
    """The module `room` of eomc's report. Raises ImportError with the remedy where there is none.

    It is asked for by its name when a picture is wanted, the one thing here that is.
    """
    try:
        return import_module(f"eomc.report.{room}")
    except ModuleNotFoundError as fault:
        if not str(fault.name).startswith("eomc"):
            raise
        raise ImportError("runs are drawn by eomc, which is not here: pip install eomc") from None
