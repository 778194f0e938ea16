"""Rows of `check` about limits of inputs: inputs beyond them act as the limits do, bit by bit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

from eomc.model.symbols import symbol
from eomc.model.system import System
from eomc.verify.comparison import Comparison
from eomc.verify.reference import Vector
from eomc.verify.sampling import State

STATES = 4
FAR = 3.0  # times what lies between limits


def report(check: Comparison) -> None:
    """Append checks of limits of inputs to the report of `eomc check`, if the scene has limits."""
    if all(x is None for i in check.system.inputs for x in i.limits):
        return
    for module, form in check.forms:
        check.row(f"{form}limits of inputs", 0, "that differ", partial(_differ, check, module))


def _differ(check: Comparison, module: Any) -> float:
    """Return how many inputs, accelerations and steps differ from those at the limits."""
    differing = 0
    for e in check.few(STATES):
        s = e.state
        least, most = limits(check.system, s.params or check.sampler.defaults)
        for beyond in _beyond(least, most):
            both = [list(_answers(module, s, u)) for u in (beyond, np.clip(beyond, least, most))]
            differing += sum(not np.array_equal(a, b) for a, b in zip(*both, strict=True))
    return float(differing)


def limits(system: System, params: Mapping[str, float]) -> tuple[Vector, Vector]:
    """Return the smallest and the largest permitted values of the inputs, both (nu,).

    An input without a limit has the value -inf or inf there. params: values of the parameters,
    which the formulas of the limits may contain.
    """
    values = {symbol(name): value for name, value in params.items()}
    ends = [
        [
            far if x is None else float(x.xreplace(values))
            for x, far in zip(i.limits, (-np.inf, np.inf), strict=True)
        ]
        for i in system.inputs
    ]
    least, most = np.array(ends).T
    return least, most


def _beyond(least: Vector, most: Vector) -> Iterator[Vector]:
    """Yield inputs of which some are below, some above and some between their limits."""
    width = np.where(np.isfinite(most - least), most - least, 1.0)
    low = np.where(np.isfinite(least), least, np.where(np.isfinite(most), most, 0) - 2 * width)
    high = np.where(np.isfinite(most), most, low + 2 * width)
    for turn in range(3):
        where = (np.arange(len(low)) + turn) % 3
        yield np.choose(where, [low - FAR * width, high + FAR * width, (low + high) / 2])


def _answers(module: Any, s: State, u: Vector) -> Iterator[Vector]:
    arguments = {"t": s.t, "u": u, "params": s.params}
    yield module.applied(s.q, s.qd, **arguments)
    yield module.acceleration(s.q, s.qd, **arguments)
    for method in module.methods:
        yield np.array(module.step(s.q, s.qd, method=method, **arguments))
    if hasattr(module, "step_batch"):
        q, qd = np.array([s.q], module.dtype), np.array([s.qd], module.dtype)
        yield module.step_batch(q, qd, **arguments)
        yield np.array([q, qd])
