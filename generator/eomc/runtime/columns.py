"""Columns and events of runs by name, and what single runs and batches have in common.

The names are t, the scene's coordinates, their rates (`theta_dot`), its inputs and outputs, energy,
and jacobi where that is not the energy. C writes events into buffers with their times and states.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import import_module
from operator import index
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from . import saved
from .arguments import Array, ByName, as_numbers, not_one_of
from .atomic_write import File, atomic_write
from .interfaces import CompiledModel
from .package import reduced
from .requests import Request, period_starts, split_times

# capacity of the buffers, in addition to one event of each kind: of a run, of each of a batch
_EVENTS, EVENTS_EACH = 1024, 64


@dataclass(frozen=True, repr=False)
class EventLog:
    """Occurrences of one event in a run.

    Attributes
    ----------
    t : (n,) array
        Times, s.
    q, qd : (n, nq) arrays
        States at these times, before a state jump.
    """

    t: Array
    q: Array
    qd: Array

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced(f"columns.{type(self).__name__}", *self.__dict__.values())

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        return f"<{self._times}>"

    @property
    def _times(self) -> str:
        """Number of occurrences and their time span as text."""
        if len(self) < 2:
            return f"once, at {self.t[0]:.6g} s" if len(self) else "never"
        return f"{len(self)} times, {self.t.min():.6g} s to {self.t.max():.6g} s"


@dataclass(frozen=True, repr=False)
class BatchEventLog(EventLog):
    """Occurrences of one event in all instances of a batch, sorted by instance, then by time.

    Attributes
    ----------
    t : (n,) array
        Times, s.
    q, qd : (n, nq) arrays
        States at these times, before a state jump.
    instance : (n,) array
        Index of the instance of each occurrence.
    """

    instance: Array
    _batch: int

    def for_instance(self, k: int) -> EventLog:
        """Return the occurrences in instance k as an EventLog; a negative k counts from the end.

        Raises IndexError if there is no instance k, TypeError if k is not an integer.
        """
        try:
            at = index(k)
        except TypeError:
            raise TypeError(f"for_instance: {k!r} is not the index of an instance") from None
        if not -self._batch <= at < self._batch:
            last = self._batch - 1
            raise IndexError(f"for_instance: there is no instance {at}: they are 0 to {last}")
        own = self.instance == at % self._batch
        return EventLog(self.t[own], self.q[own], self.qd[own])

    def __repr__(self) -> str:
        many = f", in {len(np.unique(self.instance))} of {self._batch} instances"
        return f"<{self._times}{many if len(self) else ''}>"


class BatchEventBuffer:
    """Collect the events of all instances of a batch.

    Several threads call C functions, each of which writes events into a buffer of its own; `keep`
    copies them. most: largest number of events that fit in memory.
    """

    def __init__(self, model: CompiledModel, most: float) -> None:
        self.model, self.most, self.count = model, most, 0
        self.pieces: list[tuple[Array, Array, Array]] = []

    def room(self, count: int) -> GroupEventBuffer:
        """Return a new, empty buffer for one call of C, which simulates `count` instances."""
        return GroupEventBuffer(self.model, count)

    def keep(self, room: GroupEventBuffer, counts: Array, first: int) -> None:
        """Copy the events that a call of C wrote into its buffer.

        room: the buffer. counts: number of events of each instance. first: index in the batch of
        the first instance of that call.
        """
        some = np.arange(room.which.shape[1]) < counts[:, None]
        if some.any():
            self.pieces.append((some.nonzero()[0] + first, room.which[some], room.rows[some]))
            self.count += int(some.sum())

    @property
    def full(self) -> bool:
        """True if the collected events exceed the number that fits in memory."""
        return self.count > self.most

    def all(self) -> tuple[Array, Array, Array]:
        """Return the instances (n,), event indices (n,) and rows (n, 1 + 2 nq) of all occurrences.

        A row is [t, q, qd]. The occurrences are sorted by instance. An event index is the position
        of the event's name in `events` of the model.
        """
        none = np.empty(0, int), np.empty(0, np.intc), np.empty((0, 1 + 2 * self.model.info.nq))
        parts = zip(*self.pieces, strict=True) if self.pieces else [[x] for x in none]
        instances, which, rows = (np.concatenate(list(x)) for x in parts)
        order = np.argsort(instances, kind="stable")
        return instances[order], which[order], rows[order]


class GroupEventBuffer:
    """Buffer into which one call of a C function writes the events of `count` instances.

    Attributes
    ----------
    which : (count, capacity) array
        Index of each event in `events` of the model.
    rows : (count, capacity, 1 + 2 nq) array
        Time and state [t, q, qd] of each event.
    c_arguments : tuple
        The arguments of the C function: the capacity, and pointers to these two arrays.
    """

    def __init__(self, model: CompiledModel, count: int) -> None:
        each = EVENTS_EACH + len(model.info.events)
        self.which = np.empty((count, each), np.intc)
        self.rows = np.empty((count, each, 1 + 2 * model.info.nq), model.info.dtype)
        which = model.c.ffi.from_buffer("int[]", self.which)
        self.c_arguments = each, which, model.c.pointer(self.rows)


class EventBuffer:
    """Collect the events of a single run.

    One call of C writes into a buffer, from which `keep` copies the events.
    """

    def __init__(self, model: CompiledModel) -> None:
        self.model = model
        self.pieces: list[tuple[Array, Array]] = []
        self.which = np.empty(_EVENTS + len(model.info.events), np.intc)
        self.rows = np.empty((len(self.which), 1 + 2 * model.info.nq), model.info.dtype)

    def room(self) -> tuple[Any, ...]:
        """Return the arguments with which a C function writes events into the buffer.

        They are the capacity, a pointer to the event indices and a pointer to the rows [t, q, qd].
        """
        address, real, _ = self.model.c.tools
        which = self.model.c.ffi.from_buffer("int[]", self.which)
        return len(self.which), which, address(real, self.rows)

    def keep(self, work: Any) -> None:
        """Copy the events that the last call of C wrote into the buffer.

        work: workspace of the C function; its number of events is reset to 0.
        """
        if work.events:
            n, work.events = work.events, 0
            self.pieces.append((self.which[:n].copy(), self.rows[:n].copy()))

    def all(self) -> tuple[Array, Array]:
        """Return the event indices (n,) and rows (n, 1 + 2 nq) of all n events copied so far.

        A row is [t, q, qd].
        """
        if not self.pieces:
            return self.which[:0], self.rows[:0]
        which, rows = zip(*self.pieces, strict=True)
        return np.concatenate(which), np.concatenate(rows)


ROWS_PER_STEP = 8  # equidistant rows for each step of various sizes, for curves and integrals


class _Half:
    """q or qd of a run: a half of its rows, computed at the first access and stored."""

    def __init__(self, index: int) -> None:
        self.index = index

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, run: Columns | None, owner: type) -> Array:
        if run is None:
            return self  # type: ignore[return-value]  # access on the class, as by help()
        half: Array = run.rows[self.index]
        run.__dict__[self.name] = half
        return half


class Columns:
    """Common part of `Trajectory` and `BatchTrajectory`: their rows, and quantities at the rows.

    A column is a quantity at all rows: the time t (n,), a coordinate, its velocity (`theta_dot` for
    the coordinate theta), an input, an output, the energy or the Jacobi integral. For a batch all
    columns but t have the shape (batch, n).
    """

    model: Any
    request: Request
    origin: Any  # of a short run, of which its request is created at the first access
    counts: Any  # of a short batch, of each instance
    rows: Any
    steps: Any
    evaluations: Any
    times: Array | None
    end_time: Any
    period_inputs: Array | None
    event_data: tuple[Array, ...] | None
    status: Any
    __len__: Callable[[], int]
    _axes: ClassVar[tuple[str, ...]] = ("t",)
    __iter__ = None  # `for name in run` would ask for run[0]
    __hash__ = None  # type: ignore[assignment]  # rows may be changed

    q, qd = _Half(0), _Half(1)

    @cached_property
    def t(self) -> Array:
        """Times of the rows, (n,), s."""
        if self.times is not None:
            return self.times
        request, n = self.request, self.q.shape[-2]
        steps = np.arange(n)
        if request.every > 1:
            steps = np.minimum(request.every * steps, self._last_step)
        return np.asarray(request.t0 + request.h * steps)

    @property
    def _last_step(self) -> int:
        """Number of fixed steps up to the last row."""
        return int(self.steps)

    @property
    def reached(self) -> Any:
        """Time that the run reached, s; for a batch of each instance, (batch,)."""
        return self.t0 + self.request.h * self.steps if self.end_time is None else self.end_time

    @cached_property
    def events(self) -> Mapping[str, Any]:
        """Occurrences of each event of the scene, as a dict from name to `EventLog`.

        An `EventLog` has the times t (m,), s, and the states q, qd (m, nq) at the occurrences; that
        of a batch, a `BatchEventLog`, has the indices of the instances (m,) as well. At a state
        jump, the state is that before the jump. The dict is empty without events.
        """
        if self.event_data is None:
            return ByName("events", (), ())
        *instances, which, rows = self.event_data
        names, logs = self.model.info.events, list[EventLog]()
        for own in (which == k for k in range(len(names))):
            t, q, qd = np.split(rows[own], [1, 1 + self.model.info.nq], axis=1)
            log: tuple[Array, Array, Array] = (t[:, 0], q, qd)
            if instances:
                logs.append(BatchEventLog(*log, instances[0][own], len(self)))
            else:
                logs.append(EventLog(*log))
        return ByName("events", names, logs)

    @property
    def t0(self) -> float:
        """Start time, s."""
        return self.request.t0

    @property
    def every(self) -> int:
        """Number of fixed steps from one row to the next."""
        return self.request.every

    @property
    def method(self) -> str:
        """Name of the integration method."""
        return self.request.method

    @property
    def tol(self) -> float:
        """Tolerance of adaptive steps; 0 for fixed steps."""
        return self.request.tol

    @property
    def success(self) -> Any:
        """True if the status is "ok", as in SciPy; for a batch an array (batch,) of bool."""
        return self.status == "ok"

    @property
    def nfev(self) -> Any:
        """Number of evaluations of the accelerations, as in SciPy: `evaluations`."""
        return self.evaluations

    @property
    def t_events(self) -> list[Array]:
        """Times of the occurrences of each event, s, as in SciPy: a list of arrays (m,)."""
        return [log.t for log in self.events.values()]

    @property
    def y_events(self) -> list[Array]:
        """States [q; qd] at the occurrences of each event, as in SciPy: a list of (m, 2 nq)."""
        return [np.concatenate([log.q, log.qd], axis=1) for log in self.events.values()]

    def __call__(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return the positions and velocities at any times within the run.

        They are as accurate as the run: steps of the same method, from the row before or from the
        start, end at these times. A state at a state jump is that before the jump.

        Parameters
        ----------
        t : array_like, any shape
            Times, s.

        Returns
        -------
        q, qd : arrays of shape t.shape + (nq,), for a batch (batch,) + t.shape + (nq,)
            nan at times after the end of an instance.

        Raises
        ------
        ValueError
            If a time is outside of the run.
        """
        times = self._within(t)
        unique_times, place = np.unique(times, return_inverse=True)
        states = self._states(unique_times)[..., place.ravel(), :]
        q, qd = states.reshape(*states.shape[:-2], *times.shape, self.model.info.nq)
        return q, qd

    def sol(self, t: ArrayLike) -> Array:
        """Return the state [q; qd] at times within the run, as `sol` of SciPy's solve_ivp.

        Parameters
        ----------
        t : float or (n,) array_like
            Times, s.

        Returns
        -------
        (2 nq,) or (2 nq, n) array, for a batch (batch, 2 nq) or (batch, 2 nq, n)
            See `__call__`.

        Raises
        ------
        ValueError
            If a time is outside of the run.
        """
        x = np.concatenate(self(t), axis=-1)
        return np.moveaxis(x, -1, -1 - np.ndim(t))

    def _within(self, t: ArrayLike) -> Array:
        """Check that times lie within the run; return them, s, as an array of the same shape.

        A time that is outside of the run by no more than rounding is set to the start or end.
        """
        times = as_numbers(t, "t", np.dtype(float))
        begin, end = self.t0, float(self.t[-1])
        slack = 1e-12 * max(abs(begin), abs(end), end - begin)
        if times.size and not (times.min() >= begin - slack and times.max() <= end + slack):
            raise ValueError(f"t: the run goes from {begin:g} s to {end:.9g} s")
        return np.asarray(np.clip(times, begin, end))

    def _states(self, times: Array) -> Array:
        """Return the states (2, n, nq), for a batch (2, batch, n, nq), at ascending times (n,)."""
        raise NotImplementedError

    def evaluate(self, function: Callable[..., Any], *, has_inputs: bool = False) -> Array:
        """Evaluate a function of the state, and of the inputs if it has them, at each row."""
        raise NotImplementedError

    @property
    def u(self) -> Array:
        """Inputs that act at each row, (n, nu), limited to their allowed ranges.

        At each row they are the values of the scene's signals, or the inputs of the step that
        begins there. The last row has the inputs of the last step. For a batch (batch, n, nu).
        """
        return np.asarray(self.model.functions.saturate(self.requested_inputs, self.request.p))

    @property
    def saturated(self) -> Array:
        """Array of bool, as `u`: True where an input exceeds its limits, before it is limited."""
        return np.asarray(np.abs(self.requested_inputs - self.u) > 0)

    @property
    def requested_inputs(self) -> Array:
        """The inputs at each row before saturation, (n, nu), for a batch (batch, n, nu)."""
        if (inputs := self._row_inputs()) is None:
            return self.evaluate(self.model.functions.signal)
        values = np.broadcast_to(inputs, (*self.q.shape[:-1], self.model.info.nu)).copy()
        if self.q.ndim == 3:
            values[np.isnan(self.q[..., 0])] = np.nan
        return values

    def _row_inputs(self) -> Array | None:
        """Return the inputs before saturation in a shape that fits the rows; None: the signals."""
        request = self.request
        u = request.u if self.period_inputs is None else self.period_inputs
        if u is None or u.ndim == 1 or (u.ndim == 3 and u.shape[-2] == 1):
            return None if u is None else np.asarray(u)
        if isinstance(request.u, str) and request.u == saved.NOT_STORED:
            return np.asarray(u)  # values at the rows alone
        if not u.shape[-2]:  # no step, and so no inputs
            return np.full((self.q.shape[-2], u.shape[-1]), np.nan, u.dtype)
        if not request.has_equal_steps:
            starts = period_starts(request, u.shape[-2], self.t.dtype)
            index = np.maximum(np.searchsorted(starts, self.t, side="right") - 1, 0)
            return np.asarray(u[..., index, :])
        if self.times is None:
            index = np.minimum(np.arange(self.q.shape[-2]) * request.every, self._last_step)
        else:
            index = split_times(self.times, request.t0, request.h, request.steps)[0]
        return np.asarray(u[..., np.minimum(index // request.hold, u.shape[-2] - 1), :])

    @cached_property
    def energy(self) -> Array:
        """Energy K + P (kinetic and potential) at each row, (n,) or (batch, n), J.

        In a rotating frame, `jacobi` is conserved instead of the energy.
        """
        return self.evaluate(self.model.functions.energy)

    @property
    def jacobi(self) -> Array:
        """Jacobi's integral qd . dK/dqd - K + P at each row, (n,) or (batch, n), J.

        It equals the energy if K is purely quadratic in qd. Otherwise, as in a rotating frame, it
        is conserved instead of the energy if the power is zero.
        """
        return self.evaluate(self.model.functions.jacobi)

    @cached_property
    def outputs(self) -> dict[str, Array]:
        """The scene's outputs at the rows, as a dict from name to array (n,) or (batch, n).

        A value is nan where the output depends on accelerations and the mass matrix D is singular.
        """
        names, function = self.model.info.outputs, self.model.functions.output
        return self._named_values("outputs", names, function)

    @property
    def constraints(self) -> Mapping[str, Array]:
        """Residual of each constraint equation as a dict from name to array (n,) or (batch, n).

        A residual is 0 if the equation is satisfied; its unit is that of the equation. Raises
        KeyError for unknown names.
        """
        names, function = self.model.info.constraints.names, self.model.constraints.constraints
        return self._named_values("constraints", names, function, has_inputs=False)

    @property
    def multipliers(self) -> Mapping[str, Array]:
        """Lagrange multiplier of each constraint as a dict from name to array (n,) or (batch, n).

        It is nan where the multiplier does not exist. Raises KeyError for unknown names.
        """
        names = self.model.info.constraints.names
        return self._named_values("multipliers", names, self.model.constraints.multipliers_or_nan)

    @property
    def reactions(self) -> Mapping[str, Array]:
        """Reaction of each loop's joint on its second body, by the loop's name.

        A loop is a [[loop]] of the scene: a joint that closes a kinematic chain. Its reaction is
        the force, N, and the moment about the joint's point, N m, along the axes of the world, at
        all rows: an array (n, 6) or (batch, n, 6). In plane scenes it has three components: two of
        the force and the moment.
        """
        loops, function = self.model.info.constraints.loops, self.model.constraints.reactions_or_nan
        return self._named_values("reactions", loops, function, axis=-2)

    def _named_values(
        self, what: str, names: Sequence[str], function: Callable[..., Any], *,
        has_inputs: bool = True, axis: int = -1,
    ) -> dict[str, Array]:  # fmt: skip
        """Evaluate a function at the rows; return its values along an axis by name."""
        if not names:
            return ByName(what, (), ())
        values = np.moveaxis(self.evaluate(function, has_inputs=has_inputs), axis, 0)
        return ByName(what, names, np.ascontiguousarray(values))

    def __copy__(self) -> Self:
        return self.restore(saved.field_values(self))

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self.restore(saved.deep_copies(self, memo))

    def __reduce__(self) -> tuple[Any, ...]:
        kind, state = type(self), saved.pickled_values(self)
        return reduced(f"{kind.__module__.rpartition('.')[2]}.{kind.__name__}.restore", state)

    @classmethod
    def restore(cls, values: Mapping[str, Any]) -> Self:
        """Create a run from the values of its fields; the model is that of the build by default."""
        run = cls.__new__(cls)
        run.__dict__.update(saved.completed(values))
        return run

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return saved.are_equal(self, other)

    @property
    def column_names(self) -> tuple[str, ...]:
        """Names of the columns, in the order of `to_dict`."""
        return tuple(self._columns())

    def _columns(self) -> dict[str, Callable[[], Array]]:
        """Return a function for each column that computes it, by name in the order of `to_dict`."""
        columns: dict[str, Callable[[], Array]] = {
            "t": partial(getattr, self, "t"),
            **self._named(),
        }
        names = ("energy", "jacobi") if self.model.functions.has_jacobi else ("energy",)
        for name in names:
            # a coordinate may have this name
            columns.setdefault(name, partial(getattr, self, name))
        return columns

    def _named(self) -> dict[str, Callable[[], Array]]:
        """Return the columns of the scene's coordinates, rates, inputs and outputs."""
        model = self.model
        rates = [f"{name}_dot" for name in model.info.coordinates]
        halves = (("q", model.info.coordinates), ("qd", rates), ("u", model.info.inputs))

        def column(half: str, k: Any) -> Array:
            values = getattr(self, half)
            return np.asarray(values[k] if half == "outputs" else values[..., k])

        keys = [(name, half, k) for half, names in halves for k, name in enumerate(names)]
        keys += [(name, "outputs", name) for name in model.info.outputs]
        return {name: partial(column, half, k) for name, half, k in keys}

    def __getitem__(self, name: str) -> Array:
        if not isinstance(name, str):
            raise TypeError(f"run[{name!r}]: give a name, such as run['t']; rows are run.q[k]")
        columns = self._columns()
        if name not in columns:
            raise KeyError(not_one_of("run", name, tuple(columns)))
        return columns[name]()

    def __getattr__(self, name: str) -> Any:
        """Return the column of that name from the scene, unless a member has the same name."""
        if name == "request" and "origin" in self.__dict__:
            choice, *values = self.origin
            request = self.request = choice.short_request(self.model.info, *values)
            return request
        named = {} if name.startswith("_") or "model" not in self.__dict__ else self._named()
        if name not in named:
            known = tuple(named)
            raise AttributeError(not_one_of("run", name, known) if known else name)
        return named[name]()

    def __dir__(self) -> Iterable[str]:
        return {*super().__dir__(), *self._named()}

    @property
    def params(self) -> dict[str, Any]:
        """Return the parameters of the run as a dict from name to number.

        For a batch, the values are arrays (batch,). The dict has the form of the argument `params`
        of `simulate` and `simulate_batch`.
        """
        names, table = self.model.info.parameters, self.request.p
        if table.ndim == 1:
            return dict(zip(names, table.tolist(), strict=True))
        columns = np.broadcast_to(table, (len(self), len(names))).T.copy()
        return dict(zip(names, columns, strict=True))

    def to_dict(self) -> dict[str, Array]:
        """Return all columns as a dict from name to array (n,), for a batch (batch, n).

        The order is: t (always (n,)), coordinates, velocities, inputs, outputs, energy, and jacobi
        if the Jacobi integral differs from the energy.
        """
        return {name: column() for name, column in self._columns().items()}

    def save(self, file: File) -> None:
        """Write the columns to a .csv file, or the whole run to an .npz file.

        `load_run` reads the .npz file. It contains arrays only and nothing pickled, so that
        numpy.load(file)["q"] reads it without the module. If u is a function, its values at the
        rows are saved, not the function.

        Parameters
        ----------
        file : path
            A name that ends in .csv (single runs only) or .npz.

        Raises
        ------
        ValueError
            If the name has another suffix, or for the .csv of a batch.
        FileExistsError
            If `file` exists and is a scene, or its content does not match its suffix.
        """
        path = Path(file)
        if path.suffix == ".csv" and self._axes == ("t",):
            self._to_csv(path)
        elif path.suffix == ".npz":
            saved.write(self, path)
        else:
            names = ".npz or .csv" if self._axes == ("t",) else ".npz"
            raise ValueError(f"save: {file}: give a name that ends in {names}")

    def _to_csv(self, path: Path) -> None:
        columns = self.to_dict()
        with atomic_write(path) as new, new.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(columns)
            numbers = (c.astype(float) + 0.0 for c in columns.values())  # -0 becomes 0
            for row in zip(*(c.tolist() for c in numbers), strict=True):
                writer.writerow(map(repr, row))

    def to_pandas(self) -> Any:
        """Return a pandas.DataFrame with one column for each column of the run.

        The index is t, for a batch (instance, t). Raises ModuleNotFoundError if pandas is not
        installed.
        """
        pandas = imported("pandas", "to_pandas")
        columns = self.to_dict()
        t = columns.pop("t")
        if self._axes == ("t",):
            index = pandas.Index(t, name="t")
        else:
            index = pandas.MultiIndex.from_product([range(len(self)), t], names=self._axes)
        return pandas.DataFrame({n: c.ravel() for n, c in columns.items()}, index=index)

    def to_xarray(self) -> Any:
        """Return an xarray.Dataset with one variable for each column of the run.

        The dimension is t, for a batch (instance, t). The attribute `units` of a variable is its
        unit. Parameters that differ between the instances of a batch become coordinates along
        instance. Raises ModuleNotFoundError if xarray is not installed.
        """
        xarray = imported("xarray", "to_xarray")
        model, columns = self.model, self.to_dict()
        units = dict(model.info.units)
        units |= {f"{c}_dot": f"{units[c]}/s" for c in model.info.coordinates if units.get(c)}
        t = ("t", columns.pop("t"), {"units": "s"})
        variables = {
            name: (self._axes, column, {"units": units[name]} if name in units else {})
            for name, column in columns.items()
        }
        attributes = {name: getattr(self, name) for name in ("h", "method")}
        attributes |= {"scene": model.info.name, "digest": model.info.digest}
        coordinates = {"t": t} | self._swept(units, {*variables, *self._axes})
        return xarray.Dataset(variables, coords=coordinates, attrs=attributes)

    def _swept(self, units: dict[str, str], taken: set[str]) -> dict[str, Any]:
        """Return the parameters that differ between instances by name (params_NAME if taken)."""
        if self.request.p.ndim == 1 or len(self.request.p) == 1:
            return {}
        return {
            f"params_{name}" if name in taken else name: (
                "instance", values, {"units": units[name]} if name in units else {},
            )
            for name, values in self.params.items()
            if np.ptp(values) > 0
        }  # fmt: skip


def imported(package: str, function: str) -> Any:
    """Import and return an optional package such as pandas.

    package: name of the package. function: name of the function that needs it, for the error
    message. If the package is missing, ModuleNotFoundError says how to install it.
    """
    try:
        return import_module(package)
    except ModuleNotFoundError as fault:
        name = package.split(".")[0]
        if fault.name != name:
            raise
        raise ModuleNotFoundError(
            f"{function}: {name} is not installed: pip install {name}, or take to_dict()",
            name=name,
        ) from None
