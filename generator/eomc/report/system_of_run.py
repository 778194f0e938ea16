"""Find the system that a run was simulated with."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from eomc import pipeline
from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.model.system import System

Source = str | os.PathLike[str] | System


def system_of(run: Any, scene: Source | None = None) -> System:
    """Return the system that a run simulated, with the parameter values of the run.

    Parameters
    ----------
    run : Run or batch of runs
        For a batch, the parameter values are those of the first instance.
    scene : path or System, optional
        The scene or system that the module was built from. Needed only if the module was not
        loaded with `eomc.load`.

    Returns
    -------
    System

    Raises
    ------
    EomcError
        If the scene is unknown, or is not the one that the module was built from.
    """
    model = run._model
    source = model.source if scene is None else scene
    if source is None:
        raise EomcError(
            f"{model.name}: was imported without its scene, which says what is drawn: load it "
            "with eomc.load, or give scene=PATH"
        )
    system = source if isinstance(source, System) else pipeline.read(source)
    if system.digest != model.digest:
        where = texts.line(system.file) or system.name
        raise EomcError(
            f"{where}: is not the scene that {model.name} was built from, or has changed since: "
            "load it again with eomc.load"
        )
    values = np.atleast_2d(run._params)[0]
    return system.with_parameters(dict(zip(model.parameters, map(float, values), strict=True)))
