"""Poses, velocities and Jacobians of bodies and points, inverse dynamics, momenta.

All along the world's axes. A twist is the velocity of a frame's origin and the angular velocity,
six numbers, in the plane three; a wrench a force there and a moment, in the same order. Shapes: q
(nq,) or (n, nq), results of n states have a leading n; of all frames, nf behind it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, Parameters, not_one_of
from .functions import Functions
from .package import option, reduced


class Pose(NamedTuple):
    """position: m, (3,); in the plane (2,). rotation: (3, 3), its columns the frame's axes; in the
    plane the angle, rad.
    """

    position: Array
    rotation: Array

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("frames.Pose", *self)


class Momentum(NamedTuple):
    """Of all bodies that move: kg; its centre, m; momentum, kg m/s; that about the centre, kg m2/s.

    The velocity of the centre is linear/mass.
    """

    mass: Any
    center: Array
    linear: Array
    angular: Array

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("frames.Momentum", *self)


class Frames(Functions):
    """What [run] asks for of bodies: `frames`, `inverse_dynamics`, `momentum`."""

    @property
    def frames(self) -> tuple[str, ...]:
        """The bodies and points that have poses and Jacobians, in the order of results."""
        return self._frames[0]

    def pose(
        self, q: ArrayLike, frame: str | None = None, t: float = 0.0, params: Parameters = None
    ) -> Pose:
        """Where a body or point is and how it is turned; without `frame` all of them.

        Raises ValueError for a frame that the scene did not ask for.
        """
        found = self._of("frame_poses", 1, frame, q, None, t, params)
        if self._plane:
            return Pose(found[..., :2], found[..., 2])
        return Pose(found[..., :3], found[..., 3:].reshape(*found.shape[:-1], 3, 3))

    def frame_velocity(
        self, q: ArrayLike, qd: ArrayLike, frame: str | None = None, t: float = 0.0,
        params: Parameters = None,
    ) -> Array:  # fmt: skip
        """The twist of a frame, (6,), in the plane (3,): m/s, rad/s."""
        return self._of("frame_velocities", 1, frame, q, qd, t, params)

    def frame_acceleration(
        self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike | None = None, frame: str | None = None,
        t: float = 0.0, params: Parameters = None,
    ) -> Array:  # fmt: skip
        """The rate of `frame_velocity` at accelerations qdd: m/s2, rad/s2.

        Without qdd at zero, which leaves dJ/dt qd: J qdd + that is the acceleration.
        """
        each = np.zeros(np.shape(q), self.dtype) if qdd is None else qdd
        given = self._like(each, "qdd", (self.nq,), q)
        return self._of("frame_accelerations", 1, frame, q, qd, t, params, given)

    def jacobian(
        self, q: ArrayLike, frame: str | None = None, t: float = 0.0, params: Parameters = None
    ) -> Array:
        """J of a frame, (6, nq), in the plane (3, nq): J qd is its twist."""
        return self._of("frame_jacobians", 2, frame, q, None, t, params)

    def frame_forces(
        self, q: ArrayLike, wrenches: Mapping[str, ArrayLike] | ArrayLike, t: float = 0.0,
        params: Parameters = None,
    ) -> Array:  # fmt: skip
        """The generalized forces of wrenches, (nq,): the sum of J^T w.

        wrenches: by frame, (6,) or (n, 6) each, N and N m, in the plane 3; or all, (nf, 6).
        """
        forces: Array = self._evaluate(
            "frame_forces", q, None, t, None, params, None, self._wrenches(wrenches, q)
        )
        return forces

    def inverse_dynamics(
        self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike,
        f_ext: Mapping[str, ArrayLike] | ArrayLike | None = None, t: float = 0.0,
        params: Parameters = None,
    ) -> Array:  # fmt: skip
        """tau = D qdd + C qd + g, (nq,), less what f_ext does: recursively, without D.

        f_ext: wrenches from outside, as in `frame_forces`. tau is all that acts along the
        coordinates, N or N m: what drives have to give is that less `tau` at u = 0, friction.
        Under constraints it is tau + A^T lambda; `drive_forces` parts them.
        """
        if f_ext is not None and not self.frames:
            raise ValueError(f"f_ext acts at frames: build it with {option('frames')}")
        given = self._like(qdd, "qdd", (self.nq,), q)
        found: Array = self._evaluate("inverse_dynamics", q, qd, t, None, params, None, given)
        return found if f_ext is None else found - self.frame_forces(q, f_ext, t=t, params=params)

    def momentum(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None
    ) -> Momentum:
        """Mass, centre of mass and momenta of all bodies that move, rotors of drives aside."""
        d = 2 if self._plane else 3
        x = self._evaluate("momentum", q, qd, t, None, params)
        angular = x[..., -1] if self._plane else x[..., 7:]
        return Momentum(x[..., 0], x[..., 1 : 1 + d], x[..., 1 + d : 1 + 2 * d], angular)

    # --- how they are called ---------------------------------------------------------------------

    @property
    def _plane(self) -> bool:
        return self._frames[1]

    @property
    def _width(self) -> int:
        return 3 if self._plane else 6

    def _of(
        self, name: str, axes: int, frame: str | None, q: ArrayLike, qd: ArrayLike | None, t: float,
        params: Parameters, given: Array | None = None,
    ) -> Array:  # fmt: skip
        """One frame's part of a function of all frames, with so many axes for each."""
        if not (frame is None or frame in self.frames):
            raise ValueError(not_one_of("frame", frame, self.frames))
        found: Array = self._evaluate(name, q, qd, t, None, params, None, given)
        if frame is None:
            return found
        one: Array = found.take(self.frames.index(frame), axis=found.ndim - 1 - axes)
        return one

    def _like(self, x: ArrayLike, name: str, shape: tuple[int, ...], q: ArrayLike) -> Array:
        """An array of numbers, a row for each state; the same for all where there is one."""
        array, rows = self._numbers(x, name), np.shape(q)[:-1]
        wanted = rows + shape
        if array.shape not in (wanted, shape):
            raise ValueError(f"{name}: shape {array.shape}, expected {wanted}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: not all numbers are finite")
        full = np.broadcast_to(array, wanted).reshape(*rows, -1)
        return np.ascontiguousarray(full)

    def _wrenches(self, given: Mapping[str, ArrayLike] | ArrayLike, q: ArrayLike) -> Array:
        shape = (len(self.frames), self._width)
        if not isinstance(given, Mapping):
            return self._like(given, "wrenches", shape, q)
        each = np.zeros((*np.shape(q)[:-1], *shape), self.dtype)
        for name, wrench in given.items():
            if name not in self.frames:
                raise ValueError(not_one_of("wrenches", name, self.frames))
            place = self.frames.index(name)
            each[..., place, :] = self._like(wrench, f"wrenches: {name}", shape[1:], q)
        return each.reshape(*each.shape[:-2], -1)
