"""What is shown of a run, or of some instances of a batch: a drawing, and curves, at its rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eomc.base.errors import EomcError
from eomc.model.system import System
from eomc.report.drawing import drawing, drawings
from eomc.report.marks import Drawing
from eomc.runtime.plot import Source

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

COLOURS = 4  # curves in one panel, at most; more where units are few
PANELS = 6
MOST = 24  # instances over each other
TOLD = 2  # parameters by which instances differ, named beside them


@dataclass(frozen=True)
class Line:
    """A curve: its name and its values at the rows that are shown.

    stairs: whether it is an input that is held constant from one row to the next.
    """

    name: str
    values: Array
    stairs: bool = False


@dataclass(frozen=True)
class Panel:
    """Curves that share axes, and their unit; name: where all are of one quantity, it."""

    unit: str
    lines: tuple[Line, ...]
    name: str = ""


class Reel:
    """A run, of a system with its parameters."""

    key: tuple[str, ...] = ()  # what tells instances apart, where there are several

    def __init__(self, system: Any, run: Any) -> None:
        self.system, self.run = system, run
        self.t = np.asarray(run.t, dtype=float)
        self.title: str = system.title or system.name

    @property
    def curves(self) -> int:
        """How many there are, about."""
        return 2 * len(self.system.q) + 1

    def resample(self, count: int) -> bool:
        """Replace the rows of an adaptive run by `count` interpolated ones; whether it is one."""
        run = self.run
        if not (hasattr(run, "_evenly") and len(run) > 1 and run.t[-1] > run.t[0]):
            return False
        self.run = run._evenly(count)
        self.t = np.asarray(self.run.t, dtype=float)
        return True

    def drawing(self, rows: Rows) -> Drawing | None:
        """What is drawn at some rows; None where the scene says nothing of its shape."""
        return drawing(self.system, self.t[rows], np.asarray(self.run.q, dtype=float)[rows])

    def panels(self, rows: Rows) -> Iterator[Panel]:
        """Coordinates, outputs and inputs by unit, each alone where there is room, and energy."""
        system, run = self.system, self.run
        q = np.asarray(run.q, dtype=float)[rows]
        lines = [(c.unit, Line(c.name, q[:, k])) for k, c in enumerate(system.coordinates)]
        lines += [
            (o.unit, Line(o.name, np.asarray(run.outputs[o.name], dtype=float)[rows]))
            for o in system.outputs
        ]
        u = np.asarray(run.u, dtype=float)[rows] if system.inputs else np.empty((len(rows), 0))
        held = getattr(run, "_u", None) is not None
        lines += [(i.unit, Line(i.name, u[:, k], held)) for k, i in enumerate(system.inputs)]
        units = dict.fromkeys(unit for unit, _ in lines)
        apart = len(lines) <= PANELS - 1 and len(lines) <= COLOURS
        for unit in units:
            mine = tuple(line for of, line in lines if of == unit)
            for group in [(line,) for line in mine] if apart else [mine]:
                yield Panel(unit, group)
        known = "J" if any(c.unit for c in system.coordinates) else ""
        yield Panel(known, (Line("energy", np.asarray(run.energy, dtype=float)[rows]),))


class Instances(Reel):
    """Some instances of a batch, over each other."""

    def __init__(self, system: System, batch: Any, names: Sequence[str], chosen: Any) -> None:
        picked = which(len(batch), chosen)
        super().__init__(system, part(batch, picked))
        self.names = tuple(names) or self._default()
        table = np.broadcast_to(self.run._params, (len(picked), len(system.parameters)))
        self.systems = [
            system.at(dict(zip(batch._model.parameters, map(float, row), strict=True)))
            for row in table
        ]
        self.key = tuple(_words(k, table, n, self.run, system) for n, k in enumerate(picked))
        self.numbers = [str(k) for k in picked]
        self.q = _held(np.asarray(self.run.q, dtype=float))

    def _default(self) -> tuple[str, ...]:
        coordinates: tuple[str, ...] = self.run._model.coordinates
        return (*coordinates, "energy") if len(coordinates) < PANELS else coordinates[:PANELS]

    @property
    def curves(self) -> int:
        """How many there are."""
        return len(self.names) * len(self.numbers)

    def drawing(self, rows: Rows) -> Drawing | None:
        """What is drawn of all; of one that has stopped where it did."""
        return drawings(self.systems, self.t[rows], self.q[:, rows], self.numbers)

    def panels(self, rows: Rows) -> Iterator[Panel]:
        """One a name, with a curve for each instance."""
        source = Source(self.run)
        for curve in map(source.curve, self.names):
            lines = (Line(n, x[rows]) for n, x in zip(self.numbers, curve.values, strict=True))
            yield Panel(curve.unit, tuple(lines), curve.name)


def which(count: int, chosen: int | Sequence[int]) -> list[int]:
    """The numbers of the instances that are shown, of `count`. Raises EomcError."""
    wanted: Any = chosen
    if isinstance(chosen, (int, np.integer)) and not isinstance(chosen, bool) and chosen > 0:
        wanted = np.linspace(0, count - 1, min(chosen, count)).astype(int)
    try:
        array = np.asarray(wanted)
        found = [*dict.fromkeys(array.tolist())]
        fits = array.ndim == 1 and array.dtype.kind in "iu" and 0 <= array.min() <= array.max()
    except (TypeError, ValueError):
        fits, found = False, []
    if not fits or max(found) >= count:
        raise EomcError(
            f"instances: give how many, or a list of some from 0 to {count - 1}, here {chosen!r}"
        )
    if len(found) > MOST:
        raise EomcError(f"instances: at most {MOST} can be told apart, here {len(found)}")
    return found


def part(batch: Any, picked: Sequence[int]) -> Any:
    """A batch of these instances alone."""
    own = {n: getattr(batch, n)[picked] for n in ("q", "qd", "steps", "_codes")}
    for name in ("_params", "_held"):  # which all may share
        values = getattr(batch, name)
        if values is not None and len(values) > 1:
            own[name] = values[picked]
    return replace(batch, **own)


def _held(q: Array) -> Array:
    """Rows without a value are the last good one, (batch, n, nq)."""
    good = np.isfinite(q).all(axis=2)
    last = np.maximum.accumulate(np.where(good, np.arange(q.shape[1]), 0), axis=1)
    return np.take_along_axis(q, last[:, :, None], axis=1)


def _words(k: int, table: Array, row: int, run: Any, system: System) -> str:
    """The number of an instance, what it differs by, and how it ended where it did not go on."""
    apart = np.flatnonzero(np.ptp(table, axis=0) > 0)
    units: Mapping[str, str] = run._model.units
    names = [p.name for p in system.parameters]
    told = [
        f"{names[j]} = {table[row, j]:.4g} {units.get(names[j], '')}".rstrip()
        for j in apart[:TOLD]
        if len(apart) <= TOLD
    ]
    ended = str(run.status[row])
    words = ", ".join([*told, *([] if ended == "ok" else [ended])])
    return f"{k}: {words}" if words else str(k)
