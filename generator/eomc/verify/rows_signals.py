"""Rows of `check` about closed loops: A with feedback signals, by derivatives in eighty digits."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import sympy

from eomc.model.symbols import Output, resolved
from eomc.model.system import System
from eomc.verify.comparison import Comparison
from eomc.verify.report import LIMIT
from eomc.verify.rows_outputs import SLOPE_LIMIT, Formulas
from eomc.verify.sampling import Expected


def report(check: Comparison) -> None:
    """Append checks of the linearised closed loop to the report of `eomc check`.

    The loop is closed by the signals, the scene's formulas for inputs. There are no checks if no
    signal depends on the state or if a signal has discontinuities.
    """
    if not check.system.run.needs_derivatives or not _is_feedback(check.system):
        return
    signals = tuple(Output(i.name, i.signal) for i in check.system.inputs)
    formulas = Formulas(replace(check.system, outputs=signals, inputs=()))
    limit, unit = max(SLOPE_LIMIT, LIMIT * check.eps), "of the largest derivative"
    for module, form in check.forms:
        check.row(f"{form}closed loop", limit, unit, partial(_loop, check, module, formulas))


def _is_feedback(system: System) -> bool:
    """Return whether a signal depends on the state, and none has discontinuities."""
    known = resolved(system.definitions)
    signals = sympy.Tuple(*(i.signal.xreplace(known) for i in system.inputs))
    moves = signals.free_symbols & {*system.q, *system.qd}
    return bool(moves) and not signals.has(sympy.sign, sympy.Heaviside)


def _loop(check: Comparison, module: Any, formulas: Formulas) -> float:
    """Compare A of the closed loop with A + B du/dx, from the module's own A and B."""

    def error(e: Expected) -> float:
        s = replace(e.state, u=None)
        arguments = {"t": s.t, "params": s.params}
        n = 2 * len(s.q)
        A, B, closed = (
            np.asarray(x, float)
            for x in (
                *module.linearize(s.q, s.qd, **arguments),
                module.linearize(s.q, s.qd, closed=True, **arguments)[0],
            )
        )
        K = formulas.slopes(s, np.zeros(len(s.q)))[:, :n]
        size = np.max(abs(A) + abs(B) @ abs(K), axis=1, keepdims=True)
        return float(np.max(abs(closed - A - B @ K) / (size + 1e-300)))

    return check.largest(error, 2)
