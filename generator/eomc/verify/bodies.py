"""Checks of bodies and frames, recomputed from the scene's own tables of bodies.

The reference starts from K and P, which multibody.py makes of a scene. Here each body becomes point
masses that have its mass, its centre of mass and its inertia, and frames are composed joint by
joint by rotation matrices. Energies, forces, poses and momenta are evaluated in a motion through
the state: coordinates are dual numbers, whose tangents are derivatives by time. This uses neither
SymPy nor multibody.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from eomc.scene import formulas
from eomc.scene.formulas import Formula
from eomc.scene.scene import WORLD, Assembly, Damper, Force, RigidBody, Scene, Spring
from eomc.verify.comparison import Check, Comparison
from eomc.verify.reference import Vector
from eomc.verify.sampling import Expected, State
from eomc.verify.taylor import ALGEBRA, FUNCTIONS, Dual, part_of, time_derivative

RELATIVE_LIMIT = 1e-10  # largest relative error; derivatives are exact to 1e-13
UNITS = 1e3  # largest error in units of rounding, if that is more, as in single precision

_X, _Y, _Z = np.eye(3)

# motions of each joint: "t" (translation) along or "r" (rotation) about an axis, or "h" (both, with
# the joint's pitch); None means the axis that the scene defines
_MOTIONS: Mapping[str, Sequence[tuple[str, Vector | None]]] = {
    "fixed": (),
    "revolute": (("r", None),),
    "prismatic": (("t", None),),
    "planar": (("t", _X), ("t", _Y), ("r", _Z)),
    "cylindrical": (("t", None), ("r", None)),
    "screw": (("h", None),),
    "universal": (("r", None), ("r", None)),
    "spherical": (("r", _Z), ("r", _Y), ("r", _X)),
    "free": (("t", _X), ("t", _Y), ("t", _Z), ("r", _Z), ("r", _Y), ("r", _X)),
}


def checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of energies, forces, frames and momenta, which follow from the bodies."""
    system, limit = comparison.system, max(RELATIVE_LIMIT, UNITS * comparison.eps)
    if system.scene is not None and system.scene.assembly is not None:
        for name in ("kinetic_energy", "potential_energy", "power"):
            yield Check(
                f"{'power of forces' if name == 'power' else name} of bodies",
                partial(energy_error, name), tolerance=limit, states=comparison.few(8),
                unit="relative, from point masses",
            )  # fmt: skip
        if comparison.compiled:
            yield from frame_checks(comparison)
    if comparison.compiled and system.run.inverse_dynamics:
        yield Check(
            "inverse dynamics", _inverse_dynamics_error, states=comparison.few(4), portable=True
        )  # fmt: skip


def energy_error(name: str, of: Comparison, e: Expected) -> float:
    """Return the relative error of the module's quantity `name` at the state of `e`.

    name: "kinetic_energy", "potential_energy" or "power" (the power of the forces). The expected
    value is recomputed from the scene's bodies.
    """
    s, system = e.state, of.system
    slides = {system.coordinates[m.of].name: float(s.q[m.at]) for m in system.modes}
    if name == "power":  # of forces only
        value = float(of.module_value("tau", s) @ s.qd)
        size = float(e.size["tau"] @ np.abs(s.qd))
    else:
        value, size = float(of.module_value(name, s)), float(e.size[name])
    with np.errstate(all="ignore"):
        expected = _motion(of, s, slides=slides).value(name)
    return abs(value - expected) / (size or 1.0)


@dataclass(frozen=True)
class MovingFrame:
    """Position and rotation of a body's frame, as arrays or dual numbers of arrays.

    Attributes
    ----------
    at : (3,) array
        Origin of the frame in world coordinates, m.
    turn : (3, 3) array
        Rotation matrix.
    angle : float
        Rotation angle about the z axis, rad, for scenes in the plane.
    """

    at: Any
    turn: Any
    angle: Any

    def point(self, x: Vector) -> Any:
        """Return the world coordinates (3,), m, of a point with coordinates x in the frame."""
        return self.at + self.turn @ x

    def slid(self, by: Any, axis: Vector) -> MovingFrame:
        """Return the frame translated along its own `axis` (3,) by a distance, m."""
        return replace(self, at=self.at + by * (self.turn @ axis))

    def turned(self, by: Any, axis: Vector) -> MovingFrame:
        """Return the frame rotated about its own `axis` (3,) by an angle, rad."""
        across = np.cross(np.eye(3), axis)  # across @ x = axis × x
        sine, cosine = FUNCTIONS["sin"](by), FUNCTIONS["cos"](by)
        turn = sine * across + (1 - cosine) * (across @ across) + np.eye(3)  # Rodrigues
        return MovingFrame(self.at, self.turn @ turn, self.angle + by * axis[2])


def rate_of(x: Any) -> Any:
    """Return dx/dt of a dual number, or of a constant array."""
    if isinstance(x, Dual):
        return 0 * x.value if x.tangent is None else x.tangent
    return 0 * x


def angular_velocity(turn: Any) -> Any:
    """Return the vector (3,) of the angular velocity of a rotation matrix, rad/s."""
    rate, now = rate_of(turn), turn.value if isinstance(turn, Dual) else turn
    across = rate @ now.T  # across @ x = w × x
    entries = ((_Z, _Y), (_X, _Z), (_Y, _X))
    return sum(((a @ across) @ b) * axis for (a, b), axis in zip(entries, np.eye(3), strict=True))


@dataclass
class BodyMotion:
    """The bodies of a scene in a motion through one state.

    Coordinates are dual numbers; their tangents are derivatives by time.

    Attributes
    ----------
    state : State
        The state, with its time t.
    accelerations : (nq,) array, optional
        If they are given, there are two levels of derivatives by time.
    stretched : bool
        Whether velocities have a further, innermost level: the derivative by a factor of all.
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
    accelerations: Vector | None = None
    stretched: bool = False
    slides: Mapping[str, float] = field(default_factory=dict)
    frames: dict[str, MovingFrame] = field(default_factory=dict)
    known: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        s, scene = self.state, self.scene
        levels = 1 if self.accelerations is None else 2
        self.algebra = {**ALGEBRA, "dot": partial(time_derivative, levels=levels)}
        qdd = self.accelerations
        inner: list[tuple[Any, Any, Any]] = []
        for k, (x, v) in enumerate(zip(map(np.float64, s.q), map(np.float64, s.qd), strict=True)):
            if qdd is not None:
                inner.append((Dual(x, v), Dual(v, qdd[k]), Dual(qdd[k])))
            else:
                inner.append((Dual(x), Dual(v, v), None) if self.stretched else (x, v, None))
        time: Any = np.float64(s.t)
        if qdd is not None or self.stretched:
            time = Dual(time, None if qdd is None else 1.0)
        known = self.known = {"t": Dual(time, 1.0)}
        for c, (x, v, a) in zip(scene.coordinates, inner, strict=False):  # modes follow
            known |= {c.name: Dual(x, v), f"{c.name}_dot": Dual(v, a)}
        for constant in scene.constants:
            known[constant.name] = self.evaluate(constant.formula)
        params = s.params or {}
        known |= {p.name: np.float64(params.get(p.name, p.value)) for p in scene.parameters}
        self.frames[WORLD] = MovingFrame(np.zeros(3), np.eye(3), 0.0)
        for body in self.assembly.bodies:
            if body.joint:
                self.attach(body)
        for k, i in enumerate(scene.inputs):
            if s.u is not None:
                known[i.name] = self.limited(i.name, np.float64(s.u[k]))
        for name in self.formulas:
            self.value_of_name(name)
        for body in self.assembly.bodies:
            if not body.joint:
                assert body.position is not None
                at = self.stacked(body.position)
                self.frames[body.name] = replace(self.oriented(self.frames[WORLD], body), at=at)

    @property
    def assembly(self) -> Assembly:
        """The scene's tables of bodies, springs, dampers and forces."""
        assert self.scene.assembly is not None
        return self.scene.assembly

    def evaluate(self, formula: Formula) -> Any:
        """Return the value of a formula."""
        return formulas.evaluate(formula, self.algebra, self.value_of_name)

    def stacked(self, entries: Sequence[Formula]) -> Any:
        """Return the vector (3,) of three formulas."""
        return sum(self.evaluate(x) * axis for x, axis in zip(entries, np.eye(3), strict=True))

    def at_rest(self, formula: Formula) -> Any:
        """Return the value of a formula with all velocities set to zero.

        For a generalized potential, which depends on velocities, this value is its energy.
        """
        known, algebra = self.known, self.algebra
        self.known = {name: x for name, x in known.items() if name not in self.formulas}
        self.known |= {f"{c.name}_dot": 0.0 for c in self.scene.coordinates}
        self.algebra = {**algebra, "dot": lambda x: 0.0}
        try:
            return self.evaluate(formula)
        finally:
            self.known, self.algebra = known, algebra

    @cached_property
    def formulas(self) -> Mapping[str, Formula]:
        """Formulas of the scene's definitions and of the signals of its inputs, by name."""
        return dict(self.scene.definitions) | {i.name: i.signal for i in self.scene.inputs}

    def value_of_name(self, name: str) -> Any:
        """Return the value of a definition or input."""
        if name not in self.known:
            self.known[name] = self.limited(name, self.evaluate(self.formulas[name]))
        return self.known[name]

    def limited(self, name: str, value: Any) -> Any:
        """Return `value` clipped to the limits of the input `name`.

        It is returned unchanged if there is no such input or the input has no limits.
        """
        for ends in (i.limits for i in self.scene.inputs if i.name == name):
            for end, within in zip(ends, ("max", "min"), strict=True):
                value = value if end is None else FUNCTIONS[within](value, self.evaluate(end))
        return value

    def vector(self, entries: Sequence[Formula]) -> Vector:
        """Return the values of three constant formulas, (3,)."""
        return np.array([float(self.evaluate(x)) for x in entries])

    def oriented(self, frame: MovingFrame, body: RigidBody) -> MovingFrame:
        """Return the frame after the rotations in the table of the body."""
        for turn in body.rotation:
            axis = (_X, _Y, _Z)["xyz".index(turn.axis)]
            frame = frame.turned(self.evaluate(turn.angle), axis)
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
            by = self.evaluate(body.coordinates[k])
            if motion in "th":
                frame = frame.slid(by * (self.evaluate(body.pitch) if body.pitch else 1.0), axis)
            if motion in "rh":
                frame = frame.turned(by, axis)
        self.frames[body.name] = frame
        centre = frame.point(self.vector(body.center))
        for letter, axis in zip("xyz", np.eye(3), strict=True):
            self.known.setdefault(f"{body.name}_{letter}", axis @ centre)

    # --- energies --------------------------------------------------------------------------------

    def value(self, name: str) -> float:
        """Return an energy or power of the scene at the state.

        name: "kinetic_energy" or "potential_energy", in J, or "power", the power of all forces and
        of dissipation, in W.
        """
        if name == "kinetic_energy":
            bodies = sum(map(self.kinetic, self.bodies))
            return float(number(self.evaluate(self.scene.kinetic)) + bodies)
        if name == "potential_energy":
            springs = sum(self.spring(spring) for spring in self.assembly.springs)
            weights = sum(map(self.weight, self.assembly.bodies))
            return float(number(self.at_rest(self.scene.potential)) + weights + springs)
        return self.forces() - self.loss()

    @property
    def bodies(self) -> Sequence[RigidBody]:
        """Bodies with at least one coordinate between them and the world."""
        immovable = {WORLD}
        for body in self.assembly.bodies:
            if body.joint == "fixed" and body.parent in immovable:
                immovable.add(body.name)
        return [b for b in self.assembly.bodies if b.name not in immovable]

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

    def kinetic(self, body: RigidBody) -> float:
        """Return the kinetic energy of a body and of rotors at its joint, in J.

        The energy of the body is that of its point masses, see `points`.
        """
        energy = 0.0
        for m, x in self.points(body):
            velocity = rate_of(self.frames[body.name].point(x))
            energy += m / 2 * float(velocity @ velocity)
        for armature, rate in zip(body.armature, self.rates(body), strict=False):
            energy += number(self.evaluate(armature)) / 2 * number(rate) ** 2
        return energy

    def rates(self, body: RigidBody) -> Iterator[Any]:
        """Yield the time derivative of each joint coordinate of a body.

        A body's joint has one such coordinate, in m or rad, for each direction or axis of motion.
        """
        for formula in body.coordinates:
            yield rate_of(self.evaluate(formula))

    def weight(self, body: RigidBody) -> float:
        """Return the potential energy -m g·c of a body's weight, in J.

        c is the position of the centre of mass and g the acceleration of gravity.
        """
        centre = self.frames[body.name].point(self.vector(body.center))
        height = float(number(self.vector(self.assembly.gravity) @ centre))
        return -height * float(number(self.evaluate(body.mass)))

    def length(self, line: Spring | Damper) -> Any:
        """Return the length (m) or angle (rad) of a spring or damper."""
        if line.coordinate:
            return self.known[line.coordinate]
        assert line.bodies is not None
        one, other = (self.frames[name] for name in line.bodies)
        if line.turning:
            return other.angle - one.angle
        assert line.points is not None
        a, b = (
            frame.point(self.vector(x)) for frame, x in zip((one, other), line.points, strict=True)
        )
        return FUNCTIONS["sqrt"]((b - a) @ (b - a))

    def spring(self, spring: Spring) -> float:
        """Return the potential energy of a spring, in J.

        It is k/2 times the squared extension of the spring.
        """
        longer = number(self.length(spring)) - number(self.evaluate(spring.length))
        return float(number(self.evaluate(spring.stiffness)) / 2 * longer**2)

    # --- forces ----------------------------------------------------------------------------------

    def forces(self) -> float:
        """Return the power of forces, friction and drives, in W.

        The power of the dissipation function is not included; `loss` returns it.
        """
        power = 0.0
        for name, formula in self.scene.forces.items():
            power += number(self.evaluate(formula)) * number(self.known[f"{name}_dot"])
        for c in self.scene.coordinates:
            if c.friction:
                rate = number(self.known[f"{c.name}_dot"])
                power -= self.friction_power(c.friction, c.name, rate, c.friction_width)
        for body in self.assembly.bodies:
            for k, rate in enumerate(map(number, self.rates(body))):
                if body.friction:
                    name, width = body.coordinates[k].text, body.friction_width
                    power -= self.friction_power(body.friction[k], name, rate, width)
                if body.actuator:
                    power += number(self.evaluate(body.actuator[k])) * rate
        if self.assembly.forces:  # motion due to time alone does no work on the coordinates
            at_rest = BodyMotion(self.scene, replace(self.state, qd=0 * self.state.qd))
            power += sum(self.work(f, at_rest) for f in self.assembly.forces)
        return power

    def friction_power(
        self, force: Formula, name: str, rate: float, width: Formula | None
    ) -> float:
        """Return the power that Coulomb friction takes from a coordinate, in W.

        name: the coordinate. rate: its velocity. Friction is smoothed as tanh(rate/width). For a
        coordinate with stick-slip friction, its direction is that of sliding.
        """
        direction = self.slides.get(name)
        if direction is None:
            direction = math.tanh(rate / (number(self.evaluate(width)) if width else 1.0))
        return float(number(self.evaluate(force)) * direction * rate)

    def work(self, force: Force, at_rest: BodyMotion) -> float:
        """Return the power of a force and torque on a body, in W.

        The power in the motion `at_rest`, with zero velocities, is subtracted. It comes from points
        that move with time even though the coordinates do not.
        """
        F, torque = (
            np.array([number(self.evaluate(x)) for x in entries])
            for entries in (force.force, force.torque)
        )
        if force.in_body:
            turn = number(self.frames[force.body].turn)
            F, torque = turn @ F, turn @ torque
        point = self.vector(force.point)
        twist, rest = (x.twist(x.frames[force.body], point) for x in (self, at_rest))
        return float(np.concatenate([F, torque]) @ (twist - rest))

    def twist(self, frame: MovingFrame, point: Vector) -> Any:
        """Return the velocity of a point of a frame and the frame's angular velocity, (6,).

        They are in world coordinates, in m/s and rad/s. point: its coordinates in the frame, m.
        """
        linear, angular = rate_of(frame.point(point)), angular_velocity(frame.turn)
        return np.eye(6, 3) @ linear + np.eye(6, 3, -3) @ angular

    def loss(self) -> float:
        """Return the power of dissipation, ∂R/∂q̇ · q̇, in W.

        R is the dissipation function. The power is its derivative by a factor of all velocities.
        """
        motion = BodyMotion(self.scene, self.state, stretched=True)
        return float(part_of(motion.dissipation(), "tangent"))

    def dissipation(self) -> Any:
        """Return the dissipation function R, in W, without the level of derivatives by time.

        It is the sum of the scene's own function and the terms of damped joints and dampers.
        """
        R = part_of(self.evaluate(self.scene.dissipation), "value")
        for body in self.assembly.bodies:
            for damping, rate in zip(body.damping, self.rates(body), strict=False):
                R = R + part_of(self.evaluate(damping), "value") / 2 * rate**2
        for damper in self.assembly.dampers:
            rate = rate_of(self.length(damper))
            R = R + part_of(self.evaluate(damper.damping), "value") / 2 * rate**2
        return R


def number(x: Any) -> Any:
    """Return the value of a dual number, or of nested ones, without any tangents."""
    while isinstance(x, Dual):
        x = x.value
    return x


# --- frames, inverse dynamics and momenta ---------------------------------------------------------


def frame_checks(comparison: Comparison) -> Iterator[Check]:
    """Yield the checks of frames and momentum.

    Frames are coordinate systems on bodies for which the module has functions, such as poses and
    velocities. A function that the module does not have is not checked.
    """
    functions: dict[str, tuple[Callable[[Comparison, Expected], float], float]] = {}
    if comparison.system.output_frames:
        functions |= {
            "poses of frames": (_pose_error, RELATIVE_LIMIT),
            "velocities of frames": (_velocity_error, RELATIVE_LIMIT),
            # second derivatives are exact to 1e-10
            "accelerations of frames": (_acceleration_error, 1e-8),
            "Jacobians of frames": (_jacobian_error, RELATIVE_LIMIT),
            "forces at frames": (_force_error, RELATIVE_LIMIT),
        }
    if comparison.system.run.momentum:
        functions["momentum"] = _momentum_error, RELATIVE_LIMIT
    for name, (error, limit) in functions.items():
        yield Check(
            name, error, tolerance=max(limit, UNITS * comparison.eps), states=comparison.few(4),
            unit="relative", portable=True,
        )  # fmt: skip


def _inverse_dynamics_error(of: Comparison, e: Expected) -> float:
    """Return the error of `inverse_dynamics` at a state, in units of rounding.

    It is compared with D q̈ + bias of the reference. The accelerations are twice those of the
    motion, plus large ones of alternating signs.
    """
    s, D = e.state, e.value["D"]
    qdd = 2 * e.value["acceleration"]
    qdd = qdd + of.sampler.speed**2 / of.sampler.spread * (-1.0) ** np.arange(len(qdd))
    forces = of.module.inverse_dynamics(s.q, s.qd, qdd, t=s.t, params=s.params)
    size = e.size["D"] @ np.abs(qdd) + e.size["bias"]
    return of.units(forces, D @ qdd + e.value["bias"], size)


def _scene(of: Comparison) -> Scene:
    assert of.system.scene is not None
    return of.system.scene


def _frame_names(of: Comparison) -> list[str]:
    return [frame.name for frame in of.system.output_frames]


def _motion(of: Comparison, s: State, *further: Any, **options: Any) -> BodyMotion:
    return BodyMotion(_scene(of), of.sampler.with_discrete_parameters(s), *further, **options)


def _relative_error(values: Vector, exact: Vector, least: float = 0.0) -> float:
    """Return the largest error of the module's `values`, relative to the largest exact value.

    least: lower bound of the divisor.
    """
    size = max(float(np.max(np.abs(exact))), least) or 1.0
    return float(np.max(np.abs(values - exact))) / size


def _arguments(s: State) -> dict[str, Any]:
    """Return time and parameters of a state as keyword arguments for the module."""
    return {"t": s.t, "params": s.params}


def _relevant_components(of: Comparison, linear: Vector, angular: Vector) -> Vector:
    """Return the components (x, y, angle) of a motion in the plane, or all six in space.

    linear, angular: vectors of three components.
    """
    return np.array([*linear[:2], angular[2]] if of.system.plane else [*linear, *angular])


def _pose_error(of: Comparison, e: Expected) -> float:
    """Return the relative error of the module's positions and rotations of frames."""
    poses = of.module.pose(e.state.q, **_arguments(e.state))
    motion, rows = _motion(of, e.state), []
    for name in _frame_names(of):
        frame = motion.frames[name]
        turn = [number(frame.angle)] if of.system.plane else number(frame.turn).ravel()
        rows.append([*number(frame.at)[: 2 if of.system.plane else 3], *turn])
    both = np.hstack([poses.position, np.reshape(poses.rotation, (len(rows), -1))])
    return _relative_error(both, np.array(rows))


def _twists(of: Comparison, motion: BodyMotion, order: int = 0) -> Vector:
    """Return the components of the frames' twists that exist in the plane, or all in space.

    They are linear and angular velocities or, with order 1, the derivatives of these by time.
    """
    twists = [motion.twist(motion.frames[name], np.zeros(3)) for name in _frame_names(of)]
    rows = [number(rate_of(x)) if order else number(x) for x in twists]
    return np.array([_relevant_components(of, x[:3], x[3:]) for x in rows])


def _velocity_error(of: Comparison, e: Expected) -> float:
    """Return the relative error of the module's linear and angular velocities of frames."""
    s = e.state
    twists = of.module.frame_velocity(s.q, s.qd, **_arguments(s))
    least = _twist_scale(of, s, of.sampler.speed)
    return _relative_error(twists, _twists(of, _motion(of, s)), least)


def _twist_scale(of: Comparison, s: State, rates: Vector) -> float:
    """Return the largest entry of |J| rates, a bound of the frames' velocities at a state.

    J are the module's Jacobians of the frames. rates: coordinate velocities, (nq,), used in
    place of those of `s`.
    """
    J = np.abs(of.module.jacobian(s.q, **_arguments(s)))
    return float(np.max(J @ rates, initial=0))


def _acceleration_error(of: Comparison, e: Expected) -> float:
    """Return the relative error of the module's accelerations of frames.

    The accelerations of the coordinates are those of the motion.
    """
    s, qdd = e.state, e.value["acceleration"]
    rates = of.module.frame_acceleration(s.q, s.qd, qdd, **_arguments(s))
    least = _twist_scale(of, s, of.sampler.speed**2 / of.sampler.spread)
    return _relative_error(rates, _twists(of, _motion(of, s, qdd), 1), least)


def _jacobian_error(of: Comparison, e: Expected) -> float:
    """Return the relative error of the module's Jacobians of frames.

    Column i is compared with the frames' velocities when coordinate i alone moves, minus their
    velocities when no coordinate moves, which are due to time alone.
    """
    s, errors = e.state, [0.0]
    J = np.asarray(of.module.jacobian(s.q, **_arguments(s)), float)
    rest = _twists(of, _motion(of, replace(s, qd=0 * s.qd)))
    for k, direction in enumerate(np.eye(len(s.q))):
        exact = _twists(of, _motion(of, replace(s, qd=direction))) - rest
        errors.append(_relative_error(J[..., k], exact))
    return float(np.max(errors))


def _force_error(of: Comparison, e: Expected) -> float:
    """Return the relative error of the module's `frame_forces`, Jᵀw for forces w at frames.

    The forces are random, and the expected value follows from the module's own Jacobians J.
    """
    s, arguments = e.state, _arguments(e.state)
    J = np.asarray(of.module.jacobian(s.q, **arguments), float)
    w = np.random.default_rng(0).normal(size=J.shape[:2])
    forces = of.module.frame_forces(s.q, w, **arguments)
    size = np.einsum("fik,fi->k", np.abs(J), np.abs(w))
    off = np.abs(forces - np.einsum("fik,fi->k", J, w))
    return float(np.max(off) / (np.max(size) or 1.0))


def _momentum_error(of: Comparison, e: Expected) -> float:
    """Return the relative error of the module's mass, centre of mass and momenta.

    The expected values follow from the point masses of all bodies.
    """
    s = e.state
    m = of.module.momentum(s.q, s.qd, **_arguments(s))
    momentum = np.hstack([m.mass, m.center, m.linear, m.angular])
    motion = _motion(of, s)
    masses = [(p, x, motion.frames[b.name]) for b in motion.bodies for p, x in motion.points(b)]
    weights, places = np.array([p for p, *_ in masses]), [f.point(x) for _, x, f in masses]
    at, v = np.array([*map(number, places)]), np.array([*map(rate_of, places)])
    center, linear = weights @ at / sum(weights), weights @ v
    angular = np.sum(np.cross(at - center, weights[:, None] * v), axis=0)
    d = 2 if of.system.plane else 3
    exact = [sum(weights), *center[:d], *_relevant_components(of, linear, angular)]
    return _relative_error(momentum, np.array(exact))
