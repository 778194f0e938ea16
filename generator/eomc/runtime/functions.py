"""D, C, g, accelerations and the other functions of a state: arrays in, arrays out.

Shapes: q, qd (nq,) or (n, nq); then results have a leading n as well, and t (n,), u (n, nu) and
parameters (n,) may be those of each state.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import copysign, inf
from typing import Any

import numpy as np
from numpy import empty
from numpy.typing import ArrayLike

from .arguments import Arguments, Array, Parameters, as_flag, as_number, unmasked
from .slices import slices
from .status import SAID, STATUS, MotionError, state_text

_OF_POSITION = (
    "D", "g", "potential_energy", "frame_poses", "frame_jacobians", "frame_forces",
    "constraint_jacobian",
)  # fmt: skip
_ROWS = 20_000  # rows times coordinates squared in one call, some ms at most


def row_times(t: Any, rows: tuple[int, ...]) -> Array | None:
    """A time for each row, None where there is one for all."""
    if not (rows and np.ndim(t)):
        return None
    unmasked(t, "t")
    if np.shape(t) != rows:
        raise ValueError(f"t: shape {np.shape(t)}, expected one number or {rows}")
    return np.asarray(t)


def for_each(model: Arguments, count: int, u: Any, params: Any) -> list[tuple[Any, Any]] | None:
    """(u, params) of each of so many states where one has a row for each; None where none has.

    u: (count, nu), or a dict with (count,). params: a dict with (count,), or (count, np).
    Raises ValueError.
    """
    held = given = None
    if u is not None and model.nu:
        rows = model._by_name(u) if isinstance(u, Mapping) else model._numbers(u, "u")
        held = model._array(rows, "u", model.nu) if rows.ndim == 2 else None
    if isinstance(params, Mapping):
        if many := {name for name, value in params.items() if np.ndim(value)}:
            for name in many:
                unmasked(params[name], f"params: {name}")
                _one_each(f"params: {name}", np.shape(params[name]), (count,))
            given = [{n: x[k] if n in many else x for n, x in params.items()} for k in range(count)]
    elif isinstance(params, np.ndarray) and params.ndim == 2:
        _one_each("params", params.shape, (count, len(model.parameters)))
        given = list(unmasked(params, "params"))
    if held is not None:
        _one_each("u", held.shape, (count, model.nu))
    if held is None and given is None:
        return None
    return [(u if held is None else held[k], given[k] if given else params) for k in range(count)]


def _one_each(name: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if shape != expected:
        raise ValueError(f"{name}: shape {shape}, expected {expected} for {expected[0]} states")


class Functions(Arguments):
    """The functions of a state that a compiled scene has."""

    def _evaluate(
        self, name: str, shape: tuple[int, ...], q: ArrayLike, qd: ArrayLike | None, t: float,
        u: Any, params: Any, out: Any, each: Array | None = None,
    ) -> Any:  # fmt: skip
        """The function of that name. each: what it takes in place of u, a row for each state."""
        address, real, null = self._c
        at: Any
        moving: Array | None
        if name in _OF_POSITION:
            at, moving, from_q, from_qd = q, None, self._listed(q, self._shape), null
            if from_q is None:
                at = self._array(q, "q", self.nq)
                from_q = address(real, at)
        else:
            from_q, from_qd, at, moving = self._read(q, qd)
        rows = at.shape[:-1]
        result = self._out(out, rows + shape)
        if rows and (one := self._one_by_one(rows[0], t, u, params)) is not None:
            for k, (now, held, given) in enumerate(one):
                row_qd = None if moving is None else moving[k]
                own = None if each is None else each[k]
                result[k] = self._evaluate(name, shape, at[k], row_qd, now, held, given, None, own)
            return result
        time, (inputs, p) = as_number(t, "t"), self._given(u, params)
        width = 0
        if each is not None:
            inputs, width = address(real, each), each.shape[-1]
        function = getattr(self._lib, name, None)
        if function is None:  # no forces, no power
            result[...] = 0
        elif rows and rows[0] * self.nq**2 > _ROWS:
            to, size = address(real, result), result[:1].size
            for k, many in slices(rows[0], _ROWS // self.nq**2 + 1):
                here = self.nq * k
                moving_here = from_qd + here if moving is not None else null
                held = inputs + width * k if width else inputs
                function(many, to + size * k, from_q + here, moving_here, time, held, p)
        else:
            function(
                rows[0] if rows else 1, address(real, result), from_q, from_qd, time, inputs, p
            )
        return result if result.ndim else result[()]

    def _one_by_one(self, count: int, t: Any, u: Any, params: Any) -> list[Any] | None:
        """(t, u, params) of each of so many states; None where one of each is for all."""
        times = row_times(t, (count,))
        own = None if u is params is None else for_each(self, count, u, params)
        if times is None and own is None:
            return None
        each = [(u, params)] * count if own is None else own
        whens = [t] * count if times is None else times
        return [(now, *x) for now, x in zip(whens, each, strict=True)]

    def _by_time(
        self, name: str, t: Array, q: Array, qd: Array
    ) -> Iterator[tuple[int, Array, Array]]:
        """Rows that can be evaluated in one call: all of them, unless time matters."""
        if name not in self._timed or not len(t):
            yield 0, q, qd
        else:
            for k in range(len(t)):
                yield k, q[k : k + 1], qd[k : k + 1]

    def D(self, q: ArrayLike, t: float = 0.0, params: Parameters = None, out: Any = None) -> Any:
        """D(q): mass matrix, (nq, nq), symmetric positive definite. Others call it M."""
        return self._evaluate("D", (self.nq, self.nq), q, None, t, None, params, out)

    def C(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None,
        out: Any = None,
    ) -> Any:  # fmt: skip
        """C(q, qd): Coriolis matrix, (nq, nq), Christoffel form: Ddot - 2 C is skew-symmetric."""
        return self._evaluate("C", (self.nq, self.nq), q, qd, t, None, params, out)

    def g(self, q: ArrayLike, t: float = 0.0, params: Parameters = None, out: Any = None) -> Any:
        """g(q) = dP/dq, (nq,): generalized forces of the potential energy."""
        return self._evaluate("g", (self.nq,), q, None, t, None, params, out)

    def bias(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None,
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
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None,
        out: Any = None,
    ) -> Any:  # fmt: skip
        """K(q, qd), J."""
        return self._evaluate("kinetic_energy", (), q, qd, t, None, params, out)

    def potential_energy(
        self, q: ArrayLike, t: float = 0.0, params: Parameters = None, out: Any = None
    ) -> Any:
        """P(q), J."""
        return self._evaluate("potential_energy", (), q, None, t, None, params, out)

    def energy(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None,
        out: Any = None,
    ) -> Any:  # fmt: skip
        """K + P, J."""
        return self._evaluate("energy", (), q, qd, t, None, params, out)

    def jacobi(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None,
        out: Any = None,
    ) -> Any:  # fmt: skip
        """qd.dK/dqd - K + P, J: K + P where K is quadratic in qd, else what takes its place."""
        name = "jacobi" if self.has_jacobi else "energy"
        return self._evaluate(name, (), q, qd, t, None, params, out)

    @property
    def has_jacobi(self) -> bool:
        """Whether Jacobi's integral is another than the energy: K is not purely quadratic in qd."""
        return hasattr(self._lib, "jacobi")

    @property
    def has_power(self) -> bool:
        """Whether energy, or Jacobi's integral, is put in or lost: there are forces or the time."""
        return hasattr(self._lib, "power")

    def power(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None,
        params: Parameters = None, out: Any = None,
    ) -> Any:  # fmt: skip
        """d(jacobi)/dt, W: by inputs, friction and driven supports. u None: the signals."""
        return self._evaluate("power", (), q, qd, t, u, params, out)

    def signal(self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None) -> Any:
        """The scene's own inputs at a state and time, (nu,)."""
        return self._evaluate("signal", (self.nu,), q, qd, t, None, params, None)

    @property
    def has_limits(self) -> bool:
        """Whether an input has limits."""
        return hasattr(self._lib, "applied")

    def limits(self, params: Parameters = None) -> dict[str, tuple[float, float]]:
        """The limits of each input, (least, largest), by name; -inf and inf where it has none."""
        far, params = float(np.finfo(self.dtype).max), self._parameters(params)
        both = [self._within(np.full(self.nu, x, self.dtype), params).tolist() for x in (-far, far)]
        ends = [[x if abs(x) < far else copysign(inf, x) for x in some] for some in both]
        return dict(zip(self.inputs, zip(*ends, strict=True), strict=True))

    def applied(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None, params: Parameters = None
    ) -> Array:
        """The inputs as they act at a state, (nu,): u, or the scene's signals, within limits."""
        at, moving = self._state(q, qd)
        rows = at.shape[:-1]
        if rows and (one := self._one_by_one(rows[0], t, u, params)) is not None:
            each = [self.applied(at[k], moving[k], *own) for k, own in enumerate(one)]
            return np.reshape(each, (*rows, self.nu)).astype(self.dtype)
        held = self._inputs(u)
        given = self.signal(at, moving, t, params) if held is None else held
        return self._within(np.broadcast_to(given, (*rows, self.nu)), params)

    def _within(self, u: Array, params: Any) -> Array:
        """Inputs (..., nu) within their limits: what becomes of the largest and least numbers."""
        if not self.has_limits:
            return u
        far = np.full(self.nu, np.finfo(self.dtype).max, self.dtype)
        ends = (
            self._evaluate("applied", (self.nu,), *self._start, 0.0, x, params, None)
            for x in (-far, far)
        )
        return np.asarray(np.clip(u, *ends))

    def output(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None,
        params: Parameters = None, out: Any = None,
    ) -> Array:  # fmt: skip
        """The scene's outputs, (ny,), in the order of `outputs`. u None: the scene's signals.

        nan where one needs accelerations and D is singular. Raises ValueError where there are none.
        """
        if not self.outputs:
            raise ValueError(f"output: {self.name} has none: a scene names them in [outputs]")
        values: Array = self._evaluate("outputs", (len(self.outputs),), q, qd, t, u, params, out)
        return values

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
        if at.ndim == 2 and (one := self._one_by_one(len(at), t, u, params)) is not None:
            for k, (now, held, given) in enumerate(one):
                made[k] = self.acceleration(at[k], moving[k], now, held, given)
            result[...] = made
            return result
        inputs, p = self._given(u, params)
        to, time, first = self._pointer(made), as_number(t, "t"), 0
        count = 1 if at.ndim == 1 else len(at)
        if count * self.nq**2 <= _ROWS:
            found = self._lib.acceleration(count, to, from_q, from_qd, time, inputs, p)
        else:
            for first, many in slices(count, _ROWS // self.nq**2 + 1):
                k = self.nq * first
                found = self._lib.acceleration(
                    many, to + k, from_q + k, from_qd + k, time, inputs, p
                )
                if found & 7:
                    break
        if found & 7:
            done, said = first + (found >> 3), STATUS[found & 7]
            where = state_text(np.atleast_2d(at)[done], np.atleast_2d(moving)[done])
            what = SAID[said] if said == "singular" else "the acceleration is not finite there"
            raise MotionError(f"at {where}: {what}", said)
        if made is not result:
            result[...] = made
        return result

    @property
    def has_slopes(self) -> bool:
        """Whether the module was built with the derivatives of its accelerations."""
        return hasattr(self._lib, "linearization")

    def linearize(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None, params: Any = None, *,
        outputs: bool = False, closed: bool = False,
    ) -> tuple[Array, ...]:  # fmt: skip
        """d[q; qd]/dt = A dx + B du near a state, x = [q; qd]: A (2 nq, 2 nq), B (2 nq, nu).

        With outputs=True also C (ny, 2 nq) and D (ny, nu) of the outputs, dy = C dx + D du. Many
        states, (n, nq), give each of them a leading n; u may be (n, nu) then, and a parameter (n,).

        Upper rows of A: [0, 1]; lower ones [dqdd/dq, dqdd/dqd], in rad or m per s^2 and per rad,
        m or their rates; of B: 0, then dqdd/du. Exact derivatives, to rounding. u None: held at
        the scene's signals, where these depend on the state as well; with closed=True they are
        followed: A is that of the closed loop, B of what is added to the signals.
        Raises MotionError as `acceleration` does, ValueError where the module lacks them.
        """
        if not self.has_slopes:
            raise ValueError(
                f"linearize: {self.name} was built without it: a scene asks with [run] "
                "linearize = true"
            )
        outputs, closed = as_flag(outputs, "outputs"), as_flag(closed, "closed")
        if outputs and not self.outputs:
            raise ValueError(f"linearize: {self.name} has no outputs: name them in [outputs]")
        if outputs and not hasattr(self._lib, "output_slopes"):
            raise ValueError(
                f"linearize: {self.name} was built without derivatives of its outputs: a scene "
                "asks with [run] linearize = true"
            )
        at, moving = self._state(q, qd)
        each = for_each(self, len(at), u, params) if at.ndim == 2 else None
        if each:
            times = [t] * len(at) if (given := row_times(t, at.shape[:1])) is None else given
            how = {"outputs": outputs, "closed": closed}
            found = [
                self.linearize(at[k], moving[k], t=times[k], u=own, params=p, **how)
                for k, (own, p) in enumerate(each)
            ]
            return tuple(map(np.array, zip(*found, strict=True)))
        u, params = (u, params) if each is None else (None, None)  # of no states
        A, B = self._slopes(at, moving, u, t, params)
        both = [(A, B)]
        if outputs:
            n, m = self.nq, self.nu
            shape = (len(self.outputs), 3 * n + m)
            slopes = self._evaluate("output_slopes", shape, at, moving, t, u, params, None)
            by_state, by_u, by_qdd = np.split(slopes, [2 * n, 2 * n + m], axis=-1)
            both.append((by_state + by_qdd @ A[..., n:, :], by_u + by_qdd @ B[..., n:, :]))
        if closed:
            K = self._feedback(at, moving, u, t, params)
            both = [(by_state + by_u @ K, by_u) for by_state, by_u in both]
        return tuple(x for pair in both for x in pair)

    def _slopes(self, q: Array, qd: Array, u: Any, t: float, params: Any) -> tuple[Array, Array]:
        """A and B of states (nq,) or (n, nq). Raises MotionError."""
        n, m, rows = self.nq, self.nu, q.shape[:-1]
        A, B = np.zeros((*rows, 2 * n, 2 * n), self.dtype), np.zeros((*rows, 2 * n, m), self.dtype)
        A_q, A_qd, B_u = (empty((*rows, n, w), self.dtype) for w in (n, n, m))
        out = [(self._pointer(x), n * w) for x, w in ((A_q, n), (A_qd, n), (B_u, m))]
        status, (inputs, p), count = self._ffi.new("int *"), self._given(u, params), q.size // n
        from_q, from_qd, times = self._pointer(q), self._pointer(qd), row_times(t, rows)
        one = slices(count, _ROWS // n**3 + 1) if times is None else ((k, 1) for k in range(count))
        for first, many in one:
            now = as_number(t if times is None else times[first], "t")
            done = self._lib.linearization(
                many, *(to + first * size for to, size in out), from_q + n * first,
                from_qd + n * first, now, inputs, p, status,
            )  # fmt: skip
            if status[0]:
                said = STATUS[status[0]]
                what = SAID[said] if said == "singular" else "a derivative is not finite there"
                where = state_text(*(x.reshape(-1, n)[first + done] for x in (q, qd)))
                raise MotionError(f"at {where}: {what}", said)
        A[..., :n, n:] = np.eye(n)
        A[..., n:, :n], A[..., n:, n:], B[..., n:, :] = A_q, A_qd, B_u
        return A, B

    def _feedback(self, q: Array, qd: Array, u: Any, t: float, params: Any) -> Array:
        """du/dx of the scene's signals, (nu, 2 nq), with a leading n for many states."""
        if u is not None:
            raise ValueError("closed: is for the scene's signals: give no u, which would be held")
        if not hasattr(self._lib, "signal_slopes"):
            raise ValueError(
                f"closed: {self.name} has no loop to close: no signal is a smooth function of the "
                "state"
            )
        shape = (self.nu, 2 * self.nq)
        K: Array = self._evaluate("signal_slopes", shape, q, qd, t, None, params, None)
        return K

    def sensitivity(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None,
        params: Parameters = None,
    ) -> Array:  # fmt: skip
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
            where = state_text(np.asarray(q), np.asarray(qd))
            raise MotionError(f"at {where}: a derivative is not finite there", "not finite")
        return E

    def rhs(self, t: float, x: ArrayLike, u: Any = None, params: Parameters = None) -> Array:
        """d[q; qd]/dt = [qd; qdd], (2 nq,), as scipy.integrate.solve_ivp calls it."""
        n, state = self.nq, self._numbers(x, "x")
        if state.shape != (2 * n,):
            raise ValueError(f"x: shape {state.shape}, expected ({2 * n},): q, then qd")
        out = empty(2 * n, self.dtype)
        out[:n] = state[n:]
        out[n:] = self.acceleration(state[:n], state[n:], t, u, params)
        return out
