"""Diagnosis of runs that make no step because a quantity is not finite at the start."""

from __future__ import annotations

from typing import Any

import numpy as np

from .status import MotionError
from .trajectory_data import Trajectory


def infinite_at_start(run: Trajectory) -> str:
    """Return a sentence that names the quantity that is not finite at the initial state of a run.

    The quantity is the potential energy, the kinetic energy or an acceleration. Return "" if all
    accelerations are finite there or cannot be computed, or if the run made a step.
    """
    if run.status != "not finite" or run.steps or not len(run):
        return ""
    model, q, qd, inputs = run._model, run.q[0], run.qd[0], run._u
    at: dict[str, Any] = {"t": run.t0, "params": run._params}
    try:
        model.acceleration(q, qd, u=None if inputs is None or not model.nu else run.u[0], **at)
        return ""
    except MotionError as lacking:
        if lacking.status != "not finite":
            return ""
    except ValueError:  # the inputs of a saved run are unknown
        return ""
    what = "an acceleration"
    if not np.isfinite(model.potential_energy(q, **at)):
        what = "the potential energy"
    elif not np.isfinite(model.kinetic_energy(q, qd, **at)):
        what = "the kinetic energy"
    return f"{what} is not finite at the start: start elsewhere"
