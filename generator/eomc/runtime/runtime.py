"""What every compiled scene offers in Python: arrays in, arrays out, the loop in C.

This file is copied beside each compiled extension, so that a built scene needs NumPy and cffi
only. Shapes: q, qd (nq,) or (n, nq); then results have a leading n as well. Angles in rad,
everything in SI units. Wrong shapes, unknown names and numbers that are not finite raise
ValueError with the name of the argument.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from functools import cached_property
from math import ceil, isfinite
from time import perf_counter
from typing import Any

import numpy as np
from numpy import empty, ndarray
from numpy.typing import ArrayLike, NDArray

from .estimate import Estimate, advice, estimate
from .package import Defaults, reduced
from .slices import longer, slices

Array = NDArray[Any]
Parameters = Mapping[str, float] | Sequence[float] | Array | None
Inputs = ArrayLike | Callable[[float, Array, Array], ArrayLike] | None

STATUS = ("ok", "singular", "not finite", "no convergence")
_SAID = {
    "singular": "D is not positive definite there, so no acceleration exists",
    "not finite": "the state would no longer be finite: the step may be too long, "
    "or the motion runs into a singularity",
    "no convergence": "the iteration for the step does not converge: take a smaller h",
    "interrupted": "interrupted",
}
_LEFT_OUT = "u was a function, which a pickled run doesn't keep: simulate again"
_OF_POSITION = ("D", "g", "potential_energy")
_MANY = 1000  # steps from which a look at the stability limit is worth its time
_LARGE = 2**24  # positions from which a look at the memory is worth its time
_FEW = 32  # numbers that Python looks at sooner than NumPy
_CHUNK = 16_384  # steps times coordinates before the first look, some ms
_ROWS = 20_000  # rows times coordinates squared in one call, some ms at most
_RARELY = 2**48  # steps from row to row, more than any run makes
_MOST = 2**60  # steps, so that C can return four times as many


class MotionError(ArithmeticError):
    """There is no acceleration or step at a state; `status` says why, as that of a run."""

    def __init__(self, message: str, status: str) -> None:
        super().__init__(message)
        self.status = status

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("runtime.MotionError", str(self), self.status)


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a simulation; `run` holds what was done until then."""

    def __init__(self, run: Any) -> None:
        super().__init__(run.message)
        self.run = run

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("runtime.Interrupted", self.run)


class _Half:
    """q or qd of a run: a half of its rows, made when it is first asked for, and kept."""

    def __init__(self, index: int) -> None:
        self.index = index

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, run: Run | None, owner: type) -> Array:
        if run is None:
            return self  # type: ignore[return-value]  # on the class, as for help()
        half: Array = run._rows[self.index]
        run.__dict__[self.name] = half
        return half


class Run:
    """A trajectory: t (n,), q (n, nq), qd (n, nq), status.

    status: "ok", "singular", "not finite", "no convergence" or "interrupted"; a run that is not ok
    ends with its last good state, and `message` says where and why. energy (n,): K + P, computed
    when it is asked for; `steps` were done by `method`, of size h, and a row kept of `every` so
    many. evaluations: of accelerations. error: an Estimate, where it was asked for.

    Runs are equal where their scene, settings and rows are, bit by bit. A pickled run keeps all of
    that, its parameters and its inputs, but not a u that is a function: estimate() is refused then.
    Where it is read again, it finds the built module as it was found here.
    """

    q, qd = _Half(0), _Half(1)
    error: Estimate | None = None
    _energy: Array | None = None

    def __init__(
        self, model: Model, t0: float, rows: Array | tuple[Array, Array], h: float, steps: int,
        status: str, params: Array, every: int, u: Any, method: str, evaluations: int,
    ) -> None:  # fmt: skip
        """rows: q and qd, in one array (2, n, nq) or two."""
        self.t0 = t0
        self.h = h
        self.steps = steps
        self.status = status
        self.every = every
        self.method = method
        self.evaluations = evaluations
        self._model = model
        self._rows = rows
        self._params = params
        self._u = u

    @cached_property
    def t(self) -> Array:
        """The times of the rows, (n,), s."""
        return self.t0 + self.h * np.minimum(self.every * np.arange(len(self.q)), self.steps)

    @property
    def energy(self) -> Array:
        """K + P along the run, (n,), J."""
        if self._energy is None:
            self._energy = self._values("energy")
        return self._energy

    @property
    def jacobi(self) -> Array:
        """qd.dK/dqd - K + P along the run, (n,), J: the energy, where K is purely quadratic."""
        return self._values("jacobi")

    def _values(self, name: str) -> Array:
        function = getattr(self._model, name)
        values = [
            np.atleast_1d(function(q, qd, t=float(self.t[k]), params=self._params))
            for k, q, qd in self._model._by_time(name, self.t, self.q, self.qd)
        ]
        return np.concatenate(values)

    def estimate(self, progress: Callable[[int, int], None] | None = None) -> Estimate:
        """The run's own error, by doing it again in shorter steps; kept in `error`.

        Where u is a function, it is called again, as often as in the run for each finer one.
        Raises ValueError where the run was pickled and lost that function.
        """
        if isinstance(self._u, str):
            raise ValueError(f"estimate: {self._u}")
        try:
            self.error = estimate(self, progress)
        except KeyboardInterrupt:
            raise Interrupted(self) from None
        return self.error

    def _again(
        self, parts: int, every: int, nudge: Array | None,
        progress: Callable[[int, int], None] | None,
    ) -> Run:  # fmt: skip
        """The same motion in steps of h/parts, from a start moved by `nudge` (2 nq,)."""
        model, x = self._model, self.x[0]
        if nudge is not None:
            x = (x + nudge).astype(model.dtype)
        u = self._u
        if callable(u):
            u = _held(u, parts)
        elif u is not None and np.ndim(u) == 2:
            u = np.repeat(u[: self.steps], parts, axis=0)
        return model._trajectory(
            x[: model.nq], x[model.nq :], model._pointer(x[: model.nq]),
            model._pointer(x[model.nq :]), self.h / parts, self.steps * parts, every, u,
            self._params, model._pointer(self._params), self.method, float(self.t[0]), None,
            progress,
        )  # fmt: skip

    def _state(self) -> dict[str, Any]:
        """All but what is made when it is asked for."""
        made = ("t", "q", "qd")
        return {name: value for name, value in self.__dict__.items() if name not in made}

    @classmethod
    def _of_state(cls, state: dict[str, Any]) -> Run:
        run = cls.__new__(cls)
        run.__dict__.update(state)
        return run

    def __copy__(self) -> Run:
        return self._of_state(self._state())

    def __deepcopy__(self, memo: dict[int, Any]) -> Run:
        return self._of_state(deepcopy(self._state(), memo))

    def __reduce__(self) -> tuple[Any, ...]:
        state = self._state()
        if callable(self._u):
            state["_u"] = _LEFT_OUT
        return reduced("runtime.Run._of_state", state)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Run):
            return NotImplemented
        alike = self._settings() == other._settings()
        return alike and np.array_equal(self.q, other.q) and np.array_equal(self.qd, other.qd)

    __hash__ = None  # type: ignore[assignment]  # rows may be changed

    def _settings(self) -> tuple[Any, ...]:
        model = self._model
        return (
            model.name, model.digest, self.t0, self.h, self.steps, self.status, self.every,
            self.method, self._params.tolist(),
        )  # fmt: skip

    @property
    def x(self) -> Array:
        """The states [q; qd], (n, 2 nq)."""
        return np.hstack([self.q, self.qd])

    @property
    def message(self) -> str:
        """What happened, in a sentence."""
        if self.status == "ok":
            return f"{self.steps} steps of {self.h:g} s"
        return (
            f"stopped at t = {self.t[-1]:.9g} after {self.steps} steps of {self.h:g} s, "
            f"{_state_text(self.q[-1], self.qd[-1])}: {_SAID[self.status]}"
        )

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        return f"<Run of {self._model.name}: {self.message}>"


class Params:
    """A scene's parameters, by name: `p = Params(m_c=3.0); p.m_c = 4.0`. Made by the module."""

    _names: tuple[str, ...] = ()
    _defaults: tuple[float, ...] = ()
    _dtype = "float64"
    __slots__ = ("_array",)  # a parameter's name begins with a letter
    _array: Array

    def __init__(self, /, **values: float) -> None:
        object.__setattr__(self, "_array", np.array(self._defaults, self._dtype))
        for name, value in values.items():
            self._set(name, value)

    def _set(self, name: str, value: float) -> None:
        if name not in self._names:
            raise ValueError(_unknown("params", name, self._names))
        self._array[self._names.index(name)] = _number(value, f"params: {name}")

    def __getattr__(self, name: str) -> float:
        if name not in self._names:
            raise AttributeError(_unknown("params", name, self._names))
        return float(self._array[self._names.index(name)])

    def __setattr__(self, name: str, value: float) -> None:
        self._set(name, value)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __reduce__(self) -> tuple[Any, ...]:
        # a copy too goes this way
        return reduced("_model._made_params", dict(zip(self._names, self._values(), strict=True)))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Params):
            return NotImplemented
        return self._names == other._names and self._values() == other._values()

    __hash__ = None  # type: ignore[assignment]  # values may be changed

    def _values(self) -> list[float]:
        values: list[float] = self._array.tolist()
        return values

    def __repr__(self) -> str:
        inside = ", ".join(f"{n}={v:g}" for n, v in zip(self._names, self._array, strict=True))
        return f"Params({inside})"


class Model:
    """The functions of one compiled scene; the package hands them on under their own names."""

    def __init__(
        self, extension: Any, *, name: str, title: str, dtype: str,
        coordinates: Mapping[str, str], parameters: Mapping[str, float],
        inputs: Mapping[str, str], units: Mapping[str, str],
        start: tuple[Sequence[float], Sequence[float]], h: float, duration: float,
        timed: Sequence[str], methods: Mapping[str, tuple[int, int, float, float]], digest: str,
    ) -> None:  # fmt: skip
        """methods: order, stages and stability limits (h omega undamped, h lambda decaying)."""
        # thirty attributes at most: beside more of them CPython 3.11 looks up each the slow way
        self._ffi, self._lib = extension.ffi, extension.lib
        real = self._ffi.typeof({"float64": "double[]", "float32": "float[]"}[dtype])
        # what any call needs: address(real, array), and the address of nothing
        self._c = (self._ffi.from_buffer, real, self._ffi.NULL)
        self.name, self.title, self.digest = name, title, digest
        self.dtype = np.dtype(dtype)
        self.coordinates, self.inputs = tuple(coordinates), tuple(inputs)
        self.parameters = tuple(parameters)
        self.defaults = Defaults(parameters)
        self.units = dict(units)
        self.nq, self.nu = len(self.coordinates), len(self.inputs)
        self._shape = (self.nq,) if self.nq <= _FEW else None  # of a state that is soon looked at
        self.h, self.duration = h, duration
        self._start = (self._constant(start[0]), self._constant(start[1]))
        self._p0 = self._constant(tuple(parameters.values()))
        self._at = tuple(self._pointer(x) for x in (*self._start, self._p0))
        self._timed = frozenset(timed)
        self.methods = tuple(methods)
        self.orders = {name: order for name, (order, *_) in methods.items()}
        self.limits = {name: (turn, decay) for name, (_, _, turn, decay) in methods.items()}
        self._loops = {name: self._loop(name, stages) for name, (_, stages, *_) in methods.items()}
        self._warned: set[Any] = set()  # methods with a step size, and u
        names = {
            "_names": self.parameters,
            "_defaults": tuple(parameters.values()),
            "_dtype": dtype,
        }
        self.Params: Any = type("Params", (Params,), {**names, "__slots__": ()})

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("_model._again", self.digest)

    def _again(self, digest: str) -> Model:
        """Itself, found by a value that was pickled; a warning where the scene was another then."""
        if digest != self.digest:
            warnings.warn(
                f"{self.name}: this was pickled from another version of the scene; what is "
                "computed from it now is of the present version",
                RuntimeWarning,
                stacklevel=2,
            )
        return self

    def _made_params(self, values: Mapping[str, float]) -> Any:
        return self.Params(**values)

    @property
    def start(self) -> tuple[Array, Array]:
        """(q, qd) where the scene starts."""
        q, qd = self._start
        return q.copy(), qd.copy()

    # --- arguments -----------------------------------------------------------------------------

    def _loop(self, name: str, stages: int) -> tuple[Any, Any, int, int, Any, Any]:
        """A method's step and loop in C, steps at once, stages; what is kept and counted."""
        step, run = (getattr(self._lib, f"{name}_{what}") for what in ("step", "run"))
        work = self._ffi.typeof(f"{name}_work *")
        counted = getattr(self._lib, f"{name}_evaluations", None)
        short = -1 if counted else min(_MANY - 1, _CHUNK // self.nq)
        return step, run, short, stages, work, counted

    def _constant(self, values: Sequence[float]) -> Array:
        array = np.array(values, self.dtype)
        array.flags.writeable = False
        return array

    def _pointer(self, array: Array | None) -> Any:
        address, real, null = self._c
        return null if array is None else address(real, array)

    def _given(self, u: Any, params: Any) -> tuple[Any, Any]:
        """The addresses of inputs and parameters."""
        held = self._c[2] if u is None else self._pointer(self._inputs(u))
        return held, self._at[2] if params is None else self._pointer(self._parameters(params))

    def _listed(self, x: Any) -> Any:
        """A state (nq,) as a list, which C takes soonest; None for all that needs a closer look."""
        if type(x) is ndarray and x.dtype is self.dtype and x.shape == self._shape:
            numbers = x.tolist()
            if isfinite(sum(numbers)):  # tells soonest; it may overflow all the same
                return numbers
        return None

    def _read(self, q: Any, qd: Any) -> tuple[Any, Any, Array, Array]:
        """What C reads a state, or many, from, and these as arrays."""
        if (
            type(q) is type(qd) is ndarray and q.shape == qd.shape == self._shape
            and q.dtype is qd.dtype is self.dtype
        ):  # fmt: skip
            from_q, from_qd = q.tolist(), qd.tolist()
            if isfinite(sum(from_q) + sum(from_qd)):
                return from_q, from_qd, q, qd
        at, moving = self._state(q, qd)
        return self._pointer(at), self._pointer(moving), at, moving

    def _numbers(self, value: ArrayLike, name: str) -> Array:
        """A C-contiguous, aligned array of the module's numbers, of any shape."""
        if not isinstance(value, list):
            _unmasked(value, name)
        try:
            array = np.asarray(value)
            if array.dtype.kind in "cUSmM":  # text that looks like a number is none
                raise TypeError
            return _aligned(np.ascontiguousarray(array, self.dtype))
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"{name}: {value!r} is not an array of numbers") from None

    def _array(self, value: ArrayLike, name: str, width: int) -> Array:
        """Finite numbers, (width,) or (n, width)."""
        if type(value) is ndarray and value.dtype is self.dtype and value.flags.carray:
            array = value  # C-contiguous, aligned and, which need not be, writeable
        else:
            array = self._numbers(value, name)
        if array.ndim == 1 and array.size == width <= _FEW and isfinite(sum(array.tolist())):
            return array  # of few numbers the sum tells soonest; it may overflow all the same
        if array.shape[-1:] != (width,) or array.ndim > 2:
            raise ValueError(
                f"{name}: shape {np.shape(value)}, expected ({width},) or (n, {width}): "
                f"{', '.join(self.inputs if name == 'u' else self.coordinates)}"
            )
        if array.size <= _FEW and isfinite(sum(array.ravel().tolist())):
            return array
        if not np.isfinite(array).all():
            if array.ndim == 1:
                raise ValueError(f"{name}: {np.array2string(array, threshold=20)} is not finite")
            place = np.argwhere(~np.isfinite(array))[0].tolist()
            raise ValueError(f"{name}{place}: {array[tuple(place)]} in {self.dtype} is not finite")
        return array

    def _state(self, q: ArrayLike, qd: ArrayLike) -> tuple[Array, Array]:
        at, moving = self._array(q, "q", self.nq), self._array(qd, "qd", self.nq)
        if at.shape != moving.shape:
            raise ValueError(f"qd: shape {moving.shape} beside q of shape {at.shape}")
        return at, moving

    def _one(self, q: ArrayLike, qd: ArrayLike) -> tuple[Array, Array]:
        at, moving = self._state(q, qd)
        if at.ndim != 1:
            raise ValueError(f"q: shape {at.shape}, expected ({self.nq},)")
        return at, moving

    def _parameters(self, params: Any) -> Array:
        if params is None:
            return self._p0
        if isinstance(params, self.Params):
            values: Array = params._array
            return values
        if hasattr(params, "_names"):  # Params of another module
            raise ValueError(f"params: these are another scene's: {', '.join(params._names)}")
        if isinstance(params, Mapping):
            given = self.Params()
            for name, value in params.items():
                given._set(name, value)
            return np.asarray(given._array)
        _unmasked(params, "params")
        try:
            array = _aligned(np.ascontiguousarray(params, self.dtype))
        except (TypeError, ValueError, OverflowError):
            array = empty(0, self.dtype)
        if array.shape != self._p0.shape or not np.isfinite(array).all():
            raise ValueError(
                f"params: expected a dict, Params or {len(self._p0)} finite numbers in the order "
                f"{', '.join(self.parameters)}"
            )
        return array

    def _inputs(self, u: Any) -> Array | None:
        if u is None:
            return None
        if not self.nu:
            raise ValueError("u: this scene has no inputs")
        array = self._array(u.reshape(1) if type(u) is ndarray and not u.ndim else u, "u", self.nu)
        if array.ndim != 1:
            raise ValueError(f"u: shape {array.shape}, expected ({self.nu},): one value an input")
        return array

    def _out(self, out: Any, shape: tuple[int, ...], name: str = "out") -> Array:
        if out is None:
            return empty(shape, self.dtype)
        _unmasked(out, name)
        good = isinstance(out, np.ndarray) and out.dtype == self.dtype and out.flags.carray
        if not good or out.shape != shape:
            raise ValueError(
                f"{name}: expected a writeable, aligned, C-contiguous array of {self.dtype}, "
                f"shape {shape}"
            )
        array: Array = out
        return array

    def _pair(self, out: Any, shape: tuple[int, ...]) -> tuple[Array, Array]:
        """Arrays for positions and velocities: those given, or new ones."""
        if out is None:
            return empty(shape, self.dtype), empty(shape, self.dtype)
        if not isinstance(out, (tuple, list)) or len(out) != 2:
            raise ValueError("out: expected a pair of arrays, (q, qd)")
        return self._out(out[0], shape, "out[0]"), self._out(out[1], shape, "out[1]")

    # --- functions of a state --------------------------------------------------------------------

    def _evaluate(
        self, name: str, shape: tuple[int, ...], q: ArrayLike, qd: ArrayLike | None, t: float,
        u: Any, params: Any, out: Any,
    ) -> Any:  # fmt: skip
        address, real, null = self._c
        at: Any
        moving: Array | None
        if name in _OF_POSITION:
            at, moving, from_q, from_qd = q, None, self._listed(q), null
            if from_q is None:
                at = self._array(q, "q", self.nq)
                from_q = address(real, at)
        else:
            from_q, from_qd, at, moving = self._read(q, qd)
        rows = at.shape[:-1]
        result = self._out(out, rows + shape)
        if rows and np.ndim(t):  # a time for each row
            _unmasked(t, "t")
            if np.shape(t) != rows:
                raise ValueError(f"t: shape {np.shape(t)}, expected one number or {rows}")
            for k, now in enumerate(np.asarray(t)):
                row_qd = None if moving is None else moving[k]
                result[k] = self._evaluate(name, shape, at[k], row_qd, now, u, params, None)
            return result
        time, (inputs, p) = _number(t, "t"), self._given(u, params)
        function = getattr(self._lib, name, None)
        if function is None:  # no forces, no power
            result[...] = 0
        elif rows and rows[0] * self.nq**2 > _ROWS:
            to, size = address(real, result), result[:1].size
            for k, many in slices(rows[0], _ROWS // self.nq**2 + 1):
                here = self.nq * k
                moving_here = from_qd + here if moving is not None else null
                function(many, to + size * k, from_q + here, moving_here, time, inputs, p)
        else:
            function(
                rows[0] if rows else 1, address(real, result), from_q, from_qd, time, inputs, p
            )
        return result if result.ndim else result[()]

    def _by_time(
        self, name: str, t: Array, q: Array, qd: Array
    ) -> Iterator[tuple[int, Array, Array]]:
        """Rows that can be evaluated in one call: all of them, unless time matters."""
        if name not in self._timed:
            yield 0, q, qd
        else:
            for k in range(len(t)):
                yield k, q[k : k + 1], qd[k : k + 1]

    def D(self, q: ArrayLike, *, t: float = 0.0, params: Parameters = None, out: Any = None) -> Any:
        """D(q): mass matrix, (nq, nq), symmetric positive definite. Others call it M."""
        return self._evaluate("D", (self.nq, self.nq), q, None, t, None, params, out)

    def C(
        self, q: ArrayLike, qd: ArrayLike, *, t: float = 0.0, params: Parameters = None,
        out: Any = None,
    ) -> Any:  # fmt: skip
        """C(q, qd): Coriolis matrix, (nq, nq), Christoffel form: Ddot - 2 C is skew-symmetric."""
        return self._evaluate("C", (self.nq, self.nq), q, qd, t, None, params, out)

    def g(self, q: ArrayLike, *, t: float = 0.0, params: Parameters = None, out: Any = None) -> Any:
        """g(q) = dP/dq, (nq,): generalized forces of the potential energy."""
        return self._evaluate("g", (self.nq,), q, None, t, None, params, out)

    def bias(
        self, q: ArrayLike, qd: ArrayLike, *, t: float = 0.0, params: Parameters = None,
        out: Any = None,
    ) -> Any:  # fmt: skip
        """C(q, qd) qd + g(q), (nq,), without forming C."""
        return self._evaluate("bias", (self.nq,), q, qd, t, None, params, out)

    def tau(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None,
        params: Parameters = None, out: Any = None,
    ) -> Any:  # fmt: skip
        """tau = Q - dR/dqd, (nq,): of inputs, friction and other forces. u None: the signals."""
        return self._evaluate("tau", (self.nq,), q, qd, t, u, params, out)

    def kinetic_energy(
        self, q: ArrayLike, qd: ArrayLike, *, t: float = 0.0, params: Parameters = None,
        out: Any = None,
    ) -> Any:  # fmt: skip
        """K(q, qd), J."""
        return self._evaluate("kinetic_energy", (), q, qd, t, None, params, out)

    def potential_energy(
        self, q: ArrayLike, *, t: float = 0.0, params: Parameters = None, out: Any = None
    ) -> Any:
        """P(q), J."""
        return self._evaluate("potential_energy", (), q, None, t, None, params, out)

    def energy(
        self, q: ArrayLike, qd: ArrayLike, *, t: float = 0.0, params: Parameters = None,
        out: Any = None,
    ) -> Any:  # fmt: skip
        """K + P, J."""
        return self._evaluate("energy", (), q, qd, t, None, params, out)

    def jacobi(
        self, q: ArrayLike, qd: ArrayLike, *, t: float = 0.0, params: Parameters = None,
        out: Any = None,
    ) -> Any:  # fmt: skip
        """qd.dK/dqd - K + P, J: K + P where K is quadratic in qd, else what takes its place."""
        name = "jacobi" if hasattr(self._lib, "jacobi") else "energy"
        return self._evaluate(name, (), q, qd, t, None, params, out)

    def power(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None,
        params: Parameters = None, out: Any = None,
    ) -> Any:  # fmt: skip
        """d(jacobi)/dt, W: by inputs, friction and driven supports. u None: the signals."""
        return self._evaluate("power", (), q, qd, t, u, params, out)

    def signal(self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None) -> Any:
        """The scene's own inputs at a state and time, (nu,)."""
        return self._evaluate("signal", (self.nu,), q, qd, t, None, params, None)

    def acceleration(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None,
        params: Parameters = None, out: Any = None,
    ) -> Array:  # fmt: skip
        """Qdd from D qdd + C qd + g = tau, (nq,). u None: the scene's signals.

        Raises MotionError where D is singular or a result is not finite.
        """
        from_q, from_qd, at, moving = self._read(q, qd)
        made = result = empty(at.shape, self.dtype)
        if out is not None:
            result = self._out(out, at.shape)
        inputs, p = self._given(u, params)
        to, time, first = self._pointer(made), _number(t, "t"), 0
        count = 1 if at.ndim == 1 else len(at)
        if count * self.nq**2 <= _ROWS:
            found = self._lib.acceleration(count, to, from_q, from_qd, time, inputs, p)
        else:
            for first, many in slices(count, _ROWS // self.nq**2 + 1):
                k = self.nq * first
                found = self._lib.acceleration(
                    many, to + k, from_q + k, from_qd + k, time, inputs, p
                )
                if found & 3:
                    break
        if found & 3:
            done, said = first + (found >> 2), STATUS[found & 3]
            where = _state_text(np.atleast_2d(at)[done], np.atleast_2d(moving)[done])
            what = _SAID[said] if said == "singular" else "the acceleration is not finite there"
            raise MotionError(f"at {where}: {what}", said)
        if made is not result:
            result[...] = made
        return result

    @property
    def has_slopes(self) -> bool:
        """Whether the module was built with the derivatives of its accelerations."""
        return hasattr(self._lib, "linearization")

    def linearize(
        self, q: ArrayLike, qd: ArrayLike, u: Any = None, t: float = 0.0, params: Parameters = None
    ) -> tuple[Array, Array]:
        """d[q; qd]/dt = A dx + B du near a state, x = [q; qd]: A (2 nq, 2 nq), B (2 nq, nu).

        Upper rows of A: [0, 1]; lower ones [dqdd/dq, dqdd/dqd], in rad or m per s^2 and per rad,
        m or their rates; of B: 0, then dqdd/du. Exact derivatives, to rounding. u None: held at
        the scene's signals, where these hang on the state as well.
        Raises MotionError as `acceleration` does, ValueError where the module lacks them.
        """
        if not self.has_slopes:
            raise ValueError(
                f"linearize: {self.name} was built without it: a scene asks with [run] "
                "linearize = true"
            )
        at, moving = self._one(q, qd)
        n, m = self.nq, self.nu
        A_q, A_qd, B_u = (empty((n, w), self.dtype) for w in (n, n, m))
        status = self._ffi.new("int *")
        self._lib.linearization(
            1, self._pointer(A_q), self._pointer(A_qd), self._pointer(B_u if m else None),
            self._pointer(at), self._pointer(moving), _number(t, "t"),
            *self._given(u, params), status,
        )  # fmt: skip
        if status[0]:
            said = STATUS[status[0]]
            what = _SAID[said] if said == "singular" else "a derivative is not finite there"
            raise MotionError(f"at {_state_text(at, moving)}: {what}", said)
        A, B = np.zeros((2 * n, 2 * n), self.dtype), np.zeros((2 * n, m), self.dtype)
        A[:n, n:] = np.eye(n)
        A[n:, :n], A[n:, n:], B[n:] = A_q, A_qd, B_u
        return A, B

    def sensitivity(
        self, q: ArrayLike, qd: ArrayLike, u: Any = None, t: float = 0.0, params: Parameters = None
    ) -> Array:
        """dqdd/dp at a state, (nq, np), parameters in their order; exact derivatives, u held.

        Raises MotionError where a derivative is not finite, ValueError where the module lacks them.
        """
        if not hasattr(self._lib, "sensitivity"):
            raise ValueError(
                f"sensitivity: {self.name} was built without it: a scene with parameters asks with "
                '[run] linearize = "parameters"'
            )
        shape = (self.nq, len(self.parameters))
        E: Array = self._evaluate("sensitivity", shape, q, qd, t, u, params, None)
        if not np.isfinite(E).all():
            where = _state_text(np.asarray(q), np.asarray(qd))
            raise MotionError(f"at {where}: a derivative is not finite there", "not finite")
        return E

    def rhs(self, t: float, x: ArrayLike, u: Any = None, params: Parameters = None) -> Array:
        """d[q; qd]/dt = [qd; qdd], (2 nq,), as scipy.integrate.solve_ivp calls it."""
        n, state = self.nq, np.asarray(_unmasked(x, "x"), self.dtype)
        if state.shape != (2 * n,):
            raise ValueError(f"x: shape {state.shape}, expected ({2 * n},): q, then qd")
        out = empty(2 * n, self.dtype)
        out[:n] = state[n:]
        out[n:] = self.acceleration(state[:n], state[n:], t, u, params)
        return out

    # --- motion ----------------------------------------------------------------------------------

    def step(
        self, q: ArrayLike, qd: ArrayLike, h: float | None = None, t: float = 0.0, u: Any = None,
        params: Parameters = None, method: str | None = None,
        out: tuple[Array, Array] | None = None,
    ) -> tuple[Array, Array]:  # fmt: skip
        """(q, qd) one step of size h later; u is held over the step.

        u None: the scene's signals, followed through the step. Raises MotionError where the step
        can't be made; `out` is untouched then.
        """
        from_q, from_qd, at, moving = self._read(q, qd)
        if at.ndim != 1:
            self._one(q, qd)
        h = self.h if h is None else _size(h, self.dtype)
        inputs, p = self._given(u, params)
        address, real, null = self._c
        if out is None:
            both = empty((2, self.nq), self.dtype)
            ends, to_q, to_qd = (both[0], both[1]), address(real, both), null
        else:
            ends = self._pair(out, at.shape)
            to_q, to_qd = address(real, ends[0]), address(real, ends[1])
        step = self._loops[self._method(method)][0]
        found = step(to_q, to_qd, from_q, from_qd, _number(t, "t"), h, inputs, p)
        if found:
            said = STATUS[found]
            raise MotionError(
                f"no step from t = {t:.9g}, {_state_text(at, moving)}: {_SAID[said]}", said
            )
        return ends

    def _method(self, method: str | None) -> str:
        """The name of a method that the module has."""
        if method is None:
            return self.methods[0]
        if method not in self.methods:
            raise ValueError(
                f"method: {method!r} is not in this module, which has {', '.join(self.methods)}: "
                "a scene asks for several with a list, [run] method = [...]"
            )
        return method

    def _stepper(self, method: str | None, what: str) -> Any:
        """The C function of a method: its step, run or batch."""
        return getattr(self._lib, f"{self._method(method)}_{what}")

    def _steps(self, h: float, duration: float | None, steps: int | None) -> int:
        if steps is not None:
            if duration is not None:
                raise ValueError("steps: give steps or duration, not both")
            count = _count(steps, "steps", 0)
            if count > _MOST:
                raise ValueError(f"steps: {count:.3g} are more than a run can count, {_MOST:.3g}")
            return count
        time = self.duration if duration is None else _number(duration, "duration")
        if time < 0:
            raise ValueError(f"duration: {duration} is not a time in s")
        if time / h > _MOST:
            raise ValueError(
                f"duration: {time:g} s are more steps of h = {h:g} s than a run can count, "
                f"{_MOST:.3g}: take a larger h, or a shorter duration"
            )
        # the first multiple of h that is not before the duration, rounding aside
        return ceil(time / h * (1 - 1e-12))

    def simulate(
        self, q0: ArrayLike | None = None, qd0: ArrayLike | None = None, h: float | None = None,
        duration: float | None = None, steps: int | None = None, every: int = 1,
        u: Inputs = None, params: Parameters = None, method: str | None = None, *, t0: float = 0.0,
        out: tuple[Array, Array] | None = None,
        progress: Callable[[int, int], None] | None = None, estimate: bool = False,
    ) -> Run:  # fmt: skip
        """A trajectory by fixed steps of size h, the loop in C and the GIL released.

        q0, qd0 (nq,), h, duration: the scene's where not given; steps instead of duration.
        every: a row is kept of every so many steps, and the first and last state always.
        method: one of `methods`, the first of them where None.
        u: None, the scene's signals; (nu,), constant; (steps, nu), a row held over each step; or
        a function u(t, q, qd) called before each step, which is some hundred times slower.
        out: (q, qd) arrays to write the rows to. progress: called with (done, steps).
        estimate: whether to find the run's own error, `run.error`, by doing it again in shorter
        steps, which takes some nine times as long.
        A run that can't go on keeps what it has, warns, and says in `status` and `message` where
        and why. Ctrl-C raises Interrupted, which holds the run so far.
        """
        method = self.methods[0] if method is None else self._method(method)
        q, qd = self._start
        from_q, from_qd, at_p = self._at
        if q0 is not None:
            q, from_q = self._from(q0, "q0")
        if qd0 is not None:
            qd, from_qd = self._from(qd0, "qd0")
        h = self.h if h is None else _size(h, self.dtype)
        p = self._p0
        if params is not None:
            p = self._parameters(params).copy()
            at_p = self._pointer(p)
        if (
            type(steps) is int and type(every) is int and type(t0) is float and isfinite(t0)
            and u is None and duration is None and out is None and progress is None
            and 0 < every <= _RARELY and not estimate
        ):  # fmt: skip
            # few steps, nothing unusual: all else, and what fails, goes the long way
            _, run, short, stages, _, _ = self._loops[method]
            if 0 <= steps <= short:
                address, real, null = self._c
                rows = empty((2, 1 - -steps // every, self.nq), self.dtype)
                if run(
                    address(real, rows), null, from_q, from_qd, t0, h, steps, null, 0,
                    every, at_p, null,
                ) == 4 * steps:  # fmt: skip
                    return Run(
                        self, t0, rows, h, steps, "ok", p, every, None, method, stages * steps
                    )
        t0 = _number(t0, "t0")
        steps = self._steps(h, duration, steps)
        every = min(_count(every, "every", 1), _RARELY)
        if steps >= _MANY and (method, h) not in self._warned:
            self._warned.add((method, h))
            first = self._table(u, steps)[1]
            if first is not None and first.ndim == 2:
                first = first[0]
            if words := advice(self, q, qd, h, t0, first, p, method):
                warnings.warn(f"{self.name}: {words}", RuntimeWarning, stacklevel=2)
        result = self._trajectory(
            q, qd, from_q, from_qd, h, steps, every, u, p, at_p, method, t0, out, progress
        )
        if result.status != "ok":
            if result.status == "interrupted":
                raise Interrupted(result)
            warnings.warn(f"{self.name}: {result.message}", RuntimeWarning, stacklevel=2)
        if estimate:
            result.estimate()
        return result

    def advice(
        self, q0: ArrayLike | None = None, qd0: ArrayLike | None = None, h: float | None = None,
        u: ArrayLike | None = None, params: Parameters = None, method: str | None = None, *,
        t0: float = 0.0,
    ) -> str | None:  # fmt: skip
        """Where h is beyond the stability limit of the method at a start: that, in a sentence."""
        q, qd = self.start
        if q0 is not None or qd0 is not None:
            q, qd = self._state(q if q0 is None else q0, qd if qd0 is None else qd0)
        given, method = self._parameters(params), self._method(method)
        h = self.h if h is None else _size(h, self.dtype)
        return advice(self, q, qd, h, _number(t0, "t0"), u, given, method)

    def _from(self, x0: ArrayLike, name: str) -> tuple[Array, Any]:
        """A start, (nq,), and what C reads it from."""
        if (numbers := self._listed(x0)) is not None:
            return x0, numbers  # type: ignore[return-value]  # an array, as was seen
        x = self._array(x0, name, self.nq)
        if x.ndim != 1:
            raise ValueError(f"q0, qd0: expected one state, ({self.nq},)")
        return x, self._pointer(x)

    def _trajectory(
        self, q: Array, qd: Array, from_q: Any, from_qd: Any, h: float, steps: int, every: int,
        u: Any, p: Array, at_p: Any, method: str, t0: float, out: tuple[Array, Array] | None,
        progress: Callable[[int, int], None] | None,
    ) -> Run:  # fmt: skip
        """A run from checked arguments, whatever its status; C reads from_q, from_qd and at_p."""
        _, run, _, stages, work_type, counted = self._loops[method]
        nq, (address, real, null) = self.nq, self._c
        law, held, stride = (None, None, 0) if u is None else self._table(u, steps)
        rows = 1 - -steps // every
        both: Any = out
        try:
            if out is not None:
                both = self._pair(out, (rows, nq))
            elif rows * nq > _LARGE and self._bytes(rows) > _memory():
                raise MemoryError
            else:
                both = empty((2, rows, nq), self.dtype)
        except MemoryError:
            raise MemoryError(
                f"{rows} rows of {2 * nq} numbers don't fit in memory: keep fewer with every="
            ) from None
        q_rows, qd_rows = both[0], both[1]
        to_q, to_qd = address(real, q_rows), address(real, qd_rows)
        at_u = null if held is None else address(real, held)
        # a step of an implicit method may solve for all its stages
        done, chunk = 0, 1 if law else _CHUNK // (nq**3 if counted else nq) or 1
        # what goes from one call to the next, and what is counted; a single call may do without
        single = steps <= chunk and counted is None
        work = null if single else self._ffi.new(work_type)
        try:
            while True:
                if law and done < steps:
                    if done:  # else the start is not among the rows yet
                        row = -(-done // every)
                        q, qd = q_rows[row], qd_rows[row]
                    held = self._inputs(law(t0 + done * h, q.copy(), qd.copy()))
                    if held is None:
                        raise ValueError("u: the function returned None, not the inputs")
                    at_u = address(real, held)
                count = steps - done
                if count > chunk:
                    count, begun = chunk, perf_counter()
                found = run(
                    to_q, to_qd, from_q, from_qd, t0, h, count, at_u, stride, every, at_p, work
                )
                done, said = found >> 2, STATUS[found & 3]
                if said != "ok":
                    break
                if progress is not None and done:
                    progress(done, steps)
                if done == steps:
                    break
                if not law:
                    chunk = longer(count, perf_counter() - begun)
        except KeyboardInterrupt:
            done, said = work.done if work else done, "interrupted"
            if not done:
                q_rows[0], qd_rows[0] = q, qd
        if done < steps:
            kept = 1 - -done // every
            both = q_rows[:kept], qd_rows[:kept]
        evaluations = counted(work) if counted else stages * done
        return Run(
            self, t0, both, h, done, said, p, every, u if law else held, method,
            evaluations,
        )  # fmt: skip

    def _bytes(self, rows: int) -> int:
        return rows * 2 * self.nq * self.dtype.itemsize

    def _table(self, u: Any, steps: int) -> tuple[Callable[..., Any] | None, Array | None, int]:
        """(function, held values, values from one step to the next)."""
        if u is None:
            return None, None, 0
        if not self.nu:
            raise ValueError("u: this scene has no inputs")
        if callable(u):
            if "u" not in self._warned:
                self._warned.add("u")
                warnings.warn(
                    f"{self.name}: u is a Python function, called before each step: some hundred "
                    "times slower than a table (steps, nu) or the scene's own signal",
                    RuntimeWarning,
                    stacklevel=4,
                )
            return u, None, 0
        array = self._numbers(u, "u")
        if self.nu == 1 and array.ndim < 2 and array.size:
            array = array.reshape((-1, 1) if array.size > 1 else 1)
        array = self._array(array, "u", self.nu)
        if array.ndim == 1:
            return None, array, 0
        if len(array) != steps:
            raise ValueError(f"u: {len(array)} rows for {steps} steps: give one row a step")
        return None, array, self.nu


def _held(law: Callable[..., Any], parts: int) -> Callable[..., Any]:
    """A law u(t, q, qd) that is called before every `parts`-th step, and held between."""
    done, u = 0, None

    def held(t: float, q: Array, qd: Array) -> Any:
        nonlocal done, u
        if done % parts == 0:
            u = law(t, q, qd)
        done += 1
        return u

    return held


def _unmasked(value: Any, name: str) -> Any:
    """The value; a ValueError where it is an array with masked numbers, for these have none."""
    ma = sys.modules.get("numpy.ma")  # NumPy imports it when it is first asked for
    if ma and isinstance(value, ma.MaskedArray) and ma.is_masked(value):
        raise ValueError(
            f"{name}: {ma.count_masked(value)} of {value.size} numbers are masked: "
            "fill them in first, with .filled(...), or leave these rows out"
        )
    return value


def _number(value: Any, name: str) -> float:
    """A finite number, or a ValueError that names the argument."""
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


def _size(h: Any, dtype: np.dtype[Any]) -> float:
    """A step size in the module's numbers, or a ValueError."""
    if type(h) is float and 1e-37 < h < 1e37:  # in single precision too
        return h
    size = _number(h, "h")
    limits = np.finfo(dtype)
    if not limits.smallest_subnormal <= size <= limits.max:
        why = "" if size <= 0 else f" in {dtype}"
        raise ValueError(
            f"h: {size:g} is not a step size{why}: give a number of seconds greater than 0"
        )
    return size


def _aligned(array: Array) -> Array:
    """The array, copied where its numbers lie at addresses that C can't read them from."""
    return array if array.flags.aligned else array.copy()


def _count(value: Any, name: str, least: int) -> int:
    """A whole number, `least` or more, or a ValueError that names the argument."""
    if type(value) is int and value >= least:
        return value
    number = _number(value, name)
    if number != int(number) or number < least:
        raise ValueError(f"{name}: {value!r} is not a whole number, {least} or more")
    return int(number)


def _memory() -> float:
    """The bytes of memory that the machine has; a larger array may be handed out all the same."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return float("inf")


def _state_text(q: Array, qd: Array) -> str:
    def text(x: Array) -> str:
        return np.array2string(x, precision=6, threshold=12)

    return f"q = {text(q)}, qd = {text(qd)}"


def _unknown(argument: str, name: str, known: Sequence[str]) -> str:
    return f"{argument}: '{name}' is not one of {', '.join(known) or 'none'}"
