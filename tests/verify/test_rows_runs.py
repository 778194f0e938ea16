"""Rows about runs see what only runs at such places compute."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from instrument import Shipped, in_a_fork
from mutants import variant

from eomc.verify.comparison import Comparison
from eomc.verify.rows_runs import Runs

STAGE = "at.theta1 = q->theta1 + (c_[i]*h*qd->theta1"


@pytest.mark.slow
def test_steps_of_every_method_are_compared_at_angles_far_out(tmp_path: Path) -> None:
    """There stages of gauss16 are computed one by one, which stands last in its sweep."""
    made = variant("pendulum_gauss16")
    shipped = Shipped(made, tmp_path)
    start, end = shipped.source.rsplit(STAGE, 1)

    def far() -> float:
        found = Comparison(made, shipped.load(), np.random.default_rng(0), 4)
        error = Runs(found).far()
        return error if math.isfinite(error) else 1e300

    for source, right in ((shipped.source, True), (start + STAGE.replace("+", "-") + end, False)):
        assert shipped.compile(("-O0", "-march=native"), source) is None
        kind, value = in_a_fork(far, 60)
        assert kind == "done" and isinstance(value, float), value
        assert (value < 10) if right else (value > Runs.limit)
