"""The rows of `check` that look into a compiled module, beyond what its values say."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eomc.verify.rows_batch import Batches
from eomc.verify.rows_refusals import Refusals
from eomc.verify.rows_runs import Runs
from eomc.verify.rows_slopes import Slopes

if TYPE_CHECKING:
    from eomc.verify.check import Comparison


def compiled_rows(check: Comparison) -> None:
    """Add the rows about runs, refusals and, where the module has them, batches."""
    runs, refusals = Runs(check), Refusals(check)
    runs.report()
    refusals.report()
    if hasattr(check.module, "simulate_batch"):
        Batches(runs, refusals.singular).report()
    if check.module._model.has_slopes and check.dtype == np.float64:
        Slopes(check).report()
