"""Rows of `check` about frames, inverse dynamics and momenta: by the bodies' own tables once more.

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
from eomc.verify.oracle import Vector
from eomc.verify.report import LIMIT as ROUNDINGS
from eomc.verify.rows_bodies import LIMIT, UNITS, Line, rotated, widths
from eomc.verify.sampling import Expected, State

STATES = 4
TWICE = 1e-8  # of accelerations: two derivatives are good to 1e-10


def report(of: Comparison, scene: Scene) -> None:
    """Add the rows of what the scene asks for."""
    run, eps = of.system.run, of.eps
    for module, form in of.forms:
        frames = _Frames(of, module, scene)

        def row(name: str, limit: float, measure: Callable[[Expected], float]) -> None:
            largest = partial(of.largest, measure, STATES)
            of.row(f"{form}{name}", max(limit, UNITS * eps), "of their size", largest)  # noqa: B023

        if of.system.asked:
            row("poses of frames", LIMIT, frames.poses)
            row("velocities of frames", LIMIT, frames.velocities)
            row("accelerations of frames", TWICE, frames.accelerations)
            row("Jacobians of frames", LIMIT, frames.jacobians)
            row("forces at frames", LIMIT, frames.forces)
        if run.momentum:
            row("momentum", LIMIT, frames.momentum)


def inverse_dynamics(of: Comparison) -> None:
    """Add the rows of D qdd + bias, against the reference."""
    for module, form in of.forms:
        measure = partial(of.largest, partial(_inverse, of, module), STATES)
        of.row(f"{form}inverse dynamics", ROUNDINGS, "units of rounding", measure)


def _inverse(of: Comparison, module: Any, e: Expected) -> float:
    """At twice the accelerations of the motion, and of alternating signs."""
    s, D = e.state, e.value["D"]
    qdd = 2 * e.value["acceleration"]
    qdd = qdd + of.sampler.speed**2 / of.sampler.spread * (-1.0) ** np.arange(len(qdd))
    found = module.inverse_dynamics(s.q, s.qd, qdd, t=s.t, params=s.params)
    size = e.size["D"] @ np.abs(qdd) + e.size["bias"]
    return of.units(found, D @ qdd + e.value["bias"], size)


class _Frames:
    """What a module says of frames, and what the scene's tables do."""

    def __init__(self, of: Comparison, module: Any, scene: Scene) -> None:
        self.of, self.module, self.scene = of, module, scene
        self.names = [f.name for f in of.system.asked]
        self.plane = of.system.plane

    def lines(self, s: State, bend: Vector | float = 0.0) -> Iterator[Line]:
        """Of several widths: the best counts."""
        for width in widths(self.of.sampler.spread, s.qd, bend):
            with np.errstate(all="ignore"):
                yield Line(self.scene, self.of.sampler.told(s), width, 1.0, bend)

    def off(
        self, found: Vector, exact: Callable[[Line], Vector], *state: Any, least: float = 0.0
    ) -> float:
        """The difference in parts of the largest number, which is `least` at rest."""
        best = np.inf
        for line in self.lines(*state):
            with np.errstate(all="ignore"):
                expected = exact(line)
                size = max(float(np.max(np.abs(expected))), least) or 1.0
                off = float(np.max(np.abs(found - expected))) / size
            best = min(best, off) if off == off else best
            if best < LIMIT / 10:
                break
        return best

    def held(self, s: State) -> dict[str, Any]:
        """How the module is called at a state."""
        return {"t": s.t, "params": s.params}

    def flat(self, linear: Vector, angular: Vector) -> Vector:
        """What counts of both in the plane, or in space."""
        return np.array([*linear[:2], angular[2]] if self.plane else [*linear, *angular])

    def poses(self, e: Expected) -> float:
        """Positions, and axes of frames."""
        found = self.module.pose(e.state.q, **self.held(e.state))

        def exact(line: Line) -> Vector:
            rows = []
            for name in self.names:
                frame, m = line.frames[name], line.middle
                axes = [rotated(frame.turn, x)[m] for x in np.eye(3)]
                turn = [frame.angle[m]] if self.plane else np.array(axes).T.ravel()
                rows.append([*frame.at[m][: 2 if self.plane else 3], *turn])
            return np.array(rows)

        n = len(self.names)
        both = np.hstack([found.position, np.reshape(found.rotation, (n, -1))])
        return self.off(both, exact, e.state)

    def twists(self, line: Line) -> Vector:
        """(nf, 6, n): all along the line."""
        motions = (line.motion(line.frames[name], np.zeros(3)) for name in self.names)
        return np.array([np.hstack(motion).T for motion in motions])

    def of_twists(self, twists: Vector) -> Vector:
        """What counts of them."""
        return np.array([self.flat(x[:3], x[3:]) for x in twists])

    def velocities(self, e: Expected) -> float:
        """Twists."""
        s = e.state
        found = self.module.frame_velocity(s.q, s.qd, **self.held(s))
        least = self.usual(s, self.of.sampler.speed)

        def exact(line: Line) -> Vector:
            return self.of_twists(self.twists(line)[..., line.middle])

        return self.off(found, exact, s, least=least)

    def usual(self, s: State, rates: Vector) -> float:
        """The largest twist at such rates."""
        J = np.abs(self.module.jacobian(s.q, **self.held(s)))
        return float(np.max(J @ rates, initial=0))

    def accelerations(self, e: Expected) -> float:
        """Their rates, at the accelerations of the motion."""
        s, qdd = e.state, e.value["acceleration"]
        found = self.module.frame_acceleration(s.q, s.qd, qdd, **self.held(s))

        def exact(line: Line) -> Vector:
            return self.of_twists(self.twists(line) @ line.rate[line.middle])

        sampler = self.of.sampler
        least = self.usual(s, sampler.speed**2 / sampler.spread)
        return self.off(found, exact, s, qdd, least=least)

    def jacobians(self, e: Expected) -> float:
        """Twists by one rate after the other, less what moves with time alone."""
        s = e.state
        found = np.asarray(self.module.jacobian(s.q, **self.held(s)), float)
        still = self.of.sampler.told(replace(s, qd=0 * s.qd))
        rates, worst = np.maximum(self.of.sampler.spread, 1), 0.0
        for k, direction in enumerate(np.eye(len(s.q))):

            def exact(line: Line) -> Vector:
                rest = Line(self.scene, still, line.width)
                both = [self.of_twists(self.twists(x)[..., x.middle]) for x in (line, rest)]
                return both[0] - both[1]

            moving = replace(s, qd=direction * rates)
            worst = max(worst, self.off(found[..., k] * rates[k], exact, moving))
        return worst

    def forces(self, e: Expected) -> float:
        """J^T w of the module's own Jacobians."""
        s, held = e.state, self.held(e.state)
        J = np.asarray(self.module.jacobian(s.q, **held), float)
        w = np.random.default_rng(0).normal(size=J.shape[:2])
        found = self.module.frame_forces(s.q, w, **held)
        size = np.einsum("fik,fi->k", np.abs(J), np.abs(w))
        off = np.abs(found - np.einsum("fik,fi->k", J, w))
        return float(np.max(off) / (np.max(size) or 1.0))

    def momentum(self, e: Expected) -> float:
        """Of point masses: their sum, its centre, momentum and that about the centre."""
        s = e.state
        m = self.module.momentum(s.q, s.qd, **self.held(s))
        found = np.hstack([m.mass, m.center, m.linear, m.angular])

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
            return np.hstack([sum(weights), center[:d], self.flat(linear, angular)])

        return self.off(found, exact, s)
