"""Numerical forward kinematics of a scene's bodies, and motions that move no body or no mass."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eomc.base import spatial
from eomc.base.errors import Problem
from eomc.runtime import rank
from eomc.runtime.mathematics import numpy_functions
from eomc.scene import formulas
from eomc.scene.formulas import Formula
from eomc.scene.joints import JOINTS, MotionSubspace
from eomc.scene.scene import WORLD, Assembly, Damper, RigidBody, Scene, Spring, Turn

Array = NDArray[np.float64]
Pose = tuple[Array, Array]  # position (n, 3) and rotation (n, 3, 3) of a frame at n states

COINCIDENCE_TOLERANCE = 1e-12  # relative distance below which two points coincide


# functions of formulas for arrays
ARRAYS: Mapping[str, Any] = {
    **formulas.NUMERIC,
    **numpy_functions(),
    "dot": lambda x: 0.0 * x,  # its argument is constant: others are refused by the scene's checks
}


class ForwardKinematics:
    """Poses of the bodies of a scene at n states, from its formulas.

    It shares nothing with the derivation of the equations.

    Parameters
    ----------
    scene : Scene
    t : (n,)
        Times, s.
    q : (n, nq)
        Coordinates. Further columns are ignored.
    values
        Values of parameters by name, each a number or an array (n,), by default those in the scene.

    Attributes
    ----------
    poses
        Pose of each body's frame in the world by name, also of the world.
    joint_frames
        Poses of the frames of joints at zero displacement, by the name of the body.
    motions
        For each body, its joint's motions, as pairs of the motion subspace (n, 6) in the world and
        the point (n, 3) to which it refers.
    centers
        Centres of mass (n, 3) in the world.
    """

    def __init__(
        self, scene: Scene, t: Array, q: Array, values: Mapping[str, Any] | None = None
    ) -> None:
        self.scene, self.n = scene, len(t)
        self.known: dict[str, Any] = {
            p.name: p.value for p in (*scene.constants, *scene.parameters)
        }
        self.known |= {name: x for name, x in (values or {}).items() if name in self.known}
        names = [c.name for c in scene.coordinates]
        self.known |= dict(zip(names, q.T, strict=False)) | {"t": t}
        self.definitions = dict(scene.definitions)
        world_pose = np.zeros((self.n, 3)), np.broadcast_to(np.eye(3), (self.n, 3, 3))
        self.poses: dict[str, Pose] = {WORLD: world_pose}
        self.joint_frames: dict[str, Pose] = {}
        self.motions: dict[str, list[tuple[Array, Array]]] = {}
        self.centers: dict[str, Array] = {}
        if scene.assembly:
            self._place(scene.assembly)

    def number(self, formula: Formula) -> Any:
        """Return the value of a formula, a number or an array (n,)."""
        return formulas.evaluate(formula, ARRAYS, self._lookup)

    def _lookup(self, name: str) -> Any:
        if name not in self.known:
            if name in self.definitions:
                self.known[name] = self.number(self.definitions[name])
            else:
                body, letter = name[:-2], name[-1]
                self.known[name] = self.centers[body][:, "xyz".index(letter)]
        return self.known[name]

    def vector(self, entries: Sequence[Formula]) -> Array:
        """Return the values of a vector of formulas, (n, 3)."""
        columns = [np.broadcast_to(self.number(entry), self.n) for entry in entries]
        return np.stack(columns, axis=1).astype(float)

    def rotation(self, turns: Sequence[Turn]) -> Array:
        """Return the rotation matrices of successive turns, (n, 3, 3)."""
        R = self.poses[WORLD][1]
        for turn in turns:
            R = R @ self._axis_rotation(np.eye(3)["xyz".index(turn.axis)], self.number(turn.angle))
        return R

    def _axis_rotation(self, axis: Sequence[float] | Array, angle: Any) -> Array:
        angle = np.broadcast_to(angle, self.n)
        rows = spatial.axis_angle_rotation(tuple(axis), np.cos(angle), np.sin(angle))
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)

    def _place(self, assembly: Assembly) -> None:
        """Compute the poses of all frames, those of bodies on joints first."""
        for body in assembly.bodies:
            if body.joint:
                at, R = self.poses[body.parent]
                if body.offset:
                    at = at + rotate(R, self.vector(body.offset))
                R = R @ self.rotation(body.rotation)
                self.joint_frames[body.name] = at, R
                self.poses[body.name] = at, R = self._after_joint(body, at, R)
                self.centers[body.name] = at + rotate(R, self.vector(body.center))
        for body in assembly.bodies:
            if body.position:
                pose = self.vector(body.position), self.rotation(body.rotation)
                self.poses[body.name], self.centers[body.name] = pose, pose[0]

    def _after_joint(self, body: RigidBody, at: Array, R: Array) -> Pose:
        motions = self.motions[body.name] = []
        for (axis, angular, linear), moved in self.joint_motions(body):
            unit = np.array(axis) / np.linalg.norm(axis)
            along = R @ unit
            slide = np.broadcast_to(linear, self.n)[:, None] * along
            motions.append((np.concatenate([angular * along, slide], axis=1), at))
            at = at + rotate(R, np.broadcast_to(linear * moved, self.n)[:, None] * unit)
            if angular:
                R = R @ self._axis_rotation(unit, moved)
        return at, R

    def joint_motions(self, body: RigidBody) -> list[tuple[MotionSubspace, Any]]:
        """Return the motion subspace and the displacement of each motion of a body's joint."""
        pitch = self.number(body.pitch) if body.pitch else 0.0
        subspaces = JOINTS[body.joint].subspaces(body.axes, pitch)
        return [*zip(subspaces, map(self.number, body.coordinates), strict=True)]


def rotate(R: Array, v: Array) -> Array:
    """Return the products (n, 3) of n matrices and n vectors."""
    turned: Array = np.einsum("nij,nj->ni", R, v)
    return turned


@dataclass(frozen=True)
class Jacobian:
    """Jacobians of the motion of all bodies, as matrices with one column for each coordinate.

    moves: derivatives of the velocities (m/s) of the bodies' centres of mass and of their angular
    velocities (rad/s) with respect to the generalized velocities; six rows for each body. weighs:
    these rows multiplied by the square roots of masses and inertias, and rows for the armatures
    (rotor inertias of joints), so that the mass matrix is weighs^T weighs.
    """

    moves: Array
    weighs: Array


@dataclass(frozen=True)
class NullSpaces:
    """Null spaces of a `Jacobian`, as arrays whose rows are generalized velocities (n, nq).

    moves: basis of the generalized velocities at which no body moves. weighs: basis of the
    generalized velocities at which the kinetic energy is zero.
    """

    moves: Array
    weighs: Array


class Kinematics:
    """Numerical kinematics of the bodies of a scene, for the parameter values in the scene."""

    STEP = 1e-5  # of central differences, whose error is about 1e-10
    SAMPLES = 3  # random configurations; the largest rank holds almost everywhere
    PIVOT_TOLERANCE = 1e-10  # of an inertia, relative to its terms: below, it may be rounding

    def __init__(self, scene: Scene, assembly: Assembly) -> None:
        self.scene = scene
        self.coordinates = [c.name for c in scene.coordinates]
        self.start = np.array(scene.start()[0])
        self.tree = [body for body in assembly.bodies if body.joint]
        self.placed = [body for body in assembly.bodies if not body.joint]
        self.values = self._states(self.start[None], 0.0)  # for what depends on parameters only
        self.roots = {body.name: self._inertia_roots(body) for body in assembly.bodies}

    def _states(self, q: Array, t: float) -> ForwardKinematics:
        """Return the poses at coordinates (n, nq) and one time; they may be nan."""
        with np.errstate(all="ignore"):
            return ForwardKinematics(self.scene, np.full(len(q), t), q)

    def sample_null_spaces(self) -> Iterator[NullSpaces]:
        """Yield the null spaces of the Jacobians at up to three random configurations.

        The configurations are near the initial one. A configuration is skipped if a formula of the
        scene can't be evaluated there. The iteration ends early after a configuration at which the
        mass matrix is regular, so that every motion has kinetic energy.
        """
        random = np.random.default_rng(0)
        for _ in range(self.SAMPLES):
            q = self.start + random.uniform(-0.7, 0.7, len(self.start))
            if null := self.null_spaces(q, random.uniform(0, 1)):
                yield null
                if not len(null.weighs):
                    return

    def null_spaces(self, q: Array, t: float) -> NullSpaces | None:
        """Return the null spaces of the Jacobians at coordinates q (nq,) and time t (s).

        Returns None if a formula of the scene can't be evaluated there.
        """
        if self.is_regular(q):
            return NullSpaces(*np.zeros((2, 0, len(q))))
        jacobian = self.jacobian(q, t)
        return (
            NullSpaces(null_space(jacobian.moves), null_space(jacobian.weighs))
            if jacobian
            else None
        )

    def is_regular(self, q: Array) -> bool:
        """Return True if the mass matrix at the coordinates `q` (nq,) is certainly regular.

        Rotor inertias of joints (armatures) are not counted. The joints of the tree are eliminated
        from the last one inwards in linear time (articulated bodies; Featherstone, *Rigid Body
        Dynamics Algorithms*, ch. 7). The result is False if a pivot may be rounding error, if a
        body is placed by formulas, or if the joints do not have one coordinate of the scene for
        each of their motions.
        """
        by = [formula.text for body in self.tree for formula in body.coordinates]
        if self.placed or sorted(by) != sorted(self.coordinates):
            return False
        at_q = self._states(q[None], 0.0)
        inertia: dict[str, Array] = {}  # of the subtree of each joint, in world axes
        size: dict[str, float] = {}  # scale of its terms
        for body in reversed(self.tree):
            at, R = (x[0] for x in at_q.poses[body.name])
            mass, root = self.roots[body.name]
            own = _spatial_inertia(mass**2, at_q.centers[body.name][0] - at, root @ R.T)
            beyond = own + inertia.pop(body.name, 0)
            scale = max(float(np.abs(beyond).max()), size.pop(body.name, 0.0))
            for subspace, point in reversed(at_q.motions[body.name]):
                s = moved_subspace(subspace[0], at - point[0])
                u = beyond @ s
                if s @ u <= self.PIVOT_TOLERANCE * scale:
                    return False
                beyond = beyond - np.outer(u, u) / (s @ u)
            if body.parent != WORLD:
                shift = np.eye(6)
                shift[3:, :3] = -_cross_matrix(at - at_q.poses[body.parent][0][0])
                inertia[body.parent] = inertia.get(body.parent, 0) + shift.T @ beyond @ shift
                size[body.parent] = max(size.get(body.parent, 0.0), scale)
        return True

    def jacobian(self, q: Array, t: float) -> Jacobian | None:
        """Return the Jacobians of the motion of all bodies at coordinates q (nq,) and time t (s).

        Returns None if a formula of the scene can't be evaluated there. Derivatives of formulas are
        central differences: the states are q, then q + h e_k, then q - h e_k for each k.
        """
        n, steps = len(q), self.STEP * np.eye(len(q))
        try:
            states = self._states(np.concatenate([q[None], q + steps, q - steps]), t)
            slopes = {b.name: [self._slope(states, by) for by in b.coordinates] for b in self.tree}
        except (ArithmeticError, ValueError, TypeError):
            return None
        above: dict[str, list[tuple[Array, Array, Array]]] = {WORLD: []}  # motions to the world
        moves, weighs, rotors = [], [], []
        for body in (*self.tree, *self.placed):
            center, R = states.centers[body.name], states.poses[body.name][1]
            v, omega = np.zeros((2, 3, n))
            if body.joint:
                own = zip(slopes[body.name], states.motions[body.name], strict=True)
                above[body.name] = [*above[body.parent], *((s, *motion) for s, motion in own)]
                for slope, subspace, point in above[body.name]:
                    moved = moved_subspace(subspace[0], center[0] - point[0])
                    omega += np.outer(moved[:3], slope)
                    v += np.outer(moved[3:], slope)
            else:
                v = (center[1 : n + 1] - center[n + 1 :]).T / (2 * self.STEP)
                # R(q + h) R(q - h)^T = 1 + 2 h [omega] + ..., antisymmetric up to h^3
                turn = R[1 : n + 1] @ R[n + 1 :].transpose(0, 2, 1) / (4 * self.STEP)
                skew = turn - turn.transpose(0, 2, 1)
                omega = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]])
            mass, inertia = self.roots[body.name]
            moves += [v, omega]
            weighs += [mass * v, inertia @ R[0].T @ omega]
            for armature, slope in zip(body.armature, slopes.get(body.name, ()), strict=False):
                rotors.append(math.sqrt(max(float(self.values.number(armature)), 0)) * slope)
        whole = Jacobian(np.vstack(moves), np.vstack([*weighs, *rotors]))
        return whole if np.isfinite(whole.moves).all() else None

    def _slope(self, states: ForwardKinematics, by: Formula) -> Array:
        """Return the gradient (nq,) of a joint position with respect to the coordinates."""
        n = len(self.coordinates)
        if by.text in self.coordinates:
            return np.asarray(np.eye(n)[self.coordinates.index(by.text)])
        values = np.broadcast_to(states.number(by), states.n)
        return np.asarray((values[1 : n + 1] - values[n + 1 :]) / (2 * self.STEP))

    def _inertia_roots(self, body: RigidBody) -> tuple[float, Array]:
        """Return square roots of mass and inertia tensor: 2 K = |root_m v|^2 + |root_I omega|^2."""
        inertia = [float(self.values.number(entry)) for entry in body.inertia]
        moments, axes = np.linalg.eigh(spatial.tensor(inertia))
        root = np.sqrt(np.maximum(moments, 0))[:, None] * axes.T
        return math.sqrt(max(float(self.values.number(body.mass)), 0)), root


def find_coincident_ends(scene: Scene) -> list[Problem]:
    """Return a warning for each spring and damper whose two ends coincide at the start.

    The direction of its force, along the line between the ends, is then undefined. Springs of rest
    length zero are left out, since their force does not depend on this direction.
    """
    assembly = scene.assembly
    if not assembly:
        return []
    lines: list[tuple[str, Spring | Damper]] = []
    for k, spring in enumerate(assembly.springs, start=1):
        if spring.points and not _is_zero(spring.length, scene):
            lines.append((f"spring.{k}", spring))
    for k, damper in enumerate(assembly.dampers, start=1):
        if damper.points:
            lines.append((f"damper.{k}", damper))
    if not lines:
        return []
    try:
        with np.errstate(all="ignore"):
            at = ForwardKinematics(scene, np.zeros(1), np.array(scene.start()[:1]))
    except (ArithmeticError, ValueError, TypeError):
        return []
    problems = []
    for key, line in lines:
        assert line.bodies and line.points
        one, other = (
            at.poses[name][0] + rotate(at.poses[name][1], at.vector(point))
            for name, point in zip(line.bodies, line.points, strict=True)
        )
        size = max(float(np.abs(one).max()), float(np.abs(other).max()))
        if float(np.linalg.norm(one - other)) <= COINCIDENCE_TOLERANCE * size:
            what = "its ends meet at the start, where its force has no direction: "
            remedy = "start elsewhere, or choose other points"
            if isinstance(line, Spring):
                remedy += ", or a rest length of zero, which needs no direction"
            problems.append(scene.problem(key, what + remedy, severity="warning"))
    return problems


def _is_zero(formula: Formula, scene: Scene) -> bool:
    """Return True if a formula is zero for all values of the parameters."""
    constants = {c.name: c.value for c in scene.constants}
    if any(node.id not in constants for node in formula.names()):
        return False
    return float(formulas.evaluate(formula, formulas.NUMERIC, constants.__getitem__)) == 0


def moved_subspace(subspace: Array, arm: Array) -> Array:
    """Return a motion subspace (angular velocity, velocity) at a point `arm` away."""
    return np.concatenate([subspace[:3], subspace[3:] + np.cross(subspace[:3], arm)])


def _cross_matrix(v: Array) -> Array:
    """Return the matrix [v] with [v] w = v x w."""
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _spatial_inertia(mass: float, center: Array, root: Array) -> Array:
    """Return the spatial inertia (6, 6) at a point, of angular velocity and velocity."""
    c = _cross_matrix(center)
    coupled = mass * c
    return np.block([[root.T @ root - coupled @ c, coupled], [-coupled, mass * np.eye(3)]])


def null_space(columns: Array) -> Array:
    """Return a basis of the null space of a matrix, made sparse by elimination.

    columns: the matrix (m, n). The basis vectors are the rows of the result (n - rank, n), each
    scaled so that its largest entry in size is 1 or -1.
    """
    n = columns.shape[1]
    sizes = np.linalg.norm(columns, axis=0)
    there = np.flatnonzero(sizes > rank.tolerance() * sizes.max(initial=0.0))
    rows = [np.eye(n)[k] for k in range(n) if k not in there]
    if len(there):
        upper = np.linalg.qr(columns[:, there] / sizes[there], mode="r")
        _, values, vectors = np.linalg.svd(upper)
        for row in _reduced_row_echelon_form(vectors[int(rank.count(values)) :]):
            full = np.zeros(n)
            full[there] = row / sizes[there]
            first = full[np.flatnonzero(np.abs(full) > 1e-3 * np.abs(full).max())[0]]
            rows.append(full / (np.abs(full).max() * np.sign(first)))
    return np.array(rows).reshape(-1, n)


def _reduced_row_echelon_form(rows: Array) -> Array:
    """Return the reduced row echelon form of linearly independent rows."""
    rows = rows.copy()
    for k in range(len(rows)):
        pivot = np.unravel_index(np.abs(rows[k:]).argmax(), rows[k:].shape)
        rows[[k, k + int(pivot[0])]] = rows[[k + int(pivot[0]), k]]
        column = int(pivot[1])
        rows[k] /= rows[k, column]
        others = [i for i in range(len(rows)) if i != k]
        rows[others] -= np.outer(rows[others, column], rows[k])
    return rows
