"""Constraints of a compiled scene: residuals, multipliers, reactions and projection.

D qdd + C qd + g = tau + A^T lambda, with A = dphi/dq for holonomic constraint equations
phi(q, t) = 0 and A = dpsi/dqd for nonholonomic ones, psi(q, qd, t) = 0, which are linear in qd. nc
is the number of constraint equations; results are in their order in the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from . import rank
from .arguments import Array, ByName, Parameters, StateArguments, as_names
from .functions import Functions
from .package import Component, option
from .status import STATUS, STATUS_MESSAGES, MotionError, check_finite, state_text


class Constraints(Component):
    """Methods of a compiled scene that concern its constraint equations.

    The equations come from [constraints] and [[loop]] of the scene. In all methods q and qd are one
    state (nq,) or n states (n, nq). For n states the results have a first axis n, t may be an array
    (n,), and values in params may be arrays (n,).
    """

    path = "constraints"

    def __init__(self, functions: Functions) -> None:
        self.functions, self.arguments = functions, functions.arguments
        self.info, self.c, self.nq = functions.info, functions.c, functions.nq

    def constraints(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None
    ) -> Array:
        """Return the residuals of the constraint equations at a state, or at many states.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) arrays
            Positions and velocities.
        t : float or (n,) array
            Time, s.
        params : dict, Params or array, optional
            Parameters; by default those of the scene.

        Returns
        -------
        (nc,) or (n, nc) array
            phi(q, t) of holonomic and psi(q, qd, t) of nonholonomic constraints, in the units of
            the constraint equations.
        """
        return np.asarray(self.functions.evaluate("constraints", q, qd, t, None, params))

    def constraint_rates(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None
    ) -> Array:
        """Return the residuals of the constraint equations at velocity level.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) arrays
            Positions and velocities.
        t : float or (n,) array
            Time, s.
        params : dict, Params or array, optional
            Parameters; by default those of the scene.

        Returns
        -------
        (nc,) or (n, nc) array
            The time derivative A qd + dphi/dt of holonomic constraints, and psi(q, qd, t) of
            nonholonomic ones.
        """
        return np.asarray(self.functions.evaluate("constraint_rates", q, qd, t, None, params))

    def constraint_jacobian(self, q: ArrayLike, t: float = 0.0, params: Parameters = None) -> Array:
        """Return the constraint Jacobian A at positions q.

        Parameters
        ----------
        q : (nq,) or (n, nq) array
            Positions.
        t : float or (n,) array
            Time, s.
        params : dict, Params or array, optional
            Parameters; by default those of the scene.

        Returns
        -------
        (nc, nq) or (n, nc, nq) array
            dphi/dq of holonomic constraints phi(q, t) = 0, dpsi/dqd of nonholonomic ones,
            psi(q, qd, t) = 0.
        """
        jacobian = self.functions.evaluate("constraint_jacobian", q, None, t, None, params)
        return np.asarray(jacobian)

    def tangent(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None
    ) -> Array:
        """Return an orthonormal basis T of the changes of a state that the constraints allow.

        The state is x = [q; qd]. With such a basis the linearised motion near an equilibrium x0
        reduces to independent states z, where x - x0 = T z and dz/dt = T^T A T z + T^T B u. The
        matrices A and B are those of `linearize`.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) arrays
            Positions and velocities.
        t : float or (n,) array
            Time, s.
        params : dict, Params or array, optional
            Parameters; by default those of the scene.

        Returns
        -------
        T : (2 nq, k) or (n, 2 nq, k) array
            Its k columns are the basis.

        Raises
        ------
        ValueError
            If the scene was built without derivatives, or k differs between the states.
        MotionError
            If a derivative of a constraint is not finite.
        """
        if not hasattr(self.c.lib, "constraint_slopes"):
            raise ValueError(
                f"tangent: {self.info.name} was built without derivatives: build it with "
                f"{option('linearize')}, or discretize"
            )
        A = self.constraint_jacobian(q, t=t, params=params)
        slopes = self.functions.evaluate("constraint_slopes", q, qd, t, None, params)
        of_q = A[..., : self.info.constraints.holonomic, :]
        whole = np.block([[of_q, np.zeros_like(of_q)], [slopes, A]])
        check_finite(whole, 2, q, qd, "a constraint's slope")
        _, sizes, rows = np.linalg.svd(rank.unit_rows(whole))
        ranks = rank.count(sizes, self.info.dtype)
        if not ranks.size:
            return np.empty((0, 2 * self.nq, 0))
        if np.any(ranks != ranks.flat[0]):
            few, many = int(np.argmax(ranks)), int(np.argmin(ranks))
            raise ValueError(
                f"tangent: {2 * self.nq - ranks[few]} changes keep the constraints at state {few}, "
                f"{2 * self.nq - ranks[many]} at state {many}: ask for each by itself"
            )
        return np.ascontiguousarray(np.swapaxes(rows[..., int(ranks.flat[0]) :, :], -1, -2))

    def multipliers(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None, params: Parameters = None
    ) -> Array:
        """Return the Lagrange multipliers of the constraints at a state, or at many states.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) arrays
            Positions and velocities.
        t : float or (n,) array
            Time, s.
        u : (nu,) or (n, nu) array, or dict, optional
            Inputs; by default the scene's signals.
        params : dict, Params or array, optional
            Parameters; by default those of the scene.

        Returns
        -------
        lambda : (nc,) or (n, nc) array
            0 for redundant constraints. A^T lambda is the generalized constraint force.

        Raises
        ------
        MotionError
            If D is singular, or a multiplier is not finite.
        """
        values = self.multipliers_or_nan(q, qd, t, u, params)
        if not np.isfinite(values).all():
            self.functions.acceleration(q, qd, t, u, params)  # raises with place and reason
            k = np.argwhere(~np.isfinite(values))[0, -1]
            check_finite(values, 1, q, qd, f"the multiplier of {self.info.constraints.names[k]}")
        return values

    def multipliers_or_nan(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None, params: Parameters = None
    ) -> Array:
        """Return the multipliers, nan if they do not exist."""
        return np.asarray(self.functions.evaluate("multipliers", q, qd, t, u, params))

    def reactions(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None, params: Parameters = None
    ) -> dict[str, Array]:
        """Return the reaction of the joint of each [[loop]] on its second body.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) arrays
            Positions and velocities.
        t : float or (n,) array
            Time, s.
        u : (nu,) or (n, nu) array, or dict, optional
            Inputs; by default the scene's signals.
        params : dict, Params or array, optional
            Parameters; by default those of the scene.

        Returns
        -------
        dict of (6,) or (n, 6) arrays
            By the loop's name: the force, N, and the moment about the joint's point, N m, along the
            axes of the world. For plane scenes (3,) or (n, 3), with two components of the force and
            the moment.

        Raises
        ------
        ValueError
            If the scene has no loops.
        MotionError
            If D is singular, or a multiplier is not finite.
        """
        if not self.info.constraints.loops:
            raise ValueError(f"reactions: {self.info.name} has no [[loop]]")
        values = self._reactions_from(self.multipliers(q, qd, t, u, params), q, qd, t, params)
        return ByName("reactions", self.info.constraints.loops, np.moveaxis(values, -2, 0))

    def reactions_or_nan(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, u: Any = None, params: Parameters = None
    ) -> Array:
        """Return reactions of all loops, (loops, 6), in the plane (loops, 3); nan if undefined."""
        return self._reactions_from(self.multipliers_or_nan(q, qd, t, u, params), q, qd, t, params)

    def _reactions_from(
        self, multipliers: Array, q: ArrayLike, qd: ArrayLike, t: float, params: Any
    ) -> Array:
        each = np.ascontiguousarray(multipliers)
        return np.asarray(self.functions.evaluate("reactions", q, qd, t, each, params))

    def project(
        self, q: ArrayLike, qd: ArrayLike, t: float = 0.0, params: Parameters = None,
        fixed: Sequence[str] | None = None,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Project a state, or many states, onto the constraints and return the result.

        The change is the smallest one in the metric of the mass matrix D.

        Parameters
        ----------
        q, qd : (nq,) or (n, nq) arrays
            Positions and velocities, which are not overwritten.
        t : float or (n,) array
            Time, s.
        params : dict, Params or array, optional
            Parameters; by default those of the scene.
        fixed : sequence of str, optional
            Names of coordinates and velocities, such as "theta_dot", that stay unchanged. By
            default all may change.

        Returns
        -------
        q, qd : arrays of the same shapes

        Raises
        ------
        ValueError
            For unknown names in `fixed`.
        MotionError
            If no such state is found near the given one (status "locked").
        """
        names = () if fixed is None else as_names("fixed", fixed, self.info.states)
        flags = tuple(name in names for name in self.info.states) if names else ()
        return self.project_fixed(q, qd, t, params, flags)

    def project_fixed(
        self, q: ArrayLike, qd: ArrayLike, t: float, params: Any, fixed: Sequence[bool]
    ) -> tuple[Array, Array]:
        """Project a state or many. fixed: whether each of q and qd is fixed, or empty."""
        return self._check(*self.project_rows(q, qd, t, params, fixed), fixed)

    def _check(
        self, q: Array, qd: Array, codes: Array, fixed: Sequence[bool]
    ) -> tuple[Array, Array]:
        """Return projected states; raise MotionError for the first with a status other than ok."""
        if not codes.any():
            return q, qd
        k = int(codes.nonzero()[0][0])
        status, discrete = STATUS[codes[k]], self.info.discrete_coordinates
        names = [
            name for name, is_fixed in zip(self.info.states, fixed, strict=False)
            if is_fixed and name.removesuffix("_dot") not in discrete
        ]  # fmt: skip
        what = STATUS_MESSAGES[status]
        if status == "locked":
            with_fixed = f" with {', '.join(names)} as given: leave one free" if names else ""
            what = f"no state near that obeys the constraints{with_fixed}"
        where = state_text(*(np.atleast_2d(x)[k] for x in (q, qd)))
        raise MotionError(f"from {where}: {what}", status)

    def project_rows(
        self, q: ArrayLike, qd: ArrayLike, t: float, params: Any, fixed: Sequence[bool]
    ) -> tuple[Array, Array, Array]:
        """Return projected (q, qd) and the status of each state; failed ones are unchanged."""
        at, moving = (np.array(x, self.info.dtype, order="C") for x in self.arguments.state(q, qd))
        flags = self.c.ffi.new("int[]", [int(x) for x in fixed]) if fixed else self.c.null
        acts, n = StateArguments(self.arguments, at.shape[:-1], t, None, params), self.nq
        codes, first = np.zeros(at.size // n, "i"), 0
        from_q, from_qd = self.c.pointer(at), self.c.pointer(moving)
        while first < len(codes):
            now, _, p, own = acts.pointers(first)
            result = self.c.lib.project(
                len(codes) - first, from_q + n * first, from_qd + n * first, now, flags, p, own
            )
            first += result >> 3
            if result & 7:
                codes[first] = result & 7
                first += 1
        return at, moving, codes

    def assemble_rows(
        self, q: Array, qd: Array, table: Array, t0: float
    ) -> tuple[Array, Array, Array | None]:
        """Assemble many starts (n, nq); return them and their status, (n,), or None if all succeed.

        table: parameters, a row for each or one for all. A start that cannot be assembled is
        unchanged.
        """
        if not self.info.constraints.names:
            return q, qd, None
        q, qd, codes = self._assemble(q, qd, t0, table if len(table) > 1 else table[0])
        return q, qd, codes if codes.any() else None

    def assemble(self, q0: Any, qd0: Any, t0: float, params: Any) -> tuple[Any, Any]:
        """Return an initial state on the constraints; values that the scene fixes are unchanged."""
        if q0 is None and qd0 is None and params is None and t0 == 0:
            return q0, qd0
        if not (self.info.constraints.names or self.info.discrete_count):
            return q0, qd0
        q0, qd0 = self.info.with_discrete(q0, 0), self.info.with_discrete(qd0, 1)
        for x, name in ((q0, "q0"), (qd0, "qd0")):
            if x is not None:
                self.arguments.initial_half(x, name)
        if not self.info.constraints.names:
            return q0, qd0
        q, qd = self.info.initial_state
        states = self._assemble(q if q0 is None else q0, qd if qd0 is None else qd0, t0, params)
        return self._check(*states, self.info.constraints.fixed)

    def _assemble(
        self, q: ArrayLike, qd: ArrayLike, t0: float, params: Any
    ) -> tuple[Array, Array, Array]:
        """Project starts onto the constraints and set friction modes from their velocities.

        Return the status of each as well. Failed ones are unchanged.
        """
        fixed = self.info.constraints.fixed
        if not self.info.constraints.modes:
            return self.project_rows(q, qd, t0, params, fixed)
        *states, first = self.project_rows(self._sliding(q), qd, t0, params, fixed)
        *states, codes = self.project_rows(*self._in_modes(*states), t0, params, fixed)
        codes = np.where(first, first, codes)
        failed = (codes != 0).reshape(*np.shape(q)[:-1], 1)
        return np.where(failed, q, states[0]), np.where(failed, qd, states[1]), codes

    def _sliding(self, q: ArrayLike) -> Array:
        """Return q with all friction modes set to sliding."""
        q = np.array(q, self.info.dtype)
        q[..., [at for at, _ in self.info.constraints.modes]] = 1
        return q

    def _in_modes(self, q: Array, qd: Array) -> tuple[Array, Array]:
        """Set friction modes to the signs of their velocities; tiny velocities become 0."""
        rest_tolerance, min_speed = 1e-12, 1e-18  # of the largest velocity; m/s or rad/s
        at, of = np.array(self.info.constraints.modes).T
        fastest = np.max(np.abs(qd), axis=-1, keepdims=True)
        qd[..., of] *= np.abs(qd[..., of]) > np.maximum(rest_tolerance * fastest, min_speed)
        q[..., at] = np.sign(qd[..., of])
        return q, qd
