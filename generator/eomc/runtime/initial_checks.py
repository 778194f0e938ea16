"""What is not finite where a run begins: why some make no step."""

from __future__ import annotations

from typing import Any

import numpy as np

from .status import MotionError
from .trajectory_data import Trajectory


def infinite_at_start(run: Trajectory) -> str:
    """Why no acceleration is finite there, in a sentence; "" where each is, or the run moved.

    An energy that alone overflows stops no motion.
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
    except ValueError:  # inputs of a saved run, which are not known
        return ""
    what = "an acceleration"
    if not np.isfinite(model.potential_energy(q, **at)):
        what = "the potential energy"
    elif not np.isfinite(model.kinetic_energy(q, qd, **at)):
        what = "the kinetic energy"
    return f"{what} is not finite at the start: start elsewhere"
