"""Timelines: the drawing and the curves of a run, or of some instances of a batch, at its rows."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eomc import pipeline
from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.model.system import System
from eomc.report.drawing import Drawing, draw_instances, draw_mechanism
from eomc.runtime.plot import Curve
from eomc.runtime.plot import Source as Quantities

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Source = str | os.PathLike[str] | System  # a scene file or a system

MAX_CURVES_PER_PANEL = 4  # at most, where each curve has its own panel
MAX_PANELS = 6
MAX_INSTANCES = 24  # that can be told apart in one drawing
MAX_KEY_PARAMETERS = 2  # that differ between the instances, in the key


class Panel(NamedTuple):
    """A panel of an animation: curves with the same unit that share one pair of axes.

    The values of the curves belong to the stored times that the animation shows. name: name of the
    quantity, if all curves show one quantity for different instances (runs of a batch); else "".
    """

    curves: tuple[Curve, ...]
    name: str = ""


class Timeline:
    """The data of one run for an animation: the drawing of the mechanism and curves against time.

    t: times (n,) in s of the stored states of the run.
    """

    key: tuple[str, ...] = ()  # a label for each instance of a batch

    def __init__(self, system: Any, run: Any) -> None:
        self.system, self.run = system, run
        self.t = np.asarray(run.t, dtype=float)
        self.title: str = system.title or system.name

    @property
    def has_stairs(self) -> bool:
        """True if the inputs are held constant from one row to the next (zero-order hold)."""
        return getattr(getattr(self.run, "request", None), "u", None) is not None

    @property
    def curves(self) -> int:
        """Approximate number of curves in all panels."""
        return 2 * len(self.system.q) + 1

    def resample(self, count: int) -> bool:
        """Replace the stored states of an adaptive run by `count` interpolated ones.

        The new states are equidistant in time. Returns True if they were replaced; returns False
        and changes nothing if the run has fixed steps or no duration, or is a batch.
        """
        run = self.run
        request = getattr(run, "request", None)
        if (
            request is None
            or request.has_equal_steps
            or np.ndim(run.q) > 2
            or not (len(run) > 1 and run.t[-1] > run.t[0])
        ):
            return False
        self.run = run.resample(count)
        self.t = np.asarray(self.run.t, dtype=float)
        return True

    def drawing(self, rows: Rows) -> Drawing | None:
        """Return the drawing at the stored times with the indices `rows`.

        Returns None if the scene does not describe the shape of the mechanism.
        """
        return draw_mechanism(self.system, self.t[rows], np.asarray(self.run.q, dtype=float)[rows])

    def panels(self, rows: Rows) -> Iterator[Panel]:
        """Yield the panels with curves of coordinates, outputs and inputs, and one of the energy.

        rows: indices of the stored times that the curves show. If there are few curves, each has a
        panel of its own; otherwise all curves with the same unit share a panel. The panel of the
        energy is the last one.
        """
        system, run = self.system, self.run

        def curves(kind: str, quantities: Sequence[Any], columns: Any) -> list[Curve]:
            pairs = zip(quantities, columns, strict=True)
            return [Curve(x.name, np.asarray(v, float)[rows], x.unit, kind) for x, v in pairs]

        lines = curves("coordinates", system.coordinates, np.transpose(run.q))
        lines += curves("outputs", system.outputs, [run.outputs[o.name] for o in system.outputs])
        lines += curves("inputs", system.inputs, np.transpose(run.u) if system.inputs else ())
        separate = len(lines) <= MAX_PANELS - 1 and len(lines) <= MAX_CURVES_PER_PANEL
        for unit in dict.fromkeys(line.unit for line in lines):
            group = tuple(line for line in lines if line.unit == unit)
            yield from ([Panel((line,)) for line in group] if separate else [Panel(group)])
        known = "J" if any(c.unit for c in system.coordinates) else ""
        yield Panel((Curve("energy", np.asarray(run.energy, dtype=float)[rows], known, "energy"),))


class BatchTimeline(Timeline):
    """The data of several instances of a batch for an animation that shows them superimposed.

    An instance is one run of the batch. names: quantities to plot, by default coordinates and the
    energy. chosen: number of instances to show, or the list of their indices.
    """

    def __init__(self, system: System, batch: Any, names: Sequence[str], chosen: Any) -> None:
        numbers = choose_instances(len(batch), chosen)
        super().__init__(system, batch.select(numbers))
        self.names = tuple(names) or self._default()
        table = np.broadcast_to(self.run.request.p, (len(numbers), len(system.parameters)))
        self.systems = [
            system.with_parameters(
                dict(zip(batch.model.info.parameters, map(float, row), strict=True))
            )
            for row in table
        ]
        self.key = tuple(
            _instance_label(k, table, n, self.run, system) for n, k in enumerate(numbers)
        )
        self.numbers = [str(k) for k in numbers]
        self.q = _hold_last_finite(np.asarray(self.run.q, dtype=float))

    def _default(self) -> tuple[str, ...]:
        coordinates: tuple[str, ...] = self.run.model.info.coordinates
        return (
            (*coordinates, "energy") if len(coordinates) < MAX_PANELS else coordinates[:MAX_PANELS]
        )

    @property
    def curves(self) -> int:
        """Number of curves in all panels: one for each quantity and instance."""
        return len(self.names) * len(self.numbers)

    def drawing(self, rows: Rows) -> Drawing | None:
        """Return the drawing of all chosen instances at the stored times with the indices `rows`.

        An instance whose run has ended keeps its last position.
        """
        return draw_instances(self.systems, self.t[rows], self.q[:, rows], self.numbers)

    def panels(self, rows: Rows) -> Iterator[Panel]:
        """Yield one panel for each quantity in `names`, with a curve for each instance.

        rows: indices of the stored times that the curves show.
        """
        source = Quantities(self.run)
        for curve in map(source.curve, self.names):
            pairs = zip(self.numbers, curve.values, strict=True)
            lines = tuple(replace(curve, name=n, values=x[rows]) for n, x in pairs)
            yield Panel(lines, curve.name)


def find_system(run: Any, scene: Source | None = None) -> System:
    """Return the system that a run simulated, with the parameter values of the run.

    Parameters
    ----------
    run : Run or batch of runs
        For a batch, the parameter values are those of the first instance.
    scene : path or System, optional
        The scene or system that the module was built from. Needed only if the module was not
        loaded with `eomc.load`.

    Returns
    -------
    System

    Raises
    ------
    EomcError
        If the scene is unknown, or is not the one that the module was built from.
    """
    model = run.model
    source = model.source if scene is None else scene
    if source is None:
        raise EomcError(
            f"{model.info.name}: was imported without its scene, which says what is drawn: load it "
            "with eomc.load, or give scene=PATH"
        )
    system = source if isinstance(source, System) else pipeline.read(source)
    if system.digest != model.info.digest:
        where = texts.line(system.file) or system.name
        raise EomcError(
            f"{where}: is not the scene that {model.info.name} was built from, or has changed "
            "since: load it again with eomc.load"
        )
    values = np.atleast_2d(run.request.p)[0]
    return system.with_parameters(dict(zip(model.info.parameters, map(float, values), strict=True)))


def choose_instances(count: int, chosen: int | Sequence[int]) -> list[int]:
    """Return the indices of the instances to show, for a batch of `count` instances.

    chosen: how many to show, spread evenly over the batch, or the list of their indices. Raises
    EomcError if an index does not exist or if there are more than MAX_INSTANCES.
    """
    requested: Any = chosen
    if isinstance(chosen, (int, np.integer)) and not isinstance(chosen, bool) and chosen > 0:
        requested = np.linspace(0, count - 1, min(chosen, count)).astype(int)
    try:
        array = np.asarray(requested)
        numbers = [*dict.fromkeys(array.tolist())]
        valid = array.ndim == 1 and array.dtype.kind in "iu" and 0 <= array.min() <= array.max()
    except (TypeError, ValueError):
        valid, numbers = False, []
    if not valid or max(numbers) >= count:
        raise EomcError(
            f"instances: give how many, or a list of some from 0 to {count - 1}, here {chosen!r}"
        )
    if len(numbers) > MAX_INSTANCES:
        raise EomcError(
            f"instances: at most {MAX_INSTANCES} can be told apart, here {len(numbers)}"
        )
    return numbers


def _hold_last_finite(q: Array) -> Array:
    """Return q (batch, n, nq) with rows that are not finite replaced by the last finite row."""
    good = np.isfinite(q).all(axis=2)
    last = np.maximum.accumulate(np.where(good, np.arange(q.shape[1]), 0), axis=1)
    return np.take_along_axis(q, last[:, :, None], axis=1)


def _instance_label(k: int, table: Array, row: int, run: Any, system: System) -> str:
    """Return the number of an instance, the parameters that differ, and its status if not "ok"."""
    varying = np.flatnonzero(np.ptp(table, axis=0) > 0)
    units: Mapping[str, str] = run.model.info.units
    names = [p.name for p in system.parameters]
    labels = [
        f"{names[j]} = {table[row, j]:.4g} {units.get(names[j], '')}".rstrip()
        for j in varying[:MAX_KEY_PARAMETERS]
        if len(varying) <= MAX_KEY_PARAMETERS
    ]
    ended = str(run.status[row])
    words = ", ".join([*labels, *([] if ended == "ok" else [ended])])
    return f"{k}: {words}" if words else str(k)
