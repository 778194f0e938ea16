"""Frames of bodies and points on a tape: poses, velocities, accelerations, Jacobians.

One sweep outwards along the world's axes: R_k and o_k of each link, then omega, the velocity of its
origin, and their rates. Frames of bodies placed by formulas are differentiated. A Jacobian takes
rates to the velocity of the frame's origin and the angular velocity, both along the world's axes
(Pinocchio calls that LOCAL_WORLD_ALIGNED); its transpose takes a force there and a moment to
generalized forces, which one sweep inwards does for all frames.

Source: Featherstone, *Rigid Body Dynamics Algorithms*, ch. 2 to 4.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from sympy import Expr, S, Symbol

from eomc.derive.energies import leaves
from eomc.derive.links import Links
from eomc.derive.tape import Stage, Tape
from eomc.derive.vectors import AXES, ZERO, Vector
from eomc.model.symbols import needed, symbol
from eomc.model.system import System, t
from eomc.model.tree import Frame, Tree

Twist = tuple[Vector, Vector]  # of a frame's origin and about it: velocity and omega, force, moment


@dataclass(frozen=True)
class Motions:
    """Of frames, atoms of a tape, each frame's behind the other's.

    poses: in space position and rotation matrix by rows (12), in the plane x, y, angle (3).
    velocities, accelerations: linear, angular (6; 3). jacobians: the same over the rates, by rows.
    forces: (nq,), the generalized forces of `wrenches`.
    """

    tape: Tape
    poses: Sequence[Expr]
    velocities: Sequence[Expr]
    accelerations: Sequence[Expr]
    jacobians: Sequence[Expr]
    forces: Sequence[Expr]


def wrenches(system: System) -> list[Symbol]:
    """The entries of forces and moments at the frames that are asked for, along the world's axes.

    No name of a scene's ends in an underscore.
    """
    entries = "fx fy mz" if system.plane else "fx fy fz mx my mz"
    count = len(system.asked)
    return [symbol(f"{entry}{k}_") for k in range(count) for entry in entries.split()]


def motions(system: System) -> Motions:
    """Those of the frames that the system asks for."""
    given = wrenches(system)
    tape = Tape(leaves(system, *system.qdd) | dict.fromkeys(given, Stage.TIME))
    sweep = Sweep(tape, system, system.asked)
    frames = [sweep.frame(f) for f in sweep.frames]
    jacobians: list[Expr] = []
    for frame in frames:
        columns = [sweep.flat(*twist) for twist in frame.jacobian]
        jacobians += [column[i] for i in range(sweep.width) for column in columns]
    acting = [sweep.twist(given[k : k + sweep.width]) for k in range(0, len(given), sweep.width)]
    return Motions(
        tape,
        [x for frame in frames for x in sweep.pose(frame)],
        [x for frame in frames for x in sweep.flat(*frame.moving)],
        [x for frame in frames for x in sweep.flat(*frame.accelerating)],
        jacobians,
        sweep.forces(frames, acting),
    )


@dataclass(frozen=True)
class Held:
    """A frame: where it is held, where it is, its motion, and what each rate adds to that.

    rotation: by rows; in the plane with its angle.
    """

    link: int
    arm: Vector  # from the link's origin, along the world's axes
    at: Vector
    rotation: Sequence[Vector]
    angle: Expr
    moving: Twist
    accelerating: Twist
    jacobian: Sequence[Twist]


class Sweep(Links):
    """Links and frames along the world's axes. d, width: entries of a place and of a twist."""

    def __init__(self, tape: Tape, system: System, frames: Sequence[Frame]) -> None:
        super().__init__(tape, system.tree or Tree((), (), ZERO, ZERO))
        self.system, self.plane, self.frames = system, system.plane, frames
        self.d, self.width = (2, 3) if system.plane else (3, 6)
        self.along: Mapping[Symbol, Expr] = {
            **system.rates,
            **dict(zip(system.qd, system.qdd, strict=True)),
            t: S.One,
        }
        self.joint_accelerations = self.by_link(
            dict(zip(system.q, system.qdd, strict=True))
        )  # without drift
        self.columns: list[Sequence[Vector]] = []  # of R_k, link k's frame in the world
        self.origin: list[Vector] = []
        self.step: list[Vector] = []  # from the parent's origin
        for k, link in enumerate(self.links):
            self._place(k, link.parent)
        self.spin: list[Vector] = []
        self.velocity: list[Vector] = []
        self.turning: list[Vector] = []  # d omega/dt
        self.acceleration: list[Vector] = []
        for k, link in enumerate(self.links):
            self._move(k, link.parent)

    def _place(self, k: int, p: int) -> None:
        link, fixed = self.links[k], self.rotation[k]
        columns = [(fixed[0][j], fixed[1][j], fixed[2][j]) for j in range(3)]
        step = self.arm[k]
        if p >= 0:
            columns = [self.world(p, column) for column in columns]
            step = self.world(p, step)
        if link.turns:
            c, s = self.cosine[k], self.sine[k]
            i, j = AXES[link.axis]
            one, other = columns[i], columns[j]
            columns[i] = self.plus(self.scaled(one, c), self.scaled(other, s))
            columns[j] = self.plus(self.scaled(other, c), self.scaled(one, self.minus(s)))
        self.columns.append(columns)
        self.step.append(step)
        self.origin.append(self.plus(self.origin[p], step) if p >= 0 else step)

    def _move(self, k: int, p: int) -> None:
        link, axis, r = self.links[k], self.axis(k), self.step[k]
        own = self.scaled(axis, self.speed[k])
        faster = self.scaled(axis, self.add(self.joint_accelerations[k], self.drift[k]))
        v = a = omega = alpha = ZERO
        if p >= 0:
            omega, alpha = self.spin[p], self.turning[p]
            v, a = self.carried((self.velocity[p], omega), (self.acceleration[p], alpha), r)
        swept = self.cross(omega, own)
        if link.turns:
            alpha = self.plus(alpha, faster, swept)
            omega = self.plus(omega, own)
        else:
            v = self.plus(v, own)
            a = self.plus(a, faster, self.scaled(swept, S(2)))
        self.spin.append(omega)
        self.turning.append(alpha)
        self.velocity.append(v)
        self.acceleration.append(a)

    def world(self, k: int, v: Vector) -> Vector:
        """A vector of link k's frame along the world's axes."""
        return self.plus(*(self.scaled(c, x) for c, x in zip(self.columns[k], v, strict=True)))

    def axis(self, k: int) -> Vector:
        """The axis of link k along the world's."""
        return self.columns[k][self.links[k].axis]

    def carried(self, moving: Twist, accelerating: Twist, r: Vector) -> Twist:
        """Velocity and acceleration of what is `r` away on the same body."""
        (v, omega), (a, alpha) = moving, accelerating
        across = self.cross(omega, r)
        return (
            self.plus(v, across),
            self.plus(a, self.cross(alpha, r), self.cross(omega, across)),
        )

    # --- frames ----------------------------------------------------------------------------------

    def flat(self, linear: Vector, angular: Vector) -> Sequence[Expr]:
        """What counts of both."""
        return (*linear[:2], angular[2]) if self.plane else (*linear, *angular)

    def twist(self, entries: Sequence[Expr]) -> Twist:
        """The other way."""
        if self.plane:
            x, y, turn = entries
            return (x, y, S.Zero), (S.Zero, S.Zero, turn)
        x, y, z, *rest = entries
        return (x, y, z), (rest[0], rest[1], rest[2])

    @cached_property
    def known(self) -> Mapping[Symbol, Expr]:
        """What formulas of frames name."""
        ends = [e for f in self.frames for e in self._formulas(f)]
        known: dict[Symbol, Expr] = {}
        for name, e in needed(self.system.definitions, ends):
            known[name] = self.tape.named(e.xreplace(known), name.name)
        return known

    def _formulas(self, f: Frame) -> Sequence[Expr]:
        placed = (*f.offset, *(x for row in f.rotation for x in row)) if f.link < 0 else ()
        return (*placed, f.angle) if self.plane else placed

    def value(self, e: Expr) -> Expr:
        """The atom of a formula over definitions."""
        return self.define(e.xreplace(self.known))

    def pose(self, frame: Held) -> Sequence[Expr]:
        """Position and rotation; in the plane position and angle."""
        if self.plane:
            return (*frame.at[:2], frame.angle)
        return (*frame.at, *(x for row in frame.rotation for x in row))

    def frame(self, f: Frame) -> Held:
        """A frame with its motion."""
        if f.link < 0:
            return self._placed(f)
        k = f.link
        arm = self.world(k, self.vector(f.offset))
        at = self.plus(self.origin[k], arm)
        columns = [
            self.world(k, self.vector([f.rotation[i][j] for i in range(3)])) for j in range(3)
        ]
        omega, alpha = self.spin[k], self.turning[k]
        moving, accelerating = (self.velocity[k], omega), (self.acceleration[k], alpha)
        v, a = self.carried(moving, accelerating, arm)
        by: dict[Symbol, Twist] = dict.fromkeys(self.system.q, (ZERO, ZERO))
        away = arm
        while k >= 0:
            link, axis = self.links[k], self.axis(k)
            twist = (self.cross(axis, away), axis) if link.turns else (axis, ZERO)
            for q, slope in self.slopes[k].items():
                linear, angular = (self.scaled(x, slope) for x in twist)
                by[q] = (self.plus(by[q][0], linear), self.plus(by[q][1], angular))
            k, away = link.parent, self.plus(away, self.step[k])
        rows = list(zip(*columns, strict=True))
        angle = self.value(f.angle) if self.plane else S.Zero
        return Held(f.link, arm, at, rows, angle, (v, omega), (a, alpha), [*by.values()])

    def _placed(self, f: Frame) -> Held:
        """A body placed by formulas, or what does not move."""
        tape, (x, y, z) = self.tape, map(self.value, f.offset)
        rows = [self.vector([self.value(e) for e in row]) for row in f.rotation]
        angle = self.value(f.angle) if self.plane else S.Zero
        vx, vy, vz = tape.forward([x, y, z], self.along)
        if self.plane:
            (turn,) = tape.forward([angle], self.along)
            omega = (S.Zero, S.Zero, turn)
        else:  # of dR/dt R^T
            moved = [tape.forward(row, self.along) for row in rows]
            wx, wy, wz = (self.dot(moved[j], rows[i]) for i, j in AXES)
            omega = (wx, wy, wz)
        a = tape.forward([vx, vy, vz], self.along)
        alpha = tape.forward(omega, self.along)
        over = [tape.gradient([(e, S.One)], self.system.qd) for e in (vx, vy, vz, *omega)]
        jacobian = [((c[0], c[1], c[2]), (c[3], c[4], c[5])) for c in zip(*over, strict=True)]
        accelerating = (a[0], a[1], a[2]), (alpha[0], alpha[1], alpha[2])
        moving = (vx, vy, vz), omega
        return Held(-1, ZERO, (x, y, z), rows, angle, moving, accelerating, jacobian)

    # --- forces ----------------------------------------------------------------------------------

    def forces(self, frames: Sequence[Held], acting: Sequence[Twist]) -> list[Expr]:
        """The generalized forces of forces and moments at frames: sums inwards, on each axis."""
        force, moment = [[ZERO] * self.n for _ in range(2)]
        found: dict[Symbol, list[Expr]] = {q: [] for q in self.system.q}
        for frame, (f, m) in zip(frames, acting, strict=True):
            k = frame.link
            if k >= 0:
                force[k] = self.plus(force[k], f)
                moment[k] = self.plus(moment[k], m, self.cross(frame.arm, f))
            else:
                for q, (v, omega) in zip(self.system.q, frame.jacobian, strict=True):
                    found[q] += [self.dot(v, f), self.dot(omega, m)]
        along = [S.Zero] * self.n
        for k in reversed(range(self.n)):
            link = self.links[k]
            along[k] = self.dot(self.axis(k), (moment if link.turns else force)[k])
            if (p := link.parent) >= 0:
                force[p] = self.plus(force[p], force[k])
                moment[p] = self.plus(moment[p], moment[k], self.cross(self.step[k], force[k]))
        for q, projected in self.projected(along).items():
            found[q].append(projected)
        return [self.add(*terms) for terms in found.values()]
