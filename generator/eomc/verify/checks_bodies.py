"""Checks of bodies and frames, recomputed from the scene's own tables of bodies.

The reference starts from K and P, which multibody.py makes of a scene. Here each body becomes point
masses that have its mass, its centre of mass and its inertia, and frames are composed joint by
joint with quaternions. Energies, forces, poses and momenta are evaluated along a short motion
through the state, with constant accelerations. Time derivatives are those of interpolating
polynomials. This uses neither SymPy nor multibody.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev

from eomc.scene import formulas
from eomc.scene.assembly import WORLD, Assembly, Damper, Force, RigidBody, Spring
from eomc.scene.formulas import Formula
from eomc.scene.scene import Scene
from eomc.verify.comparison import Comparison
from eomc.verify.reference import STENCIL, Vector
from eomc.verify.report import LIMIT
from eomc.verify.sampling import Expected, State

RELATIVE_LIMIT = 1e-10  # largest relative error; derivatives are exact to 1e-13
UNITS = 1e3  # largest error in units of rounding, if that is more, as in single precision

_X, _Y, _Z = np.eye(3)

# motions of each joint: "t" (translation) along or "r" (rotation) about an axis; None means the
# axis that the scene defines
_MOTIONS: Mapping[str, Sequence[tuple[str, Vector | None]]] = {
    "fixed": (),
    "revolute": (("r", None),),
    "prismatic": (("t", None),),
    "planar": (("t", _X), ("t", _Y), ("r", _Z)),
    "cylindrical": (("t", None), ("r", None)),
    "universal": (("r", None), ("r", None)),
    "spherical": (("r", _Z), ("r", _Y), ("r", _X)),
    "free": (("t", _X), ("t", _Y), ("t", _Z), ("r", _Z), ("r", _Y), ("r", _X)),
}


def widths(spread: Vector, qd: Vector, qdd: Vector | float = 0.0) -> Iterator[float]:
    """Yield half-widths, in s, of time intervals on which a motion is interpolated at a state.

    The first ones are fractions of the time in which some coordinate moves as far as in the whole
    motion. If that time is short, as with a stiff spring, differences between the nodes are mostly
    rounding. Therefore longer intervals follow, up to one in which a coordinate moves by one unit.
    Callers use the interval with the smallest error, since no interval makes a wrong value right.

    spread: how far each coordinate moves in the whole motion, (nq,). qd, qdd: velocities and
    accelerations at the state.
    """

    def rate(far: Vector) -> float:
        return float(np.max([np.abs(qd) / far, np.sqrt(np.abs(qdd) / far)])) or 1.0

    typical, least = rate(spread), rate(np.maximum(spread, 1))
    yield from (width / typical for width in (0.1, 0.01, 1e-3))
    width = 0.1 / typical
    while 0 < 3 * width < 1 / least:
        width *= 3
        yield width


class BodyChecks:
    """Checks of energies and power, which are recomputed from the bodies in the scene file.

    lines: the lines of motion computed so far (see `MotionLine`), by state and width.
    """

    def __init__(self, check: Comparison, scene: Scene) -> None:
        self.check, self.scene = check, scene
        self.lines: dict[tuple[int, float], MotionLine] = {}

    def report(self) -> None:
        """Append checks of energies and of the power of forces to the report of `eomc check`."""
        limit = max(RELATIVE_LIMIT, UNITS * self.check.eps)
        for name in ("kinetic_energy", "potential_energy", "power"):
            label = "power of forces" if name == "power" else name
            self.check.add_check(f"{label} of bodies", limit, "of its size, from point masses",
                           partial(self.largest_error, name))  # fmt: skip

    def largest_error(self, name: str) -> float:
        """Return the largest relative error of a quantity of the module over some states.

        name: "kinetic_energy", "potential_energy" or "power" (the power of the forces). The
        expected value is recomputed from the scene's bodies.
        """
        return self.check.largest(partial(self.relative_error, name), 8)

    def relative_error(self, name: str, e: Expected) -> float:
        """Return the relative error of the module's quantity `name` at the state of `e`.

        The expected value is recomputed from the scene's bodies by interpolation in time. Of
        several widths of the interval (see `widths`) the one with the smallest error counts. The
        result is nan if there is no expected value.
        """
        s, differences, system = e.state, [], self.check.system
        slides = {system.coordinates[m.of].name: float(s.q[m.at]) for m in system.modes}
        if name == "power":  # of forces only
            value = float(self.check.module_value("tau", s) @ s.qd)
            size = float(e.size["tau"] @ np.abs(s.qd))
        else:
            value, size = float(self.check.module_value(name, s)), float(e.size[name])
        for width in widths(self.check.sampler.spread, s.qd):
            with np.errstate(all="ignore"):
                key = id(e), width
                state_with_parameters = self.check.sampler.with_discrete_parameters(s)
                line = self.lines.get(key) or MotionLine(
                    self.scene, state_with_parameters, width, slides=slides
                )
                ours = self.lines.setdefault(key, line).value(name)
            if not math.isnan(ours):
                differences.append(abs(value - ours) / (size or 1.0))
            if differences and differences[-1] < RELATIVE_LIMIT / 10:
                break
        return min(differences, default=math.nan)


@dataclass(frozen=True)
class MovingFrame:
    """Position and rotation of a body's frame at n times along a motion.

    Attributes
    ----------
    at : (n, 3) array
        Origins of the frame in world coordinates, m.
    turn : (n, 4) array
        Rotations as unit quaternions, real part first.
    angle : (n,) array
        Rotation angles about the z axis, rad, for scenes in the plane.
    """

    at: Vector
    turn: Vector
    angle: Vector

    def point(self, x: Vector) -> Vector:
        """Return the world coordinates of a point of the frame, (n, 3), m.

        x: coordinates in the frame, (3,) or (n, 3), m.
        """
        return self.at + rotate(self.turn, x)

    def slid(self, by: Vector, axis: Vector) -> MovingFrame:
        """Return the frame translated along its own `axis` (3,) by distances `by` (n,), in m."""
        return replace(self, at=self.point(by[:, None] * axis))

    def turned(self, by: Vector, axis: Vector) -> MovingFrame:
        """Return the frame rotated about its own `axis` (3,) by the angles `by` (n,), in rad."""
        half = by[:, None] / 2
        turn = np.hstack([np.cos(half), np.sin(half) * axis])
        return MovingFrame(self.at, quaternion_product(self.turn, turn), self.angle + by * axis[2])


@dataclass
class MotionLine:
    """The bodies of a scene along a line of motion: a short motion through one state.

    The coordinates at the time t + s are q + stretch qd s + bend s²/2, |s| <= width. Quantities are
    arrays of their values at n interpolation nodes, which are values of s. Time derivatives at the
    nodes are those of the interpolating polynomial.

    Attributes
    ----------
    state : State
        The state in the middle of the line, with its time t.
    width : float
        Half the duration of the line, s.
    stretch : float
        Factor of all velocities.
    bend : (nq,) array or 0
        Accelerations.
    slides : mapping
        Modes of coordinates with stick-slip friction, by name: the direction of sliding, 1 or
        -1, or 0 if the coordinate sticks.
    frames : dict
        Frames of the bodies and of the world, by name.
    known : dict
        Values of the names in the scene's formulas.
    """

    scene: Scene
    state: State
    width: float
    stretch: float = 1.0
    bend: Vector | float = 0.0
    slides: Mapping[str, float] = field(default_factory=dict)
    frames: dict[str, MovingFrame] = field(default_factory=dict)
    known: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        s, n = self.state, 16  # degree of the interpolating polynomials
        nodes, rate = _interpolation(n)
        self.nodes, self.rate = nodes * self.width, rate / self.width
        zero = np.zeros(n + 1)
        self.middle = n // 2
        self.algebra = {**_ALGEBRA, "dot": lambda x: self.rate @ (x + zero)}
        known = self.known = {"t": s.t + self.nodes}
        motion = np.broadcast_arrays(s.q, s.qd * self.stretch, self.bend)
        for c, q, qd, qdd in zip(self.scene.coordinates, *motion, strict=False):  # modes follow
            rate = qd + qdd * self.nodes
            known |= {c.name: q + (qd + rate) / 2 * self.nodes, f"{c.name}_dot": rate + zero}
        for constant in self.scene.constants:
            known[constant.name] = self.evaluate(constant.formula)
        known |= {p.name: (s.params or {}).get(p.name, p.value) for p in self.scene.parameters}
        self.frames[WORLD] = MovingFrame(
            np.zeros((n + 1, 3)), np.tile([1.0, 0, 0, 0], (n + 1, 1)), zero
        )
        for body in self.assembly.bodies:
            if body.joint:
                self.attach(body)
        for k, i in enumerate(self.scene.inputs):
            if s.u is not None:
                known[i.name] = self.limited(i.name, s.u[k] + zero)
        for name in self.formulas:
            self.value_of_name(name)
        for body in self.assembly.bodies:
            if not body.joint:
                assert body.position is not None
                at = np.stack([self.evaluate(x) + zero for x in body.position], axis=1)
                frame = self.frames[WORLD]
                self.frames[body.name] = replace(self.oriented(frame, body), at=at)

    @property
    def assembly(self) -> Assembly:
        """The scene's tables of bodies, springs, dampers and forces."""
        assert self.scene.assembly is not None
        return self.scene.assembly

    def evaluate(self, formula: Formula) -> Any:
        """Return the value of a formula at the n nodes of the line, (n,), or a single number."""
        return formulas.evaluate(formula, self.algebra, self.value_of_name)

    def at_rest(self, formula: Formula) -> Any:
        """Return the value of a formula at the nodes of the line, with all velocities set to zero.

        For a generalized potential, which depends on velocities, this value is its energy.
        """
        known, algebra = self.known, self.algebra
        self.known = {name: x for name, x in known.items() if name not in self.formulas}
        self.known |= {f"{c.name}_dot": 0 * self.nodes for c in self.scene.coordinates}
        self.algebra = {**algebra, "dot": lambda x: 0 * x}
        try:
            return self.evaluate(formula)
        finally:
            self.known, self.algebra = known, algebra

    @cached_property
    def formulas(self) -> Mapping[str, Formula]:
        """Formulas of the scene's definitions and of the signals of its inputs, by name."""
        return dict(self.scene.definitions) | {i.name: i.signal for i in self.scene.inputs}

    def value_of_name(self, name: str) -> Any:
        """Return the value of a definition or input at the nodes of the line."""
        if name not in self.known:
            self.known[name] = self.limited(name, self.evaluate(self.formulas[name]))
        return self.known[name]

    def limited(self, name: str, value: Any) -> Any:
        """Return `value` clipped to the limits of the input `name`.

        It is returned unchanged if there is no such input or the input has no limits.
        """
        for ends in (i.limits for i in self.scene.inputs if i.name == name):
            for end, within in zip(ends, (np.maximum, np.minimum), strict=True):
                value = value if end is None else within(value, self.evaluate(end))
        return value

    def vector(self, entries: Sequence[Formula]) -> Vector:
        """Return the values of three constant formulas, (3,)."""
        return np.array([float(self.evaluate(x)) for x in entries])

    def oriented(self, frame: MovingFrame, body: RigidBody) -> MovingFrame:
        """Return the frame after the rotations in the table of the body."""
        for turn in body.rotation:
            axis = (_X, _Y, _Z)["xyz".index(turn.axis)]
            frame = frame.turned(self.evaluate(turn.angle) + 0 * self.nodes, axis)
        return frame

    def attach(self, body: RigidBody) -> None:
        """Compute and store the frame of a body that has a joint.

        body: the body; the frame of its parent must be stored already. The coordinates of its
        centre of mass are added to the names known in formulas.
        """
        frame = self.frames[body.parent]
        if body.offset:
            frame = replace(frame, at=frame.point(self.vector(body.offset)))
        frame = self.oriented(frame, body)
        axes = list(body.axes)
        for k, (motion, own) in enumerate(_MOTIONS[body.joint]):
            # a joint with one axis slides along it and turns about it
            axis = np.array(axes[min(k, len(axes) - 1)], float) if own is None else own
            axis = axis / np.linalg.norm(axis)
            by = self.evaluate(body.coordinates[k]) + 0 * self.nodes
            frame = frame.slid(by, axis) if motion == "t" else frame.turned(by, axis)
        self.frames[body.name] = frame
        centre = frame.point(self.vector(body.center))
        for letter, x in zip("xyz", centre.T, strict=True):
            self.known.setdefault(f"{body.name}_{letter}", x)

    # --- energies --------------------------------------------------------------------------------

    def value(self, name: str) -> float:
        """Return an energy or power of the scene at the state in the middle of the line.

        name: "kinetic_energy" or "potential_energy", in J, or "power", the power of all forces and
        of dissipation, in W.
        """
        if name == "kinetic_energy":
            return self.at_middle(
                self.evaluate(self.scene.kinetic) + sum(map(self.kinetic, self.bodies))
            )
        if name == "potential_energy":
            weights = sum(map(self.weight, self.assembly.bodies))
            springs = sum(map(self.spring, self.assembly.springs))
            return self.at_middle(self.at_rest(self.scene.potential) + weights + springs)
        return self.at_middle(self.forces()) - self.loss()

    @property
    def bodies(self) -> Sequence[RigidBody]:
        """Bodies with at least one coordinate between them and the world."""
        return [b for b in self.assembly.bodies if b.name not in self.immovable_bodies()]

    def immovable_bodies(self) -> set[str]:
        """Return the names of the world and of the bodies that are fixed to it."""
        immovable = {WORLD}
        for body in self.assembly.bodies:
            if body.joint == "fixed" and body.parent in immovable:
                immovable.add(body.name)
        return immovable

    def at_middle(self, values: Any) -> float:
        """Return the entry of an array of values at the nodes that belongs to the middle node."""
        return float((values + 0 * self.nodes)[self.middle])

    def points(self, body: RigidBody) -> list[tuple[float, Vector]]:
        """Return point masses with the same mass, centre of mass and inertia as the body.

        Each is a pair of a mass, kg, which may be negative, and a position in the body's frame, m.
        They are two masses for each eigenvector of J = tr(I)/2 - I, the second moments of the mass:
        these are at unit distance on both sides of the centre of mass. The rest of the mass is in
        the centre.
        """
        m, centre = float(self.evaluate(body.mass)), self.vector(body.center)
        xx, yy, zz, xy, xz, yz = (float(self.evaluate(entry)) for entry in body.inertia)
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        moments, axes = np.linalg.eigh(np.trace(tensor) / 2 * np.eye(3) - tensor)
        masses = [(m - float(np.sum(moments)), centre)]
        for moment, axis in zip(moments.tolist(), axes.T, strict=True):
            masses += [(moment / 2, centre + axis), (moment / 2, centre - axis)]
        return masses

    def kinetic(self, body: RigidBody) -> Vector:
        """Return the kinetic energy of a body and of rotors at its joint at the nodes, (n,), in J.

        The energy of the body is that of its point masses, see `points`.
        """
        frame, energy = self.frames[body.name], 0 * self.nodes
        for m, x in self.points(body):
            velocity = self.rate @ frame.point(x)
            energy = energy + m / 2 * np.sum(velocity**2, axis=1)
        for armature, rate in zip(body.armature, self.rates(body), strict=False):
            energy = energy + self.evaluate(armature) / 2 * rate**2
        return energy

    def rates(self, body: RigidBody) -> Iterator[Vector]:
        """Yield the time derivative of each joint coordinate of a body at the line's nodes, (n,).

        A body's joint has one such coordinate, in m or rad, for each direction or axis of motion.
        """
        for formula in body.coordinates:
            yield self.rate @ (self.evaluate(formula) + 0 * self.nodes)

    def weight(self, body: RigidBody) -> Vector:
        """Return the potential energy -m g·c of a body's weight, in J, at the line's nodes, (n,).

        c is the position of the centre of mass and g the acceleration of gravity.
        """
        centre = self.frames[body.name].point(self.vector(body.center))
        energy: Vector = -self.evaluate(body.mass) * centre @ self.vector(self.assembly.gravity)
        return energy

    def length(self, line: Spring | Damper) -> Vector:
        """Return the length (m) or angle (rad) of a spring or damper at the line's nodes, (n,)."""
        if line.coordinate:
            return np.asarray(self.known[line.coordinate])
        assert line.bodies is not None
        one, other = (self.frames[name] for name in line.bodies)
        if line.turning:
            return other.angle - one.angle
        assert line.points is not None
        a, b = (
            frame.point(self.vector(x)) for frame, x in zip((one, other), line.points, strict=True)
        )
        return np.asarray(np.linalg.norm(b - a, axis=1))

    def spring(self, spring: Spring) -> Vector:
        """Return the potential energy of a spring, in J, at the line's nodes, (n,).

        It is k/2 times the squared extension of the spring.
        """
        longer = self.length(spring) - self.evaluate(spring.length)
        energy: Vector = self.evaluate(spring.stiffness) / 2 * longer**2
        return energy

    # --- forces ----------------------------------------------------------------------------------

    def forces(self) -> Vector:
        """Return the power of forces, friction and drives, in W, at the line's nodes, (n,).

        The power of the dissipation function is not included; `loss` returns it.
        """
        power = 0 * self.nodes
        for name, formula in self.scene.forces.items():
            power = power + self.evaluate(formula) * self.known[f"{name}_dot"]
        for c in self.scene.coordinates:
            if c.friction:
                rate = self.known[f"{c.name}_dot"]
                power = power - self.evaluate(c.friction) * self.unit_friction_power(
                    c.name, rate, c.friction_width
                )
        for body in self.assembly.bodies:
            for k, rate in enumerate(self.rates(body)):
                if body.friction:
                    name, width = body.coordinates[k].text, body.friction_width
                    power = power - self.evaluate(body.friction[k]) * self.unit_friction_power(
                        name, rate, width
                    )
                if body.actuator:
                    power = power + self.evaluate(body.actuator[k]) * rate
        if self.assembly.forces:  # motion due to time alone does no work on the coordinates
            at_rest = MotionLine(self.scene, self.state, self.width, 0.0)
            power = power + sum(self.work(f, at_rest) for f in self.assembly.forces)
        return power

    def unit_friction_power(self, name: str, rate: Vector, width: Formula | None) -> Vector:
        """Return the power that Coulomb friction of 1 N or N m takes from a coordinate, in W, (n,).

        name: the coordinate. rate: its velocity at the n nodes of the line. Friction is smoothed as
        tanh(rate/width). For a coordinate with stick-slip friction, its direction is that of
        sliding.
        """
        if name in self.slides:
            return self.slides[name] * rate
        return np.tanh(rate / (self.evaluate(width) if width else 1.0)) * rate

    def work(self, force: Force, at_rest: MotionLine) -> Vector:
        """Return the power of a force and torque on a body, in W, at the line's nodes, (n,).

        The power along `at_rest`, the same line with zero velocities, is subtracted. It comes from
        points that move with time even though the coordinates do not.
        """
        frame, zero = self.frames[force.body], 0 * self.nodes
        F, torque = (
            np.stack([self.evaluate(x) + zero for x in formulas], axis=1)
            for formulas in (force.force, force.torque)
        )
        if force.in_body:
            F, torque = rotate(frame.turn, F), rotate(frame.turn, torque)
        point = self.vector(force.point)
        (v, w), (v0, w0) = (line.motion(line.frames[force.body], point) for line in (self, at_rest))
        return np.asarray(np.sum(F * (v - v0) + torque * (w - w0), axis=1))

    def motion(self, frame: MovingFrame, point: Vector) -> tuple[Vector, Vector]:
        """Return the velocity of a point of a frame and the frame's angular velocity, both (n, 3).

        They are in world coordinates, in m/s and rad/s, at the n nodes of the line. point:
        coordinates of the point in the frame, (3,), m.
        """
        turning = quaternion_product(self.rate @ frame.turn, frame.turn * [1, -1, -1, -1])
        return self.rate @ frame.point(point), 2 * turning[:, 1:]

    def loss(self) -> float:
        """Return the power of dissipation in the middle of the line, ∂R/∂q̇ · q̇, in W.

        R is the dissipation function. The derivative is a difference quotient: R is evaluated with
        all velocities multiplied by factors near 1.
        """
        total = 0.0
        if not self.loses():
            return total
        for n, weight in STENCIL:
            for sign in (1, -1):
                by = 0.01 * n * sign
                line = MotionLine(self.scene, self.state, self.width, 1 + by)
                total += sign * weight / 0.01 * line.at_middle(line.dissipation())
        return total

    def loses(self) -> bool:
        """Return whether the scene has a dissipation function, damped joints or dampers."""
        joints = any(body.damping for body in self.assembly.bodies)
        return bool(joints or self.assembly.dampers or self.scene.dissipation.text != "0")

    def dissipation(self) -> Vector:
        """Return the dissipation function R in W, at the line's nodes, (n,).

        It is the sum of the scene's own function and the terms of damped joints and dampers.
        """
        R: Vector = self.evaluate(self.scene.dissipation) + 0 * self.nodes
        for body in self.assembly.bodies:
            for damping, rate in zip(body.damping, self.rates(body), strict=False):
                R = R + self.evaluate(damping) / 2 * rate**2
        for damper in self.assembly.dampers:
            R = R + self.evaluate(damper.damping) / 2 * (self.rate @ self.length(damper)) ** 2
        return R


@cache
def _interpolation(n: int) -> tuple[Vector, Vector]:
    """Return n + 1 nodes on [-1, 1], and the matrix from values to derivatives at them."""
    nodes = chebyshev.chebpts2(n + 1)
    slopes = chebyshev.chebval(nodes, chebyshev.chebder(np.eye(n + 1))).T
    return nodes, slopes @ np.linalg.inv(chebyshev.chebvander(nodes, n))


def _cross(a: Vector, b: Vector) -> Vector:
    """Return a x b row by row, four times as fast as numpy.cross for few rows."""
    (a0, a1, a2), (b0, b1, b2) = a.T, b.T
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=1)


def quaternion_product(a: Vector, b: Vector) -> Vector:
    """Return the products a b of quaternions, row by row; all are (n, 4), real part first."""
    w, x = a[:, :1], a[:, 1:]
    v, y = b[:, :1], b[:, 1:]
    real = w * v - np.sum(x * y, axis=1, keepdims=True)
    return np.hstack([real, w * y + v * x + _cross(x, y)])


def rotate(turn: Vector, x: Vector) -> Vector:
    """Return vectors x rotated by unit quaternions `turn` (n, 4), real part first: (n, 3).

    With turn = (w, a) the result is x + 2 w a × x + 2 a × (a × x).
    """
    w, a = turn[:, :1], turn[:, 1:]
    across = 2 * _cross(a, np.broadcast_to(x, a.shape))
    return np.asarray(x + w * across + _cross(a, across))


_ALGEBRA: Mapping[str, Any] = {
    "number": formulas.NUMERIC["number"],
    "pi": math.pi,
    **{name: getattr(np, name) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{name: getattr(np, f"arc{name[1:]}") for name in ("asin", "acos", "atan", "atan2")},
    **{name: getattr(np, name) for name in ("exp", "log", "sqrt", "abs", "sign")},
    "heaviside": lambda x: np.heaviside(x, 0.5),
    "min": lambda *x: np.minimum.reduce(np.broadcast_arrays(*x)),
    "max": lambda *x: np.maximum.reduce(np.broadcast_arrays(*x)),
}


# --- frames, inverse dynamics and momenta ---------------------------------------------------------

FRAME_STATES = 4  # states at which frames are compared


def report_frames(check: Comparison, scene: Scene) -> None:
    """Append checks of frames and momentum to the report of `eomc check`.

    Frames are coordinate systems on bodies for which the module has functions, such as poses and
    velocities. A function that the module does not have is not checked.
    """
    run, eps = check.system.run, check.eps
    for module, form in check.forms:
        frames = FrameChecks(check, module, scene)

        def add(name: str, limit: float, measure: Callable[[Expected], float]) -> None:
            largest = partial(check.largest, measure, FRAME_STATES)
            check.add_check(f"{form}{name}", max(limit, UNITS * eps), "of their size", largest)  # noqa: B023

        if check.system.output_frames:
            add("poses of frames", RELATIVE_LIMIT, frames.poses)
            add("velocities of frames", RELATIVE_LIMIT, frames.velocities)
            # second derivatives are exact to 1e-10
            add("accelerations of frames", 1e-8, frames.accelerations)
            add("Jacobians of frames", RELATIVE_LIMIT, frames.jacobians)
            add("forces at frames", RELATIVE_LIMIT, frames.forces)
        if run.momentum:
            add("momentum", RELATIVE_LIMIT, frames.momentum)


def report_inverse_dynamics(check: Comparison) -> None:
    """Append checks of the module's `report_inverse_dynamics` to the report of `eomc check`.

    This function is compared with D q̈ + bias of the reference.
    """
    for module, form in check.forms:
        measure = partial(
            check.largest, partial(_inverse_dynamics_error, check, module), FRAME_STATES
        )
        check.add_check(f"{form}inverse dynamics", LIMIT, "units of rounding", measure)


def _inverse_dynamics_error(check: Comparison, module: Any, e: Expected) -> float:
    """Return the error of `report_inverse_dynamics` at a state, in units of rounding.

    The accelerations are twice those of the motion, plus large ones of alternating signs.
    """
    s, D = e.state, e.value["D"]
    qdd = 2 * e.value["acceleration"]
    qdd = qdd + check.sampler.speed**2 / check.sampler.spread * (-1.0) ** np.arange(len(qdd))
    forces = module.inverse_dynamics(s.q, s.qd, qdd, t=s.t, params=s.params)
    size = e.size["D"] @ np.abs(qdd) + e.size["bias"]
    return check.units(forces, D @ qdd + e.value["bias"], size)


class FrameChecks:
    """Comparison of a module's frame functions with frames computed from the scene's own tables.

    module: that of one form of C, optimised or portable.
    """

    def __init__(self, check: Comparison, module: Any, scene: Scene) -> None:
        self.check, self.module, self.scene = check, module, scene
        self.names = [f.name for f in check.system.output_frames]
        self.plane = check.system.plane

    def lines(self, s: State, bend: Vector | float = 0.0) -> Iterator[MotionLine]:
        """Yield short motions through the state `s`, one for each of several durations.

        bend: accelerations during the motion, (nq,). See `checks_bodies.MotionLine`.
        """
        for width in widths(self.check.sampler.spread, s.qd, bend):
            with np.errstate(all="ignore"):
                yield MotionLine(
                    self.scene, self.check.sampler.with_discrete_parameters(s), width, 1.0, bend
                )

    def relative_error(
        self, values: Vector, exact: Callable[[MotionLine], Vector], *state: Any, least: float = 0.0
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
            if best < RELATIVE_LIMIT / 10:
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

        def exact(line: MotionLine) -> Vector:
            rows = []
            for name in self.names:
                frame, m = line.frames[name], line.middle
                axes = [rotate(frame.turn, x)[m] for x in np.eye(3)]
                turn = [frame.angle[m]] if self.plane else np.array(axes).T.ravel()
                rows.append([*frame.at[m][: 2 if self.plane else 3], *turn])
            return np.array(rows)

        n = len(self.names)
        both = np.hstack([poses.position, np.reshape(poses.rotation, (n, -1))])
        return self.relative_error(both, exact, e.state)

    def twists(self, line: MotionLine) -> Vector:
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

        def exact(line: MotionLine) -> Vector:
            return self.relevant_twists(self.twists(line)[..., line.middle])

        return self.relative_error(twists, exact, s, least=least)

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

        def exact(line: MotionLine) -> Vector:
            return self.relevant_twists(self.twists(line) @ line.rate[line.middle])

        sampler = self.check.sampler
        least = self.twist_scale(s, sampler.speed**2 / sampler.spread)
        return self.relative_error(rates, exact, s, qdd, least=least)

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

            def exact(line: MotionLine) -> Vector:
                rest = MotionLine(self.scene, at_rest, line.width)
                both = [self.relevant_twists(self.twists(x)[..., x.middle]) for x in (line, rest)]
                return both[0] - both[1]

            moving = replace(s, qd=direction * rates)
            worst = max(worst, self.relative_error(J[..., k] * rates[k], exact, moving))
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

        def exact(line: MotionLine) -> Vector:
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

        return self.relative_error(momentum, exact, s)
