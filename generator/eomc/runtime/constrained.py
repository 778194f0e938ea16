"""Constraints of a compiled scene: what is zero, multipliers, reactions, states moved onto them.

D qdd + C qd + g = tau + A^T lambda, with A = dphi/dq of holonomic rows phi(q, t) = 0 and dpsi/dqd
of others, psi(q, qd, t) = 0, which are linear in qd. nc: the number of rows, in the scene's order.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, Parameters, as_number, not_one_of
from .by_name import ByName
from .frames import Frames
from .status import SAID, STATUS, MotionError, state_text

AT_REST, SLOWEST = 1e-12, 1e-18  # of the largest velocity; m/s or rad/s


class Rows(NamedTuple):
    """Names of constraints, of loops with reactions, and what a start holds of q, then of qd.

    holonomic: how many of the constraints are; they come first. redundant: which of them were left
    out, as the others imply them. modes: of friction that sticks, places of the modes among the
    coordinates, the last of these, and of what slides. discrete: how many parameters that jumps set
    are coordinates, before the modes.
    """

    names: tuple[str, ...] = ()
    loops: tuple[str, ...] = ()
    held: tuple[bool, ...] = ()
    holonomic: int = 0
    redundant: tuple[int, ...] = ()
    modes: tuple[tuple[int, int], ...] = ()
    discrete: int = 0


class Constrained(Frames):
    """What scenes with [constraints] or [[loop]] have besides."""

    _rows = Rows()

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """The constraints, in the order of results."""
        return self._rows.names

    @property
    def loops(self) -> tuple[str, ...]:
        """The loops that have reactions, in the order of results."""
        return self._rows.loops

    def constraints(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None
    ) -> Array:
        """phi, and psi of rows that are not holonomic, (nc,): zero along every motion."""
        return self._of_rows("constraints", q, qd, t, params)

    def constraint_rates(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None
    ) -> Array:
        """A qd + dphi/dt, psi of rows that are not holonomic, (nc,): zero along every motion."""
        return self._of_rows("constraint_rates", q, qd, t, params)

    def _of_rows(self, name: str, q: ArrayLike, qd: ArrayLike, t: float, params: Any) -> Array:
        found: Array = self._evaluate(name, (len(self._rows.names),), q, qd, t, None, params, None)
        return found

    def constraint_jacobian(self, q: ArrayLike, t: float = 0.0, params: Parameters = None) -> Array:
        """A, (nc, nq): dphi/dq of holonomic constraints, dpsi/dqd of others."""
        shape = (len(self._rows.names), self.nq)
        found: Array = self._evaluate("constraint_jacobian", shape, q, None, t, None, params, None)
        return found

    def tangent(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None
    ) -> Array:
        """Changes of [q; qd] that keep the constraints, to the first order: (2 nq, k), orthonormal.

        Of many states, (n, nq), they have a leading n; these have to leave equally many freedoms.

        Near an equilibrium with A, B of `linearize`, dz/dt = T^T A T z + T^T B u has no more
        states than the motion, x - x0 = T z. Raises ValueError where the scene was built without
        derivatives.
        """
        if not hasattr(self._lib, "constraint_slopes"):
            raise ValueError(
                f"tangent: {self.name} was built without derivatives: a scene asks with [run] "
                "linearize = true, or discretize"
            )
        shape = (len(self._rows.names), self.nq)
        A = self.constraint_jacobian(q, t=t, params=params)
        slopes = self._evaluate("constraint_slopes", shape, q, qd, t, None, params, None)
        if A.ndim == 2:
            return self._kernel(A, slopes, q, qd)
        each = zip(A, slopes, np.asarray(q), np.asarray(qd), strict=True)
        found = [self._kernel(*one) for one in each]
        if len({x.shape for x in found}) > 1:
            few, many = (
                pick(range(len(found)), key=lambda k: found[k].size) for pick in (min, max)
            )
            raise ValueError(
                f"tangent: {found[few].shape[1]} changes keep the constraints at state {few}, "
                f"{found[many].shape[1]} at state {many}: ask for each by itself"
            )
        return np.array(found) if found else np.empty((0, 2 * self.nq, 0))

    def _kernel(self, A: Array, slopes: Array, q: ArrayLike, qd: ArrayLike) -> Array:
        """The tangent of one state."""
        of_q = A[: self._rows.holonomic]
        whole = np.block([[of_q, np.zeros_like(of_q)], [slopes, A]])
        if not np.isfinite(whole).all():
            where = state_text(np.asarray(q), np.asarray(qd))
            raise MotionError(f"at {where}: a constraint's slope is not finite there", "not finite")
        whole /= np.maximum(np.linalg.norm(whole, axis=1, keepdims=True), 1e-300)
        _, sizes, rows = np.linalg.svd(whole)
        rank = int((sizes > 1e-9 * sizes[0]).sum()) if sizes.size else 0
        return np.asarray(rows[rank:].T)

    def multipliers(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None, params: Parameters = None
    ) -> Array:
        """lambda, (nc,), one a constraint as it is written. u None: the scene's signals.

        A constraint that says what others say has 0. Raises MotionError as `acceleration` does.
        """
        found = self._multipliers(q, qd, t, u, params)
        if not np.isfinite(found).all():
            self.acceleration(q, qd, t, u, params)  # which says where, and why
            at, k = np.argwhere(~np.isfinite(np.atleast_2d(found)))[0]
            where = state_text(*(np.atleast_2d(x)[at] for x in (q, qd)))
            words = f"the multiplier of {self._rows.names[k]} is not finite there"
            raise MotionError(f"at {where}: {words}", "not finite")
        return found

    def _multipliers(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None, params: Parameters = None
    ) -> Array:
        """The same, nan where there are none: of rows of runs."""
        shape = (len(self._rows.names),)
        found: Array = self._evaluate("multipliers", shape, q, qd, t, u, params, None)
        return found

    def reactions(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None, params: Parameters = None
    ) -> dict[str, Array]:
        """What each [[loop]] does to its second body, by name, along the world's axes.

        Force and moment about the joint's point: (6,), in the plane (3,), the force (2) and the
        moment; N and N m. Raises ValueError where the scene has no loops, MotionError as
        `acceleration` does.
        """
        if not self._rows.loops:
            raise ValueError(f"reactions: {self.name} has no [[loop]]")
        found = self._reactions_by(self.multipliers(q, qd, t, u, params), q, qd, t, params)
        return ByName("reactions", self._rows.loops, np.moveaxis(found, -2, 0))

    def _reactions(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None, params: Parameters = None
    ) -> Array:
        """Of all loops, (loops, 6), in the plane (loops, 3); nan where there are none."""
        return self._reactions_by(self._multipliers(q, qd, t, u, params), q, qd, t, params)

    def _reactions_by(
        self, multipliers: Array, q: ArrayLike, qd: ArrayLike, t: float, params: Any
    ) -> Array:
        shape = (len(self._rows.loops), 3 if self._plane else 6)
        each = np.ascontiguousarray(multipliers)
        found: Array = self._evaluate("reactions", shape, q, qd, t, None, params, None, each)
        return found

    def project(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None,
        held: Sequence[str] | None = None,
    ) -> tuple[Array, Array]:  # fmt: skip
        """(q, qd) moved onto the constraints, by the least change in the metric of D.

        held: names of coordinates and velocities that stay as they are; None: nothing is held.
        Raises MotionError, status "locked", where no such state is found.
        """
        if isinstance(held, str):
            held = (held,)
        if not (held is None or isinstance(held, Iterable)):
            raise ValueError(f"held: {held!r} is no list of names: {', '.join(self._states)}")
        held = held and tuple(held)
        for name in held or ():
            if name not in self._states:
                raise ValueError(not_one_of("held", name, self._states))
        flags = tuple(name in held for name in self._states) if held else ()
        return self._projected(q, qd, t, params, flags)

    def _projected(
        self, q: ArrayLike, qd: ArrayLike, t: float, params: Any, held: Sequence[bool]
    ) -> tuple[Array, Array]:
        """The same; held: whether each of q and qd is, or empty."""
        at, moving = (np.array(x, self.dtype, order="C") for x in self._state(q, qd))
        flags = self._ffi.new("int[]", [int(x) for x in held]) if held else self._c[2]
        found = self._lib.project(
            at.size // self.nq, self._pointer(at), self._pointer(moving), as_number(t, "t"), flags,
            self._given(None, params)[1],
        )  # fmt: skip
        if found & 7:
            k, said = found >> 3, STATUS[found & 7]
            where = state_text(at.reshape(-1, self.nq)[k], moving.reshape(-1, self.nq)[k])
            kept = [n for n, h in zip(self._states, held, strict=False) if h]
            kept = [n for n in kept if n.removesuffix("_dot") not in self.still]
            what = SAID[said] if said != "locked" else (
                "no state near that obeys the constraints"
                + (f" with {', '.join(kept)} as given: leave one free" if kept else "")
            )  # fmt: skip
            raise MotionError(f"from {where}: {what}", said)
        return at, moving

    @property
    def _states(self) -> tuple[str, ...]:
        return (*self.coordinates, *(f"{name}_dot" for name in self.coordinates))

    def _assembled_rows(
        self, q: Array, qd: Array, table: Array, t0: float
    ) -> tuple[Array, Array, Array | None]:
        """The starts of many, (n, nq), and their status, (n,), None where all are assembled.

        table: their parameters, a row each or one for all. A start that can't be assembled stays
        as it is given.
        """
        if not self._rows.names:
            return q, qd, None
        if len(table) == 1:
            with suppress(MotionError):  # else each by itself
                return *self._begun(q, qd, t0, table[0]), None
        q, qd = np.array(q, self.dtype), np.array(qd, self.dtype)
        codes = np.zeros(len(q), "i")
        for k, p in enumerate(np.broadcast_to(table, (len(q), table.shape[1]))):
            try:
                q[k], qd[k] = self._begun(q[k], qd[k], t0, p)
            except MotionError as fault:
                codes[k] = STATUS.index(fault.status)
        return q, qd, codes if codes.any() else None

    def _tell(self, run: Any, method: str, work: Any) -> None:
        """A run what its steps met, as their work in C has it."""
        if not self._rows.names:
            return
        run.singular_steps = getattr(self._lib, f"{method}_singular")(work)
        if run.singular_steps:
            run.first_singular = run.t0 + getattr(self._lib, f"{method}_first")(work)

    def _assembled(self, q0: Any, qd0: Any, t0: float, params: Any) -> tuple[Any, Any]:
        """A start on the constraints: what the scene holds stays as it is given, the rest moves."""
        q0, qd0 = self._completed(q0, 0), self._completed(qd0, 1)
        for x, name in ((q0, "q0"), (qd0, "qd0")):
            if x is not None:
                self._from(x, name)
        if not self._rows.names or (q0 is None and qd0 is None and params is None and t0 == 0):
            return q0, qd0
        q, qd = self._start
        return self._begun(q if q0 is None else q0, qd if qd0 is None else qd0, t0, params)

    def _begun(self, q: ArrayLike, qd: ArrayLike, t0: float, params: Any) -> tuple[Array, Array]:
        """A start on the rows, and its modes as the velocities say that these leave."""
        held = self._rows.held
        if not self._rows.modes or not np.shape(q)[-1:] == np.shape(qd)[-1:] == (self.nq,):
            return self._projected(q, qd, t0, params, held)
        q = np.array(q, self.dtype)
        q[..., [at for at, _ in self._rows.modes]] = 1  # where all slides no row of a mode holds
        return self._projected(
            *self._in_modes(*self._projected(q, qd, t0, params, held)), t0, params, held
        )

    @property
    def still(self) -> tuple[str, ...]:
        """The coordinates that only jumps change: the last ones, without velocities."""
        return self.coordinates[self.nq - len(self._rows.modes) - self._rows.discrete :]

    def _completed(self, x: Any, half: int) -> Any:
        """q or qd, half 0 or 1, where it was given without what jumps set: as the scene has it."""
        more = len(self._rows.modes) + self._rows.discrete  # in every call: no slice
        if not more or np.shape(x)[-1:] != (self.nq - more,):
            return x
        shape = (*np.shape(x)[:-1], more)
        return np.concatenate([x, np.broadcast_to(self._start[half][-more:], shape)], axis=-1)

    def _in_modes(self, q: Array, qd: Array) -> tuple[Array, Array]:
        """A start whose modes are what its velocities say; one that is rounding is 0."""
        at, of = np.array(self._rows.modes).T
        fastest = np.max(np.abs(qd), axis=-1, keepdims=True)
        qd[..., of] *= np.abs(qd[..., of]) > np.maximum(AT_REST * fastest, SLOWEST)
        q[..., at] = np.sign(qd[..., of])
        return q, qd
