"""The public interface of a run: states at any time, error, balance and pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, ByName
from .atomic_write import File
from .estimate import Estimate, estimate
from .inputs import evaluate_law
from .package import require_eomc, warn
from .status import STATUS_MESSAGES, Interrupted, state_text
from .trajectory_data import Trajectory, infinite_at_start

if TYPE_CHECKING:  # modules that analyse and draw runs are imported when they are used
    from .balance import Balance

NOISE = (
    "estimate: u gives other values at the start than it gave in the run, as noise does, or what "
    "has a state of its own: let it depend on t, q and qd alone"
)


@dataclass(eq=False, repr=False)
class Run(Trajectory):
    """A trajectory: the states at the rows of a simulation, and quantities that follow from them.

    Columns are read by name as well: run["theta_dot"].

    Attributes
    ----------
    t : (n,) array
        Times of the rows, s.
    q, qd : (n, nq) arrays
        Positions and velocities.
    u : (n, nu) array
        Inputs.
    energy : (n,) array
        K + P, J, computed at the first access.
    status : str
        "ok", "singular", "not finite", "no convergence", with constraints "locked", or
        "interrupted". A run with another status than "ok" ends with its last valid state.
    message : str
        The outcome; if the run stopped, the time and the reason.
    h, method, steps, every : float, str, int, int
        Step size, s, method and number of completed steps; there is a row after each `every` steps.
    evaluations : int
        Number of evaluations of accelerations.
    error : Estimate or None
        Error estimate, if `estimate` was called or requested.

    Notes
    -----
    Runs are equal if their scenes, settings and rows are equal, bit by bit. A pickled run contains
    all of these, its parameters and its inputs, except a u that is a function; `estimate` then
    raises ValueError. An unpickled run belongs to the build that pickled it. If that build no
    longer exists, it belongs to the present build, with a warning, if the columns have the same
    names.
    """

    error: Estimate | None = field(default=None, init=False)

    stopped = ""  # name of the event that ended the run

    @property
    def events(self) -> Mapping[str, Any]:
        """Occurrences of each event as an `EventLog`, by the event's name.

        The mapping is empty for a scene without events.
        """
        return ByName("events", (), ())

    def balance(self) -> Balance | None:
        """Return the energy balance of the run, J, with the numerical error that follows from it.

        Returns
        -------
        Balance or None
            Work of inputs, forces and state jumps, and dissipated energy. None if an energy or a
            force is not finite, or if the inputs at the rows are unknown. They are unknown for a
            function u in a run with `every` > 1.
        """
        from .balance import balance

        return balance(self)

    def plot(
        self, *names: str, phase: Any = None, section: Mapping[str, Array] | None = None,
        other: Run | Sequence[Run] = (), labels: Sequence[str] | None = None,
        wrap: bool | str | Sequence[str] = False, ax: Any = None, axes: Any = None,
        file: File | None = None, **style: Any,
    ) -> Any:  # fmt: skip
        """Plot columns of the run over time, or phase portraits, with matplotlib.

        Parameters
        ----------
        *names : str
            Names of columns; by default coordinates, inputs, outputs and energy, or none if `phase`
            is given. Columns of the same kind, unit and size share a panel.
        phase : str, pair of str, or list of these, optional
            Phase portraits: a coordinate, drawn with its velocity on the y axis, or a pair (x, y).
        section : dict, optional
            Result of `section`, whose points are drawn in the portraits instead of curves.
        other : Run or sequence of Run
            Runs that are drawn dashed in the same panels.
        labels : sequence of str, optional
            Names of the runs for the legend, that of this run first.
        wrap : bool, str or sequence of str
            Angles that are drawn from -pi to pi, without lines where they jump: the named ones, or
            with True all coordinates in rad.
        ax : Axes, optional
            One Axes for all columns.
        axes : sequence of Axes, optional
            One Axes for each panel.
        file : str or path, optional
            File to which the figure is written as well.
        **style
            Arguments of `Axes.plot` of matplotlib.

        Returns
        -------
        Axes or array of Axes

        Raises
        ------
        ModuleNotFoundError
            Without matplotlib.
        KeyError
            If a name is unknown.
        ValueError
            If the number of `axes` or `labels` does not fit.
        """
        from .plot import plot

        return plot(self, names, phase, section, other, labels, wrap, ax, axes, file, style)

    def section(
        self, name: str, value: float = 0.0, *, rising: bool | None = None,
        period: float | None = None,
    ) -> dict[str, Array]:  # fmt: skip
        """Return all columns at the instants when one column crosses a value: a Poincaré section.

        Columns are interpolated by cubics through four rows, with an error of fourth order in the
        time between rows. Crossings closer than rows are missed, so simulate with every=1. Adaptive
        runs and runs with events use states within the steps, which are as accurate as the steps. A
        state jump is not a crossing.

        Parameters
        ----------
        name : str
            Column that crosses the value.
        value : float
            The value, in the unit of the column.
        rising : bool, optional
            True: only crossings where the column increases; False: only where it decreases.
        period : float, optional
            Multiples of this period, added to the value, count as well: 2 pi for an angle, or the
            period of the excitation for the column "t".

        Returns
        -------
        dict
            Arrays (m,) by the name of the column, for m crossings.

        Raises
        ------
        ValueError
            If the run has fewer than four rows.
        KeyError
            If the name is unknown.
        """
        from .section import as_section

        return self._crossings(name, *as_section(self._columns(), name, value, rising, period))

    def _crossings(
        self, name: str, value: float, rising: bool | None, period: float | None
    ) -> dict[str, Array]:
        from .section import crossings

        return crossings(self.to_dict(), name, value, rising, period)

    @property
    def curve_run(self) -> Run:
        """The run with rows close enough for curves."""
        return self

    def _repr_html_(self) -> str:
        """Return the summary of the run that notebooks display, as HTML."""
        from .notebook import html

        return html(self)

    def animate(
        self, file: File | None = None, *others: Run, scene: Any = None, title: str | None = None
    ) -> Any:
        """Animate the motion as a page for browsers and notebooks, or as a film.

        Parameters
        ----------
        file : str or path, optional
            File to write: a page .html, or a film .gif or .mp4, which needs matplotlib.
        *others : Run
            Runs that are shown beside this one.
        scene : path, optional
            The scene, if the module was not loaded by `eomc.load`.
        title : str, optional
            Title of the page.

        Returns
        -------
        Animation
            See docs/pictures.md.

        Raises
        ------
        ImportError
            Without eomc.
        EomcError
            If the motion cannot be drawn or the file cannot be written.
        """
        page = require_eomc("report.animation")
        return page.animate([self, *others], file, scene=scene, title=title)

    def render(self, t: ArrayLike | None = None, *, scene: Any = None) -> Array:
        """Draw the mechanism at times within the run and return the pixels.

        Parameters
        ----------
        t : float or (n,) array, optional
            Time in s; the end of the run by default. States between rows are interpolated.
        scene : path, optional
            The scene, if the module was not loaded by `eomc.load`.

        Returns
        -------
        (height, width, 3) or (n, height, width, 3) array of uint8
            RGB pixels. The view is the same for all times of a run.

        Raises
        ------
        ImportError
            Without eomc or matplotlib.
        EomcError
            If the scene does not describe the shape of the mechanism.
        ValueError
            If a time lies outside of the run.
        """
        pixels: Array = require_eomc("report.film").render(self, t, scene)
        return pixels

    def estimate(self, progress: Callable[[int, int], None] | None = None) -> Estimate:
        """Estimate the error of the run by repeating it in shorter steps; store it in `error`.

        If u is a function, it is called again in each repetition. A warning is issued if the motion
        is not resolved.

        Parameters
        ----------
        progress : callable, optional
            Function that is called with (completed steps, expected number of steps).

        Returns
        -------
        Estimate

        Raises
        ------
        ValueError
            If the run was pickled and has lost the function u, or if u returns other values at the
            start than in the run, as noise does.
        Interrupted
            On Ctrl-C.
        """
        self._repeated()
        try:
            self.error = self._estimated(progress)
        except KeyboardInterrupt:
            raise Interrupted(self) from None
        if words := self.error.warning:
            warn(f"{self.model.info.name}: {words}")
        return self.error

    def _repeated(self) -> None:
        """Raise ValueError if the run cannot be repeated."""
        if isinstance(self.input_source, str):
            raise ValueError(f"estimate: {self.input_source}")
        if (
            callable(self.input_source)
            and self.applied_inputs is not None
            and len(self)
            and self.t[0] == self.t0
        ):
            u_at_start = evaluate_law(
                self.input_source, self.model.arguments.inputs, self.t0, self.q[0], self.qd[0]
            )
            if not np.array_equal(u_at_start, self.applied_inputs[0]):
                raise ValueError(NOISE)

    def _estimated(self, progress: Callable[[int, int], None] | None) -> Estimate:
        return estimate(self, progress)

    @property
    def message(self) -> str:
        """The outcome of the run as a sentence: number of steps, or time and reason of a stop."""
        if self.status == "ok":
            return f"{self.steps} steps of {self.h:g} s"
        reason = infinite_at_start(self) or STATUS_MESSAGES[self.status]
        return (
            f"stopped at t = {self.t[-1]:.9g} after {self.steps} steps of {self.h:g} s, "
            f"{state_text(self.q[-1], self.qd[-1])}: {reason}"
        )

    @property
    def remark(self) -> str:
        """Warning for a run with status "ok", or ""."""
        return self._singular
