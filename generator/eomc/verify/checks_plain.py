"""Checks of the portable C code ("plain"), against the reference and the optimised code ("fast").

Values, one step and a run are compared with the reference, as for the optimised code. Then values,
derivatives and runs of both codes are compared with each other, in units of rounding.
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
from eomc.verify.reference import Vector
from eomc.verify.report import LIMIT, Measurement, largest
from eomc.verify.sampling import (
    NUDGE,
    VALUES,
    Expected,
    State,
    evaluate_module,
    perturb_each_input,
    projected_start,
    simulate,
)

COMPARED_VALUES = (*VALUES, "acceleration")


def report(check: Comparison) -> None:
    """Append checks of the portable C code (as opposed to the optimised one) to the report.

    There are none if there is no module of that form.
    """
    if check.plain is None:
        return
    unit, plain = "units of rounding", check.plain
    twin = copy.copy(check)
    twin.module = plain
    check.add_check(
        "plain C",
        LIMIT,
        unit,
        lambda: float(np.max([twin.value_error(name) for name in COMPARED_VALUES])),
    )
    if check.methods[0] == "rk4":
        check.add_check("plain C: one step", LIMIT, unit, twin.rk4_step_error)
        check.add_check("plain C: run", LIMIT, unit + ", times steps and growth", twin.run_error)
    check.add_check("plain C beside fast", LIMIT, unit, partial(_values, check, plain))
    if (
        hasattr(check.module, "linearize")
        and _slopes(check.module, check.expected[0].state) is not None
    ):
        check.add_check(
            "plain C beside fast: A, B", LIMIT, unit, partial(_linearization, check, plain)
        )
    for method in check.methods:
        check.add_check(
            f"plain C beside fast: {method}", LIMIT, unit + ", times steps and growth",
            partial(_runs, check, plain, method),
        )  # fmt: skip


def _values(check: Comparison, plain: Any) -> float:
    """Return the largest difference of all values of both forms, in units of rounding."""

    def error(e: Expected) -> float:
        pairs = [
            (
                evaluate_module(plain, n, e.state),
                evaluate_module(check.module, n, e.state),
                e.size[n],
            )
            for n in COMPARED_VALUES
        ]
        return float(np.max([check.units(*pair) for pair in pairs]))

    return check.largest(error)


def _slopes(module: Any, s: State) -> Vector | None:
    """Return A, B and the derivatives by parameters side by side, if the module has them."""
    derivatives = []
    for name in ("linearize", "sensitivity"):
        try:
            result = getattr(module, name)(s.q, s.qd, u=s.u, t=s.t, params=s.params)
        except ValueError:  # the module does not have it
            continue
        derivatives += [
            x[-len(s.q) :] for x in (result if isinstance(result, tuple) else (result,))
        ]
    return np.hstack(derivatives).astype(float) if derivatives else None


def _linearization(check: Comparison, plain: Any) -> float:
    """Compare derivatives at a few states, in units of the effect of rounded inputs."""

    def error(e: Expected) -> float:
        one, other = (_slopes(module, e.state) for module in (check.module, plain))
        assert one is not None and other is not None
        near = [
            _slopes(check.module, s)
            for s in perturb_each_input(e.state, check.sampler.defaults)[:64]
        ]
        size = np.abs(one) + sum(np.abs(x - one) / NUDGE for x in near if x is not None)
        # entries that are 0 everywhere are sums of terms that cancel
        scale = _inputs(check, e.state)[: one.shape[1]]
        size = np.maximum(size, e.size["acceleration"][:, None] / scale)
        return check.units(other, one, np.maximum(size, 1e-6 * np.max(size)))

    return check.largest(error, check.effort.few)


def _inputs(check: Comparison, s: State) -> Vector:
    """Return the scales of q, qd, inputs and parameters, in the order of `_slopes`."""
    params = list((s.params or check.sampler.defaults).values())
    sizes = np.abs([*(np.zeros(len(check.system.inputs)) if s.u is None else s.u), *params])
    return np.array([*check.sampler.spread, *check.sampler.speed, *np.where(sizes > 0, sizes, 1.0)])


def _runs(check: Comparison, plain: Any, method: str) -> float | Measurement:
    """Return the largest difference of short runs of both forms, in units of rounding.

    They start at the initial state and at a random one.
    """
    differences = (_least_off(check, plain, method, e) for e in check.few(2))
    return largest(differences, "a difference grows too much in one step")


def _least_off(check: Comparison, plain: Any, method: str, e: Expected) -> float | None:
    """Return the difference of runs from one state, in steps that are short enough.

    None if not even one step can be compared.
    """
    least = None
    # with a fixed number of iterations, shorter steps reduce their error to rounding
    for part in (16, 64, 256) if METHODS[method].sweeps else (1,):
        off = _run_off(check, plain, method, e, check.system.run.h / part)
        least = off if least is None or (off is not None and off < least) else least
        if least is not None and least <= LIMIT:
            break
    return least


def _run_off(check: Comparison, plain: Any, method: str, e: Expected, h: float) -> float | None:
    """Return the difference of runs of both forms in steps of h.

    Raises RuntimeError if one form ends before the other although the step can be made.
    """
    s, spread = e.state, check.sampler.scale

    def run(module: Any, by: Vector) -> Any:
        at = projected_start(module, replace(s, q=s.q + by[0], qd=s.qd + by[1]))
        return simulate(module, at, h=h, steps=24, method=method, t0=s.t)

    one, other = run(check.module, 0 * spread), run(plain, 0 * spread)
    both = min(len(one), len(other))
    rows, others = (np.stack([x.q, x.qd], axis=1)[:both].astype(float) for x in (one, other))
    growth = np.ones(both)
    for sign in (
        1,
        np.where(np.arange(len(s.q)) % 2, -1, 1),
    ):  # alternating signs excite fast modes
        near = run(check.module, NUDGE * sign * spread)
        grown = np.full(both, np.inf)
        known = min(both, len(near))
        moved = np.stack([near.q, near.qd], axis=1)[:known].astype(float)
        with np.errstate(all="ignore"):
            grown[:known] = np.max(np.abs(moved - rows[:known]) / spread, axis=(1, 2)) / NUDGE
        growth = np.fmax(growth, np.where(np.isnan(grown), np.inf, grown))
    growth = np.maximum.accumulate(growth)
    comparable = int(np.sum(growth < GROWTH_LIMIT))
    if (
        len(one) != len(other)
        and comparable == both
        and _next_step_converges(check, method, s, rows[-1], h, both)
    ):
        raise RuntimeError(f"{len(one) - 1} steps of the fast form, {len(other) - 1} of plain")
    if comparable < 2:
        return None
    kick = h * e.size["acceleration"]  # its rounding error changes the state after a step
    size = growth[:comparable, None, None] * (spread + np.array([h * kick, kick]))
    size = np.arange(1, comparable + 1)[:, None, None] * (size + np.abs(rows[:comparable]))
    off = check.units(others[:comparable], rows[:comparable], size)
    if off > LIMIT and METHODS[method].implicit:  # a converging step may lose half its digits
        clear = (
            _next_step_converges(check, method, s, x, h, k + 1)
            for k, x in enumerate(rows[: comparable - 1])
        )
        comparable = 1 + next(
            (k for k, is_clear in enumerate(clear) if not is_clear), comparable - 1
        )
        off = check.units(others[:comparable], rows[:comparable], size[:comparable])
    return off if comparable > 1 else None


def _next_step_converges(
    check: Comparison, method: str, s: State, x: Vector, h: float, rows: int
) -> bool:
    """Return whether the reference's next step converges.

    An implicit method needs fixed-point iteration or few iterations of Newton's method.
    """
    m, t, acceleration = METHODS[method], s.t + (rows - 1) * h, check.accelerations(s)
    with np.errstate(all="ignore"):
        if np.all(np.isfinite(one_step.step(m, acceleration, x[0], x[1], t, h))):
            return True
        return m.newton and one_step.step_by_newton(m, acceleration, x[0], x[1], t, h)[1] <= 7
