"""Forces that hold a compiled scene at rest or give it a motion: equilibria, forces of drives."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arguments import Array, Parameters, Start, as_number
from .constrained import Constrained
from .drives import Motion, actuated_coordinates, drive_forces
from .equilibrium import Equilibrium, equilibrium
from .starts import initial_state_for_parameters, values_by_name


class Statics(Constrained):
    """A compiled scene with methods for inverse problems.

    The problems are the actuator forces that a motion requires, and equilibria.
    """

    def drive_forces(
        self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, drives: Sequence[str] | None = None,
        f_ext: Mapping[str, ArrayLike] | ArrayLike | None = None, t: float = 0.0,
        params: Parameters = None,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return the actuator forces tau and the multipliers lambda that a given motion requires.

        tau + A^T lambda equals `inverse_dynamics` minus friction and all other forces of the scene
        at zero inputs. If there are more drives than degrees of freedom, the solution with the
        smallest tau^T D^-1 tau is returned.

        Parameters
        ----------
        q, qd, qdd : (nq,) or (n, nq) array_like
            State and accelerations of the motion.
        drives : sequence of str, optional
            Coordinates along which actuators act; by default all. tau is 0 along the others.
        f_ext : mapping or array_like, optional
            External wrenches (force and moment) on frames, in the form of `wrenches` in
            `frame_forces`.
        t, params
            Time, s; parameters that differ from the scene's.

        Returns
        -------
        tau : (nq,) or (n, nq) array
            Actuator forces along the coordinates, N or N m.
        multipliers : (nc,) or (n, nc) array
            Lagrange multiplier of each constraint equation.

        Raises
        ------
        ValueError
            If the drives cannot produce this motion, or the constraints do not allow `qdd`.
        MotionError
            If D is not positive definite or a value is not finite.
        """
        which = actuated_coordinates(self, drives)
        force = self.inverse_dynamics(q, qd, qdd, f_ext, t=t, params=params)
        force = force - self.tau(q, qd, t, np.zeros(self.nu) if self.nu else None, params)
        at, moving = self._state(q, qd)
        each = self._like(qdd, "qdd", (self.nq,), at)
        tau = np.empty_like(at)
        multipliers = np.empty((*at.shape[:-1], len(self._rows.names)), at.dtype)
        motion = Motion.from_states(self, at, moving, each, force, t, params)
        for k in np.ndindex(at.shape[:-1]):
            tau[k], multipliers[k] = drive_forces(self, which, motion.state(k))
        return tau, multipliers

    def equilibrium(
        self, q: Start = None, qd: Start = 0.0, t: float = 0.0, u: Any = None,
        params: Parameters = None, *, free: Collection[str] | None = None,
    ) -> Equilibrium:  # fmt: skip
        """Find a state and inputs at which the accelerations are zero, by Newton's method.

        Parameters
        ----------
        q : (nq,) array or dict, optional
            Positions, or their guess. Values that are not given are the initial values of the
            scene.
        qd : float, (nq,) array or dict
            Velocities, or their guess. Values that are not given are 0.
        t : float
            Time, s.
        u : (nu,) array or dict, optional
            Inputs, or their guess; by default the scene's signals.
        params : optional
            Parameters that differ from those of the scene.
        free : collection of str, optional
            Names of the coordinates, velocities (such as "theta_dot") and inputs that are solved
            for; by default all coordinates that have velocities. All other values stay as they are
            given. If `free` contains velocities, such as "charge_dot", the result is a steady
            motion, provided that no force changes along it.

        Returns
        -------
        Equilibrium
            The named tuple (q, qd, u).

        Raises
        ------
        MotionError
            If no equilibrium is found; its status is "no convergence".
        """
        if isinstance(free, str):
            free = (free,)
        if not (free is None or isinstance(free, Iterable)):
            raise ValueError(
                f"free: {free!r} is no list of names: {', '.join((*self._states, *self.inputs))}"
            )
        rates: Any = qd
        by_name = values_by_name(self, rates, 1)
        if by_name is not None:
            moving = np.zeros(self.nq)
            for name, value in by_name.items():
                moving[self.coordinates.index(name)] = value
        elif not isinstance(rates, (list, tuple)) and not np.ndim(rates):
            moving = np.full(self.nq, as_number(rates, "qd"))
        else:
            moving = self._completed(rates, 1)
        q = self._completed(q, 0)
        at, moving = self._one(
            *initial_state_for_parameters(self, q, moving, self._parameters(params))
        )
        moves = [name for name in self.coordinates if name not in self.discrete_coordinates]
        names = moves if free is None else tuple(free)
        inputs = self._inputs(u)
        return equilibrium(self, at, moving, inputs, names, as_number(t, "t"), params)
