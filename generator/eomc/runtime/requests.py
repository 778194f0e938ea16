"""Arguments of simulations: as the user gives them, their checks, and the checked values.

Initial states may be given by name, and depend on parameters by formulas of the scene.

Invalid arguments raise ValueError.
"""

from __future__ import annotations

import ast
import operator
import sys
from collections.abc import Callable, Mapping
from functools import partial
from math import ceil, inf, isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .arguments import (
    Array,
    as_count,
    as_flag,
    as_number,
    as_numbers,
    as_period,
    as_step_size,
    by_name,
    check_time,
    cut_table,
    machine_memory,
    not_one_of,
)
from .info import SceneInfo
from .interfaces import CompiledModel
from .mathematics import numpy_functions
from .package import option, warn
from .status import PART

Progress = Callable[[int, int], None] | None
_Times = tuple[float, float, float, int, int, Array | None]  # from t0 to times, as in `Request`
Inputs = ArrayLike | Mapping[str, ArrayLike] | Callable[[float, Array, Array], ArrayLike] | None

MIN_TOLERANCE = {8: 1e-15, 4: 5e-7}  # by the size of a floating-point number in bytes
MAX_TOLERANCE = 1e-2
FIRST_CALL_NUMBERS = 16_384  # steps times coordinates of the first call of C, some ms
ADAPTIVE_METHOD = "gauss16"  # Gauss and Legendre's method with eight stages
MAX_EVERY = 2**48  # steps from row to row, more than any run makes
MAX_SHORT_STEPS = 999  # of a run in a single call of C
MIN_CHECKED_STEPS = 20  # the step size of shorter runs is not checked
_MAX_STEPS = 2**60  # so that C can return four times as many
_STEP_TOLERANCE = 1e-12  # times closer to a step than this fraction of h coincide with it


class SimulationArguments(NamedTuple):
    """Arguments of `simulate` and `simulate_batch` as the user gives them; None if not given.

    Their meaning is described there. `threads` and `max_evaluations` belong to batches, `out` and
    a function `u` to single runs.
    """

    q0: Any = None
    qd0: Any = None
    h: float | None = None
    duration: float | None = None
    steps: int | None = None
    every: int = 1
    u: Any = None
    params: Any = None
    method: str | None = None
    t0: float = 0.0
    control_period: float | None = None
    out: Any = None
    progress: Progress = None
    tol: float | None = None
    times: ArrayLike | None = None
    max_step: float | None = None
    stiff: bool = False
    threads: int | None = None
    max_evaluations: int | None = None

    def uses_adaptive_steps(self, info: SceneInfo) -> bool:
        """Return True if these arguments ask for adaptive steps.

        Steps are adaptive if tol, max_step, stiff or method="auto" is given. They are also adaptive
        if the scene has a tolerance and none of h, steps and method is given.
        """
        if self.tol is None and self.max_step is None and self.stiff is False:
            if self.method is None:
                return bool(info.tolerance) and self.h is None and self.steps is None
            return self.method == "auto"
        return True

    def adaptive_limits(self, info: SceneInfo) -> tuple[float, float]:
        """Return the tolerance and the longest adaptive step, s (0: no limit).

        Raises ValueError if the module was built without adaptive steps, or if an argument of fixed
        steps is given.
        """
        as_flag(self.stiff, "stiff")
        if info.tolerance is None:
            raise ValueError(
                f"tol: {info.name} was built without adaptive steps, to which tol, max_step and "
                f"stiff belong: build it with {option('tolerance', '1e-9')}"
            )
        for name in self._present("h", "steps", "method", "every", "out"):
            raise ValueError(f"{name}: {self._why_not_adaptive(info)}")
        most = 0.0 if self.max_step is None else as_step_size(self.max_step, info.dtype, "max_step")
        return as_tolerance(info.tolerance if self.tol is None else self.tol, info.dtype), most

    def _why_not_adaptive(self, info: SceneInfo) -> str:
        """Return the reason why adaptive steps do not accept an argument of fixed steps."""
        if self.tol is not None or self.max_step is not None or self.stiff or self.method == "auto":
            return (
                "belongs to fixed steps; tol, max_step and stiff to adaptive ones: give one or the "
                "other"
            )
        return (
            f"belongs to fixed steps, and {info.name} goes by its tolerance, {info.tolerance:g}, "
            f"where nothing is said: give h too, such as h={info.h:g}"
        )

    def excluded_rows(self) -> None:
        """Raise ValueError if `times` is combined with an argument that determines rows as well."""
        for name in self._present("steps", "every", "out"):
            raise ValueError(f"{name}: times say where rows are; give one or the other")

    def _present(self, *names: str) -> list[str]:
        """Return those of these arguments that are given and ask for steps of equal size."""
        neutral: dict[str, tuple[Any, ...]] = {"every": (1,), "method": ("auto",)}
        values = {name: getattr(self, name) for name in names}
        return [k for k, x in values.items() if x is not None and x not in neutral.get(k, ())]


class Request(NamedTuple):
    """Checked arguments with which a run, or a batch of runs, is made, and made again.

    Attributes
    ----------
    q, qd : (nq,) or (batch, nq) arrays
        Initial state.
    t0, t_end : float
        Start and end time, s.
    h : float
        Size of fixed steps, s; 0: adaptive steps.
    steps, every : int
        Number of fixed steps, and of steps from one row to the next.
    times : (n,) array or None
        Requested times of the rows, s, in place of `every`.
    u : callable, array, str or None
        Inputs: None for the scene's signals; constant ones (nu,); a row for each control period
        (periods, nu), in batches (batch or 1, periods or 1, nu); or a function u(t, q, qd). A
        pickled or saved run has a text in place of the function.
    period : float
        Control period, s, over which a row or a value of the function is constant; 0: none.
    periods : int
        Number of control periods.
    p : (np,) or (batch or 1, np) array
        Parameters.
    method : str
        Name of the method.
    tol : float
        Tolerance of adaptive steps; 0: fixed steps.
    max_step : float
        Longest adaptive step, s; 0: no limit.
    stiff : bool
        Whether adaptive steps begin with Newton's method.
    detects_events : bool
        Whether the events of the scene are detected.
    max_steps : float
        Number of adaptive steps after which a run ends early. It is checked between calls of C, so
        the run may have more steps.
    max_evaluations : int
        Number of evaluations after which an instance with adaptive steps ends early; 0: no limit.
    """

    q: Array
    qd: Array
    t0: float
    t_end: float
    h: float
    steps: int
    every: int
    times: Array | None
    u: Any
    period: float
    periods: int
    p: Array
    method: str
    tol: float = 0.0
    max_step: float = 0.0
    stiff: bool = False
    detects_events: bool = False
    max_steps: float = inf
    max_evaluations: int = 0

    def replace(self, **changes: Any) -> Request:
        """Return a copy with other values of the named fields."""
        return self._replace(**changes)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], prefix: str = "") -> Request:
        """Return the request whose fields have the names of these values, after a prefix.

        A field without a value has its default value, or None.
        """
        defaults = cls._field_defaults
        return cls(*(values.get(f"{prefix}{k}", defaults.get(k)) for k in cls._fields))

    def to_mapping(self, prefix: str = "") -> dict[str, Any]:
        """Return the values of the fields by name, after a prefix."""
        return {f"{prefix}{name}": value for name, value in self._asdict().items()}

    @property
    def has_equal_steps(self) -> bool:
        """True if all steps have the size h; adaptive steps and those up to events have others."""
        return not (self.tol or self.detects_events)

    @property
    def hold(self) -> int:
        """Number of fixed steps of a control period."""
        return round(self.period / self.h) if self.period else 1

    @property
    def step_limit(self) -> float:
        """Size of fixed steps or longest adaptive step, s, as C takes it."""
        return self.h or self.max_step


class StepChoice(NamedTuple):
    """Checked steps of runs: fields of `Request`, in its order, other than those of `request`."""

    t0: float
    t_end: float
    h: float
    steps: int
    every: int
    times: Array | None
    method: str
    tol: float = 0.0
    max_step: float = 0.0
    stiff: bool = False
    detects_events: bool = False
    max_steps: float = inf
    max_evaluations: int = 0

    @classmethod
    def from_arguments(
        cls, info: SceneInfo, options: SimulationArguments, ignores_events: bool
    ) -> StepChoice:
        """Check the arguments that concern steps and times.

        Raises ValueError if an argument is invalid, or if arguments exclude each other.
        """
        limit, has_events = options.max_evaluations, bool(info.events)
        if options.uses_adaptive_steps(info):
            limits = options.adaptive_limits(info)
            if limit is not None:
                limit = min(as_count(limit, "max_evaluations", 1), 2**31 - 1)  # a long in C
            return cls(
                *adaptive_times(info, options), ADAPTIVE_METHOD, *limits, bool(options.stiff),
                has_events, max_evaluations=limit or 0,
            )  # fmt: skip
        if limit is not None:
            raise ValueError("max_evaluations: belongs to adaptive steps: give tol=, and no h=")
        detects_events = has_events and not ignores_events
        if detects_events and options.out is not None:
            raise ValueError("out: events add rows, and no one knows how many: leave it out")
        method = info.method_name(options.method)
        times = fixed_times(info, options, detects_events)
        return cls(*times, method, detects_events=detects_events)

    @classmethod
    def from_request(cls, request: Request) -> StepChoice:
        """Return the steps of a request."""
        choice: StepChoice = tuple.__new__(cls, request[2:8] + request[12:])
        return choice

    @property
    def duration(self) -> float:
        """Time from the start to the end, s."""
        return self.t_end - self.t0

    def request(self, q: Array, qd: Array, inputs: tuple[Any, float, int], p: Array) -> Request:
        """Return the request with an initial state, inputs (u, period, periods) and parameters."""
        fields = q, qd, *self[:6], *inputs, p, *self[6:]
        return tuple.__new__(Request, fields)  # faster than Request(...)

    def short_request(
        self, info: SceneInfo, start: bytes, u: bytes | None, u_shape: tuple[int, ...], p: Array,
        times: tuple[float, float, int, Array | None],
    ) -> Request:  # fmt: skip
        """Return the request of a run, or of a batch, that a single call of C has made.

        start, u: numbers of the initial states, q and then qd, and of the inputs, whose shape is
        `u_shape`; None: the signals. p: parameters. times: t0, t_end, steps and times of the run.
        """
        inputs, (t0, t_end, steps, rows) = None, times
        if u is not None:
            inputs = np.frombuffer(u, info.dtype).reshape(u_shape).copy()
        x = np.frombuffer(start, info.dtype).copy()
        n = x.size // 2
        q, qd = x[:n], x[n:]
        if len(u_shape) > 2:  # of a batch
            q, qd, p = q.reshape(-1, info.nq), qd.reshape(-1, info.nq), np.atleast_2d(p)
        hold = (self.h, steps) if len(u_shape) > 1 else (0.0, 0)
        fields = q, qd, t0, t_end, self.h, steps, self.every, rows, inputs, *hold, p, *self[6:]
        return tuple.__new__(Request, fields)


class PlainSteps(dict[tuple[Any, ...], StepChoice | None]):
    """Steps of runs from t = 0 by the arguments of calls, if these need no further checks.

    A key consists of h, duration, steps, every, method, tol, and of whether times are requested.
    The value is None if the arguments have unusual types, or values that may need a message. With
    requested times it has no steps, and its end is the largest permitted time, s.

    warned: see `Integrator`.
    """

    def __init__(self, info: SceneInfo, warned: set[Any]) -> None:
        self.info, self.warned = info, warned

    def find(self, key: tuple[Any, ...]) -> StepChoice | None:
        """Return the steps for a key, or None."""
        try:
            return self[key]
        except TypeError:  # arrays are not hashable
            return None

    def __missing__(self, key: tuple[Any, ...]) -> StepChoice | None:
        """Check the arguments, store the steps and return them."""
        max_count, most = 256, MAX_SHORT_STEPS
        (h, duration, steps, every, method, tol, has_times), info = key, self.info
        span = info.duration if duration is None else duration
        if type(every) is not int or not 0 < every <= most or (has_times and every > 1):
            return None
        if not isinstance(span, (float, int)) or not 1e-30 < span < 1e15:
            return None
        t_end = inf if has_times and duration is None else float(span)
        if h is steps is method is None and (tol is not None or info.tolerance):
            tol = info.tolerance if tol is None else tol
            if info.tolerance is None or every > 1 or not isinstance(tol, float):
                return None
            if not MIN_TOLERANCE[info.dtype.itemsize] <= tol <= MAX_TOLERANCE:
                return None
            h, tol, steps, method = 0.0, float(tol), 0, ADAPTIVE_METHOD
            if not has_times and info.dtype.itemsize < 8:
                t_end = float(info.dtype.type(t_end))
        else:
            method, h = method or info.methods[0], info.h if h is None else h
            if tol is not None or not isinstance(h, float) or not 1e-37 < h < 1e37:
                return None
            if type(method) is not str or method not in info.methods:
                return None
            h = float(h)  # of NumPy's type
            if has_times:
                if steps is not None:
                    return None
                steps = 0
            elif steps is None:
                if not h <= span <= h * most:
                    return None
                steps = whole_steps(span, h)
            elif duration is not None or not isinstance(steps, (int, np.integer)):
                return None
            if not 0 <= steps <= most:
                return None
            if steps >= MIN_CHECKED_STEPS and (method, h) not in self.warned:
                return None
            if not has_times:
                t_end = steps * h
                if info.events:
                    t_end = float(info.dtype.type(t_end))
        choice: StepChoice = tuple.__new__(StepChoice, (
            0.0, t_end, h, int(steps), every, None, method, tol or 0.0, 0.0, False,
            bool(info.events), inf, 0,
        ))  # fmt: skip
        if len(self) >= max_count:
            self.clear()
        self[key] = choice
        return choice


def fixed_times(info: SceneInfo, options: SimulationArguments, detects_events: bool) -> _Times:
    """Check the arguments of fixed steps that concern time.

    Raises ValueError if an argument is invalid, if arguments exclude each other, or if the times of
    the steps are not distinct. Without events they are compared in double precision, as the times
    of the rows are in double precision.
    """
    h = info.h if options.h is None else as_step_size(options.h, info.dtype)
    t0, rows = as_number(options.t0, "t0"), None
    if options.times is None:
        steps = step_count(info, h, options.duration, options.steps)
    else:
        options.excluded_rows()
        dtype = info.dtype if detects_events else np.dtype(float)
        rows = as_times(options.times, t0, dtype, options.duration)
        steps = step_count(info, h, None, count_steps(rows, t0, h))
    every = min(as_count(options.every, "every", 1), MAX_EVERY)
    if detects_events:
        span = steps * h if rows is None else float(rows[-1]) - t0
        check_time(info.dtype, t0, span, h)
        return t0, float(info.dtype.type(t0 + span)), h, steps, every, rows
    if steps:
        check_time(info.dtype, t0, h, h)
        check_time(np.dtype(float), t0, steps * h, h)
    return t0, t0 + steps * h, h, steps, every, rows


def adaptive_times(info: SceneInfo, options: SimulationArguments) -> _Times:
    """Check the arguments of adaptive steps that concern time.

    Raises ValueError if an argument is invalid.
    """
    t0 = as_number(options.t0, "t0")
    if options.times is None:
        return t0, as_end(info, t0, options.duration), 0.0, 0, 1, None
    rows = as_times(options.times, t0, info.dtype, options.duration)
    check_time(info.dtype, t0, float(rows[-1]) - t0)
    return t0, float(rows[-1]), 0.0, 0, 1, rows


def split_times(times: Array, t0: float, h: float, most: int = 2**60) -> tuple[Array, Array]:
    """Split times into a number of whole steps from t0 and a remaining time, both (n,).

    times: (n,), s. t0: start of the run, s. h: step size, s. most: largest number of steps, such as
    the number of steps of the run. The remaining time is in s.
    """
    steps = (times - t0) / h
    near = _STEP_TOLERANCE + 4 * sys.float_info.epsilon * (steps + abs(t0) / h)  # rounding of times
    whole = np.minimum((steps + near).astype(int), most)
    return whole, np.where(steps - whole < near, 0.0, times - (t0 + whole * h))


def step_count(info: SceneInfo, h: float, duration: float | None, steps: int | None) -> int:
    """Return the number of fixed steps of size h, s, from `steps` or `duration`, s.

    If neither is given, the duration is that of the scene. Raises ValueError if both are given or
    the number is too large.
    """
    if steps is not None:
        steps = as_count(steps, "steps", 0)
        if duration is not None:
            raise ValueError("steps: give steps or duration, not both")
        if steps > _MAX_STEPS:
            shown = f"{steps:.3g}" if steps < 10**300 else "so many"
            raise ValueError(f"steps: {shown} are more than a run can count, {_MAX_STEPS:.3g}")
        return steps
    time = info.duration if duration is None else as_number(duration, "duration")
    if words := beyond_end(h, time):
        warn(f"{info.name}: {words}")
    if time < 0:
        raise ValueError(f"duration: {duration} is not a time in s")
    if time / h > _MAX_STEPS:
        raise ValueError(
            f"duration: {time:g} s are more steps of h = {h:g} s than a run can count, "
            f"{_MAX_STEPS:.3g}: take a larger h, or a shorter duration"
        )
    # the first multiple of h that is not before the duration, rounding aside
    return whole_steps(time, h)


def whole_steps(span: float, h: float) -> int:
    """Return the number of steps of size h, s, up to or beyond a time span, s, rounding aside."""
    return ceil(span / h * (1 - _STEP_TOLERANCE))


def beyond_end(h: float, duration: float) -> str | None:
    """Return a message if the step size h, s, is larger than the duration, s, else None."""
    if not 0 < duration < h * (1 - _STEP_TOLERANCE):
        return None
    return (
        f"h = {h:g} s is longer than the duration, {duration:g} s: the run is one step of {h:g} s"
    )


def count_steps(times: Array, t0: float, h: float) -> int:
    """Return the number of steps of size h, s, from t0 up to or beyond the last of these times."""
    span = float(times[-1]) - t0
    return whole_steps(span - 4 * sys.float_info.epsilon * (abs(t0) + span), h)


def as_progress(progress: Any) -> Any:
    """Return the progress callback unchanged; raise ValueError unless it is None or callable."""
    if progress is not None and not callable(progress):
        raise ValueError(f"progress: {progress!r} is not a function of steps done and in all")
    return progress


def as_end(info: SceneInfo, t0: float, duration: float | None) -> float:
    """Return the end time t0 + duration of a run, s, rounded to the module's number type.

    duration: in s; None: that of the scene. Raises ValueError if the duration is negative, or if
    the spacing of floating-point numbers near the end time is too large for the duration.
    """
    span = info.duration if duration is None else as_number(duration, "duration")
    if span < 0:
        raise ValueError(f"duration: {span:g} is not a time in s")
    check_time(info.dtype, t0, span)
    end = float(t0 + span)
    return end if info.dtype.itemsize == 8 else float(info.dtype.type(end))


def as_tolerance(tol: Any, dtype: np.dtype[Any]) -> float:
    """Return the tolerance as a float; raise ValueError if it is outside of the allowed range.

    The range is from MIN_TOLERANCE, which depends on the module's number type `dtype`, to
    MAX_TOLERANCE.
    """
    least = MIN_TOLERANCE[dtype.itemsize]
    number = as_number(tol, "tol")
    if not least <= number <= MAX_TOLERANCE:
        raise ValueError(f"tol: {number:g}: give one between {least:.1g} and {MAX_TOLERANCE:g}")
    return number


def as_times(
    times: ArrayLike, t0: float, dtype: np.dtype[Any], duration: float | None = None
) -> Array:
    """Check the requested times of rows and return them as an array (n,), s.

    Raises ValueError unless the times are finite, ascending and not before t0, nor after
    t0 + duration if a duration in s is given.
    """
    array = np.array(as_numbers(times, "times", dtype), ndmin=1)
    if array.ndim != 1 or not len(array) or not (isfinite(array[0]) and isfinite(array[-1])):
        raise ValueError("times: expected a row of finite numbers, in s")
    if array[0] < t0:
        raise ValueError(
            f"times: expected ascending times from t0 = {t0:g} s on; times[0] is {array[0]:g}"
        )
    if not (is_ascending := array[1:] > array[:-1]).all():
        k = int(np.argmin(is_ascending))
        raise ValueError(
            f"times: expected ascending times from t0 = {t0:g} s on; times[{k + 1}] is "
            f"{array[k + 1]:g}, after {array[k]:g}"
        )
    if duration is not None:
        end = t0 + as_number(duration, "duration")
        if array[-1] > end + 4 * np.finfo(dtype).eps * abs(end):  # sums of steps are rounded
            raise ValueError(
                f"times: {array[-1]:g} s is behind the end of the duration, {end:g} s: leave out "
                "such times, or duration, as a run ends with the last of its times"
            )
    return array


def named_initial_state(
    model: CompiledModel, q0: Any, qd0: Any, params: Any, many: bool = False
) -> tuple[Any, Any]:
    """Complete an initial state that is given by name, or depends on parameters of the call.

    Any other initial state is returned unchanged. many: whether values may be (n,), one for each
    instance.
    """
    is_by_name = hasattr(q0, "keys") or hasattr(qd0, "keys")
    if not (is_by_name or (params is not None and model.info.start_formulas)):
        return q0, qd0
    convert = model.arguments.parameter_rows if many else model.arguments.parameters
    return initial_state_for_parameters(model, q0, qd0, convert(params), many)


def initial_state_for_parameters(
    model: CompiledModel, q0: Any, qd0: Any, p: Array, many_values: bool = False
) -> tuple[Any, Any]:
    """Return the initial state (q0, qd0), completed by the scene's initial values.

    An initial value of the scene may be a formula of parameters; it is evaluated for the parameters
    p.

    Parameters
    ----------
    q0, qd0 : array, mapping or None
        Arrays are returned unchanged. Mappings give values by the names of coordinates; all other
        values are those of the scene. None: all values are those of the scene.
    p : (np,) or (n, np) array
        Parameters; with (n, np) the completed arrays are (n, nq).
    many_values : bool
        Whether values of the mappings may be (n,), one for each instance.

    Returns
    -------
    q0, qd0 : (nq,) or (n, nq) arrays

    Raises
    ------
    ValueError
        For unknown names, or if a formula has no finite value.
    """
    mappings = [values_by_name(model, x, half, many_values) for half, x in enumerate((q0, qd0))]
    many = _instances(mappings, p.shape[:-1])
    p = np.broadcast_to(p, (*many, p.shape[-1]))
    result = [
        x if named_values is None else np.tile(own, (*many, 1))
        for x, own, named_values in zip((q0, qd0), model.info.initial_state, mappings, strict=True)
    ]
    for x, named_values in zip(result, mappings, strict=True):
        for name, value in (named_values or {}).items():
            x[..., model.info.coordinates.index(name)] = value
    values = {name: p[..., k].astype(float) for k, name in enumerate(model.info.parameters)}
    for name, text in model.info.start_formulas.items():
        half, at = divmod(model.info.states.index(name), model.info.nq)
        named_values = mappings[half]
        if named_values is None or model.info.coordinates[at] in named_values:
            continue
        tree = ast.parse(text, mode="eval").body
        own = [n.id for n in ast.walk(tree) if isinstance(n, ast.Name)]
        which = [k for k, parameter in enumerate(model.info.parameters) if parameter in own]
        changed = (p[..., which] != model.info.p0[which]).any(axis=-1)
        with np.errstate(all="ignore"):
            value = np.broadcast_to(_value(tree, values | {"pi": np.pi}), many)
        if not np.isfinite(value[changed]).all():
            what = ("q0", "qd0")[half]
            raise ValueError(
                f"params: the start of {name}, {text}, is not finite there: give {what}"
            )
        result[half][..., at][changed] = value[changed]
    return result[0], result[1]


def _instances(
    mappings: list[dict[str, Array] | None], of_parameters: tuple[int, ...]
) -> tuple[int, ...]:
    """Return the leading shape of the initial state, from the parameters or the values by name."""
    result = {of_parameters: "params"} if of_parameters != (1,) else {}
    for what, values in zip(("q0", "qd0"), mappings, strict=True):
        for name, value in (values or {}).items():
            if value.size > 1:
                result.setdefault(value.shape, f"{what}: {name}")
    if len(result) > 1:
        (one, whose), (other, its) = list(result.items())[:2]
        raise ValueError(f"{its}: {other[0]} instances where {whose} has {one[0]}")
    return next(iter(result), of_parameters)


def values_by_name(
    model: CompiledModel, x: Any, half: int, many: bool = False
) -> dict[str, Array] | None:
    """Check a mapping of initial values by coordinate name and return it as a dict of arrays.

    x: the user's argument q0 or qd0. half: 0 if x are positions, 1 if they are velocities, whose
    names may end with "_dot". many: values may be (n,), one for each instance. Returns {} if x is
    None, and None if x is an array. Raises ValueError for unknown names.
    """
    if x is None:
        return {}
    if not hasattr(x, "keys"):
        return None
    what, result = ("q0", "qd0")[half], dict[str, Array]()
    moving = [
        name for name in model.info.coordinates if name not in model.info.discrete_coordinates
    ]
    known = moving if half else model.info.coordinates
    for key, value in by_name(x).items():
        name = key.removesuffix("_dot") if half and key not in known else key
        if name not in known:
            if not half and key.removesuffix("_dot") in moving:
                raise ValueError(f"q0: '{key}' is a velocity: give it in qd0")
            raise ValueError(not_one_of(what, key, known))
        if name in result:
            raise ValueError(f"{what}: '{name}' is given twice, as '{name}' and as '{name}_dot'")
        if many and np.ndim(value) == 1:
            result[name] = model.arguments.numbers(value, f"{what}: {name}")
            if not np.isfinite(result[name]).all():
                raise ValueError(f"{what}: {name}: not all numbers are finite")
        else:
            result[name] = np.array(as_number(value, f"{what}: {name}"))
    return result


_OPERATORS: Mapping[type, Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul,
    ast.Div: operator.truediv, ast.Pow: operator.pow,
    ast.UAdd: operator.pos, ast.USub: operator.neg,
}  # fmt: skip
_FUNCTIONS = numpy_functions()


def _value(node: ast.expr, values: Mapping[str, Any]) -> Any:
    """Evaluate a formula; eomc has checked each of its nodes when the module was built."""
    match node:
        case ast.Constant(value=number):
            return np.float64(number)  # type: ignore[arg-type]
        case ast.Name(id=name):
            return values[name]
        case ast.UnaryOp(op=op, operand=operand):
            return _OPERATORS[type(op)](_value(operand, values))
        case ast.BinOp(left=left, op=op, right=right):
            return _OPERATORS[type(op)](_value(left, values), _value(right, values))
        case ast.Call(func=ast.Name(id=name), args=args):
            return _FUNCTIONS[name](*(_value(arg, values) for arg in args))
    raise AssertionError(f"unchecked node {ast.dump(node)}")


def evaluate_law(
    law: Callable[..., Any], inputs: Callable[[Any], Any], t: float, q: Array, qd: Array
) -> Array:
    """Call a user's function law(t, q, qd) and return the inputs (nu,) that it computes.

    inputs: function that checks the returned value and converts it to an array. t: time, s. q, qd:
    state (nq,). An exception in the law gets a note with the time and the state. An invalid result
    raises ValueError or TypeError.
    """
    try:
        try:
            returned = law(t, q.copy(), qd.copy())
        except TypeError as fault:
            if fault.__traceback__ and fault.__traceback__.tb_next:  # raised inside the function
                raise
            raise TypeError(f"u: is called as u(t, q, qd), and {fault}") from None
        try:
            inputs_array = inputs(returned)
        except ValueError as fault:
            wrong = str(fault).removeprefix("u: ")
            raise ValueError(f"u: what the function returned: {wrong}") from None
    except Exception as fault:
        fault.add_note(f"u was called at t = {t:.9g} s, q = {q}, qd = {qd}")
        raise
    if inputs_array is None:
        raise ValueError("u: the function returned None, not the inputs")
    return np.array(inputs_array)


def _signal(model: CompiledModel, params: Array, t: float, q: Array, qd: Array) -> Any:
    """Return the scene's signals, which a run with a control period reads once in each period."""
    return model.functions.signal(q, qd, t, params)


def period_starts(request: Request, count: int, dtype: np.dtype[Any]) -> Array:
    """Return the start times, s, of the first `count` control periods of a run, in type `dtype`."""
    return np.asarray(request.t0 + request.period * np.arange(count), dtype)


def checked_inputs(
    model: CompiledModel, options: SimulationArguments, choice: StepChoice, p: Array
) -> tuple[Any, float, int]:
    """Check the inputs of a run; return the fields `u`, `period` and `periods` of its `Request`.

    A table of inputs may cover the given duration if the requested times end earlier. Raises
    ValueError if the inputs are invalid or do not fit the number of periods, MemoryError if those
    of all periods of steps of various sizes do not fit in memory.
    """
    info, u, control_period = model.info, options.u, options.control_period
    if u is None and (control_period is None or not info.nu):
        if control_period is not None:
            count_input_periods(info, choice, control_period)  # checks the period
        return None, 0.0, 0
    if not info.nu:
        raise ValueError("u: this scene has no inputs")
    period, periods = count_input_periods(info, choice, control_period)
    if u is None:
        u = partial(_signal, model, p)
    elif callable(u):
        if not period:
            raise ValueError(
                "u: a function is called once in each control period, and adaptive steps have no "
                "fixed length: give control_period=, in s"
            )
        if period == choice.h and "u" not in model.integrator.warned:
            model.integrator.warned.add("u")
            warn(
                f"{info.name}: u is a Python function, called before each step: some hundred times "
                "slower than a table (steps, nu) or the scene's own signal"
            )
    else:
        u = _constant_or_table(model, options, choice, (period, periods))
        if u.ndim == 1:
            return u, 0.0, 0
    stored_bytes = 200  # of the inputs of one period
    size = periods * (info.row_bytes(1) + stored_bytes)
    if (not choice.h or info.events) and size > PART * machine_memory():
        raise MemoryError(
            f"control_period: the rows of {periods:.3g} periods of {period:g} s don't fit in "
            "memory: take a longer one, or a shorter duration"
        )
    return u, period, periods


def count_input_periods(
    info: SceneInfo, choice: StepChoice, control_period: float | None
) -> tuple[float, int]:
    """Return the control period, s, and the number of periods; without one, that of a fixed step.

    A control period may be longer than the run.
    """
    if choice.h:
        hold = min(as_period(control_period, choice.h), max(choice.steps, 2))
        return hold * choice.h, -(-choice.steps // hold)
    if control_period is None:
        return 0.0, 0
    period = as_step_size(control_period, info.dtype, "control_period")
    return period, count_periods(choice.duration, period)


def _constant_or_table(
    model: CompiledModel, options: SimulationArguments, choice: StepChoice, hold: tuple[float, int]
) -> Array:
    """Return a copy of constant inputs, (nu,), or of a row for each control period, (periods, nu).

    hold: control period, s, and number of periods.
    """
    (period, periods), info = hold, model.info
    u = cut_to_periods(info, options, choice, hold)
    if isinstance(u, Mapping):
        u = model.arguments.inputs_by_name(u)
    rows = model.arguments.numbers(u, "u")
    if info.nu == 1 and rows.ndim < 2 and rows.size:
        rows = rows.reshape((-1, 1) if rows.size > 1 else 1)
    rows = model.arguments.array(rows, "u", info.nu)
    if rows.ndim == 1:
        return rows.copy()
    if not period:
        raise ValueError(
            f"u: shape {np.shape(u)}, expected ({info.nu},): one value an input; rows, each "
            "constant over a control period, take control_period=, in s"
        )
    if len(rows) != periods:
        if not choice.h:
            raise ValueError(
                f"u: {len(rows)} rows for {periods} control periods of {period:g} s: give a row "
                f"each, or duration={len(rows) * period:g}"
            )
        steps = round(period / choice.h)
        what = "step" if steps == 1 else f"control period of {steps} steps"
        raise ValueError(
            f"u: {len(rows)} rows for {choice.steps} steps: give one row a {what}, or the "
            "duration= or steps= that the rows cover"
        )
    return rows.copy()


def count_periods(span: float, period: float) -> int:
    """Return the number of control periods, at least 1, that begin within a time span.

    The last period may be shorter. span, period: in s.
    """
    return max(whole_steps(span, period), 1)


def period_end(k: int, t0: float, period: float, dtype: np.dtype[Any]) -> float:
    """Return the end time of control period k, s, rounded to the module's number type `dtype`.

    t0: start of the run, s; the first period is k = 0.
    """
    return float(dtype.type(t0 + (k + 1) * period))


def cut_to_periods(
    info: SceneInfo, options: SimulationArguments, choice: StepChoice, hold: tuple[float, int],
    axis: int = 0,
) -> Any:  # fmt: skip
    """Return the inputs u; a table for the duration is cut if the last output time is earlier.

    hold: control period, s, and number of periods. axis: axis of the rows, 1 for a batch.
    """
    (period, periods), u, duration = hold, options.u, options.duration
    if u is None or options.times is None or duration is None or not period:
        return u
    if choice.h:
        whole = -(-step_count(info, choice.h, duration, None) // round(period / choice.h))
    else:
        whole = count_periods(as_number(duration, "duration"), period)
    return cut_table(u, info.nu, whole, periods, axis)


def table_of_steps(request: Request) -> Array:
    """Return the inputs of each fixed step, (steps, nu), in batches (batch or 1, steps, nu).

    A run that was interrupted may have fewer rows than periods; the last one applies then.
    """
    u, hold, steps = request.u, request.hold, request.steps
    if hold == 1 and u.shape[-2] >= steps:
        table: Array = u
        return table
    index = np.minimum(np.arange(steps) // hold, u.shape[-2] - 1)
    return np.ascontiguousarray(u[..., index, :])


class InputSchedule:
    """Inputs of a run in progress that are constant over control periods.

    request: the run. Its inputs are a function u(t, q, qd), or a row for each period.

    Attributes
    ----------
    current : (nu,) array
        Present inputs.
    count : int
        Number of periods that have begun.
    """

    def __init__(self, model: CompiledModel, request: Request) -> None:
        self.model, self.request, self.count = model, request, 0
        self.current: Any = None
        shape = max(request.periods, 1), model.info.nu
        self.stored = np.empty(shape, model.info.dtype) if callable(request.u) else None

    def next(self, t: float, q: Array, qd: Array) -> None:
        """Set the inputs of the period that begins at time t, s, with the state q, qd."""
        k, request = self.count, self.request
        if self.stored is not None:
            self.current = evaluate_law(request.u, self.model.arguments.inputs, t, q, qd)
            self.stored[k] = self.current
        else:  # a run that was interrupted has fewer rows than periods
            self.current = request.u[min(k, len(request.u) - 1)]
        self.count += 1

    @property
    def end(self) -> float:
        """End of the present period, s, as C takes it."""
        request, dtype = self.request, self.model.info.dtype
        if self.count >= request.periods:
            return request.t_end
        end = period_end(self.count - 1, request.t0, request.period, dtype)
        return min(end, request.t_end)

    @property
    def values(self) -> Array | None:
        """Values of the function in the periods so far, (count, nu); None for a table."""
        if self.stored is None or self.count == len(self.stored):
            return self.stored
        return self.stored[: self.count].copy()
