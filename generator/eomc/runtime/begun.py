"""What is not finite where a run begins: why some make no step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from .trajectory import Run


def infinite_at_start(run: Run) -> str:
    """Which energy is, or that an acceleration is, in a sentence; "" where none, or it moved."""
    from .trajectory import MotionError

    if run.status != "not finite" or run.steps or not len(run):
        return ""
    model, q, qd, held = run._model, run.q[0], run.qd[0], run._u
    at: dict[str, Any] = {"t": run.t0, "params": run._params}
    for what, value in (
        ("potential", model.potential_energy(q, **at)),
        ("kinetic", model.kinetic_energy(q, qd, **at)),
    ):
        if not np.isfinite(value):
            return f"the {what} energy is not finite at the start: start elsewhere"
    try:
        model.acceleration(q, qd, u=None if held is None or not model.nu else run.u[0], **at)
    except MotionError as lacking:
        if lacking.status == "not finite":
            return "an acceleration is not finite at the start: start elsewhere"
    except ValueError:
        pass  # inputs of a saved run, which are not known
    return ""
