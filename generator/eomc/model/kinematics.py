"""Numerical forward kinematics of a scene's bodies, and motions that move no body or no mass."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eomc.base import spatial
from eomc.scene import formulas
from eomc.scene.assembly import WORLD, Assembly, RigidBody, Turn
from eomc.scene.formulas import Formula
from eomc.scene.joints import JOINTS
from eomc.scene.scene import Scene

Array = NDArray[np.float64]
Pose = tuple[Array, Array]  # of a frame in the world: offset (3,), rotation (3, 3)
# derivative by coordinate index, "t" or "r", axis and a point on it, in the world
Motion = tuple[dict[int, float], str, Array, Array]

ZERO_COLUMN_TOLERANCE = 1e-7  # relative to the longest column
RANK_TOLERANCE = 1e-6  # of singular values of normalised columns, relative to the largest


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
        self.coordinates = [c.name for c in scene.coordinates]
        self.index = {name: k for k, name in enumerate(self.coordinates)}
        self.values = {p.name: p.value for p in (*scene.parameters, *scene.constants)}
        self.definitions = dict(scene.definitions)
        self.start = np.array(scene.start()[0])
        self.tree = [body for body in assembly.bodies if body.joint]
        self.placed = [body for body in assembly.bodies if not body.joint]
        # these depend on parameters only
        self.frames = {body.name: self.joint_frame(body) for body in self.tree}
        self.centers = {body.name: self.vector(body.center, self.values) for body in self.tree}
        self.roots = {body.name: self._inertia_roots(body) for body in assembly.bodies}

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
        frames = self._frames(q)
        inertia: dict[str, Array] = {}  # of the subtree of each joint, in world axes
        size: dict[str, float] = {}  # scale of its terms
        for body in reversed(self.tree):
            (at, R), motions = frames[body.name]
            mass, root = self.roots[body.name]
            own = _spatial_inertia(mass**2, R @ self.centers[body.name], root @ R.T)
            beyond = own + inertia.pop(body.name, 0)
            scale = max(float(np.abs(beyond).max()), size.pop(body.name, 0.0))
            for _, kind, axis, point in reversed(motions):
                turn = [axis, np.cross(axis, at - point)]  # angular velocity, and velocity at `at`
                s = np.concatenate(turn if kind == "r" else [np.zeros(3), axis])
                u = beyond @ s
                if s @ u <= self.PIVOT_TOLERANCE * scale:
                    return False
                beyond = beyond - np.outer(u, u) / (s @ u)
            if body.parent != WORLD:
                shift = np.eye(6)
                shift[3:, :3] = -_cross_matrix(at - frames[body.parent][0][0])
                inertia[body.parent] = inertia.get(body.parent, 0) + shift.T @ beyond @ shift
                size[body.parent] = max(size.get(body.parent, 0.0), scale)
        return True

    def poses(self, q: Array) -> dict[str, Pose] | None:
        """Return a dict from the name of each body to its pose in the world.

        A pose is a pair (position (3,) in m, rotation matrix (3, 3)). The position is that of the
        body's frame; for a body placed by formulas it is that of the centre of mass at time 0. q:
        coordinates (nq,). Returns None if a formula of the scene can't be evaluated at `q`.
        """
        try:
            by_name = {name: pose for name, (pose, _) in self._frames(q).items()}
            return by_name | (self._poses_by_formulas(q, 0.0) if self.placed else {})
        except (ArithmeticError, ValueError, TypeError):
            return None

    def _frames(self, q: Array) -> dict[str, tuple[Pose, list[Motion]]]:
        """Return each body's frame and the motions of its joint, in the world."""
        known = self._quantity_values(q)
        out: dict[str, tuple[Pose, list[Motion]]] = {WORLD: ((np.zeros(3), np.eye(3)), [])}
        for body in self.tree:
            at, R = out[body.parent][0]
            offset, rotation = self.frames[body.name]
            at, R = at + R @ offset, R @ rotation
            motions = []
            kinds = JOINTS[body.joint].motions
            for kind, axis, by in zip(kinds, self.axes(body), body.coordinates, strict=True):
                motions.append((self._slopes(by, known), kind, R @ axis, at))
                moved = self._number(by, known)
                if kind == "t":
                    at = at + R @ axis * moved
                else:
                    R = R @ _rotation_matrix(axis, moved)
            out[body.name] = (at, R), motions
        return out

    def _quantity_values(self, q: Array) -> dict[str, float]:
        """Return the values of parameters, constants and coordinates."""
        return {**self.values, **dict(zip(self.coordinates, map(float, q), strict=True))}

    def _slopes(self, by: Formula, known: dict[str, float]) -> dict[int, float]:
        """Return the derivatives of a joint position with respect to the coordinates.

        Those of a formula are computed by central differences.
        """
        if by.text in self.index:
            return {self.index[by.text]: 1.0}
        slopes = {}
        for name in {node.id for node in by.names()} & self.index.keys():
            after, before = (
                self._number(by, {**known, name: known[name] + step})
                for step in (self.STEP, -self.STEP)
            )
            slopes[self.index[name]] = (after - before) / (2 * self.STEP)
        return slopes

    def jacobian(self, q: Array, t: float) -> Jacobian | None:
        """Return the Jacobians of the motion of all bodies at coordinates q (nq,) and time t (s).

        Returns None if a formula of the scene can't be evaluated there.
        """
        try:
            velocities = [*self._tree_rates(q), *self._placed_rates(q, t)]
            rotors = [*self._armatures(q)]
        except (ArithmeticError, ValueError, TypeError):
            return None
        moves, weighs = [], []
        for body, R, v, omega in velocities:
            mass, inertia = self.roots[body.name]
            moves += [v, omega]
            weighs += [mass * v, inertia @ R.T @ omega]
        return Jacobian(np.vstack(moves), np.vstack([*weighs, *rotors]))

    def _tree_rates(self, q: Array) -> Iterator[tuple[RigidBody, Array, Array, Array]]:
        """Yield each body's rotation and its translational and rotational Jacobians (3, nq)."""
        frames = self._frames(q)
        above: dict[str, list[Motion]] = {WORLD: []}  # all motions between a body and the world
        for body in self.tree:
            (at, R), own = frames[body.name]
            above[body.name] = [*above[body.parent], *own]
            center = at + R @ self.centers[body.name]
            v, omega = np.zeros((3, len(q))), np.zeros((3, len(q)))
            for slopes, kind, axis, point in above[body.name]:
                for k, slope in slopes.items():
                    if kind == "t":
                        v[:, k] += slope * axis
                    else:
                        v[:, k] += slope * np.cross(axis, center - point)
                        omega[:, k] += slope * axis
            yield body, R, v, omega

    def _placed_rates(self, q: Array, t: float) -> Iterator[tuple[RigidBody, Array, Array, Array]]:
        """Yield rotation and Jacobians (3, nq) of bodies placed by formulas.

        The Jacobians are computed by central differences. The tuples are those of `_tree_rates`.
        """
        if not self.placed:
            return
        here = self._poses_by_formulas(q, t)
        v = {name: np.zeros((3, len(q))) for name in here}
        omega = {name: np.zeros((3, len(q))) for name in here}
        for k in range(len(q)):
            step = np.zeros(len(q))
            step[k] = self.STEP
            after, before = (
                self._poses_by_formulas(q + step, t),
                self._poses_by_formulas(q - step, t),
            )
            for name in here:
                v[name][:, k] = (after[name][0] - before[name][0]) / (2 * self.STEP)
                # R(q + h) R(q - h)^T = 1 + 2 h [omega] + ..., antisymmetric up to h^3
                turn = after[name][1] @ before[name][1].T / (4 * self.STEP)
                skew = turn - turn.T
                omega[name][:, k] = skew[2, 1], skew[0, 2], skew[1, 0]
        for body in self.placed:
            yield body, here[body.name][1], v[body.name], omega[body.name]

    def _poses_by_formulas(self, q: Array, t: float) -> dict[str, Pose]:
        """Return centre of mass and rotation of each body that is placed by formulas."""
        known = {**self._quantity_values(q), "t": t}
        for name, ((at, R), _) in self._frames(q).items():
            if name != WORLD:
                center = at + R @ self.centers[name]
                known |= {f"{name}_{x}": float(c) for x, c in zip("xyz", center, strict=True)}
        return {
            body.name: (
                self.vector(body.position or (), known),
                self._rotation(body.rotation, known),
            )
            for body in self.placed
        }

    def joint_frame(self, body: RigidBody) -> Pose:
        """Return the pose of a joint's frame in the frame of the parent body.

        body: the body that the joint attaches to its parent. The pose is a pair (position (3,) in
        m, rotation matrix (3, 3)).
        """
        offset = self.vector(body.offset, self.values) if body.offset else np.zeros(3)
        return offset, self._rotation(body.rotation, self.values)

    def axes(self, body: RigidBody) -> list[Array]:
        """Return a unit vector for each motion of a body's joint.

        The components of each vector are in the joint's frame after the motions before it.
        """
        axes = map(np.array, JOINTS[body.joint].motion_axes(body.axes))
        return [axis / np.linalg.norm(axis) for axis in axes]

    def _inertia_roots(self, body: RigidBody) -> tuple[float, Array]:
        """Return square roots of mass and inertia tensor: 2 K = |root_m v|^2 + |root_I omega|^2."""
        inertia = [self._number(entry, self.values) for entry in body.inertia]
        moments, axes = np.linalg.eigh(spatial.tensor(inertia))
        root = np.sqrt(np.maximum(moments, 0))[:, None] * axes.T
        return math.sqrt(max(self._number(body.mass, self.values), 0)), root

    def _armatures(self, q: Array) -> Iterator[Array]:
        """Yield a row (nq,) for each armature: its square root times the gradient of its joint."""
        frames = self._frames(q)
        for body in self.tree:
            for armature, (slopes, *_) in zip(body.armature, frames[body.name][1], strict=False):
                row = np.zeros(len(q))
                row[[*slopes]] = [*slopes.values()]
                yield math.sqrt(max(self._number(armature, self.values), 0)) * row

    def vector(self, formulas_: Iterable[Formula], known: dict[str, float]) -> Array:
        """Return the values of formulas as an array.

        known: dict from each name that the formulas use to its value.
        """
        return np.array([self._number(formula, known) for formula in formulas_])

    def _rotation(self, turns: Iterable[Turn], known: dict[str, float]) -> Array:
        rotation = np.eye(3)
        for turn in turns:
            axis = np.eye(3)["xyz".index(turn.axis)]
            rotation = rotation @ _rotation_matrix(axis, self._number(turn.angle, known))
        return rotation

    def _number(self, formula: Formula, known: dict[str, float]) -> float:
        """Return the value of a formula; values of definitions are added to `known`."""

        def lookup(name: str) -> float:
            if name not in known:
                known[name] = self._number(self.definitions[name], known)
            return known[name]

        value = float(formulas.evaluate(formula, formulas.NUMERIC, lookup))
        if not math.isfinite(value):
            raise ValueError("not finite")
        return value


def _cross_matrix(v: Array) -> Array:
    """Return the matrix [v] with [v] w = v x w."""
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _spatial_inertia(mass: float, center: Array, root: Array) -> Array:
    """Return the spatial inertia (6, 6) at a point, of angular velocity and velocity."""
    c = _cross_matrix(center)
    coupled = mass * c
    return np.block([[root.T @ root - coupled @ c, coupled], [-coupled, mass * np.eye(3)]])


def _rotation_matrix(axis: Array, angle: float) -> Array:
    """Return the rotation by an angle about a unit axis."""
    return np.array(spatial.axis_angle_rotation(axis.tolist(), math.cos(angle), math.sin(angle)))


def null_space(columns: Array) -> Array:
    """Return a basis of the null space of a matrix, made sparse by elimination.

    columns: the matrix (m, n). The basis vectors are the rows of the result (n - rank, n), each
    scaled so that its largest entry in size is 1 or -1.
    """
    n = columns.shape[1]
    sizes = np.linalg.norm(columns, axis=0)
    there = np.flatnonzero(sizes > ZERO_COLUMN_TOLERANCE * sizes.max(initial=0.0))
    rows = [np.eye(n)[k] for k in range(n) if k not in there]
    if len(there):
        upper = np.linalg.qr(columns[:, there] / sizes[there], mode="r")
        _, values, vectors = np.linalg.svd(upper)
        rank = int((values > RANK_TOLERANCE * values[0]).sum())
        for row in _reduced_row_echelon_form(vectors[rank:]):
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
