"""Where a run's energy went: the work of inputs and forces along its rows, and what that leaves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .arguments import Array
from .package import reduced

if TYPE_CHECKING:
    from .trajectory import Run

_ROWS = 8  # of an interpolating polynomial, and so the order of an integral, at most
_FEWEST = 2 * _ROWS + 1  # from which on every fourth shows something; below all may be wrong
_LEAST = 0.5  # of the order that is taken for seen
_TOLD = 0.005  # of the largest part: an integral that is off by more tells nothing


@dataclass(frozen=True)
class Balance:
    """J: E(end) - E(0) = inputs + forces - lost, and what the method and rounding made of it.

    E is the energy, or Jacobi's integral where that is another. inputs: their work, the signals'
    too. lost: what forces took that are odd in the velocities, as friction and dampers are. forces:
    the work of all others, and of what moves with time. left: E - E(0) less all work, the largest
    along the run: the method's error. unsure: how far the work may be off, since steps are long;
    less than that can't be seen of `left`. told: whether that is little beside the work.
    """

    inputs: float
    forces: float
    lost: float
    left: float
    unsure: float
    told: bool

    @property
    def words(self) -> str:
        """What was put in, taken and lost, and the error, for people."""
        if not self.told:
            return "steps are too long to tell what was put in and what was lost"
        ways = (
            (self.inputs, "inputs put in {} J", "inputs took {} J"),
            (self.forces, "forces put in {} J", "forces took {} J"),
            (self.lost, "{} J were lost", "negative damping put in {} J"),
        )
        found = [(more if x > 0 else less).format(f"{abs(x):.3g}")
                 for x, more, less in ways if abs(x) > self.unsure]  # fmt: skip
        error = f"{self.left:.2g}" if self.left > 3 * self.unsure else ""
        error = error or f"at most {self.left + self.unsure:.1g}"
        return f"{', '.join(found) or 'nothing was put in or lost'}; numerical error {error} J"

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("balance.Balance", *self.__dict__.values())


def balance(run: Run) -> Balance | None:
    """The balance of a run; None where it jumps, or inputs change from step to step, unseen."""
    if run._u is not None and np.ndim(run._u) != 1:
        return None
    if not np.isfinite(run.jacobi).all():
        return None
    run = run._even()  # all its rows: few may look smooth and not be
    if (np.diff(run.t) == 0).any():  # the state jumps
        return None
    model, energy = run._model, run.jacobi.astype(float)
    none = np.zeros(model.nu) if model.nu else None
    power, rest = (run._values("power", u=u).astype(float) for u in (run._u, none))
    ahead, back = (
        run._values("tau", lambda q, qd, way=way, **held: model.tau(q, way * qd, **held), u=none)
        for way in (1, -1)
    )
    braking = np.sum((back - ahead) / 2 * run.qd, axis=1).astype(float)
    (work, off), (other, _), (lost, blur) = (_work(run.t, y) for y in (power, rest, braking))
    inputs, forces = float(work[-1] - other[-1]), float(other[-1] + lost[-1])
    parts = inputs, forces, float(lost[-1])
    off, rounding = max(off, blur), float(np.finfo(model.dtype).eps * np.max(np.abs(energy)))
    left = float(np.max(np.abs(energy - energy[0] - work)))
    told = off <= max(_TOLD * max(map(abs, parts)), 10 * rounding)
    return Balance(*parts, left, off + rounding, told=told)


def _work(t: Array, power: Array) -> tuple[Array, float]:
    """The integral of the power up to each row, (n,), and how far it may be off.

    That is thrice what the integrals over every second and fourth row show, by their order.
    """
    n = len(t)
    if n < _FEWEST:
        sums = np.concatenate([[0.0], np.cumsum(_intervals(t, power))])
        return sums, float(np.max(np.abs(power)) * (t[-1] - t[0]))
    kept = [np.unique([*range(0, n, stride), n - 1]) for stride in (1, 2, 4)]
    found = [np.concatenate([[0.0], np.cumsum(_intervals(t[k], power[k]))]) for k in kept]
    whole, half, quarter = (
        sums[np.searchsorted(k, kept[-1])] for sums, k in zip(found, kept, strict=True)
    )
    near, far = (float(np.max(np.abs(x))) for x in (whole - half, half - quarter))
    order = min(max(math.log2(far / near), _LEAST), _ROWS) if near and far else _LEAST
    return found[0], 3 * near / (2.0**order - 1)


def _intervals(t: Array, y: Array) -> Array:
    """The integral of y from each row to the next, (n - 1,), by polynomials through some rows.

    Rows are equally far apart, but perhaps the last.
    """
    n, rows = len(t), min(_ROWS, len(t))
    k = np.arange(n - 1)
    first = np.clip(k - (rows // 2 - 1), 0, n - rows)
    usual = _weights(np.arange(rows)) * (t[1] - t[0] if n > 1 else 0.0)
    weights = usual[k - first]
    last = first == n - rows
    weights[last] = _weights(t[n - rows :])[k[last] - (n - rows)]
    windows = np.lib.stride_tricks.sliding_window_view(y, rows)[first]
    return np.asarray(np.sum(weights * windows, axis=1))


def _weights(nodes: Array) -> Array:
    """Of each interval between nodes, (n - 1, n), those whose sum with values is the integral."""
    n, middle, half = len(nodes), (nodes[0] + nodes[-1]) / 2, (nodes[-1] - nodes[0]) / 2 or 1.0
    x = (nodes - middle) / half
    powers = np.arange(1, n + 1)
    moments = np.diff(x[:, None] ** powers / powers, axis=0)
    return np.asarray(half * np.linalg.solve(np.vander(x, increasing=True).T, moments.T).T)
