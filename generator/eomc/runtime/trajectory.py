"""Trajectory of a single run: states at and between its rows, events, sections, error, pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, as_flag, as_number, not_one_of
from .atomic_write import File
from .columns import ROWS_PER_STEP, Columns
from .estimate import Estimate, estimate
from .interfaces import CompiledModel
from .package import option, require_eomc, warn
from .requests import Request, count_steps, evaluate_law, split_times
from .saved import NOT_STORED
from .status import STATUS_MESSAGES, Interrupted, MotionError, state_text

if TYPE_CHECKING:
    from .balance import Balance
    from .sensitivity import RunGradient, Sensitivity


@dataclass(eq=False, repr=False)
class Trajectory(Columns):
    """Trajectory of one run: the states at its rows, and quantities that follow from them.

    A row consists of a time, the positions q and the velocities qd. There is a row after each step,
    after every n-th step, or at each requested time. With events there are two rows at each state
    jump, before and after it, and a fixed step that reaches a state jump ends there; the next step
    is shorter and leads to the next multiple of the step size h. Columns are read by name as well:
    run["theta_dot"]. The names of SciPy's solve_ivp are understood: success, message, t, sol, nfev,
    t_events and y_events.

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
        "ok", "singular", "not finite", "no convergence", with constraints "locked", with events
        "accumulated", "out of memory", or "interrupted". A run with another status than "ok" ends
        with its last valid state.
    success : bool
        True if the status is "ok".
    message : str
        The outcome; if the run stopped, the time and the reason.
    sol : callable
        sol(t) is the state [q; qd] at a time or at times, (2 nq,) or (2 nq, n).
    nfev, evaluations : int
        Number of evaluations of accelerations.
    t_events, y_events : list of arrays
        Times (m,), s, and states [q; qd] (m, 2 nq) of the occurrences of each event.
    events : dict of EventLog
        Times t (m,) and states q, qd (m, nq) of the occurrences of each event, by the event's name.
    h, method, steps, every : float, str, int, int
        Size of fixed steps or mean size of adaptive steps, s, method and number of completed steps;
        with fixed steps and without requested times there is a row after each `every` steps.
    tol : float
        Tolerance of adaptive steps; 0 for fixed steps.
    rejected, stiff_steps : int
        Number of rejected steps, and of steps that were solved by Newton's method because the
        motion is stiff.
    reached : float
        Time that the run reached, s.
    stopped : str
        Name of the event that ended the run, or "".
    limit : float
        Time at which events accumulate (Zeno behaviour), s; nan unless the status is "accumulated".
    singular_steps : int
        Number of steps that end at a singular position, where a constraint equation depends on the
        others. Its multiplier is large or 0 there, and joint forces are not unique. The motion is
        correct nevertheless.
    first_singular : float
        End time of the first of these steps, s; nan if there is none.
    request : Request
        The checked arguments with which the run was made.
    error : Estimate or None
        Error estimate, if `estimate` was called or requested.

    Notes
    -----
    Runs are equal if their scenes, arguments except inputs, rows, events and counters are equal,
    bit by bit. A pickled run contains all of these, except a u that is a function; `estimate` then
    raises ValueError. An unpickled run belongs to the build that pickled it. If that build no
    longer exists, it belongs to the present build, with a warning, if the columns have the same
    names.
    """

    model: CompiledModel
    request: Request
    rows: Array | tuple[Array, Array]  # q and qd, in one array (2, n, nq) or two
    steps: int
    status: str
    evaluations: int
    # rarely used fields are set after construction, whose time dominates that of short runs
    times: Array | None = field(default=None, init=False)  # None: multiples of `every` steps
    end_time: float | None = field(default=None, init=False)  # None: that of `steps` steps
    rejected: int = field(default=0, init=False)
    stiff_steps: int = field(default=0, init=False)
    # values of a function u, a row for each control period that began
    period_inputs: Array | None = field(default=None, init=False, compare=False)
    # event indices (m,), rows of t, q, qd
    event_data: tuple[Array, Array] | None = field(default=None, init=False)
    stopped: str = field(default="", init=False)
    limit: float = field(default=float("nan"), init=False)
    singular_steps: int = field(default=0, init=False)
    first_singular: float = field(default=float("nan"), init=False)
    error: Estimate | None = field(default=None, init=False, compare=False)

    @property
    def x(self) -> Array:
        """States [q; qd] at the rows, (n, 2 nq)."""
        return np.concatenate([self.q, self.qd], axis=-1)

    @property
    def h(self) -> float:
        """Size of fixed steps, or mean size of adaptive steps, s."""
        request = self.request
        return request.h or float(self.reached - request.t0) / (self.steps or 1)

    def evaluate(self, function: Callable[..., Any], *, has_inputs: bool = False) -> Array:
        """Evaluate a function of the state, and of the inputs if it has them, at each row."""
        inputs = {"u": self._row_inputs()} if has_inputs else {}
        return np.asarray(function(self.q, self.qd, t=self.t, params=self.request.p, **inputs))

    def _states(self, times: Array) -> Array:
        request = self.request
        if request.has_equal_steps and self.times is None:
            return self._states_after_rows(times)
        rows = np.empty((2, len(times), len(request.q)), self.model.info.dtype)
        first = int(bool(len(times)) and times[0] <= request.t0)
        rows[:, :first] = [[request.q], [request.qd]]
        if len(times) > first:
            rows[:, first:] = self.repeat(times[first:]).rows
        return rows

    def _states_after_rows(self, times: Array) -> Array:
        """Return the states at times, by steps from the row before each."""
        model, request = self.model, self.replayed_request()
        rows, u = np.empty((2, len(times), model.info.nq), model.info.dtype), request.u
        whole, rest = split_times(times, request.t0, request.h, self.steps)
        for k, (n, left) in enumerate(zip(whole.tolist(), rest.tolist(), strict=True)):
            row = min(n // request.every, len(self) - 1)
            q, qd = self.q[row], self.qd[row]
            for step in range(row * request.every, n + (left > 0)):
                inputs = u
                if u is not None and u.ndim == 2:
                    inputs = u[min(step // request.hold, len(u) - 1)]
                q, qd = model.integrator.step(
                    q, qd, request.h if step < n else left, request.t0 + step * request.h, inputs,
                    request.p, request.method,
                )  # fmt: skip
            rows[:, k] = q, qd
        return rows

    def replayed_request(self) -> Request:
        """Return the request with the stored inputs in place of a function of inputs."""
        if isinstance(self.request.u, str) and self.request.u == NOT_STORED:
            raise ValueError(NOT_STORED)
        if self.period_inputs is None:
            return self.request
        return self.request.replace(u=self.period_inputs)

    def repeat(self, times: Array | None, end: float | None = None) -> Trajectory:
        """Repeat the run with rows at `times`, (n,), s, or after each step.

        end: end time of steps of various sizes, s; by default that of the run. Without `times` such
        runs have both rows of each jump. A function of inputs is not called again, as its values
        are stored.
        """
        request = self.replayed_request()
        if not request.has_equal_steps:
            times = None if times is None else times.astype(self.model.info.dtype)
            request = request.replace(t_end=request.t_end if end is None else end)
        elif times is None and self.status != "ok":
            request = request.replace(steps=self.steps)
        elif times is not None:
            request = request.replace(steps=count_steps(times, request.t0, request.h))
        request = request.replace(times=times, every=1)
        run: Trajectory = self.model.integrator.integrate(request)
        return run

    def with_rows(self, times: Array, rows: Array) -> Trajectory:
        """Return a copy of the run with other times (n,) and rows (2, n, nq)."""
        run = copy(self)
        run.times, run.rows = times, rows
        return run

    def rows_at(self, times: Array) -> Trajectory:
        """Return a copy of the run with rows at `times`, (n,), s, instead of its own."""
        return self.with_rows(times, np.array(self(times)))

    def with_jump_rows(self) -> Trajectory:
        """Return a run that has two rows at each state jump, one before and one after it.

        A run with events whose rows are at requested times is repeated with a row after each step.
        Any other run is returned unchanged.
        """
        if self.event_data is None or not len(self.event_data[0]) or (np.diff(self.t) == 0).any():
            return self
        return self.with_step_rows()

    def with_step_rows(self) -> Trajectory:
        """Return the run with a row after each step and both rows of each jump."""
        return self.repeat(None, float(self.t[-1]) if self.status == "interrupted" else None)

    @property
    def curve_run(self) -> Trajectory:
        """The run for plots, which has a thousand rows at least if its steps have various sizes."""
        min_rows = 1_000
        if self.request.has_equal_steps or not 2 <= len(self) < min_rows:
            return self
        return self.insert_rows(np.linspace(self.t[0], self.t[-1], min_rows + 1)[1:-1])

    def resample(self, count: int) -> Trajectory:
        """Interpolate the run at `count` equidistant times, with both rows of each jump."""
        steps = self.with_jump_rows()
        jumps = np.flatnonzero(np.diff(steps.t) == 0)
        own = np.unique(np.concatenate([[0], jumps, jumps + 1, [len(steps) - 1]]))
        times = np.linspace(steps.t[0], steps.t[-1], count)
        times = times[~np.isin(times, steps.t[own])]
        return steps.with_rows(steps.t[own], np.array([steps.q[own], steps.qd[own]])).insert_rows(
            times
        )

    def insert_rows(self, times: Array) -> Trajectory:
        """Return a copy of the run with additional rows at `times`."""
        whole = np.concatenate([self.t, times])
        order = np.argsort(whole, kind="stable")
        both = zip((self.q, self.qd), self(times), strict=True)
        return self.with_rows(whole[order], np.array([np.concatenate(x)[order] for x in both]))

    def equidistant(self) -> Trajectory:
        """Return a run with equidistant rows, one for each step, or enough for a picture."""
        if self.request.has_equal_steps:
            has_all = self.every == 1 and self.times is None
            return self if has_all else self.repeat(None)
        if (np.diff(self.t) == 0).any() or len(self) < 2:
            return self
        times = np.linspace(self.t[0], self.t[-1], ROWS_PER_STEP * (self.steps + 1))
        return self.rows_at(times)

    @property
    def description(self) -> str:
        """The choice of steps as text: numbers of rejected and Newton steps, or the step size."""
        if not self.tol:
            return f"h = {self.h:g} s"
        stiff = f", {self.stiff_steps} by Newton's method" if self.stiff_steps else ""
        return f"{self.rejected} rejected{stiff}, tolerance {self.tol:g}"

    @property
    def message(self) -> str:
        """The outcome of the run as a sentence: number of steps, or time and reason of a stop."""
        progress = f"{self.steps} steps of {self.h:g} s"
        if self.tol:
            progress = f"{self.steps} steps, {self.description}"
        if self.status == "ok":
            return progress
        if self.status == "not finite" and self.stopped:
            reason = "jumps to no finite state, or its function is not a number,"
            return f"event '{self.stopped}' {reason} at t = {self.t[-1]:.9g} s"
        if self.status == "accumulated":
            return (
                f"jumps follow one another ever sooner, up to t = {self.limit:.15g} s: there the "
                f"run ends, after {progress}"
            )
        why = _infinite_at_start(self) or failure_message(self.model, self.status, self.tol > 0)
        where = state_text(self.q[-1], self.qd[-1]) if len(self) else ""
        end = self.t[-1] if len(self) else self.t0
        return f"stopped at t = {end:.9g} after {progress}, {where}: {why}"

    @property
    def broken_constraints(self) -> str:
        """Return a message on a constraint that is violated at the end of the run, or ""."""
        model, names = self.model, self.model.info.constraints.names
        max_roundings, min_scale = 2.0**26, 1e-9  # of the terms of a constraint
        # steps satisfy all other constraints
        has_dependent = self.singular_steps or model.info.constraints.redundant
        if not has_dependent or not len(self.q) or self.status != "ok":
            return ""
        q, qd, t, p = self.q[-1], self.qd[-1], float(self.t[-1]), self.request.p
        sizes = np.abs(model.constraints.constraint_jacobian(q, t=t, params=p)).astype(float)
        for what, x in (("constraints", q), ("constraint_rates", qd)):
            off = np.abs(getattr(model.constraints, what)(q, qd, t, p)).astype(float)
            share = off / np.maximum(sizes @ (np.abs(x) + np.max(np.abs(x))), min_scale)
            worst = int(np.argmax(share))
            if share[worst] > max_roundings * float(np.finfo(model.info.dtype).eps):
                rate = "the rate of " if what != "constraints" else ""
                return (
                    f"{rate}{names[worst]} is {off[worst]:.3g} at the end, not 0: constraints "
                    "contradict one another, and this motion does not obey them all"
                )
        return ""

    @property
    def remark(self) -> str:
        """Warning for a run with status "ok": violated or dependent constraint equations; or ""."""
        if broken := self.broken_constraints:
            return broken
        if not self.singular_steps:
            return ""
        many = "a step ends" if self.singular_steps == 1 else f"{self.singular_steps} steps end"
        return (
            f"{many} where a constraint depends on others, first at t = {self.first_singular:.9g}: "
            "multipliers and reactions are not unique there"
        )

    def vjp(
        self, q_bar: ArrayLike | None = None, qd_bar: ArrayLike | None = None, *,
        events: Mapping[str, tuple[ArrayLike | None, ...]] | None = None,
    ) -> RunGradient:  # fmt: skip
        """Return the gradient of a scalar function of the rows: start, inputs and parameters.

        The gradient is that of the steps themselves (discrete adjoint), exact to rounding, at the
        cost of a few runs, whatever the number of inputs and parameters. Memory is bounded: the
        steps between two rows are made again in parts. The gradient includes the event times: the
        rows at a state jump and at a stop follow the event. All other times, such as those of
        adaptive steps, are constant.

        Parameters
        ----------
        q_bar, qd_bar : (n, nq) array_like or None
            Derivatives of the function with respect to the positions and velocities at the rows;
            None: zeros.
        events : mapping, optional
            Derivatives of the function with respect to the occurrences of events: a tuple
            (t_bar, q_bar, qd_bar) for `run.events[name]` by the name of each event; None: zeros.

        Returns
        -------
        RunGradient
            Derivatives q, qd (nq,) with respect to the start, u with respect to the inputs, in
            their shape, and p (np,) with respect to the parameters at a constant start.

        Raises
        ------
        MotionError
            If a derivative is not finite, if the fixed-point iterations of an implicit method do
            not converge, as in stiff motions, or if an event function only grazes zero.
        ValueError
            If the module was built without Jacobian products, or if the run has no adjoint, such
            as one with constraints.
        KeyError
            If the name of an event is unknown.

        Notes
        -----
        Values of a function u count as a table: its dependence on the state is not included.

        References
        ----------
        W. W. Hager, Runge-Kutta methods in optimal control and the transformed adjoint system,
        Numer. Math. 87 (2000), 247-282.
        """
        from .sensitivity import pull_back

        return pull_back(self, self.replayed_request(), q_bar, qd_bar, events)

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

    def sensitivity(
        self, *, outputs: bool = False, h: float | None = None, method: str | None = None
    ) -> Sensitivity:
        """Return forward sensitivities: the derivatives of the rows by start, inputs, parameters.

        They are the products of the derivatives of the steps from row to row, exact to rounding for
        a run by fixed steps. The rows at a state jump and at a stop follow the event: their
        derivatives include those of the event time. All other times are constant.

        Parameters
        ----------
        outputs : bool
            Return the derivatives of the scene's outputs instead of those of the states.
        h, method : float, str, optional
            Largest step size, s, and name of the method; by default those of the run. By default a
            run by adaptive steps takes those of the scene; its sensitivities then have the error of
            these steps.

        Returns
        -------
        Sensitivity
            Derivatives `start` (n, 2 nq, 2 nq) by the initial state [q; qd], `inputs`
            (n, 2 nq, nu) by a constant that is added to each input over the whole run, and
            `parameters` (n, 2 nq, np) at a constant initial state. With `outputs` there are ny
            instead of 2 nq rows.

        Raises
        ------
        MotionError
            If a derivative is not finite, or if an event function only grazes zero.
        ValueError
            If the module was built without derivatives of steps, or without Jacobian products where
            the state jumps or an event ends the run, or if the inputs are a function.
        """
        from .sensitivity import sensitivity

        return sensitivity(self, outputs, h, method)

    def event_sensitivity(self) -> dict[str, Sensitivity]:
        """Return forward sensitivities of the occurrences of each event, by its name.

        Returns
        -------
        dict of Sensitivity
            Derivatives of [t; q; qd] at the m occurrences, with the state before a state jump:
            `start` (m, 1 + 2 nq, 2 nq), `inputs` (m, 1 + 2 nq, nu) and `parameters`
            (m, 1 + 2 nq, np), as in `sensitivity`.

        Raises
        ------
        MotionError, ValueError
            As `sensitivity`.
        """
        from .sensitivity import event_sensitivity

        return event_sensitivity(self)

    def plot(
        self, *names: str, phase: Any = None, section: Mapping[str, Array] | None = None,
        other: Trajectory | Sequence[Trajectory] = (), labels: Sequence[str] | None = None,
        wrap: bool | str | Sequence[str] = False, ax: Any = None, file: File | None = None,
        **style: Any,
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
        other : Trajectory or sequence of Trajectory
            Runs that are drawn dashed in the same panels.
        labels : sequence of str, optional
            Names of the runs for the legend, that of this run first.
        wrap : bool, str or sequence of str
            Angles that are drawn from -pi to pi, without lines where they jump: the named ones, or
            with True all coordinates in rad.
        ax : Axes or sequence of Axes, optional
            One Axes for all columns, or one for each panel.
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
            If the number of Axes or `labels` does not fit.
        """
        from .plot import Figure, plot

        return plot(self, names, Figure(wrap, ax, file, style), phase, other, section, labels)

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
        return find_section(self, name, value, rising, period)

    def _repr_html_(self) -> str:
        """Return the summary of the run that notebooks display, as HTML."""
        from .plot import html

        return html(self)

    def animate(
        self,
        file: File | None = None,
        *others: Trajectory,
        scene: Any = None,
        title: str | None = None,
    ) -> Any:
        """Animate the motion as a page for browsers and notebooks, or as a film.

        Parameters
        ----------
        file : str or path, optional
            File to write: a page .html, or a film .gif or .mp4, which needs matplotlib.
        *others : Trajectory
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
        pixels: Array = require_eomc("report.animation").render(self, t, scene)
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
        self._check_repeatable()
        try:
            self.error = estimate(self, progress)
        except KeyboardInterrupt:
            raise Interrupted(self) from None
        if words := self.error.warning:
            warn(f"{self.model.info.name}: {words}")
        return self.error

    def _check_repeatable(self) -> None:
        """Raise ValueError if the run cannot be repeated with the inputs that it had."""
        request, values = self.request, self.period_inputs
        if isinstance(request.u, str):
            raise ValueError(f"estimate: {request.u}")
        if callable(request.u) and values is not None and len(values):
            u_at_start = evaluate_law(
                request.u, self.model.arguments.inputs, self.t0, request.q, request.qd
            )
            if not np.array_equal(u_at_start, values[0]):
                raise ValueError(
                    "estimate: u gives other values at the start than it gave in the run, as noise "
                    "does, or what has a state of its own: let it depend on t, q and qd alone"
                )

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        how = "" if self.status == "ok" else f"{self.status} after "
        steps = f", tolerance {self.tol:g}" if self.tol else f" of {self.h:g} s"
        return f"<Trajectory of {self.model.info.name}: {how}{self.steps} steps{steps}>"


def failure_message(model: CompiledModel, status: str, is_adaptive: bool) -> str:
    """Return a sentence with the reason why a run ended with this status, and with a remedy.

    status: such as "singular". is_adaptive: whether its steps are adaptive.
    """
    if status != "no convergence" or not is_adaptive:
        return STATUS_MESSAGES[status]
    remedy = "take " + option("friction", '"stick"')
    if model.info.constraints.modes:  # the scene has it for another coordinate
        remedy = "give its coordinate friction = in place of the force"
    return (
        "no step is short enough to go on: forces grow without end there, as in a fall into a "
        f"centre, or keep jumping: for friction by sign(x_dot) that sticks {remedy}, or let events "
        "switch it; else a looser tolerance"
    )


def _infinite_at_start(run: Trajectory) -> str:
    """Return a sentence that names the quantity that is not finite at the initial state of a run.

    The quantity is the potential energy, the kinetic energy or an acceleration. Return "" if all
    accelerations are finite there or cannot be computed, or if the run made a step.
    """
    if run.status != "not finite" or run.steps or not len(run):
        return ""
    model, q, qd, inputs = run.model, run.q[0], run.qd[0], run.request.u
    at: dict[str, Any] = {"t": run.t0, "params": run.request.p}
    try:
        model.functions.acceleration(
            q, qd, u=None if inputs is None or not model.info.nu else run.u[0], **at
        )
        return ""
    except MotionError as lacking:
        if lacking.status != "not finite":
            return ""
    except ValueError:  # the inputs of a saved run are unknown
        return ""
    what = "an acceleration"
    if not np.isfinite(model.functions.potential_energy(q, **at)):
        what = "the potential energy"
    elif not np.isfinite(model.functions.kinetic_energy(q, qd, **at)):
        what = "the kinetic energy"
    return f"{what} is not finite at the start: start elsewhere"


def find_section(run: Any, name: str, value: Any, rising: Any, period: Any) -> dict[str, Array]:
    """Return all columns of a run where the column `name` crosses a value.

    The arguments are those of `Trajectory.section`. Raises KeyError if `name` is no column of the
    run, ValueError for invalid values.
    """
    if name not in (columns := run.column_names):
        raise KeyError(not_one_of("section", name, columns))
    value = as_number(value, "value")
    if rising is not None:
        rising = as_flag(rising, "rising")
    if period is not None and (period := as_number(period, "period")) <= 0:
        raise ValueError(f"period: {period:g} is not a period: give a number greater than 0")
    if run.request.has_equal_steps:
        return crossings(run.to_dict(), name, value, rising, period)
    steps = run.with_jump_rows()
    t, parts = steps.t[:, None], np.arange(1, ROWS_PER_STEP) / ROWS_PER_STEP
    between = (t[:-1] + np.diff(t, axis=0) * parts).astype(t.dtype)
    is_inside = (t[:-1] < between) & (between < t[1:])
    rows = steps.insert_rows(between[is_inside]).to_dict()
    estimates = crossings(rows, name, value, rising, period)
    times = estimates["t"][estimates["t"] >= run.t[0]]
    level = np.full(len(times), value)
    if period is not None:
        level += period * np.round((estimates[name][estimates["t"] >= run.t[0]] - value) / period)
    refined: dict[str, Array] = run.rows_at(_refined(run, steps, name, times, level)).to_dict()
    return refined


def _refined(run: Any, steps: Any, name: str, times: Array, level: Array) -> Array:
    """Return the times at which a column is at a level, from estimates (m,), by Newton's method.

    steps: the run with both rows of each jump. A state at a jump is that before it.
    """
    by = 1e-6 * float(np.max(np.diff(steps.t)))
    jumps = np.unique(steps.t[1:][np.diff(steps.t) == 0])
    piece = np.searchsorted(jumps, times)
    ends = (
        np.array([steps.t[0], *np.nextafter(jumps, np.inf)])[piece],
        np.array([*jumps, steps.t[-1]])[piece],
    )
    for _ in range(2):
        places = times, np.clip(times - by, *ends), np.clip(times + by, *ends)
        here, one, other = (run.rows_at(x)[name] for x in places)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = (here - level) / (other - one) * (places[2] - places[1])
        times = np.clip(np.where(np.isfinite(step), times - step, times), *ends)
    return times


def crossings(
    columns: Mapping[str, Array], name: str, value: float, rising: bool | None, period: float | None
) -> dict[str, Array]:
    """Return all columns of a run at the m times when the column `name` crosses `value`.

    The result is a dict of arrays (m,) by name. columns: arrays (n,) by name, including "t".
    rising, period: as in `Trajectory.section`. Columns are interpolated by cubics through four
    rows. Two rows of the same time are a state jump: no cubic spans it, and a jump is not a
    crossing. Raises ValueError for fewer than four rows.
    """
    t, column = columns["t"], columns[name]
    f, n = np.asarray(column, float) - value, len(t)
    if n < 4:
        raise ValueError(f"section: {n} rows, where a cubic needs 4")
    moving = np.diff(t) > 0
    # a row within so many ulp of the largest value lies on a level
    near = 0.0 if moving.all() else 16 * np.finfo(column.dtype).eps * np.max(abs(column))
    sides = _sides(f, near, period)
    up = sides[1:] > sides[:-1]
    inside = (sides[1:] != sides[:-1]) & moving & np.isfinite(np.diff(f))
    if rising is not None:
        inside &= up == rising
    edges = np.diff(moving.astype(int), prepend=0, append=0)
    firsts, lasts = (np.flatnonzero(edges == side) for side in (1, -1))  # of pieces between jumps
    rows = np.flatnonzero(inside)
    piece = np.searchsorted(firsts, rows, "right") - 1
    long = (lasts - firsts)[piece] >= 3
    rows, piece = rows[long], piece[long]
    first = np.clip(rows - 1, firsts[piece], lasts[piece] - 3)[:, None] + np.arange(4)  # about each
    s = (t[first] - t[rows][:, None]) / (t[rows + 1] - t[rows])[:, None]
    target = np.minimum(sides[rows], sides[rows + 1]) * (period or 0.0)
    a, b = np.zeros(len(rows)), np.ones(len(rows))
    for _ in range(60):  # bisection of the cubic, whose ends are the two rows
        middle = (a + b) / 2
        beyond = ((_weights(s, middle) * f[first]).sum(axis=1) > target) == up[rows]
        a, b = np.where(beyond, a, middle), np.where(beyond, middle, b)
    weights = _weights(s, (a + b) / 2)
    return {key: (weights * np.asarray(x, float)[first]).sum(axis=1) for key, x in columns.items()}


def _sides(f: Array, near: float, period: float | None) -> Array:
    """Return the number of levels below each of f (n,); levels are 0, or multiples of the period.

    A row within `near` of a level stays on the side of the row before.
    """
    turns = np.zeros(len(f)) if period is None else np.round(f / period)
    sides = (f > 0).astype(float) if period is None else np.ceil(f / period)
    for k in np.flatnonzero(abs(f - turns * (period or 0.0)) <= near):
        sides[k] = turns[k] + bool(k and sides[k - 1] > turns[k])
    return sides


def _weights(nodes: Array, at: Array) -> Array:
    """Return the Lagrange weights of four nodes (n, 4) at `at` (n,)."""
    weights = np.ones_like(nodes)
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[:, i] *= (at - nodes[:, j]) / (nodes[:, i] - nodes[:, j])
    return weights
