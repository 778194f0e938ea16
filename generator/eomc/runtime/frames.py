"""Poses, velocities and Jacobians of bodies and points, inverse dynamics, momenta.

All components are along the world's axes. A twist is the velocity of a frame's origin and the
angular velocity, six numbers, in the plane three; a wrench is a force at the origin and a moment,
in the same order. Shapes: q (nq,) or (n, nq); results for n states have a leading n, and results
for all frames an axis nf after it.
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
    """Momentum of all moving bodies, linear kg m/s, angular kg m2/s; mass, kg; centre of mass, m.

    `angular` is about the centre of mass. The velocity of the centre is linear/mass.
    """

    mass: Any
    center: Array
    linear: Array
    angular: Array

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("frames.Momentum", *self)


class Frames(Functions):
    """Functions of bodies that [run] enables: `frames`, `inverse_dynamics`, `momentum`."""

    @property
    def frames(self) -> tuple[str, ...]:
        """The bodies and points that have poses and Jacobians, in the order of results."""
        return self._frames[0]

    def pose(
        self, q: ArrayLike, frame: str | None = None, t: float = 0.0, params: Parameters = None
    ) -> Pose:
        """Return the pose of a body or point, or of all frames if `frame` is None.

        Raises ValueError for a frame that is not among the scene's `frames`.
        """
        poses = self._evaluate_frame("frame_poses", 1, frame, q, None, t, params)
        if self._plane:
            return Pose(poses[..., :2], poses[..., 2])
        return Pose(poses[..., :3], poses[..., 3:].reshape(*poses.shape[:-1], 3, 3))

    def frame_velocity(
        self, q: ArrayLike, qd: ArrayLike, frame: str | None = None, t: float = 0.0,
        params: Parameters = None,
    ) -> Array:  # fmt: skip
        """The twist of a frame, (6,), in the plane (3,): m/s, rad/s."""
        return self._evaluate_frame("frame_velocities", 1, frame, q, qd, t, params)

    def frame_acceleration(
        self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike | None = None, frame: str | None = None,
        t: float = 0.0, params: Parameters = None,
    ) -> Array:  # fmt: skip
        """The rate of `frame_velocity` at accelerations qdd: m/s2, rad/s2.

        Without qdd at zero, which leaves dJ/dt qd: J qdd + that is the acceleration.
        """
        each = np.zeros(np.shape(q), self.dtype) if qdd is None else qdd
        full = self._like(each, "qdd", (self.nq,), q)
        return self._evaluate_frame("frame_accelerations", 1, frame, q, qd, t, params, full)

    def jacobian(
        self, q: ArrayLike, frame: str | None = None, t: float = 0.0, params: Parameters = None
    ) -> Array:
        """J of a frame, (6, nq), in the plane (3, nq): J qd is its twist."""
        return self._evaluate_frame("frame_jacobians", 2, frame, q, None, t, params)

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
        accelerations = self._like(qdd, "qdd", (self.nq,), q)
        forces: Array = self._evaluate(
            "inverse_dynamics", q, qd, t, None, params, None, accelerations
        )
        return forces if f_ext is None else forces - self.frame_forces(q, f_ext, t=t, params=params)

    def momentum(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None
    ) -> Momentum:
        """Mass, centre of mass and momenta of all bodies that move, rotors of drives aside."""
        d = 2 if self._plane else 3
        x = self._evaluate("momentum", q, qd, t, None, params)
        angular = x[..., -1] if self._plane else x[..., 7:]
        return Momentum(x[..., 0], x[..., 1 : 1 + d], x[..., 1 + d : 1 + 2 * d], angular)

    # --- calls of C ------------------------------------------------------------------------------

    @property
    def _plane(self) -> bool:
        return self._frames[1]

    @property
    def _width(self) -> int:
        return 3 if self._plane else 6

    def _evaluate_frame(
        self, name: str, axes: int, frame: str | None, q: ArrayLike, qd: ArrayLike | None, t: float,
        params: Parameters, extra: Array | None = None,
    ) -> Array:  # fmt: skip
        """Evaluate a function of all frames; return the part of one, which has `axes` axes."""
        if not (frame is None or frame in self.frames):
            raise ValueError(not_one_of("frame", frame, self.frames))
        values: Array = self._evaluate(name, q, qd, t, None, params, None, extra)
        if frame is None:
            return values
        one: Array = values.take(self.frames.index(frame), axis=values.ndim - 1 - axes)
        return one

    def _like(self, x: ArrayLike, name: str, shape: tuple[int, ...], q: ArrayLike) -> Array:
        """Return x as an array with a row for each state; one row is repeated for all."""
        array, rows = self._numbers(x, name), np.shape(q)[:-1]
        expected = rows + shape
        if array.shape not in (expected, shape):
            raise ValueError(f"{name}: shape {array.shape}, expected {expected}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: not all numbers are finite")
        full = np.broadcast_to(array, expected).reshape(*rows, -1)
        return np.ascontiguousarray(full)

    def _wrenches(self, wrenches: Mapping[str, ArrayLike] | ArrayLike, q: ArrayLike) -> Array:
        shape = (len(self.frames), self._width)
        if not isinstance(wrenches, Mapping):
            return self._like(wrenches, "wrenches", shape, q)
        each = np.zeros((*np.shape(q)[:-1], *shape), self.dtype)
        for name, wrench in wrenches.items():
            if name not in self.frames:
                raise ValueError(not_one_of("wrenches", name, self.frames))
            place = self.frames.index(name)
            each[..., place, :] = self._like(wrench, f"wrenches: {name}", shape[1:], q)
        return each.reshape(*each.shape[:-2], -1)
