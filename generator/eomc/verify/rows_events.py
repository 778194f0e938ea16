"""Rows of `check` about events: event functions and states after jumps.

Both are compared with the formulas as they stand, in many digits, at states anywhere. When and
where events are detected follows from these values alone. Events of stick-slip friction are left
out.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from eomc.model.symbols import Output
from eomc.model.system import System
from eomc.verify.comparison import Comparison
from eomc.verify.reference import Vector
from eomc.verify.report import LIMIT
from eomc.verify.rows_outputs import Formulas, compare_outputs
from eomc.verify.sampling import State


def report(check: Comparison) -> None:
    """Append checks of event functions and jumps to the report, if the scene defines events.

    An event is detected at a root of its event function; a jump then changes the state.
    """
    system = check.system
    events = system.own_events
    groups = {"events": [Output(e.name, e.when) for e in events]}
    names = [*(str(q) for q in system.q), *(str(qd) for qd in system.qd)]
    states = dict(zip(names, (*system.q, *system.qd), strict=True))
    if any(e.action == "jump" for e in events):
        groups["jumps"] = [
            Output(name, (states | dict(e.jump))[name]) for e in events for name in names
        ]
    for name, formulas in groups.items():
        if formulas:
            for module, form in check.forms:
                find = partial(
                    _values, check, module, name, replace(system, outputs=tuple(formulas))
                )
                check.row(f"{form}{name}", LIMIT, "units of rounding", find)


def _values(check: Comparison, module: Any, name: str, system: System) -> float:
    """Return the largest error of event functions or jumps, in units of rounding."""
    model = module._model

    def module_values(s: State) -> Vector:
        values = model._evaluate(name, s.q, s.qd, s.t, s.u, s.params)
        return np.asarray(values, float).ravel()[: len(system.outputs)]

    return compare_outputs(check, module, Formulas(system), module_values)
