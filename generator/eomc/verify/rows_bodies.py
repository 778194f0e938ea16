"""Checks of bodies: energies and forces recomputed from the scene's own tables.

The reference starts from K and P, which multibody.py makes of a scene. Here every body becomes
point masses that have its mass, its centre and its inertia, frames are composed joint by joint with
quaternions, and numbers are taken along a straight line through the state, q + s qd at the time
t + s, so that rates are derivatives of interpolating polynomials. No SymPy, nothing of
multibody.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev

from eomc.scene import formulas
from eomc.scene.assembly import WORLD, Assembly, Body, Damper, Force, Spring
from eomc.scene.formulas import Formula
from eomc.scene.scene import Scene
from eomc.verify.comparison import Comparison
from eomc.verify.reference import STENCIL, Vector
from eomc.verify.sampling import Expected, State

LIMIT = 1e-10  # of the energies or the power: derivatives are good to 1e-13
UNITS = 1e3  # of rounding, which are more in single precision
STATES = 8  # at most
NODES = 16  # of the interpolating polynomials
WIDTHS = (0.1, 0.01, 1e-3)  # of the line, in parts of the time in which things go far
WIDER = 3.0  # times as wide, where things hardly move

_X, _Y, _Z = np.eye(3)

# the elementary motions of a joint, "t" along an axis or "r" about it; None: the scene's axis
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
    """Yield widths, s, of time intervals along which quantities are interpolated at a state.

    spread: how far each coordinate goes in a motion. qd, qdd: velocities and accelerations. First
    come fractions of the time in which a coordinate moves that far. If that is short, as with a
    stiff spring, differences are rounding, so longer intervals follow, up to one in which a
    coordinate moves by one unit. The interval with the smallest error counts: none makes a wrong
    value right.
    """

    def rate(far: Vector) -> float:
        return float(np.max([np.abs(qd) / far, np.sqrt(np.abs(qdd) / far)])) or 1.0

    typical, least = rate(spread), rate(np.maximum(spread, 1))
    yield from (width / typical for width in WIDTHS)
    width = WIDTHS[0] / typical
    while 0 < WIDER * width < 1 / least:
        width *= WIDER
        yield width


class Bodies:
    """Checks of energies and power, which are recomputed from the bodies in the scene's own tables.

    lines: the lines of motion computed so far, by state and width.
    """

    def __init__(self, check: Comparison, scene: Scene) -> None:
        self.check, self.scene = check, scene
        self.lines: dict[tuple[int, float], Line] = {}

    def report(self) -> None:
        """Append checks of energies and of the power of forces to the report of `eomc check`."""
        limit = max(LIMIT, UNITS * self.check.eps)
        for name in ("kinetic_energy", "potential_energy", "power"):
            label = "power of forces" if name == "power" else name
            self.check.row(f"{label} of bodies", limit, "of its size, from point masses",
                           partial(self.compare, name))  # fmt: skip

    def compare(self, name: str) -> float:
        """Return the largest relative error of a quantity of the module over the states.

        name: "kinetic_energy", "potential_energy" or "power", the power of forces.
        """
        return self.check.largest(partial(self.off, name), STATES)

    def off(self, name: str, e: Expected) -> float:
        """Return the relative error of the quantity `name` at one state, from the bodies.

        The width of the interpolated line of motion (see `widths`) with the smallest error counts.
        The result is nan if there is no value to compare with.
        """
        s, differences, system = e.state, [], self.check.system
        slides = {system.coordinates[m.of].name: float(s.q[m.at]) for m in system.modes}
        if name == "power":  # that of forces alone
            value = float(self.check.ask("tau", s) @ s.qd)
            size = float(e.size["tau"] @ np.abs(s.qd))
        else:
            value, size = float(self.check.ask(name, s)), float(e.size[name])
        for width in widths(self.check.sampler.spread, s.qd):
            with np.errstate(all="ignore"):
                key = id(e), width
                state_with_parameters = self.check.sampler.with_discrete_parameters(s)
                line = self.lines.get(key) or Line(
                    self.scene, state_with_parameters, width, slides=slides
                )
                ours = self.lines.setdefault(key, line).value(name)
            if not math.isnan(ours):
                differences.append(abs(value - ours) / (size or 1.0))
            if differences and differences[-1] < LIMIT / 10:
                break
        return min(differences, default=math.nan)


@dataclass(frozen=True)
class Frame:
    """The frame of a body at the n points of a line of motion.

    at: origins in the world, (n, 3), m. turn: rotations as unit quaternions, real part first, (n,
    4). angle: rotation angles about the z axis, (n,), rad, for scenes in the plane.
    """

    at: Vector
    turn: Vector
    angle: Vector

    def point(self, x: Vector) -> Vector:
        """Return the world coordinates of a point of the frame, (n, 3), m.

        x: coordinates in the frame, (3,) or (n, 3), m.
        """
        return self.at + rotate(self.turn, x)

    def slid(self, by: Vector, axis: Vector) -> Frame:
        """Return the frame translated along its own `axis` by the distances `by`, (n,), m."""
        return replace(self, at=self.point(by[:, None] * axis))

    def turned(self, by: Vector, axis: Vector) -> Frame:
        """Return the frame rotated about its own `axis` by the angles `by`, (n,), rad."""
        half = by[:, None] / 2
        turn = np.hstack([np.cos(half), np.sin(half) * axis])
        return Frame(self.at, quaternion_product(self.turn, turn), self.angle + by * axis[2])


@dataclass
class Line:
    """The bodies of a scene along a line of motion through a state, for interpolation in time.

    Coordinates are q + stretch qd s + bend s²/2 at the times t + s, |s| <= width. Each quantity is
    an array of its values at the n nodes s; rates are derivatives of the interpolating polynomial.

    Attributes
    ----------
    state : State
        The state in the middle of the line.
    width : float
        Half the duration of the line, s.
    stretch : float
        Factor of all velocities.
    bend : array or 0
        Accelerations.
    slides : mapping
        Names of coordinates with stick-slip friction, and the direction in which each slides.
    frames : dict
        Frames of the bodies and of the world, by name.
    known : dict
        Values of the names in the scene's formulas.
    """

    scene: Scene
    state: State
    width: float
    stretch: float = 1.0  # of the velocities
    bend: Vector | float = 0.0  # accelerations
    slides: Mapping[str, float] = field(default_factory=dict)  # of what may stick: its mode
    frames: dict[str, Frame] = field(default_factory=dict)
    known: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        s, n = self.state, NODES
        nodes, rate = _interpolation(n)
        self.nodes, self.rate = nodes * self.width, rate / self.width
        zero = np.zeros(n + 1)
        self.middle = n // 2
        self.algebra = {**_ALGEBRA, "dot": lambda x: self.rate @ (x + zero)}
        known = self.known = {"t": s.t + self.nodes}
        motion = np.broadcast_arrays(s.q, s.qd * self.stretch, self.bend)
        for c, q, qd, qdd in zip(self.scene.coordinates, *motion, strict=False):  # modes
            rate = qd + qdd * self.nodes
            known |= {c.name: q + (qd + rate) / 2 * self.nodes, f"{c.name}_dot": rate + zero}
        for constant in self.scene.constants:
            known[constant.name] = self.evaluate(constant.formula)
        known |= {p.name: (s.params or {}).get(p.name, p.value) for p in self.scene.parameters}
        self.frames[WORLD] = Frame(np.zeros((n + 1, 3)), np.tile([1.0, 0, 0, 0], (n + 1, 1)), zero)
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
        """Return the value of a formula at the nodes of the line, (n,), or one constant number."""
        return formulas.evaluate(formula, self.algebra, self.value_of_name)

    def at_rest(self, formula: Formula) -> Any:
        """Return the value of a formula at the nodes, with all velocities set to zero.

        That is the energy of a potential.
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
        """Formulas of definitions and signals, which may refer to one another."""
        return dict(self.scene.definitions) | {i.name: i.signal for i in self.scene.inputs}

    def value_of_name(self, name: str) -> Any:
        """Return the value of a name in the scene's formulas at the nodes of the line."""
        if name not in self.known:
            self.known[name] = self.limited(name, self.evaluate(self.formulas[name]))
        return self.known[name]

    def limited(self, name: str, value: Any) -> Any:
        """Return the value clipped to the limits of the input `name`; unchanged without limits."""
        for ends in (i.limits for i in self.scene.inputs if i.name == name):
            for end, within in zip(ends, (np.maximum, np.minimum), strict=True):
                value = value if end is None else within(value, self.evaluate(end))
        return value

    def vector(self, entries: Sequence[Formula]) -> Vector:
        """Return the values of three constant formulas, (3,)."""
        return np.array([float(self.evaluate(x)) for x in entries])

    def oriented(self, frame: Frame, body: Body) -> Frame:
        """Return the frame after the rotations in the table of the body."""
        for turn in body.rotation:
            axis = (_X, _Y, _Z)["xyz".index(turn.axis)]
            frame = frame.turned(self.evaluate(turn.angle) + 0 * self.nodes, axis)
        return frame

    def attach(self, body: Body) -> None:
        """Add the frame of a body, and the coordinates of its centre of mass to the known names.

        body: one with a joint; the frame of its parent must have been added.
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
        """Return a quantity at the state in the middle of the line, from the scene's tables.

        name: "kinetic_energy" or "potential_energy", J, or "power", the power of all forces and of
        dissipation, W.
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
    def bodies(self) -> Sequence[Body]:
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
        """Return the entry for the middle node of an array of values at the nodes."""
        return float((values + 0 * self.nodes)[self.middle])

    def points(self, body: Body) -> list[tuple[float, Vector]]:
        """Return point masses with the body's mass, centre of mass and inertia.

        Each is a pair of a mass, kg, and a position in the body's frame, m; some masses are
        negative. With the second moments J = tr(I)/2 - I, there are two for each eigenvector of J,
        at unit distance from the centre of mass, and the rest is in the centre of mass.
        """
        m, centre = float(self.evaluate(body.mass)), self.vector(body.center)
        xx, yy, zz, xy, xz, yz = (float(self.evaluate(entry)) for entry in body.inertia)
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        moments, axes = np.linalg.eigh(np.trace(tensor) / 2 * np.eye(3) - tensor)
        masses = [(m - float(np.sum(moments)), centre)]
        for moment, axis in zip(moments.tolist(), axes.T, strict=True):
            masses += [(moment / 2, centre + axis), (moment / 2, centre - axis)]
        return masses

    def kinetic(self, body: Body) -> Vector:
        """Return the kinetic energy of a body at the nodes, (n,), J.

        It is that of the body's point masses and of the rotors at its joint.
        """
        frame, energy = self.frames[body.name], 0 * self.nodes
        for m, x in self.points(body):
            velocity = self.rate @ frame.point(x)
            energy = energy + m / 2 * np.sum(velocity**2, axis=1)
        for armature, rate in zip(body.armature, self.rates(body), strict=False):
            energy = energy + self.evaluate(armature) / 2 * rate**2
        return energy

    def rates(self, body: Body) -> Iterator[Vector]:
        """Yield the velocity of each motion of a body's joint at the nodes, (n,)."""
        for formula in body.coordinates:
            yield self.rate @ (self.evaluate(formula) + 0 * self.nodes)

    def weight(self, body: Body) -> Vector:
        """Return the potential energy of a body's weight at the nodes, -m g·c, (n,), J."""
        centre = self.frames[body.name].point(self.vector(body.center))
        energy: Vector = -self.evaluate(body.mass) * centre @ self.vector(self.assembly.gravity)
        return energy

    def length(self, line: Spring | Damper) -> Vector:
        """Return the length (m) or angle (rad) of a spring or damper at the nodes, (n,)."""
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
        """Return the energy of a spring, k/2 times its squared extension, at the nodes, (n,), J."""
        longer = self.length(spring) - self.evaluate(spring.length)
        energy: Vector = self.evaluate(spring.stiffness) / 2 * longer**2
        return energy

    # --- forces ----------------------------------------------------------------------------------

    def forces(self) -> Vector:
        """Return the power of forces, friction and drives at the nodes, (n,), W.

        That of the dissipation function is not included; see `loss`.
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
        if self.assembly.forces:  # what moves with time alone is none of the coordinates' work
            at_rest = Line(self.scene, self.state, self.width, 0.0)
            power = power + sum(self.work(f, at_rest) for f in self.assembly.forces)
        return power

    def unit_friction_power(self, name: str, rate: Vector, width: Formula | None) -> Vector:
        """Return the absolute power of Coulomb friction of 1 N or N m, (n,), W.

        name: the coordinate. rate: its velocity at the nodes. Friction is smoothed over `width`, or
        has a fixed direction if the coordinate has stick-slip friction.
        """
        if name in self.slides:
            return self.slides[name] * rate
        return np.tanh(rate / (self.evaluate(width) if width else 1.0)) * rate

    def work(self, force: Force, at_rest: Line) -> Vector:
        """Return the power of a force and torque on a body at the nodes, (n,), W.

        at_rest: the line of motion with zero velocities, whose power is subtracted: that of points
        that move with time alone.
        """
        frame, zero = self.frames[force.body], 0 * self.nodes
        F, torque = (
            np.stack([self.evaluate(x) + zero for x in given], axis=1)
            for given in (force.force, force.torque)
        )
        if force.in_body:
            F, torque = rotate(frame.turn, F), rotate(frame.turn, torque)
        point = self.vector(force.point)
        (v, w), (v0, w0) = (line.motion(line.frames[force.body], point) for line in (self, at_rest))
        return np.asarray(np.sum(F * (v - v0) + torque * (w - w0), axis=1))

    def motion(self, frame: Frame, point: Vector) -> tuple[Vector, Vector]:
        """Return the velocity of a point of a frame, and the frame's angular velocity, both (n, 3).

        point: its coordinates in the frame, (3,), m. Both are world coordinates, in m/s and rad/s.
        """
        turning = quaternion_product(self.rate @ frame.turn, frame.turn * [1, -1, -1, -1])
        return self.rate @ frame.point(point), 2 * turning[:, 1:]

    def loss(self) -> float:
        """Return the power of dissipation at the state, ∂R/∂q̇ · q̇, W.

        It is a difference quotient of R at velocities that are a little larger and smaller.
        """
        total = 0.0
        if not self.loses():
            return total
        for n, weight in STENCIL:
            for sign in (1, -1):
                by = 0.01 * n * sign
                line = Line(self.scene, self.state, self.width, 1 + by)
                total += sign * weight / 0.01 * line.at_middle(line.dissipation())
        return total

    def loses(self) -> bool:
        """Return whether the scene has a dissipation function, damped joints or dampers."""
        joints = any(body.damping for body in self.assembly.bodies)
        return bool(joints or self.assembly.dampers or self.scene.dissipation.text != "0")

    def dissipation(self) -> Vector:
        """Return the dissipation function R of scene, joints and dampers at the nodes, (n,), W."""
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
