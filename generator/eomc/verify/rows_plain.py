"""The plain form of C compared with the reference, and with the fast form.

Values, one step and a run against the reference, as the fast form is; then all that both forms
compute, one against the other. In units of rounding, as in `check`, whose rows these are.
"""

from __future__ import annotations

import copy
import warnings
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from eomc.integrators.tableaux import METHODS
from eomc.verify.comparison import GROWTH_LIMIT
from eomc.verify.oracle import Vector
from eomc.verify.report import LIMIT
from eomc.verify.sampling import NUDGE, VALUES, State, ask, nudged

if TYPE_CHECKING:
    from eomc.verify.comparison import Comparison
    from eomc.verify.sampling import Expected

STEPS = 24  # of a run by each method
SHORTER = 16  # by how much, where sweeps are few and fixed: what they leave is then rounding
BOTH = (*VALUES, "acceleration")


def rows(of: Comparison, plain: Any) -> None:
    """Add the rows of the plain form. of: the comparison of the fast one; plain: its module."""
    unit = "units of rounding"
    twin = copy.copy(of)
    twin.module = plain
    of.row("plain C", LIMIT, unit, lambda: float(np.max([twin.value(name) for name in BOTH])))
    if of.methods[0] == "rk4":
        of.row("plain C: one step", LIMIT, unit, twin.steps)
        of.row("plain C: run", LIMIT, unit + ", times steps and growth", twin.runs)
    of.row("plain C beside fast", LIMIT, unit, partial(_values, of, plain))
    if hasattr(of.module, "linearize") and _slopes(of.module, of.expected[0].state) is not None:
        of.row("plain C beside fast: A, B", LIMIT, unit, partial(_linearization, of, plain))
    for method in of.methods:
        of.row(
            f"plain C beside fast: {method}", LIMIT, unit + ", times steps and growth",
            partial(_runs, of, plain, method),
        )  # fmt: skip


def _values(of: Comparison, plain: Any) -> float:
    """All values at all states."""

    def error(e: Expected) -> float:
        pairs = [(ask(plain, n, e.state), ask(of.module, n, e.state), e.size[n]) for n in BOTH]
        return float(np.max([of.units(*pair) for pair in pairs]))

    return of.largest(error)


def _slopes(module: Any, s: State) -> Vector | None:
    """A and B side by side, and the sensitivity to parameters, as far as the module has them."""
    found = []
    for name in ("linearize", "sensitivity"):
        try:
            made = getattr(module, name)(s.q, s.qd, u=s.u, t=s.t, params=s.params)
        except ValueError:  # built without it
            continue
        found += [x[-len(s.q) :] for x in (made if isinstance(made, tuple) else (made,))]
    return np.hstack(found).astype(float) if found else None


def _linearization(of: Comparison, plain: Any) -> float:
    """The derivatives at a few states, against what a rounding of the inputs makes of them."""

    def error(e: Expected) -> float:
        one, other = (_slopes(module, e.state) for module in (of.module, plain))
        assert one is not None and other is not None
        near = [_slopes(of.module, s) for s in nudged(e.state, of.sampler.defaults)[:64]]
        size = np.abs(one) + sum(np.abs(x - one) / NUDGE for x in near if x is not None)
        return of.units(other, one, np.maximum(size, 1e-6 * np.max(size)))

    return float(np.max([error(e) for e in of.few(of.effort.few)]))


def _runs(of: Comparison, plain: Any, method: str) -> float:
    """A short run of each form from the start and from a random state, as far as it can be said."""
    spread = np.array([of.sampler.spread, of.sampler.speed])

    def run(module: Any, s: State, by: float) -> Vector:
        h = of.system.run.h / (SHORTER if METHODS[method].sweeps else 1)
        with warnings.catch_warnings():  # a run that stops early ends in both forms alike
            warnings.simplefilter("ignore", RuntimeWarning)
            made = module.simulate(
                q0=s.q + by * spread[0], qd0=s.qd + by * spread[1], u=s.u, params=s.params,
                h=h, steps=STEPS, method=method,
            )  # fmt: skip
        return np.stack([made.q, made.qd], axis=1).astype(float)

    def error(e: Expected) -> float:
        one, other = run(of.module, e.state, 0.0), run(plain, e.state, 0.0)
        if len(one) != len(other):
            raise RuntimeError(f"{len(one) - 1} steps of the fast form, {len(other) - 1} of plain")
        near = run(of.module, e.state, NUDGE)[: len(one)]
        rows = len(near)
        growth = np.max(np.abs(near - one[:rows]) / spread, axis=(1, 2)) / NUDGE
        growth = np.maximum.accumulate(np.maximum(growth, 1.0))
        honest = int(np.sum(growth < GROWTH_LIMIT))
        steps = np.arange(1, honest + 1)[:, None, None]
        size = steps * (growth[:honest, None, None] * spread + np.abs(one[:honest]))
        return of.units(other[:honest], one[:honest], size)

    return float(np.max([error(e) for e in of.few(2)]))
