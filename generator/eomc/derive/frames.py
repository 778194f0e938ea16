"""Poses, velocities, accelerations and Jacobians of frames, and momenta of bodies, on a tape.

One pass from the base to the leaves gives, along the world's axes, the rotation matrix R_k, origin
o_k, angular velocity and velocity of each link and their time derivatives. Frames of bodies placed
by formulas are differentiated instead. The Jacobian of a frame maps qd to the velocity of its
origin and its angular velocity along the world's axes (LOCAL_WORLD_ALIGNED in Pinocchio). Its
transpose maps a force and a moment to generalized forces; one pass from the leaves to the base does
this for all frames.

Source: Featherstone, *Rigid Body Dynamics Algorithms*, ch. 2 to 4.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from sympy import Expr, S, Symbol

from eomc.base.errors import SceneError
from eomc.base.spatial import ENTRIES
from eomc.derive.energies import leaves
from eomc.derive.newton_euler import AXES, ZERO, LinkFrames, Vector
from eomc.derive.tape import Stage, Tape
from eomc.model.symbols import needed_definitions, symbol
from eomc.model.system import System, t
from eomc.model.tree import BodyFrame, Tree

Twist = tuple[Vector, Vector]  # (velocity, angular velocity) or (force, moment)


@dataclass(frozen=True)
class Motions:
    """Kinematics of all frames that a system outputs, as atoms of the tape `tape`.

    A tape is a list of elementary operations, each with a named result. An atom is a number, a name
    on the tape, or a number times a name.

    Each sequence has one entry for each frame. Components of vectors are along the world's axes;
    lengths are in m, angles in rad.

    Attributes
    ----------
    poses
        For each frame, its position (3) and rotation matrix by rows (9); in the plane x, y, angle.
    velocities, accelerations
        For each frame, the linear (3) and angular (3) part; in the plane x, y, angle.
    jacobians
        For each frame, the matrix that maps qd to its velocity, by rows: (6, nq); in the plane
        (3, nq).
    forces : (nq,)
        Generalized forces of the forces and moments `wrenches(system)` that act at the frames.
    """

    tape: Tape
    poses: Sequence[Expr]
    velocities: Sequence[Expr]
    accelerations: Sequence[Expr]
    jacobians: Sequence[Expr]
    forces: Sequence[Expr]


def wrenches(system: System) -> list[Symbol]:
    """Return one symbol for each component of the force (N) and moment (N m) at each output frame.

    The components are along the world's axes: fx fy fz mx my mz for each frame, in the plane
    fx fy mz. The names end in an underscore, so that they differ from all names in a scene.
    """
    entries = "fx fy mz" if system.plane else "fx fy fz mx my mz"
    count = len(system.output_frames)
    return [symbol(f"{entry}{k}_") for k in range(count) for entry in entries.split()]


def motions(system: System) -> Motions:
    """Return poses, velocities, accelerations and Jacobians of the frames `system.output_frames`.

    The result includes the new tape (list of elementary operations) on which they are defined.
    """
    entries = wrenches(system)
    tape = Tape(leaves(system, *system.qdd) | dict.fromkeys(entries, Stage.TIME))
    kinematics = TreeKinematics(tape, system, system.output_frames)
    frames = [kinematics.frame(f) for f in kinematics.frames]
    jacobians: list[Expr] = []
    for frame in frames:
        columns = [kinematics.flat(*twist) for twist in frame.jacobian]
        jacobians += [column[i] for i in range(kinematics.width) for column in columns]
    applied = [
        kinematics.twist(entries[k : k + kinematics.width])
        for k in range(0, len(entries), kinematics.width)
    ]
    return Motions(
        tape,
        [x for frame in frames for x in kinematics.pose(frame)],
        [x for frame in frames for x in kinematics.flat(*frame.velocity)],
        [x for frame in frames for x in kinematics.flat(*frame.acceleration)],
        jacobians,
        kinematics.forces(frames, applied),
    )


@dataclass(frozen=True)
class FrameKinematics:
    """Pose, velocity, acceleration and Jacobian of a frame, as symbolic expressions.

    Components of vectors are along the world's axes. A `Twist` is a pair of vectors (linear,
    angular).

    Attributes
    ----------
    link : int
        Index of the link that the frame is fixed to; -1 for a frame placed by formulas.
    arm : Vector
        Vector from the link's origin to the frame's origin (m).
    at : Vector
        Position of the frame's origin in the world (m).
    rotation : sequence of Vector
        Rotation matrix by rows.
    angle : Expr
        Angle in the plane; 0 in space.
    velocity, acceleration : Twist
        Linear and angular velocity; linear and angular acceleration.
    jacobian : sequence of Twist
        For each coordinate, the velocity of the frame for a unit rate of the coordinate.
    """

    link: int
    arm: Vector
    at: Vector
    rotation: Sequence[Vector]
    angle: Expr
    velocity: Twist
    acceleration: Twist
    jacobian: Sequence[Twist]


class TreeKinematics:
    """Kinematics of the links of a tree and of frames, computed from the base to the leaves.

    Components of vectors are along the world's axes.

    Attributes
    ----------
    tree : LinkFrames
        The frames of the links.
    vectors : Vectors
        Sums and products on the tape.
    d : int
        Number of entries of a position: 2 in the plane, 3 in space.
    width : int
        Number of entries of a twist (linear and angular velocity): 3 in the plane, 6 in space.
    columns, origin, step
        For each link, the columns of its rotation matrix, the position of its origin, and the
        vector from the origin of its parent to its own origin.
    velocity, acceleration
        For each link, the velocity and acceleration of its origin.
    spin, turning
        For each link, its angular velocity and angular acceleration.
    """

    def __init__(self, tape: Tape, system: System, frames: Sequence[BodyFrame]) -> None:
        tree = self.tree = LinkFrames(tape, system.tree or Tree((), (), ZERO, ZERO))
        self.vectors, self.links, self.n = tree.vectors, tree.links, tree.n
        self.system, self.plane, self.frames = system, system.plane, frames
        self.d, self.width = (2, 3) if system.plane else (3, 6)
        self.along: Mapping[Symbol, Expr] = {
            **system.rates,
            **dict(zip(system.qd, system.qdd, strict=True)),
            t: S.One,
        }
        self.joint_accelerations = tree.joint_rates(
            dict(zip(system.q, system.qdd, strict=True))
        )  # without the terms that are quadratic in velocities
        self.columns: list[Sequence[Vector]] = []  # columns of R_k
        self.origin: list[Vector] = []
        self.step: list[Vector] = []  # from the parent's origin to the link's
        for k, link in enumerate(self.links):
            self._append_pose(k, link.parent)
        self.spin: list[Vector] = []
        self.velocity: list[Vector] = []
        self.turning: list[Vector] = []  # d omega/dt
        self.acceleration: list[Vector] = []
        for k, link in enumerate(self.links):
            self._append_motion(k, link.parent)

    def _append_pose(self, k: int, p: int) -> None:
        """Append R_k and the origin of link k, from those of its parent p."""
        V, tree = self.vectors, self.tree
        link, rotation = self.links[k], tree.rotation[k]
        columns = [(rotation[0][j], rotation[1][j], rotation[2][j]) for j in range(3)]
        step = tree.arm[k]
        if p >= 0:
            columns = [self.world(p, column) for column in columns]
            step = self.world(p, step)
        if tree.angular[k] != 0:
            c, s = tree.cosine[k], tree.sine[k]
            i, j = AXES[link.axis]
            x, y = columns[i], columns[j]
            columns[i] = V.plus(V.scaled(x, c), V.scaled(y, s))
            columns[j] = V.plus(V.scaled(y, c), V.scaled(x, V.minus(s)))
        self.columns.append(columns)
        self.step.append(step)
        self.origin.append(V.plus(self.origin[p], step) if p >= 0 else step)

    def _append_motion(self, k: int, p: int) -> None:
        """Append velocity and acceleration of link k, from those of its parent p."""
        V, tree = self.vectors, self.tree
        axis, r = self.axis(k), self.step[k]
        rate, acceleration = tree.speed[k], V.add(self.joint_accelerations[k], tree.drift[k])
        turn, slide = (
            (V.scaled(axis, V.times(x, rate)), V.scaled(axis, V.times(x, acceleration)))
            for x in (tree.angular[k], tree.linear[k])
        )
        v = a = omega = alpha = ZERO
        if p >= 0:
            omega, alpha = self.spin[p], self.turning[p]
            v, a = self.propagate((self.velocity[p], omega), (self.acceleration[p], alpha), r)
        v = V.plus(v, slide[0])
        a = V.plus(a, slide[1], V.scaled(V.cross(omega, slide[0]), S(2)))
        alpha = V.plus(alpha, turn[1], V.cross(omega, turn[0]))
        omega = V.plus(omega, turn[0])
        self.spin.append(omega)
        self.turning.append(alpha)
        self.velocity.append(v)
        self.acceleration.append(a)

    def world(self, k: int, v: Vector) -> Vector:
        """Return the components along the world's axes of a vector given in link k's frame."""
        V = self.vectors
        return V.plus(*(V.scaled(c, x) for c, x in zip(self.columns[k], v, strict=True)))

    def axis(self, k: int) -> Vector:
        """Return the unit vector of link k's joint axis, along the world's axes."""
        return self.columns[k][self.links[k].axis]

    def propagate(self, moving: Twist, accelerating: Twist, r: Vector) -> Twist:
        """Return the velocity and acceleration of a point of a body, from those of another point.

        The other point is the reference point.

        Parameters
        ----------
        moving : Twist
            Velocity of the reference point, and angular velocity of the body.
        accelerating : Twist
            Acceleration of the reference point, and angular acceleration of the body.
        r : Vector
            Vector from the reference point to the point.
        """
        V = self.vectors
        (v, omega), (a, alpha) = moving, accelerating
        rotational = V.cross(omega, r)
        return (
            V.plus(v, rotational),
            V.plus(a, V.cross(alpha, r), V.cross(omega, rotational)),
        )

    # --- frames ----------------------------------------------------------------------------------

    def flat(self, linear: Vector, angular: Vector) -> Sequence[Expr]:
        """Return the entries of a twist or wrench as one sequence.

        In space these are the 6 entries of both vectors; in the plane x, y and the angular entry.
        """
        return (*linear[:2], angular[2]) if self.plane else (*linear, *angular)

    def twist(self, entries: Sequence[Expr]) -> Twist:
        """Return the pair of vectors (linear, angular) with the given entries; inverts `flat`."""
        if self.plane:
            x, y, turn = entries
            return (x, y, S.Zero), (S.Zero, S.Zero, turn)
        x, y, z, *rest = entries
        return (x, y, z), (rest[0], rest[1], rest[2])

    @cached_property
    def known(self) -> Mapping[Symbol, Expr]:
        """The value on the tape of each definition in the scene that the formulas of frames use.

        The keys are the symbols that the scene defines. A value is a number, a name on the tape, or
        a number times a name.
        """
        formulas = [formula for f in self.frames for formula in self._formulas(f)]
        known: dict[Symbol, Expr] = {}
        for name, formula in needed_definitions(self.system.definitions, formulas):
            known[name] = self.vectors.tape.named(formula.xreplace(known), name.name)
        return known

    def _formulas(self, f: BodyFrame) -> Sequence[Expr]:
        """Return the formulas of a frame's placement."""
        placed = (*f.offset, *(x for row in f.rotation for x in row)) if f.link < 0 else ()
        return (*placed, f.angle) if self.plane else placed

    def value(self, e: Expr) -> Expr:
        """Return the value of the formula `e` on the tape: a number, a name, or a number times it.

        The formula may contain symbols that the scene defines by other formulas.
        """
        return self.vectors.define(e.xreplace(self.known))

    def pose(self, frame: FrameKinematics) -> Sequence[Expr]:
        """Return the position (3 entries) and rotation matrix by rows (9 entries) of a frame.

        In the plane, return x, y and the angle (rad).
        """
        if self.plane:
            return (*frame.at[:2], frame.angle)
        return (*frame.at, *(x for row in frame.rotation for x in row))

    def frame(self, f: BodyFrame) -> FrameKinematics:
        """Return pose, velocity, acceleration and Jacobian of the frame `f`."""
        V = self.vectors
        if f.link < 0:
            return self._frame_by_formulas(f)
        k = f.link
        arm = self.world(k, V.vector(f.offset))
        at = V.plus(self.origin[k], arm)
        columns = [self.world(k, V.vector([f.rotation[i][j] for i in range(3)])) for j in range(3)]
        omega, alpha = self.spin[k], self.turning[k]
        moving, accelerating = (self.velocity[k], omega), (self.acceleration[k], alpha)
        v, a = self.propagate(moving, accelerating, arm)
        jacobian: dict[Symbol, Twist] = dict.fromkeys(self.system.q, (ZERO, ZERO))
        lever = arm
        while k >= 0:
            link, axis = self.links[k], self.axis(k)
            turn, slide = (V.scaled(axis, x[k]) for x in (self.tree.angular, self.tree.linear))
            twist = V.plus(V.cross(turn, lever), slide), turn
            for q, derivative in self.tree.slopes[k].items():
                linear, angular = (V.scaled(x, derivative) for x in twist)
                jacobian[q] = (
                    V.plus(jacobian[q][0], linear),
                    V.plus(jacobian[q][1], angular),
                )
            k, lever = link.parent, V.plus(lever, self.step[k])
        rows = list(zip(*columns, strict=True))
        angle = self.value(f.angle) if self.plane else S.Zero
        return FrameKinematics(
            f.link, arm, at, rows, angle, (v, omega), (a, alpha), [*jacobian.values()]
        )

    def _frame_by_formulas(self, f: BodyFrame) -> FrameKinematics:
        """Compute the kinematics of a frame that is placed by formulas, or fixed in the world."""
        V = self.vectors
        tape, (x, y, z) = self.vectors.tape, map(self.value, f.offset)
        rows = [V.vector([self.value(e) for e in row]) for row in f.rotation]
        angle = self.value(f.angle) if self.plane else S.Zero
        vx, vy, vz = tape.forward([x, y, z], self.along)
        if self.plane:
            (turn,) = tape.forward([angle], self.along)
            omega = (S.Zero, S.Zero, turn)
        else:  # omega from the skew matrix dR/dt R^T
            rotation_rates = [tape.forward(row, self.along) for row in rows]
            wx, wy, wz = (V.dot(rotation_rates[j], rows[i]) for i, j in AXES)
            omega = (wx, wy, wz)
        a = tape.forward([vx, vy, vz], self.along)
        alpha = tape.forward(omega, self.along)
        gradients = [tape.gradient([(e, S.One)], self.system.qd) for e in (vx, vy, vz, *omega)]
        jacobian = [((c[0], c[1], c[2]), (c[3], c[4], c[5])) for c in zip(*gradients, strict=True)]
        accelerating = (a[0], a[1], a[2]), (alpha[0], alpha[1], alpha[2])
        moving = (vx, vy, vz), omega
        return FrameKinematics(-1, ZERO, (x, y, z), rows, angle, moving, accelerating, jacobian)

    # --- forces ----------------------------------------------------------------------------------

    def forces(self, frames: Sequence[FrameKinematics], wrenches: Sequence[Twist]) -> list[Expr]:
        """Return the generalized force on each coordinate of forces and moments that act at frames.

        `wrenches` contains the pair (force, moment) for each of `frames`. With the Jacobian J_k of
        frame k and its pair w_k, the result is sum_k J_k^T w_k. For frames that are fixed to links,
        the sum is computed in one pass over the links, from the leaves to the base.
        """
        V = self.vectors
        force, moment = [[ZERO] * self.n for _ in range(2)]
        generalized: dict[Symbol, list[Expr]] = {q: [] for q in self.system.q}
        for frame, (f, m) in zip(frames, wrenches, strict=True):
            k = frame.link
            if k >= 0:
                force[k] = V.plus(force[k], f)
                moment[k] = V.plus(moment[k], m, V.cross(frame.arm, f))
            else:
                for q, (v, omega) in zip(self.system.q, frame.jacobian, strict=True):
                    generalized[q] += [V.dot(v, f), V.dot(omega, m)]
        joint_forces = [S.Zero] * self.n
        for k in reversed(range(self.n)):
            link = self.links[k]
            turn, slide = (
                V.scaled(self.axis(k), x[k]) for x in (self.tree.angular, self.tree.linear)
            )
            joint_forces[k] = V.add(V.dot(turn, moment[k]), V.dot(slide, force[k]))
            if (p := link.parent) >= 0:
                force[p] = V.plus(force[p], force[k])
                moment[p] = V.plus(moment[p], moment[k], V.cross(self.step[k], force[k]))
        for q, projected in self.tree.project_forces(joint_forces).items():
            generalized[q].append(projected)
        return [V.add(*terms) for terms in generalized.values()]


# --- momenta of bodies ----------------------------------------------------------------------------


def momentum(system: System) -> tuple[Tape, Sequence[Expr]]:
    """Return the pair (tape, values) with total mass, centre of mass and momenta of all bodies.

    The tape is the list of elementary operations that compute the values. These are, for all moving
    bodies together: the mass (kg), the position of the centre of mass (m), the momentum (kg m/s)
    and the angular momentum about the centre of mass (kg m^2/s). Vectors are along the world's
    axes. In the plane the values are m, x, y, px, py, L. Rotors of drives are not included.

    Raises
    ------
    SceneError
        If no moving body has mass.
    """
    tape = Tape(leaves(system, *system.qdd))
    kinematics = TreeKinematics(tape, system, [f for f in system.frames if f.mass != 0])
    V, parts = kinematics.vectors, list(_parts(kinematics))
    mass = V.add(*(m for m, *_ in parts))
    if mass is S.Zero:
        raise SceneError([system.problem("run.momentum", "no body that moves has a mass")])
    moment, linear, angular = (V.plus(*(part[k] for part in parts)) for k in (1, 2, 3))
    center = V.scaled(moment, tape.define(1 / mass))
    about = V.plus(angular, V.scaled(V.cross(center, linear), S.NegativeOne))
    return tape, (mass, *center[: kinematics.d], *kinematics.flat(linear, about))


# position, axes, velocity and angular velocity of a body, along the world's axes
_BodyMotion = tuple[Vector, Sequence[Vector], Vector, Vector]


def _parts(kinematics: TreeKinematics) -> Iterator[tuple[Expr, Vector, Vector, Vector]]:
    """Yield the mass, first moment, momentum and angular momentum of each body.

    The moments are about the world's origin.
    """
    V = kinematics.vectors
    for k, link in enumerate(kinematics.links):
        motion = (
            kinematics.origin[k],
            kinematics.columns[k],
            kinematics.velocity[k],
            kinematics.spin[k],
        )
        moment = kinematics.world(k, V.vector(link.moment))
        yield _part(kinematics, motion, V.define(link.mass), moment, link.inertia)
    for f in kinematics.frames:
        frame = kinematics.frame(f)
        columns = list(zip(*frame.rotation, strict=True))
        motion = frame.at, columns, *frame.velocity
        yield _part(kinematics, motion, V.define(f.mass), ZERO, f.inertia)


def _part(
    kinematics: TreeKinematics,
    motion: _BodyMotion,
    mass: Expr,
    moment: Vector,
    inertia: Sequence[Expr],
) -> tuple[Expr, Vector, Vector, Vector]:
    """Return the same quantities for one body.

    `moment` (along the world's axes) and `inertia` refer to the position in `motion`.
    """
    V, (at, columns, v, omega) = kinematics.vectors, motion
    tensor = [[S.Zero] * 3 for _ in range(3)]
    for (i, j), entry in zip(ENTRIES, inertia, strict=True):
        tensor[i][j] = tensor[j][i] = V.define(entry)
    spin_in_body = V.apply(tensor, V.apply(columns, omega))
    spin = V.plus(*(V.scaled(c, x) for c, x in zip(columns, spin_in_body, strict=True)))
    linear = V.plus(V.scaled(v, mass), V.cross(omega, moment))
    angular = V.plus(spin, V.cross(moment, v), V.cross(at, linear))
    return mass, V.plus(V.scaled(at, mass), moment), linear, angular
