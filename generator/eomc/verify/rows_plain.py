"""The plain form of C compared with the reference, and with the fast form.

Values, one step and a run against the reference, as the fast form is; then all that both forms
compute, one against the other. In units of rounding, as in `check`, whose rows these are.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from eomc.integrators.tableaux import METHODS
from eomc.verify import one_step
from eomc.verify.comparison import GROWTH_LIMIT, Comparison
from eomc.verify.finding import Finding, largest
from eomc.verify.oracle import Vector
from eomc.verify.report import LIMIT
from eomc.verify.sampling import NUDGE, VALUES, Expected, State, ask, nudged, simulate, started

STEPS = 24  # of a run by each method
# by how much, where sweeps are few and fixed, until what they leave is rounding
SHORTER = (16, 64, 256)
CLEAR = 7  # sweeps of Newton's method with derivatives at the start, which any way to them finds
BOTH = (*VALUES, "acceleration")


def rows(of: Comparison) -> None:
    """Add the rows of the plain form, where there is one."""
    if of.plain is None:
        return
    unit, plain = "units of rounding", of.plain
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
        # entries that are 0 everywhere are sums of what cancels
        scale = _inputs(of, e.state)[: one.shape[1]]
        size = np.maximum(size, e.size["acceleration"][:, None] / scale)
        return of.units(other, one, np.maximum(size, 1e-6 * np.max(size)))

    return of.largest(error, of.effort.few)


def _inputs(of: Comparison, s: State) -> Vector:
    """How far coordinates, rates, inputs and parameters go, in the order of `_slopes`."""
    params = list((s.params or of.sampler.defaults).values())
    given = np.abs([*(np.zeros(len(of.system.inputs)) if s.u is None else s.u), *params])
    return np.array([*of.sampler.spread, *of.sampler.speed, *np.where(given > 0, given, 1.0)])


def _runs(of: Comparison, plain: Any, method: str) -> float | Finding:
    """A short run of each form from the start and from a random state, as far as it can be said."""
    found = (_least_off(of, plain, method, e) for e in of.few(2))
    return largest(found, "a difference grows too much in one step")


def _least_off(of: Comparison, plain: Any, method: str, e: Expected) -> float | None:
    """From one state, in steps that are short enough; None where not even one can be compared."""
    least = None
    for part in SHORTER if METHODS[method].sweeps else (1,):
        off = _run_off(of, plain, method, e, of.system.run.h / part)
        least = off if least is None or (off is not None and off < least) else least
        if least is not None and least <= LIMIT:
            break
    return least


def _run_off(of: Comparison, plain: Any, method: str, e: Expected, h: float) -> float | None:
    """The same in steps of h.

    Raises RuntimeError where one form ends before the other though the step can be made.
    """
    s, spread = e.state, of.sampler.scale

    def run(module: Any, by: Vector) -> Any:
        at = started(module, replace(s, q=s.q + by[0], qd=s.qd + by[1]))
        return simulate(module, at, h=h, steps=STEPS, method=method, t0=s.t)

    one, other = run(of.module, 0 * spread), run(plain, 0 * spread)
    both = min(len(one), len(other))
    rows, others = (np.stack([x.q, x.qd], axis=1)[:both].astype(float) for x in (one, other))
    growth = np.ones(both)
    for sign in (1, np.where(np.arange(len(s.q)) % 2, -1, 1)):  # which excites the fastest modes
        near = run(of.module, NUDGE * sign * spread)
        grown = np.full(both, np.inf)
        known = min(both, len(near))
        moved = np.stack([near.q, near.qd], axis=1)[:known].astype(float)
        with np.errstate(all="ignore"):
            grown[:known] = np.max(np.abs(moved - rows[:known]) / spread, axis=(1, 2)) / NUDGE
        growth = np.fmax(growth, np.where(np.isnan(grown), np.inf, grown))
    growth = np.maximum.accumulate(growth)
    honest = int(np.sum(growth < GROWTH_LIMIT))
    if len(one) != len(other) and honest == both and _can_go_on(of, method, s, rows[-1], h, both):
        raise RuntimeError(f"{len(one) - 1} steps of the fast form, {len(other) - 1} of plain")
    if honest < 2:
        return None
    kick = h * e.size["acceleration"]  # of whose rounding a step makes a difference
    size = growth[:honest, None, None] * (spread + np.array([h * kick, kick]))
    size = np.arange(1, honest + 1)[:, None, None] * (size + np.abs(rows[:honest]))
    off = of.units(others[:honest], rows[:honest], size)
    if off > LIMIT and METHODS[method].implicit:  # others may be found to half their digits
        clear = (_can_go_on(of, method, s, x, h, k + 1) for k, x in enumerate(rows[: honest - 1]))
        honest = 1 + next((k for k, found in enumerate(clear) if not found), honest - 1)
        off = of.units(others[:honest], rows[:honest], size[:honest])
    return off if honest > 1 else None


def _can_go_on(of: Comparison, method: str, s: State, x: Vector, h: float, rows: int) -> bool:
    """Whether the next step is clear: of an implicit method, by plain sweeps or few of Newton's."""
    m, t, acceleration = METHODS[method], s.t + (rows - 1) * h, of.accelerations(s)
    with np.errstate(all="ignore"):
        if np.all(np.isfinite(one_step.step(m, acceleration, x[0], x[1], t, h))):
            return True
        return m.newton and one_step.by_newton(m, acceleration, x[0], x[1], t, h)[1] <= CLEAR
