"""The public interface of a run: states at any time, error, balance and pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array
from .atomic_write import File
from .balance import Balance, balance
from .by_name import ByName
from .dense import states
from .estimate import Estimate, estimate
from .initial_checks import infinite_at_start
from .laws import evaluate_law
from .notebook import html
from .package import warn
from .plot import plot
from .plugins import require_eomc
from .section import as_section, crossings
from .status import STATUS_MESSAGES, Interrupted, state_text
from .trajectory_data import Trajectory

NOISE = (
    "estimate: u gives other values at the start than it gave in the run, as noise does, or what "
    "keeps a state of its own: let it depend on t, q and qd alone"
)


@dataclass(eq=False, repr=False)
class Run(Trajectory):
    """A trajectory: t (n,), q (n, nq), qd (n, nq), u (n, nu), status; by name run["theta_dot"].

    status: "ok", "singular", "not finite", "no convergence", under constraints "locked", or
    "interrupted". A run with another status than "ok" ends with its last valid state; `message`
    gives the time and the reason. energy (n,): K + P, computed at the first access. steps: number
    of steps of size h by `method`, with a row after `every` so many. evaluations: number of
    evaluations of accelerations. error: an Estimate, if it was requested.

    Runs are equal if their scenes, settings and rows are equal, bit by bit. A pickled run contains
    all of these, its parameters and its inputs, except a u that is a function; then estimate()
    raises ValueError. An unpickled run belongs to the build that pickled it. If that build no
    longer exists, it belongs to the present build, with a warning, if the columns have the same
    names.
    """

    error: Estimate | None = field(default=None, init=False)

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return (q, qd) at times t (...,) within the run, each (..., nq).

        A shorter step of the method from the last row before yields the state, with the order of
        the method. Raises ValueError outside of the run, or if u was a function whose values are
        not stored at each step.
        """
        return states(self, t)

    stopped = ""  # name of the event that ended the run

    @property
    def events(self) -> Mapping[str, Any]:
        """Occurrences of each event by its name; empty for scenes without events."""
        return ByName("events", (), ())

    def balance(self) -> Balance | None:
        """Return the energy balance: work of inputs and forces, losses and the error left, J.

        The work of jumps is a separate term. None if the inputs at the rows are unknown, as those
        of a function with `every`, or if an energy or a force is not finite.
        """
        return balance(self)

    def plot(
        self, *names: str, phase: Any = None, section: Mapping[str, Array] | None = None,
        other: Run | Sequence[Run] = (), labels: Sequence[str] | None = None,
        wrap: bool | str | Sequence[str] = False, ax: Any = None, axes: Any = None,
        file: File | None = None, **style: Any,
    ) -> Any:  # fmt: skip
        """Curves over time by name; coordinates, inputs, outputs and energy where none is given.

        Names of one kind, unit and size share a panel. phase: a coordinate, drawn over its rate, a
        pair of names, or a list of such; section: what `section` returns, drawn there as points.
        other: runs beside this one, dashed; labels: names of the runs, in a legend. wrap: angles
        from -pi to pi, those in rad or the named ones, without lines where they jump. ax: one Axes
        for all, axes: one a panel. file: where the figure is written, too. style: for matplotlib's
        `plot`. Returns the Axes, an array of several. Raises ModuleNotFoundError without
        matplotlib, KeyError for unknown names.
        """
        return plot(self, names, phase, section, other, labels, wrap, ax, axes, file, style)

    def section(
        self, name: str, value: float = 0.0, *, rising: bool | None = None,
        period: float | None = None,
    ) -> dict[str, Array]:  # fmt: skip
        """All columns (m,) where one of them crosses a value: a Poincaré section.

        rising: only where it grows, or only where it falls. period: whole periods above and below
        the value count too, as 2 pi of an angle, or of t that of a drive. Each column is a cubic
        through four rows: errors go as the fourth power of the time between rows, and crossings
        closer than rows are missed, so keep every=1. By a tolerance, and of scenes with events,
        states within the steps place crossings: as exact as these; a jump crosses nothing. Raises
        ValueError below four rows.
        """
        return self._crossings(name, *as_section(self._columns(), name, value, rising, period))

    def _crossings(
        self, name: str, value: float, rising: bool | None, period: float | None
    ) -> dict[str, Array]:
        return crossings(self.to_dict(), name, value, rising, period)

    @property
    def _drawn(self) -> Run:
        """The run with rows close enough for curves."""
        return self

    def _repr_html_(self) -> str:
        """For notebooks: the end, the verdict, a small picture where matplotlib is there."""
        return html(self)

    def animate(
        self, file: File | None = None, *others: Run, scene: Any = None, title: str | None = None
    ) -> Any:
        """The motion as a page that plays it, for browsers and notebooks, or as a film.

        file: where it is written, a page .html, or a film .gif or .mp4, which need matplotlib;
        others: runs that are shown beside it. scene: the path of the scene, where the module was
        not loaded by eomc.load. Returns an Animation; see docs/pictures.md. Raises ImportError
        without eomc, EomcError where it can't be drawn or written.
        """
        page = require_eomc("report.animation")
        return page.animate([self, *others], file, scene=scene, title=title)

    def render(self, t: ArrayLike | None = None, *, scene: Any = None) -> Array:
        """Draw the mechanism at a time within the run.

        Parameters
        ----------
        t : float or (n,) array, optional
            Time in s; the end of the run by default. States between rows are interpolated.
        scene : path, optional
            The scene, where the module was not loaded by `eomc.load`.

        Returns
        -------
        (height, width, 3) or (n, height, width, 3) array of uint8
            RGB pixels. The view is the same for all times of a run.

        Raises
        ------
        ImportError
            Without eomc or matplotlib.
        EomcError
            If the scene says nothing about its shape.
        ValueError
            If a time lies outside of the run.
        """
        pixels: Array = require_eomc("report.film").render(self, t, scene)
        return pixels

    def estimate(self, progress: Callable[[int, int], None] | None = None) -> Estimate:
        """The run's own error, by doing it again in shorter steps; kept in `error`.

        Where u is a function, it is called again, as often as in the run for each finer one.
        Warns where the motion is not resolved. Raises ValueError where the run was pickled and lost
        that function, or where this gives other values at the start than it gave: noise.
        """
        self._repeated()
        try:
            self.error = self._estimated(progress)
        except KeyboardInterrupt:
            raise Interrupted(self) from None
        if words := self.error.warning:
            warn(f"{self._model.name}: {words}")
        return self.error

    def _repeated(self) -> None:
        """Raise ValueError if the run cannot be repeated."""
        if isinstance(self._u, str):
            raise ValueError(f"estimate: {self._u}")
        if callable(self._u) and self._applied is not None and len(self) and self.t[0] == self.t0:
            u_at_start = evaluate_law(self._u, self._model._inputs, self.t0, self.q[0], self.qd[0])
            if not np.array_equal(u_at_start, self._applied[0]):
                raise ValueError(NOISE)

    def _estimated(self, progress: Callable[[int, int], None] | None) -> Estimate:
        return estimate(self, progress)

    @property
    def message(self) -> str:
        """The outcome of the run, in a sentence."""
        if self.status == "ok":
            return f"{self.steps} steps of {self.h:g} s"
        reason = infinite_at_start(self) or STATUS_MESSAGES[self.status]
        return (
            f"stopped at t = {self.t[-1]:.9g} after {self.steps} steps of {self.h:g} s, "
            f"{state_text(self.q[-1], self.qd[-1])}: {reason}"
        )

    @property
    def _remark(self) -> str:
        """Warning for a run with status "ok", or ""."""
        return self._singular
