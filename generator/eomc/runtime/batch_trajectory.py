"""Trajectories of many instances: what `simulate_batch` returns, and their plots."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array
from .atomic_write import File
from .columns import Columns
from .interfaces import CompiledBatchModel
from .package import require_eomc
from .requests import Request, count_steps, split_times
from .status import FULL, STATUS
from .trajectory import Trajectory, failure_message

if TYPE_CHECKING:
    from .sensitivity import RunGradient, Sensitivity

_STATUSES = np.array([*STATUS, FULL])
_SINGLE_RUN_ATTRIBUTES = {
    "balance": "balance()", "estimate": "estimate()", "error": "estimate()",
    "section": "section(...)",
}  # fmt: skip
COUNTERS = ("steps", "evaluations", "rejected", "stiff_steps", "status_codes")  # as C counts
_SINGLE_RUN_ARGUMENTS = {"phase", "section", "other", "labels"}
_ROWS_PER_CALL = 2**16  # rows of all instances in a call, which fit in the cache
_EVALUATIONS_PER_STATE = 8 * 64  # for a state between two steps: stages times iterations, at most


@dataclass(eq=False, repr=False)
class BatchTrajectory(Columns):
    """Trajectories of many instances of a scene, returned by `simulate_batch`.

    All instances have rows at the same n times. The rows of an instance after its failure are nan.
    A requested time may lie between two fixed steps; the state there is computed by a shorter step
    that begins at the earlier of the two. Columns are available by name: run["theta_dot"] has the
    shape (batch, n). The names of SciPy's solve_ivp are understood: success, message, t, sol, nfev,
    t_events and y_events. Two batches are equal if their scenes, arguments except inputs, rows,
    events and counters are equal, bit by bit.

    Attributes
    ----------
    t : (n,) array
        Times of the rows, s.
    q, qd : (batch, n, nq) arrays
        Positions and velocities.
    u : (batch, n, nu) array
        Applied inputs.
    status : (batch,) array of str
        "ok", "singular", "not finite", "no convergence", "locked", "accumulated", "too long" or
        "interrupted". For an initial state that cannot be moved onto the constraints ("locked"),
        the first row is the initial state of the caller.
    success : (batch,) array of bool
        True for the status "ok".
    message : str
        Numbers of instances, of steps, and of instances by status.
    sol : callable
        sol(t) are the states [q; qd] at a time or at times, (batch, 2 nq) or (batch, 2 nq, n).
    nfev, evaluations : (batch,) array of int
        Number of evaluations of the accelerations of each instance.
    t_events, y_events : list of arrays
        Times (m,), s, and states [q; qd] (m, 2 nq) of the occurrences of each event.
    events : dict of BatchEventLog
        Occurrences of each event, by the event's name: times t, states q, qd and instances, sorted
        by instance.
    steps : (batch,) array of int
        Number of steps that each instance completed.
    t0, h : float
        Start time and size of fixed steps or mean size of adaptive steps, s.
    every : int
        Number of fixed steps between two rows, without requested times.
    method : str
        Name of the integration method.
    tol : float
        Tolerance of adaptive steps; 0 for fixed steps.
    rejected, stiff_steps : (batch,) arrays of int
        Numbers of rejected steps, and of steps by Newton's method of each instance.
    reached : (batch,) array
        Time that each instance reached, s. Rows at later times are nan. An instance ends early
        after a failure, at an event that stops it, or after `max_evaluations` (status "too long").
    stopped : (batch,) array of str
        Name of the event that ended each instance, or "".
    limit : (batch,) array
        Time at which the events of each instance accumulate (Zeno behaviour), s; nan unless its
        status is "accumulated".
    request : Request
        The checked arguments with which the batch was made.
    """

    _axes = ("instance", "t")
    period_inputs = None
    model: CompiledBatchModel
    request: Request
    rows: Array | tuple[Array, Array]  # q and qd, (batch, n, nq)
    steps: Array
    status_codes: Array
    evaluations: Array
    rejected: Array
    stiff_steps: Array
    times: Array | None = field(default=None, init=False)  # None: multiples of `every` steps
    end_time: Array | None = field(default=None, init=False)  # None: those of `steps` steps
    event_data: tuple[Array, Array, Array] | None = field(default=None, init=False)
    stopped_codes: Array | None = field(default=None, init=False)  # 1 + index of the event, or 0
    limits: Array | None = field(default=None, init=False)

    @cached_property
    def status(self) -> Array:
        """Status of each instance as text, (batch,), such as "ok" or "singular"."""
        return np.asarray(_STATUSES[self.status_codes])

    @property
    def h(self) -> float:
        """Size of fixed steps, or mean size of adaptive steps, s."""
        request = self.request
        return request.h or (request.t_end - request.t0) / max(1.0, float(self.steps.mean()))

    @property
    def stopped(self) -> Array:
        """Name of the event that ended each instance, (batch,); "" if none did."""
        codes = np.zeros(len(self), int) if self.stopped_codes is None else self.stopped_codes
        return np.asarray(np.array(["", *self.model.info.events])[codes])

    @property
    def limit(self) -> Array:
        """Time at which the events of each instance accumulate, (batch,), s; nan for all others."""
        return np.full(len(self), np.nan) if self.limits is None else self.limits

    @property
    def _last_step(self) -> int:
        request = self.request
        if self.times is None or not request.has_equal_steps:
            return request.steps
        return int(split_times(self.times[-1:], request.t0, request.h)[0][0])

    def evaluate(self, function: Callable[..., Any], *, has_inputs: bool = False) -> Array:
        """Evaluate a function of the state, and of the inputs if it has them, at each row.

        The result, (batch, n, ...), is nan at rows that are nan.
        """
        count, n = self.q.shape[:2]
        t, each = np.broadcast_to(self.t, (count, n)), {"params": self.request.p[:, None]}
        if has_inputs and (u := self._row_inputs()) is not None:
            each["u"] = u
        alike = {name: x.size == x.shape[-1] for name, x in each.items()}
        results: Any = None
        for first in range(0, count, many := max(1, _ROWS_PER_CALL // max(n, 1))):
            at = slice(first, first + many)
            q, qd = self.q[at], self.qd[at]
            finite = np.isfinite(q).all(axis=-1) & np.isfinite(qd).all(axis=-1)
            here: Any = ... if finite.all() else finite
            arguments = {
                name: x[0, 0]
                if alike[name]
                else _rows(np.broadcast_to(x, (count, n, x.shape[-1]))[at][here])
                for name, x in each.items()
            }
            values = function(_rows(q[here]), _rows(qd[here]), t=t[at][here].ravel(), **arguments)
            if results is None:
                results = np.full((count, n, *values.shape[1:]), np.nan, self.model.info.dtype)
            results[at][here] = values.reshape(results[at][here].shape)
        return np.asarray(results)

    def _states(self, times: Array) -> Array:
        request, n = self.request, len(times)
        batch, codes = self.model.batch, self._initial_failures()
        if not request.has_equal_steps:
            limit = request.max_evaluations
            if limit:  # without those of states between steps
                each = _EVALUATIONS_PER_STATE + 2 * self.model.info.nq + 1
                limit += each * (n + len(self.t))
            times = times.astype(self.model.info.dtype)
            request = request.replace(times=times, max_evaluations=limit)
            rows = np.array(batch.integrate(request, codes).rows)
            # instances with status "too long" do not get beyond their end
            ended = np.where(self.status_codes == STATUS.index("too long"), self.reached, np.inf)
            rows[:, times > ended[:, None]] = np.nan
            return rows
        if self.times is not None:
            steps = count_steps(times, request.t0, request.h)
            return np.array(batch.integrate(request.replace(times=times, steps=steps), codes).rows)
        rows = np.empty((2, len(self), n, self.model.info.nq), self.model.info.dtype)
        whole = split_times(times, request.t0, request.h, request.steps)[0]
        for row in np.unique(whole // request.every):
            own, first = (whole // request.every == row).nonzero()[0], int(row) * request.every
            state = np.array([self.q[:, row], self.qd[:, row]])
            unreached = np.where(self.steps < first, STATUS.index("not finite"), codes)
            some = np.empty((2, len(self), len(own), self.model.info.nq), self.model.info.dtype)
            batch.states_from(request.replace(times=times[own]), state, first, unreached, some)
            rows[:, :, own[0] : own[-1] + 1] = some
        return rows

    def _initial_failures(self) -> Array:
        """Return the status number of each instance that failed at its initial state, else 0."""
        failed = (self.steps == 0) & (self.status_codes < STATUS.index("interrupted"))
        return np.where(failed, self.status_codes, 0)

    def simulate_instance(self, k: int) -> Trajectory:
        """Simulate instance k as a single run with the same rows, as far as it gets."""
        request = self.request
        q, qd, p = (x[min(k, len(x) - 1)] for x in (request.q, request.qd, request.p))
        u = None if request.u is None else request.u[min(k, len(request.u) - 1)]
        if u is None or len(u) == 1:  # no table
            request = request.replace(period=0.0, periods=0)
            u = u if u is None else u[0]
        times = request.times if request.has_equal_steps else self.t
        request = request.replace(q=q, qd=qd, p=p, u=u, times=times, max_evaluations=0)
        run: Trajectory = self.model.integrator.integrate(request)
        return run

    def vjp(
        self, q_bar: ArrayLike | None = None, qd_bar: ArrayLike | None = None, *,
        events: Mapping[str, tuple[ArrayLike | None, ...]] | None = None,
    ) -> RunGradient:  # fmt: skip
        """Return the gradient of a scalar function of the rows of each instance.

        See `Trajectory.vjp`. Each instance is simulated once more, as a single run.

        Parameters
        ----------
        q_bar, qd_bar : (batch, n, nq) array_like or None
            Derivatives of the functions with respect to the positions and velocities; None: zeros.
        events : mapping, optional
            Derivatives with respect to `self.events[name]`: a tuple (t_bar, q_bar, qd_bar) by the
            name of each event.

        Returns
        -------
        RunGradient
            The gradient of each instance, with a leading axis (batch,), also where the instances
            share inputs or parameters.

        Raises
        ------
        MotionError, ValueError, KeyError
            As `Trajectory.vjp`.
        """
        from .sensitivity import pull_back_batch

        return pull_back_batch(self, q_bar, qd_bar, events)

    def sensitivity(self, **options: Any) -> Sensitivity:
        """Return the forward sensitivities of each instance, with a leading axis (batch,).

        See `Trajectory.sensitivity`, also for the arguments. Each instance is simulated once more,
        as a single run. The derivatives at rows that an instance does not reach are nan.
        """
        from .sensitivity import batch_sensitivity

        return batch_sensitivity(self, **options)

    def select(self, numbers: Sequence[int]) -> BatchTrajectory:
        """Return a batch of the instances with these numbers (indices)."""
        count, run, request = len(self), copy(self), self.request

        def chosen(values: Any) -> Any:
            own = values is not None and len(values) == count > 1
            return values[numbers] if own else values

        own_fields = {name: chosen(getattr(request, name)) for name in ("q", "qd", "p", "u")}
        run.request, run.rows = request.replace(**own_fields), (self.q[numbers], self.qd[numbers])
        names = ("steps", "status_codes", "evaluations", "rejected", "stiff_steps", "end_time",
                 "stopped_codes", "limits")  # fmt: skip
        run.__dict__.update({name: chosen(getattr(self, name)) for name in names})
        if self.event_data is not None:
            of = [np.flatnonzero(self.event_data[0] == k) for k in numbers]
            whose = np.repeat(np.arange(len(of)), [len(rows) for rows in of])
            rows = np.concatenate(of)
            run.event_data = whose, self.event_data[1][rows], self.event_data[2][rows]
        return run

    def __getattr__(self, name: str) -> Any:
        """Return a column of the scene; the error for attributes of single runs has a hint."""
        if name in COUNTERS and "counts" in self.__dict__:  # at the first access
            self.__dict__.update(zip(COUNTERS, self.counts, strict=True))
            return self.__dict__[name]
        if name in _SINGLE_RUN_ATTRIBUTES and name not in self._named():
            raise AttributeError(f"{name} {single_run_hint(self)}.{_SINGLE_RUN_ATTRIBUTES[name]}")
        return super().__getattr__(name)

    def plot(
        self, *names: str, quantiles: Sequence[float] = (0.05, 0.25, 0.5, 0.75, 0.95),
        lines: int | None = None, over: Any = None, wrap: bool | str | Sequence[str] = False,
        ax: Any = None, file: File | None = None, **style: Any,
    ) -> Any:  # fmt: skip
        """Plot the distribution of the instances over time, as bands between quantiles.

        Parameters
        ----------
        *names : str
            Columns to plot, each in its own panel; by default the coordinates.
        quantiles : sequence of float
            Limits of the bands, from 0 to 1, of the instances that reached each time. If their
            number is odd, the middle one is drawn as a line.
        lines : int, optional
            Draw this number of instances as lines instead of the bands.
        over : str or (batch,) array, optional
            Draw the final value of each instance instead, over "instance" (its index), a parameter
            or these numbers.
        wrap, ax, file, **style
            As in `Trajectory.plot`.

        Returns
        -------
        matplotlib Axes, or an array of Axes if there are several panels

        Raises
        ------
        TypeError
            For arguments that apply to single runs only, such as phase.
        KeyError
            For unknown names.
        ValueError
            If `over` is neither a known name nor has the shape (batch,).
        ModuleNotFoundError
            If matplotlib is not installed.
        """
        for name in _SINGLE_RUN_ARGUMENTS & style.keys():
            raise TypeError(f"plot: {name}= {single_run_hint(self)}.plot({name}=...)")
        from .plot import Figure, draw_fan

        figure = Figure(wrap, ax, file, style)
        return draw_fan(self, names, figure, quantiles, lines, over)

    def animate(
        self, file: File | None = None, *, names: Sequence[str] = (),
        instances: int | Sequence[int] = 6, scene: Any = None, title: str | None = None,
    ) -> Any:  # fmt: skip
        """Animate several instances together in different colours.

        Instances that ended earlier keep their last position.

        Parameters
        ----------
        file : path, optional
            File to write: a page .html, or a film .gif or .mp4.
        names : sequence of str
            Columns to draw as curves; by default the coordinates and the energy.
        instances : int or sequence of int
            Number of instances, which are evenly spaced in the batch, or their indices; at most 24.
        scene : path, optional
            Scene file, if the module was not loaded by `eomc.load`.
        title : str, optional
            Title of the page.

        Returns
        -------
        Animation or None
            The page; None for a film.

        Raises
        ------
        KeyError
            For unknown names.
        EomcError
            For unknown instances, or if the animation cannot be drawn or written.
        ImportError
            If eomc is not installed.
        """
        page = require_eomc("report.animation")
        return page.instances(self, file, names=names, chosen=instances, scene=scene, title=title)

    @property
    def message(self) -> str:
        """Return a sentence with the numbers of instances, of steps and of instances by status."""
        names, counts = np.unique(self.status, return_counts=True)
        statuses = ", ".join(f"{c} {n}" for n, c in zip(names, counts, strict=True))
        steps = f"{int(self.steps.sum())}"
        if self.request.has_equal_steps:
            steps += f" of {len(self) * self._last_step}"
        names, counts = np.unique(self.stopped, return_counts=True)
        ends = zip(counts, names, strict=True)
        stops = "".join(f", {c} stopped by '{n}'" for c, n in ends if n)
        how = f", tolerance {self.tol:g}" if self.tol else f" of {self.h:g} s"
        return f"{len(self)} instances, {steps} steps{how}: {statuses}{stops}"

    @property
    def failure_summary(self) -> str:
        """Number of failed instances and the reason of the first failure; "" if none failed."""
        if not self.status_codes.any():
            return ""
        k = int(self.status_codes.nonzero()[0][0])
        end = float(self.reached[k])
        first = f"the first that could not go on, instance {k}, stopped at t = {end:.9g}"
        return f"{self.message}; {first}: {self._failure_reason(k)}"

    def _failure_reason(self, k: int) -> str:
        """Return the reason why instance k failed."""
        status, event = str(self.status[k]), self.stopped[k]
        if status == "not finite" and event:
            return f"event '{event}' jumps to no finite state, or its function is not a number"
        if status == "accumulated":
            return f"jumps follow one another ever sooner, up to t = {self.limit[k]:.15g} s"
        return failure_message(self.model, status, self.tol > 0)

    def __len__(self) -> int:
        return len(self.status_codes)

    def __repr__(self) -> str:
        return f"<BatchTrajectory of {self.model.info.name}: {self.message}>"


def single_run_hint(runs: Any) -> str:
    """Return a hint for error messages: the call that repeats one instance as a single run.

    runs: the batch that contains the instance.
    """
    name = runs.model.info.name
    return f"is of one run: {name}.simulate(runs.q[k, 0], runs.qd[k, 0], params=...)"


def _rows(x: Array) -> Array:
    """Reshape (..., m) to rows (n, m)."""
    return x.reshape(-1, x.shape[-1]) if x.shape[-1] else x.reshape(int(np.prod(x.shape[:-1])), 0)
