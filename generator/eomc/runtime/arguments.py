"""Checks of the arguments of a compiled scene and their conversion to arguments of C.

Wrong shapes, unknown names and numbers that are not finite raise ValueError with the name of the
argument.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from math import isfinite
from typing import Any, NoReturn

import numpy as np
from numpy import empty, ndarray
from numpy.typing import ArrayLike, NDArray

from .info import CLibrary, SceneInfo
from .package import initial_value_message, reduced, suggestion

Array = NDArray[Any]
Start = ArrayLike | Mapping[str, ArrayLike] | None  # positions or velocities, also by name
Parameters = Mapping[str, float] | Sequence[float] | Array | None

_MAX_LIST_NUMBERS = 32  # below this size Python checks numbers faster than NumPy


class Params:
    """Parameters of a scene by name, with the scene's values as defaults.

    Each parameter is an attribute: `p = Params(m_c=3.0); p.m_c = 4.0`. Raises ValueError for
    values that are not finite numbers and for unknown names.
    """

    _names: tuple[str, ...] = ()
    _defaults: tuple[float, ...] = ()
    _dtype = "float64"
    __slots__ = ("_array",)  # a parameter's name begins with a letter
    _array: Array

    def __init__(self, /, **values: float) -> None:
        object.__setattr__(self, "_array", np.array(self._defaults, self._dtype))
        for name, value in values.items():
            setattr(self, name, value)

    def __getattr__(self, name: str) -> float:
        if name not in self._names:
            raise AttributeError(not_one_of("params", name, self._names))
        return float(self._array[self._names.index(name)])

    def __setattr__(self, name: str, value: float) -> None:
        set_parameter(self._array, self._names, name, value)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __reduce__(self) -> tuple[Any, ...]:
        # also used by copy
        return reduced(
            "_model.arguments.create_params", dict(zip(self._names, self._values(), strict=True))
        )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Params):
            return NotImplemented
        return self._names == other._names and self._values() == other._values()

    __hash__ = None  # type: ignore[assignment]  # values may be changed

    def _values(self) -> list[float]:
        values: list[float] = self._array.tolist()
        return values

    def __repr__(self) -> str:
        both = zip(self._names, self._array, strict=True)
        return in_a_line("Params(", [f"{n}={v:g}" for n, v in both], ")")


def set_parameter(values: Array, names: tuple[str, ...], name: str, value: Any) -> None:
    """Set the value of a parameter in an array of all values.

    Raises ValueError for an unknown name, or a value that is not a finite number.
    """
    place = index_of("params", name, names)
    if not isinstance(value, str) and np.ndim(value) == 1:
        raise ValueError(
            f"params: {name}: {value!r} is not a number: one each is for many states, as in "
            "simulate_batch"
        )
    values[place] = as_number(value, f"params: {name}")


class Arguments:
    """Conversion of the arguments of a compiled scene to arrays and pointers for C.

    info: facts about the scene. c: its compiled functions.

    Attributes
    ----------
    places : dict
        Index of each parameter, by name.
    default_pointers : tuple
        Pointers to the positions, velocities and parameters of the scene.
    Params : type
        Class of the scene's parameters, a subclass of `Params`.
    """

    def __init__(self, info: SceneInfo, c: CLibrary) -> None:
        self.info, self.c, self.dtype, self.nq = info, c, info.dtype, info.nq
        # shape of a state that is small enough for lists of numbers
        self.small_shape = (info.nq,) if info.nq <= _MAX_LIST_NUMBERS else None
        self.places = {name: k for k, name in enumerate(info.parameters)}
        self.default_pointers = tuple(c.pointer(x) for x in (*info.initial_state, info.p0))
        names = {
            "_names": info.parameters,
            "_defaults": tuple(info.defaults.values()),
            "_dtype": info.dtype.name,
            "__module__": str(__package__).rpartition(".")[0],  # where pickle finds the class
        }
        self.Params: Any = type("Params", (Params,), {**names, "__slots__": ()})

    def create_params(self, values: Mapping[str, float]) -> Any:
        """Return `Params` with these values by name; an unpickled `Params` is created by it."""
        return self.Params(**values)

    def input_pointers(self, u: Any, params: Any) -> tuple[Any, Any]:
        """Return the pointers to inputs and parameters."""
        inputs = self.c.null if u is None else self.c.pointer(self.inputs(u))
        return inputs, self.default_pointers[2] if params is None else self.c.pointer(
            self.parameters(params)
        )

    def as_list(self, x: Any, shape: tuple[int | None, ...] | None) -> Any:
        """Return x as a list, which C takes fastest; None if x needs further checks."""
        if type(x) is ndarray and x.dtype is self.dtype and x.shape == shape:
            numbers = x.tolist()
            if isfinite(sum(numbers)):  # is quickest; it may overflow all the same
                return numbers
        return None

    def read_state(self, q: Any, qd: Any, many: bool = True) -> tuple[Any, Any, Array, Array]:
        """Return what C reads q and qd from, of one or many states, and q and qd as arrays."""
        if (
            type(q) is type(qd) is ndarray and q.shape == qd.shape == self.small_shape
            and q.dtype is qd.dtype is self.dtype
        ):  # fmt: skip
            from_q, from_qd = q.tolist(), qd.tolist()
            if isfinite(sum(from_q) + sum(from_qd)):
                return from_q, from_qd, q, qd
        at, moving = self.state(q, qd, many)
        return self.c.pointer(at), self.c.pointer(moving), at, moving

    def numbers(self, value: ArrayLike, name: str) -> Array:
        """Return a C-contiguous, aligned array of the module's precision, of any shape."""
        return aligned(np.ascontiguousarray(as_numbers(value, name, self.dtype, self._remedy)))

    def _remedy(self, value: Any, name: str) -> str:
        """Return a remedy for a value that is not an array of numbers, as the end of a message."""
        parts = value if isinstance(value, (list, tuple)) else [value]
        if callable(value) and name == "u":
            return ": give what it returns, u(t, q, qd); runs alone call functions"
        if name[0] == "u" and any(map(callable, parts)):
            return ": one function u(t, q, qd) gives all inputs, in order or as a dict"
        order = f": give them in order, {', '.join(self.info.coordinates)}"
        return order if isinstance(value, Mapping) else ""

    def array(self, value: ArrayLike, name: str, width: int, many: bool = True) -> Array:
        """Return an array of finite numbers, (width,), or also (n, width) if `many`."""
        if type(value) is ndarray and value.dtype is self.dtype and value.flags.carray:
            array = value  # C-contiguous, aligned and, which need not be, writeable
        else:
            array = self.numbers(value, name)
        if array.shape[-1:] != (width,) or array.ndim > 1 + many:
            description = f"shape {np.shape(value)}" if np.ndim(value) else repr(value)
            rates = array.shape == (2 * self.nq,) and name in ("q", "q0")
            raise ValueError(
                f"{name}: {description}, expected ({width},){f' or (n, {width})' * many}: "
                f"{', '.join(self.info.inputs if name == 'u' else self.info.coordinates)}"
                f"{'; velocities go to qd' + name[1:] if rates else ''}"
            )
        if array.size <= _MAX_LIST_NUMBERS and isfinite(sum(array.ravel().tolist())):
            return array  # of few numbers the sum is quickest; it may overflow all the same
        if not np.isfinite(array).all():
            if array.ndim == 1:
                raise ValueError(f"{name}: {np.array2string(array, threshold=20)} is not finite")
            place = np.argwhere(~np.isfinite(array))[0].tolist()
            raise ValueError(f"{name}{place}: {array[tuple(place)]} in {self.dtype} is not finite")
        return array

    def state(self, q: ArrayLike, qd: ArrayLike, many: bool = True) -> tuple[Array, Array]:
        """Return positions and velocities as arrays of the same shape, (nq,) or (n, nq)."""
        at, moving = (self.array(x, n, self.nq, many) for x, n in ((q, "q"), (qd, "qd")))
        if at.shape != moving.shape:
            raise ValueError(f"qd: shape {moving.shape} with q of shape {at.shape}")
        return at, moving

    def initial_half(self, x0: Any, name: str) -> Array:
        """Return q0 or qd0 as an array (nq,), which may be the caller's."""
        if self.as_list(x0, self.small_shape) is not None:
            array: Array = x0
            return array
        x = self.numbers(x0, name)
        if x.ndim == 2 and x.shape[1] == self.nq:
            raise ValueError(
                f"{name}: shape {x.shape}, expected one state, ({self.nq},): "
                f"{', '.join(self.info.coordinates)}; simulate_batch takes many"
            )
        return self.array(x0, name, self.nq, many=False)

    def parameters(self, params: Any) -> Array:
        """Return all parameters as an array (np,): the given values, else those of the scene."""
        if params is None:
            return self.info.p0
        values: Array
        if type(params) is not dict:
            if isinstance(params, self.Params):
                values = params._array
                return values
            if hasattr(params, "_names"):  # Params of another module
                raise ValueError(f"params: these are another scene's: {', '.join(params._names)}")
        if type(params) is dict or isinstance(params, Mapping):
            values = self.info.p0.copy()
            for key, value in params.items():
                name = key if type(key) is str else name_of(key)
                k = self.places.get(name)
                if k is not None and type(value) is float and isfinite(value):
                    values[k] = value
                elif name in self.info.coordinates:
                    raise ValueError(f"params: {initial_value_message(self, name)}")
                else:
                    set_parameter(values, self.info.parameters, name, value)
            return values
        without_mask(params, "params")
        try:
            array = self.numbers(params, "params")
        except ValueError:
            array = empty(0, self.dtype)
        if array.shape != self.info.p0.shape or not np.isfinite(array).all():
            if not self.info.parameters:
                raise ValueError("params: this scene has no parameters")
            raise ValueError(
                f"params: expected a dict, Params or {len(self.info.p0)} finite numbers in the "
                "order "
                f"{', '.join(self.info.parameters)}"
            )
        return array

    def parameter_rows(self, params: Any) -> Array:
        """Return parameters of many states or instances, (n, np), or (1, np) if they are equal."""
        if params is None or isinstance(params, Params):
            return self.parameters(params)[None]
        if isinstance(params, (list, tuple)) and any(isinstance(p, Mapping) for p in params):
            raise ValueError('params: give one dict of arrays, {"m": [1, 2]}, no list of dicts')
        if not isinstance(params, Mapping):
            array = self.numbers(params, "params")
            if array.ndim == 2 and array.shape[1] == len(self.info.parameters):
                return _finite(array, "params: not all numbers are finite: {}")
            return self.parameters(params)[None]
        params = by_name(params)
        sizes = {name: np.size(value) for name, value in params.items() if np.ndim(value)}
        count = max(sizes.values(), default=1)
        table = np.tile(self.info.p0, (count, 1))
        for name, value in params.items():
            if name not in self.info.parameters:
                self.parameters({name: 0.0})  # raises, with the names there are
            column = self.numbers(value, f"params: {name}")
            if np.ndim(value) > 1 or (np.ndim(value) and len(column) != count):
                raise ValueError(f"params: {name} has shape {column.shape}, expected ({count},)")
            words = f"params: {name} is not finite everywhere: {{}}"
            table[:, self.info.parameters.index(name)] = _finite(column, words)
        return table

    def inputs(self, u: Any, many: bool = False) -> Array | None:
        """Return inputs (nu,), or also (n, nu) if `many`; None for the scene's signals."""
        if u is None:
            return None
        if not self.info.nu:
            raise ValueError("u: this scene has no inputs")
        if type(u) is not ndarray and isinstance(u, Mapping):
            u = self.inputs_by_name(u)
        u = u.reshape(1) if type(u) is ndarray and not u.ndim else u
        return self.array(u, "u", self.info.nu, many)

    def inputs_by_name(self, u: Mapping[Any, Any]) -> Array:
        """Return inputs from a dict by name as an array, (..., nu).

        All inputs are required: inputs that are constant over a step cannot be mixed with signals,
        which are evaluated within it.
        """
        u = by_name(u)
        as_names("u", u, self.info.inputs)
        if missing := [name for name in self.info.inputs if name not in u]:
            raise ValueError(
                f"u: no value for {', '.join(missing)}: give all inputs, or None for the signals "
                "of the scene"
            )
        columns = [self.numbers(u[name], f"u: {name}") for name in self.info.inputs]
        shapes = [np.shape(u[name]) for name in self.info.inputs]
        most = max(map(len, shapes))
        lined = [  # (batch,) beside (batch, steps) is one number a row
            c.reshape(shape + (1,) * (most - len(shape) if shape else 0))
            for c, shape in zip(columns, shapes, strict=True)
        ]
        try:
            return np.stack(np.broadcast_arrays(*lined), axis=-1)
        except ValueError:
            both = zip(self.info.inputs, shapes, strict=True)
            shown = ", ".join(f"{name} has shape {shape}" for name, shape in both)
            raise ValueError(f"u: {shown}") from None

    def for_each_state(
        self, x: ArrayLike, name: str, shape: tuple[int, ...], q: ArrayLike
    ) -> Array:
        """Return x as an array with a row for each state; one row is repeated for all."""
        array, rows = self.numbers(x, name), np.shape(q)[:-1]
        expected = rows + shape
        if array.shape not in (expected, shape):
            raise ValueError(f"{name}: shape {array.shape}, expected {expected}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: not all numbers are finite")
        full = np.broadcast_to(array, expected).reshape(*rows, -1)
        return np.ascontiguousarray(full)

    def output_array(self, out: Any, shape: tuple[int, ...], name: str = "out") -> Array:
        """Return the array `out` of the user if it fits, or a new one if it is None."""
        if out is None:
            return empty(shape, self.dtype)
        without_mask(out, name)
        good = isinstance(out, np.ndarray) and out.dtype == self.dtype and out.flags.carray
        if not good or out.shape != shape:
            raise ValueError(
                f"{name}: expected a writeable, aligned, C-contiguous array of {self.dtype}, "
                f"shape {shape}"
            )
        array: Array = out
        return array

    def check_writable(self, x: Array, name: str) -> None:
        """Raise ValueError unless C can overwrite these states in place."""
        description = f"a {type(x).__name__}"
        if isinstance(without_mask(x, name), np.ndarray):
            right, flags = x.dtype == self.dtype and x.shape[1:] == (self.nq,), x.flags
            if right and flags.carray:
                return
            order = "" if flags.c_contiguous else ", not C-contiguous"
            order += "" if flags.aligned else ", not aligned"
            order += "" if flags.writeable else ", read-only"
            description = f"an array of {x.dtype}, shape {x.shape}{order}"
        raise ValueError(
            f"{name}: {description}; moved in place, it has to be a writeable, C-contiguous array "
            f"of {self.dtype}, shape (n, {self.nq}): make it one with numpy.require(x, "
            f"'{self.dtype}', 'CAW'), or give out=, a pair of such arrays for the result"
        )

    def output_pair(self, out: Any, shape: tuple[int, ...]) -> tuple[Array, Array]:
        """Return arrays for positions and velocities: those of `out`, or new ones."""
        if out is None:
            return empty(shape, self.dtype), empty(shape, self.dtype)
        if not isinstance(out, (tuple, list)) or len(out) != 2:
            raise ValueError("out: expected a pair of arrays, (q, qd)")
        q, qd = (self.output_array(x, shape, f"out[{k}]") for k, x in enumerate(out))
        return q, qd

    def output_matrices(self, out: Any, names: str, q: Array, qd: Array) -> tuple[Array, Array]:
        """Return arrays (2 nq, 2 nq) and (2 nq, nu) of each state: those of `out`, or new ones."""
        shape = (*q.shape[:-1], 2 * self.nq)
        if not (out is None or (isinstance(out, (tuple, list)) and len(out) == 2)):
            raise ValueError(f"out: expected a pair of arrays, {names}")
        first, second = (None, None) if out is None else out
        A = self.output_array(first, (*shape, 2 * self.nq), "out[0]")
        B = self.output_array(second, (*shape, self.info.nu), "out[1]")
        if out is not None and any(
            np.may_share_memory(*pair) for pair in ((A, B), (A, q), (A, qd), (B, q), (B, qd))
        ):
            raise ValueError("out: its arrays overlap each other or the state")
        return A, B


class StateArguments:
    """Time, inputs and parameters of one or many states, checked and converted for C.

    Each of these three arguments may be the same for all states or differ between them.

    Parameters
    ----------
    rows : tuple of int
        Shape of the states without the coordinate axis: () for one state, (n,) for n states.
    t : float or (n,) array
        Times, s.
    u : (nu,) or (n, nu) array, dict or None
        Inputs; None: the scene's signals (formulas for the inputs).
    params : dict, Params, array or None
        Parameters; None: those of the scene.
    replacement : (width,) or (n, width) array, optional
        Numbers that are passed to C in place of the inputs.

    Attributes
    ----------
    u_rows : (nu,) or (n, nu) array or None
        The checked inputs; None: the scene's signals.

    Raises
    ------
    ValueError
        If an argument is invalid.
    """

    def __init__(
        self, arguments: Arguments, rows: tuple[int, ...], t: Any, u: Any, params: Any,
        replacement: Array | None = None,
    ) -> None:  # fmt: skip
        address, real, null = arguments.c.tools
        self.t, self.own, self.u_rows = 0.0, null, None
        self.times = row_times(arguments, t, rows)
        if self.times is None:
            self.t = as_number(t, "t")
        if u is not None:
            self.u_rows = arguments.inputs(u, many=bool(rows))
            if self.u_rows is not None and self.u_rows.ndim == 2:
                _check_rows("u", self.u_rows.shape, (*rows, arguments.info.nu))
        inputs = self.u_rows if replacement is None else replacement
        self.u = null if inputs is None else address(real, inputs)
        u_stride = inputs.shape[-1] if inputs is not None and inputs.ndim == 2 else 0
        p_stride = 0
        if rows and isinstance(params, Mapping):
            params = by_name(params)
            for name in [name for name, value in params.items() if np.ndim(value)]:
                without_mask(params[name], f"params: {name}")
                _check_rows(f"params: {name}", np.shape(params[name]), rows)
                p_stride = len(arguments.info.parameters)
        elif rows and isinstance(params, ndarray) and params.ndim == 2:
            _check_rows("params", params.shape, (*rows, len(arguments.info.parameters)))
            p_stride = len(arguments.info.parameters)
        table = arguments.parameter_rows(params) if p_stride else arguments.parameters(params)
        self.p = address(real, table)
        self._arrays = inputs, table  # C reads them
        if self.times is not None or u_stride or p_stride:
            self.own = arguments.c.ffi.new("row_strides *", {"u": u_stride, "p": p_stride})
            self._from_t = null if self.times is None else address(real, self.times)

    def time(self, k: int) -> float:
        """Return the time of state k, s."""
        return self.t if self.times is None else float(self.times[k])

    def pointers(self, k: int) -> tuple[float, Any, Any, Any]:
        """Return the arguments of a C function that evaluates the states from number k on.

        The result is (t, u, p, strides):
        t: the common time of the states, s.
        u, p: pointers to the inputs and to the parameters of state k.
        strides: pointer to a struct that says which of the three differ between states; NULL if
        none does. If the times differ, the struct contains them.
        """
        if not self.own:
            return self.t, self.u, self.p, self.own
        if self.times is not None:
            self.own.t = self._from_t + k
        u = self.u + self.own.u * k if self.own.u else self.u
        return self.t, u, self.p + self.own.p * k, self.own


def row_times(arguments: Arguments, t: Any, rows: tuple[int, ...]) -> Array | None:
    """Return the times of many states as an array (n,), s, or None if t is a single number.

    t: the caller's time or times. rows: shape of the states without the coordinate axis, () for one
    state and (n,) for n states. Raises ValueError if t is an array of another shape than `rows`, or
    is not finite.
    """
    if not (rows and np.ndim(t)):
        return None
    without_mask(t, "t")
    if np.shape(t) != rows:
        raise ValueError(f"t: shape {np.shape(t)}, expected one number or {rows}")
    return _finite(arguments.numbers(t, "t"), "t: {} is not a finite number")


def _check_rows(name: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if shape != expected:
        raise ValueError(f"{name}: shape {shape}, expected {expected} for {expected[0]} states")


def _finite(array: Array, words: str) -> Array:
    """Return the array; raise ValueError with the place of a number that is not finite."""
    if not np.isfinite(array).all():
        place = np.argwhere(~np.isfinite(array))[0].tolist()
        number = array[tuple(place)]
        raise ValueError(f"{words.format(number)}" + (f", at {place}" if place else ""))
    return array


def as_numbers(
    value: Any, name: str, dtype: np.dtype[Any], remedy: Callable[[Any, str], str] | None = None
) -> Array:
    """Convert a value of any shape to a C-contiguous array of type `dtype`.

    Raises ValueError, which begins with the argument's `name` and ends with remedy(value, name), if
    the value is not numeric.
    """
    if not isinstance(value, list):
        without_mask(value, name)
    try:
        array = np.asarray(value)
        if array.dtype.kind in "cUSmM":  # text that looks like a number is none
            raise TypeError
        return np.asarray(array, dtype, order="C")
    except (TypeError, ValueError, OverflowError):
        end = remedy(value, name) if remedy else ""
        raise ValueError(f"{name}: {value!r} is not an array of numbers{end}") from None


def by_name(values: Mapping[Any, Any]) -> dict[str, Any]:
    """Return a dict with the same values whose keys are strings.

    A key may also be a SymPy symbol or a SymPy function of time, whose name becomes the key.
    """
    return {k if type(k) is str else name_of(k): x for k, x in values.items()}


def name_of(key: Any) -> str:
    """Return the name of a SymPy symbol or function, or any other key as text."""
    return str(getattr(key, "name", key))


def without_mask(value: Any, name: str) -> Any:
    """Return the value unchanged; raise ValueError if it is a NumPy array with masked numbers.

    name: name of the argument, for the message.
    """
    ma: Any = sys.modules.get("numpy.ma")  # NumPy imports it on first use
    masked = getattr(ma, "MaskedArray", ())  # another thread may be importing it
    if isinstance(value, masked) and ma.is_masked(value):
        raise ValueError(
            f"{name}: {ma.count_masked(value)} of {value.size} numbers are masked: "
            "fill them in first, with .filled(...), or leave these rows out"
        )
    return value


def as_number(value: Any, name: str) -> float:
    """Return the value as a float; raise ValueError if it is not a finite number.

    name: name of the argument, for the message.
    """
    if type(value) is float and isfinite(value):
        return value
    try:
        number = float("x" if isinstance(value, (str, bytes)) else value)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: {value!r} is not a number") from None
    except OverflowError:  # a whole number
        number = float("inf")
    if not isfinite(number):
        raise ValueError(f"{name}: {value!r} is not a finite number")
    return number


def as_step_size(h: Any, dtype: np.dtype[Any], name: str = "h") -> float:
    """Return a step size or period h as a float, s.

    Raises ValueError, which begins with the argument's `name`, unless h is a positive number in the
    range of the module's number type `dtype`.
    """
    if type(h) is float and 1e-37 < h < 1e37:  # in single precision too
        return h
    size = as_number(h, name)
    limits = np.finfo(dtype)
    if not limits.smallest_subnormal <= size <= limits.max:
        why = "" if size <= 0 else f" in {dtype}"
        what = "period" if name == "control_period" else "step size"
        raise ValueError(
            f"{name}: {size:g} is not a {what}{why}: give a number of seconds greater than 0"
        )
    return size


def cut_table(u: Any, nu: int, whole: int, count: int, axis: int = 0) -> Any:
    """Shorten a table of inputs over time from `whole` rows to its first `count` rows.

    Return u unchanged if it is not a table with `whole` rows, or if whole <= count.

    Parameters
    ----------
    u : array_like, dict, callable or None
        The argument u of a simulation. In a dict, which contains a table for each input by name,
        all tables are shortened.
    nu : int
        Number of inputs, which is the length of the table's last axis. 0: the table has no such
        axis, as is the case for the table of one input in a dict.
    whole, count : int
        Numbers of rows before and after.
    axis : int
        Axis of the rows: 0 for a single run, 1 for a batch, whose axis 0 is the instance.
    """
    if u is None or callable(u) or whole <= count:
        return u
    if isinstance(u, Mapping):
        return {name: cut_table(x, 0, whole, count, axis) for name, x in u.items()}
    try:
        shape = np.shape(u)
    except ValueError:  # no array; a later check raises an error
        return u
    column = nu == 0 or (nu == 1 and axis == 0)  # values of one input
    if len(shape) not in ({axis + 1} if nu == 0 else {axis + 2, axis + 2 - column}):
        return u
    if shape[axis] != whole:
        return u
    rows = u if isinstance(u, ndarray) else np.asarray(u)
    return rows[:, :count] if axis else rows[:count]


def check_time(dtype: np.dtype[Any], t0: float, span: float, h: float | None = None) -> None:
    """Raise ValueError if floating-point numbers are too coarse for the times of a run.

    This is the case if the steps are too short compared with the times. dtype: number type of the
    module. t0: start of the run, s. span: duration of the run, s. h: size of fixed steps, s; None:
    adaptive steps.
    """
    min_times = 256  # floating-point times within an adaptive run
    least = math.ulp(abs(t0) + abs(span))
    if dtype.itemsize == 4:
        with np.errstate(over="ignore", invalid="ignore"):
            least = float(np.spacing(dtype.type(abs(t0) + abs(span))))
    least = least if least < math.inf else math.inf
    if span and h is not None and h < least:
        raise ValueError(
            f"h: {h:g} s is less than what time resolves at {t0 + span:g} s, {least:.2g} s: take "
            "a smaller t0, or a larger h"
        )
    if span and h is None and not abs(span) >= min_times * least:
        raise ValueError(
            f"t0: time resolves {least:.2g} s at {t0 + span:g} s, which is too coarse for steps "
            f"within {span:g} s: take a smaller t0, or a longer duration"
        )


def as_period(period: Any, h: float) -> int:
    """Return the number of fixed steps of size h in a control period.

    period: control period, s; None: one step. Raises ValueError if the period is not a whole
    number of steps.
    """
    if period is None:
        return 1
    count = as_number(period, "control_period") / h
    whole = max(round(count), 1) if isfinite(count) else 1
    if abs(count - whole) > 1e-6 * whole:
        raise ValueError(
            f"control_period: {period:g} s is {count:.6g} steps of h = {h:g} s: give a whole "
            f"number of steps, such as {whole * h:.6g}, or another h"
        )
    return whole


def aligned(array: Array) -> Array:
    """Return the array itself if its memory is aligned for C, else a copy."""
    return array if array.flags.aligned else array.copy()


def as_flag(value: Any, name: str) -> bool:
    """Return a Python or NumPy bool as a Python bool.

    Raises ValueError, which begins with the argument's `name`, for values of other types.
    """
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    raise ValueError(f"{name}: {value!r} is not True or False")


def as_count(value: Any, name: str, least: int) -> int:
    """Return the value as an int; raise ValueError unless it is a whole number >= least.

    name: name of the argument, for the message.
    """
    if type(value) is int and value >= least:
        return value
    number = as_number(value, name)
    if number != int(number) or number < least:
        raise ValueError(f"{name}: {value!r} is not a whole number, {least} or more")
    return int(number)


@cache
def machine_memory() -> float:
    """Return the physical memory of the machine in bytes; inf if it is unknown.

    An allocation of more than this may still succeed, as systems reserve memory at first use.
    """
    if sys.platform == "win32":
        return float("inf")
    try:
        return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return float("inf")


def not_one_of(argument: str, name: str, known: Sequence[str]) -> str:
    """Return the error message for an unknown `name` that a user gave.

    argument: name of the function's argument in which the user gave `name`. known: the allowed
    names; the message lists them and suggests a similar one.
    """
    if not known:
        return f"{argument}: there is no '{name}': this scene has none"
    return f"{argument}: '{name}' is not one of {', '.join(known)}{suggestion(name, known)}"


def index_of(argument: str, name: Any, known: Sequence[str]) -> int:
    """Return the index of a name in a sequence; raise ValueError, as `not_one_of`, without it."""
    if name not in known:
        raise ValueError(not_one_of(argument, str(name), known))
    return known.index(name)


def as_names(argument: str, names: Any, known: Sequence[str]) -> tuple[str, ...]:
    """Return names as a tuple; a str is one name. Raises ValueError for names that are not known.

    argument: name of the function's argument, for the message.
    """
    if isinstance(names, str):
        names = (names,)
    if not isinstance(names, Iterable):
        raise ValueError(f"{argument}: {names!r} is no list of names: {', '.join(known)}")
    result: tuple[str, ...] = tuple(names)
    for name in result:
        index_of(argument, name, known)
    return result


def in_a_line(start: str, parts: Sequence[str], end: str, width: int = 80) -> str:
    """Join `start`, the comma-separated `parts` and `end` to one line of text.

    width: maximum number of characters. If the parts do not fit, the last ones are replaced by
    "... N more".
    """
    whole = start + ", ".join(parts) + end
    if len(whole) <= width:
        return whole
    used, room = 0, width - len(f"{start}..., {len(parts)} more{end}")
    while used < len(parts) and (room := room - len(parts[used]) - 2) >= 0:
        used += 1
    return f"{start}{', '.join([*parts[:used], f'... {len(parts) - used} more'])}{end}"


class ByName(dict[str, Any]):
    """Dict of values by name, whose KeyError for an unknown name lists the known names.

    Parameters
    ----------
    what : str
        What the dict contains, such as "events"; part of the error message.
    names : sequence of str
        The known names.
    values : iterable
        One value for each name.
    """

    def __init__(self, what: str, names: Sequence[str], values: Iterable[Any]) -> None:
        super().__init__(zip(names, values, strict=True))
        self.what = what

    def __missing__(self, name: object) -> NoReturn:
        raise KeyError(not_one_of(self.what, str(name), tuple(self)))

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)
