"""Checks of frames, inverse dynamics and momenta, recomputed from the scene's own tables.

As in rows_bodies.py frames are composed of quaternions along a line through the state, here bent by
accelerations, and everything else is a derivative of the interpolating polynomial.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from eomc.scene.scene import Scene
from eomc.verify.comparison import Comparison
from eomc.verify.reference import Vector
from eomc.verify.report import LIMIT as ROUNDINGS
from eomc.verify.rows_bodies import LIMIT, UNITS, Line, rotate, widths
from eomc.verify.sampling import Expected, State

STATES = 4
TWICE = 1e-8  # of accelerations: two derivatives are good to 1e-10


def report(check: Comparison, scene: Scene) -> None:
    """Append checks of frames and momentum to the report of `eomc check`.

    Frames are coordinate systems on bodies for which the module has functions, such as poses and
    velocities. A function that the module does not have is not checked.
    """
    run, eps = check.system.run, check.eps
    for module, form in check.forms:
        frames = _Frames(check, module, scene)

        def row(name: str, limit: float, measure: Callable[[Expected], float]) -> None:
            largest = partial(check.largest, measure, STATES)
            check.row(f"{form}{name}", max(limit, UNITS * eps), "of their size", largest)  # noqa: B023

        if check.system.output_frames:
            row("poses of frames", LIMIT, frames.poses)
            row("velocities of frames", LIMIT, frames.velocities)
            row("accelerations of frames", TWICE, frames.accelerations)
            row("Jacobians of frames", LIMIT, frames.jacobians)
            row("forces at frames", LIMIT, frames.forces)
        if run.momentum:
            row("momentum", LIMIT, frames.momentum)


def inverse_dynamics(check: Comparison) -> None:
    """Append checks of the module's `inverse_dynamics` to the report of `eomc check`.

    This function is compared with D q̈ + bias of the reference.
    """
    for module, form in check.forms:
        measure = partial(check.largest, partial(_inverse, check, module), STATES)
        check.row(f"{form}inverse dynamics", ROUNDINGS, "units of rounding", measure)


def _inverse(check: Comparison, module: Any, e: Expected) -> float:
    """Return the error of `inverse_dynamics` at a state, in units of rounding.

    The accelerations are twice those of the motion, plus large ones of alternating signs.
    """
    s, D = e.state, e.value["D"]
    qdd = 2 * e.value["acceleration"]
    qdd = qdd + check.sampler.speed**2 / check.sampler.spread * (-1.0) ** np.arange(len(qdd))
    forces = module.inverse_dynamics(s.q, s.qd, qdd, t=s.t, params=s.params)
    size = e.size["D"] @ np.abs(qdd) + e.size["bias"]
    return check.units(forces, D @ qdd + e.value["bias"], size)


class _Frames:
    """Comparison of a module's frame functions with frames computed from the scene's own tables.

    module: that of one form of C, optimised or portable.
    """

    def __init__(self, check: Comparison, module: Any, scene: Scene) -> None:
        self.check, self.module, self.scene = check, module, scene
        self.names = [f.name for f in check.system.output_frames]
        self.plane = check.system.plane

    def lines(self, s: State, bend: Vector | float = 0.0) -> Iterator[Line]:
        """Yield short motions through the state `s`, one for each of several durations.

        bend: accelerations during the motion, (nq,). See `rows_bodies.Line`.
        """
        for width in widths(self.check.sampler.spread, s.qd, bend):
            with np.errstate(all="ignore"):
                yield Line(
                    self.scene, self.check.sampler.with_discrete_parameters(s), width, 1.0, bend
                )

    def off(
        self, values: Vector, exact: Callable[[Line], Vector], *state: Any, least: float = 0.0
    ) -> float:
        """Return the largest error of the module's `values`, relative to the largest exact value.

        exact: a function that computes the exact values from a line of motion (a short motion
        through a state). state: arguments of `lines`, which yields such lines of several widths;
        the smallest error counts. least: lower bound of the divisor.
        """
        best = np.inf
        for line in self.lines(*state):
            with np.errstate(all="ignore"):
                expected = exact(line)
                size = max(float(np.max(np.abs(expected))), least) or 1.0
                off = float(np.max(np.abs(values - expected))) / size
            best = min(best, off) if off == off else best
            if best < LIMIT / 10:
                break
        return best

    def arguments(self, s: State) -> dict[str, Any]:
        """Return time and parameters of a state as keyword arguments for the module."""
        return {"t": s.t, "params": s.params}

    def relevant_components(self, linear: Vector, angular: Vector) -> Vector:
        """Return the components (x, y, angle) of a motion in the plane, or all six in space.

        linear, angular: vectors of three components.
        """
        return np.array([*linear[:2], angular[2]] if self.plane else [*linear, *angular])

    def poses(self, e: Expected) -> float:
        """Return the relative error of the module's positions and rotations of frames."""
        poses = self.module.pose(e.state.q, **self.arguments(e.state))

        def exact(line: Line) -> Vector:
            rows = []
            for name in self.names:
                frame, m = line.frames[name], line.middle
                axes = [rotate(frame.turn, x)[m] for x in np.eye(3)]
                turn = [frame.angle[m]] if self.plane else np.array(axes).T.ravel()
                rows.append([*frame.at[m][: 2 if self.plane else 3], *turn])
            return np.array(rows)

        n = len(self.names)
        both = np.hstack([poses.position, np.reshape(poses.rotation, (n, -1))])
        return self.off(both, exact, e.state)

    def twists(self, line: Line) -> Vector:
        """Return linear and angular velocities of all nf frames along a motion, (nf, 6, n).

        line: the motion, evaluated at n times.
        """
        motions = (line.motion(line.frames[name], np.zeros(3)) for name in self.names)
        return np.array([np.hstack(motion).T for motion in motions])

    def relevant_twists(self, twists: Vector) -> Vector:
        """Return the components of twists (nf, 6) that exist in the plane, or all in space."""
        return np.array([self.relevant_components(x[:3], x[3:]) for x in twists])

    def velocities(self, e: Expected) -> float:
        """Return the relative error of the module's linear and angular velocities of frames."""
        s = e.state
        twists = self.module.frame_velocity(s.q, s.qd, **self.arguments(s))
        least = self.twist_scale(s, self.check.sampler.speed)

        def exact(line: Line) -> Vector:
            return self.relevant_twists(self.twists(line)[..., line.middle])

        return self.off(twists, exact, s, least=least)

    def twist_scale(self, s: State, rates: Vector) -> float:
        """Return the largest entry of |J| rates, a bound of the frames' velocities at a state.

        J are the module's Jacobians of the frames. rates: coordinate velocities, (nq,), used in
        place of those of `s`.
        """
        J = np.abs(self.module.jacobian(s.q, **self.arguments(s)))
        return float(np.max(J @ rates, initial=0))

    def accelerations(self, e: Expected) -> float:
        """Return the relative error of the module's accelerations of frames.

        The accelerations of the coordinates are those of the motion.
        """
        s, qdd = e.state, e.value["acceleration"]
        rates = self.module.frame_acceleration(s.q, s.qd, qdd, **self.arguments(s))

        def exact(line: Line) -> Vector:
            return self.relevant_twists(self.twists(line) @ line.rate[line.middle])

        sampler = self.check.sampler
        least = self.twist_scale(s, sampler.speed**2 / sampler.spread)
        return self.off(rates, exact, s, qdd, least=least)

    def jacobians(self, e: Expected) -> float:
        """Return the relative error of the module's Jacobians of frames.

        Column i is compared with the frames' velocities when coordinate i alone moves, minus their
        velocities when no coordinate moves, which are due to time alone.
        """
        s = e.state
        J = np.asarray(self.module.jacobian(s.q, **self.arguments(s)), float)
        at_rest = self.check.sampler.with_discrete_parameters(replace(s, qd=0 * s.qd))
        rates, worst = np.maximum(self.check.sampler.spread, 1), 0.0
        for k, direction in enumerate(np.eye(len(s.q))):

            def exact(line: Line) -> Vector:
                rest = Line(self.scene, at_rest, line.width)
                both = [self.relevant_twists(self.twists(x)[..., x.middle]) for x in (line, rest)]
                return both[0] - both[1]

            moving = replace(s, qd=direction * rates)
            worst = max(worst, self.off(J[..., k] * rates[k], exact, moving))
        return worst

    def forces(self, e: Expected) -> float:
        """Return the relative error of the module's `frame_forces`, Jᵀw for forces w at frames.

        The forces are random, and the expected value follows from the module's own Jacobians J.
        """
        s, arguments = e.state, self.arguments(e.state)
        J = np.asarray(self.module.jacobian(s.q, **arguments), float)
        w = np.random.default_rng(0).normal(size=J.shape[:2])
        forces = self.module.frame_forces(s.q, w, **arguments)
        size = np.einsum("fik,fi->k", np.abs(J), np.abs(w))
        off = np.abs(forces - np.einsum("fik,fi->k", J, w))
        return float(np.max(off) / (np.max(size) or 1.0))

    def momentum(self, e: Expected) -> float:
        """Return the relative error of the module's mass, centre of mass and momenta.

        The expected values follow from the point masses of all bodies.
        """
        s = e.state
        m = self.module.momentum(s.q, s.qd, **self.arguments(s))
        momentum = np.hstack([m.mass, m.center, m.linear, m.angular])

        def exact(line: Line) -> Vector:
            bodies = line.bodies
            masses = [(p, x, line.frames[b.name]) for b in bodies for p, x in line.points(b)]
            places = [frame.point(x) for _, x, frame in masses]
            weights = np.array([p for p, *_ in masses])
            at = np.array([x[line.middle] for x in places])
            v = np.array([(line.rate @ x)[line.middle] for x in places])
            center, linear = weights @ at / sum(weights), weights @ v
            angular = np.sum(np.cross(at - center, weights[:, None] * v), axis=0)
            d = 2 if self.plane else 3
            return np.hstack([sum(weights), center[:d], self.relevant_components(linear, angular)])

        return self.off(momentum, exact, s)
