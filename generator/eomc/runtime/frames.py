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

from .arguments import Array, Parameters, index_of
from .functions import FUNCTIONS, Functions
from .package import Component, option, reduced


class Pose(NamedTuple):
    """Position and orientation of a frame, or of several frames.

    Attributes
    ----------
    position : (3,) array, in plane scenes (2,)
        Position of the frame's origin in the world, m.
    rotation : (3, 3) array, in plane scenes a number
        Rotation matrix, whose columns are the frame's axes; in plane scenes the angle, rad.
    """

    position: Array
    rotation: Array

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("frames.Pose", *self)


class Momentum(NamedTuple):
    """Mass, centre of mass and momentum of all moving bodies.

    Vectors are (3,), or (2,) in plane scenes. The velocity of the centre of mass is linear / mass.

    Attributes
    ----------
    mass : float
        Total mass, kg.
    center : array
        Centre of mass, m.
    linear : array
        Linear momentum, kg m/s.
    angular : array, in plane scenes a number
        Angular momentum about the centre of mass, kg m^2/s.
    """

    mass: Any
    center: Array
    linear: Array
    angular: Array

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced("frames.Momentum", *self)


class Frames(Component):
    """Functions of bodies and points (frames): poses, Jacobians, inverse dynamics, momentum.

    A module has them if the scene's [run] enables them. A *twist* is the velocity of a frame's
    origin, m/s, and the angular velocity, rad/s: (6,), or (3,) in plane scenes. A *wrench* is a
    force at the frame's origin, N, and a moment, N m, in the same order. All components are along
    the world's axes. Results for n states, q (n, nq), have a leading axis n; results for all nf
    frames have an axis nf after it.
    """

    path = "frames"

    def __init__(self, functions: Functions) -> None:
        self.functions, self.arguments, self.info = functions, functions.arguments, functions.info

    def pose(
        self, q: ArrayLike, frame: str | None = None, t: float = 0.0, params: Parameters = None
    ) -> Pose:
        """Return the pose of a body or point, or of all frames.

        Parameters
        ----------
        q : (nq,) or (n, nq) array_like
            Generalized coordinates.
        frame : str, optional
            Name in `frames`; by default all, and the results have an axis nf before the last ones.
        t, params
            Time, s; parameters that differ from the scene's.

        Returns
        -------
        Pose
            (position, rotation) in the world.

        Raises
        ------
        ValueError
            If `frame` is not among the scene's `frames`.
        """
        poses = self._evaluate_frame("frame_poses", frame, q, None, t, params)
        if self.info.plane:
            return Pose(poses[..., :2], poses[..., 2])
        return Pose(poses[..., :3], poses[..., 3:].reshape(*poses.shape[:-1], 3, 3))

    def frame_velocity(
        self, q: ArrayLike, qd: ArrayLike, frame: str | None = None, t: float = 0.0,
        params: Parameters = None,
    ) -> Array:  # fmt: skip
        """Return the twist of a frame: the velocity of its origin and the angular velocity.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State.
        frame : str, optional
            Name in `frames`; by default all, and the result has an axis nf before the last one.
        t, params
            Time, s; parameters that differ from the scene's.

        Returns
        -------
        (6,) array, in plane scenes (3,)
            m/s and rad/s; with a leading axis n for n states.
        """
        return self._evaluate_frame("frame_velocities", frame, q, qd, t, params)

    def frame_acceleration(
        self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike | None = None, frame: str | None = None,
        t: float = 0.0, params: Parameters = None,
    ) -> Array:  # fmt: skip
        """Return the time derivative of a frame's twist: J qdd + dJ/dt qd.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State.
        qdd : (nq,) or (n, nq) array_like, optional
            Accelerations; by default zero, so that the result is dJ/dt qd.
        frame : str, optional
            Name in `frames`; by default all, and the result has an axis nf before the last one.
        t, params
            Time, s; parameters that differ from the scene's.

        Returns
        -------
        (6,) array, in plane scenes (3,)
            m/s^2 and rad/s^2; with a leading axis n for n states.
        """
        each = np.zeros(np.shape(q), self.info.dtype) if qdd is None else qdd
        full = self.arguments.for_each_state(each, "qdd", (self.info.nq,), q)
        return self._evaluate_frame("frame_accelerations", frame, q, qd, t, params, full)

    def jacobian(
        self, q: ArrayLike, frame: str | None = None, t: float = 0.0, params: Parameters = None
    ) -> Array:
        """Return the Jacobian J of a frame: J qd is the twist of the frame.

        Parameters
        ----------
        q : (nq,) or (n, nq) array_like
            Generalized coordinates.
        frame : str, optional
            Name in `frames`; by default all, and the result has an axis nf before the last two.
        t, params
            Time, s; parameters that differ from the scene's.

        Returns
        -------
        (6, nq) array, in plane scenes (3, nq)
            With a leading axis n for n states.
        """
        return self._evaluate_frame("frame_jacobians", frame, q, None, t, params)

    def frame_forces(
        self, q: ArrayLike, wrenches: Mapping[str, ArrayLike] | ArrayLike, t: float = 0.0,
        params: Parameters = None,
    ) -> Array:  # fmt: skip
        """Return the generalized forces, the sum of J^T w, of wrenches w (force, moment) on frames.

        Parameters
        ----------
        q : (nq,) or (n, nq) array_like
            Generalized coordinates.
        wrenches : mapping or array_like
            Wrenches by the frame's name, (6,) or (n, 6) each, or those of all frames, (nf, 6). In
            plane scenes they have 3 components instead of 6. A wrench is the force at the frame's
            origin, N, then the moment, N m.
        t, params
            Time, s; parameters that differ from the scene's.

        Returns
        -------
        (nq,) or (n, nq) array
            Generalized forces, N or N m.
        """
        forces: Array = self.functions.evaluate(
            "frame_forces", q, None, t, self._wrenches(wrenches, q), params
        )
        return forces

    def inverse_dynamics(
        self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike,
        f_ext: Mapping[str, ArrayLike] | ArrayLike | None = None, t: float = 0.0,
        params: Parameters = None,
    ) -> Array:  # fmt: skip
        """Return the generalized force that a motion requires: D qdd + C qd + g - sum(J^T f_ext).

        It is the sum of all forces that the motion requires. Damping, friction and the scene's
        other forces contribute to this sum, so the drives supply the rest: inverse_dynamics(q, qd,
        qdd) - tau(q, qd, u=np.zeros(nu)). With constraints it equals tau + A^T lambda;
        `drive_forces` separates the two terms. The evaluation is recursive and does not form D.

        Parameters
        ----------
        q, qd, qdd : (nq,) or (n, nq) array_like
            State and accelerations.
        f_ext : mapping or array_like, optional
            External wrenches (force and moment) on frames, in the form of `wrenches` in
            `frame_forces`.
        t, params
            Time, s; parameters that differ from the scene's.

        Returns
        -------
        (nq,) or (n, nq) array
            Generalized forces, N or N m.

        Raises
        ------
        ValueError
            If `f_ext` is given and the module has no frames.
        """
        if f_ext is not None and not self.info.frames:
            raise ValueError(f"f_ext acts at frames: build it with {option('frames')}")
        accelerations = self.arguments.for_each_state(qdd, "qdd", (self.info.nq,), q)
        forces: Array = self.functions.evaluate("inverse_dynamics", q, qd, t, accelerations, params)
        return forces if f_ext is None else forces - self.frame_forces(q, f_ext, t=t, params=params)

    def momentum(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None
    ) -> Momentum:
        """Return mass, centre of mass and momenta of all moving bodies, except rotors of drives.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) array_like
            State.
        t, params
            Time, s; parameters that differ from the scene's.

        Returns
        -------
        Momentum
            Named tuple (mass, center, linear, angular); with a leading axis n for n states.
        """
        d = 2 if self.info.plane else 3
        x = self.functions.evaluate("momentum", q, qd, t, None, params)
        angular = x[..., -1] if self.info.plane else x[..., 7:]
        return Momentum(x[..., 0], x[..., 1 : 1 + d], x[..., 1 + d : 1 + 2 * d], angular)

    def _evaluate_frame(
        self, name: str, frame: str | None, q: ArrayLike, qd: ArrayLike | None, t: float,
        params: Parameters, accelerations: Array | None = None,
    ) -> Array:  # fmt: skip
        """Evaluate a function of all frames; return the part of one frame, or all."""
        place = None if frame is None else index_of("frame", frame, self.info.frames)
        values: Array = self.functions.evaluate(name, q, qd, t, accelerations, params)
        axis = -len(FUNCTIONS[name].shape(self.info))
        return values if place is None else np.asarray(values.take(place, axis=axis))

    def _wrenches(self, wrenches: Mapping[str, ArrayLike] | ArrayLike, q: ArrayLike) -> Array:
        shape = (len(self.info.frames), self.info.frame_size)
        if not isinstance(wrenches, Mapping):
            return self.arguments.for_each_state(wrenches, "wrenches", shape, q)
        each = np.zeros((*np.shape(q)[:-1], *shape), self.info.dtype)
        for name, wrench in wrenches.items():
            place = index_of("wrenches", name, self.info.frames)
            each[..., place, :] = self.arguments.for_each_state(
                wrench, f"wrenches: {name}", shape[1:], q
            )
        return each.reshape(*each.shape[:-2], -1)
