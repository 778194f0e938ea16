"""Forward kinematics of a scene's bodies in plain numbers, and what moves nothing at a state."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eomc.base import spatial
from eomc.scene import formulas
from eomc.scene.assembly import WORLD, Assembly, Body, Turn
from eomc.scene.formulas import Formula
from eomc.scene.joints import JOINTS
from eomc.scene.scene import Scene

Array = NDArray[np.float64]
Pose = tuple[Array, Array]  # where a body's frame is in the world: offset (3,), rotation (3, 3)
# how fast over each coordinate, "t" or "r", axis and a point on it, in the world
Motion = tuple[dict[int, float], str, Array, Array]

STEP = 1e-5  # of central differences: their error is about 1e-10
NOTHING = 1e-7  # a column shorter than this, relative to the longest, is one of zeros
RANK = 1e-6  # a singular value of columns of length one, relative to the largest: a zero
PIVOT = (
    1e-10  # of an inertia, relative to those that it is made of: above it, it is none of rounding
)
STATES = 3  # random ones; a rank that holds almost everywhere is the largest of them


@dataclass(frozen=True)
class Jacobian:
    """Over the coordinates, a column each.

    moves: velocities and angular velocities of all bodies, m/s and rad/s a unit of rate. weighs:
    these times the roots of their inertias, so that D = weighs^T weighs.
    """

    moves: Array
    weighs: Array


@dataclass(frozen=True)
class Null:
    """Motions that move no body, and those that move nothing with inertia, a row each."""

    moves: Array
    weighs: Array


class Kinematics:
    """A scene's bodies at a state, in plain numbers."""

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
        self.roots = {body.name: self._roots(body) for body in assembly.bodies}

    def states(self) -> Iterator[Null]:
        """At random states: coordinates not too far from the start, where formulas have values."""
        random = np.random.default_rng(0)
        for _ in range(STATES):
            q = self.start + random.uniform(-0.7, 0.7, len(self.start))
            if null := self.null(q, random.uniform(0, 1)):
                yield null
                if not len(null.weighs):
                    return

    def null(self, q: Array, t: float) -> Null | None:
        """What moves nothing at a state; None where a formula has no value there."""
        if self.is_regular(q):
            return Null(*np.zeros((2, 0, len(q))))
        found = self.jacobian(q, t)
        return Null(_null(found.moves), _null(found.weighs)) if found else None

    def is_regular(self, q: Array) -> bool:
        """Whether every joint of a tree, armature left out, is seen to have inertia of its own.

        The joints are eliminated from the last one inwards (articulated bodies; Featherstone,
        *Rigid Body Dynamics Algorithms*, ch. 7), which takes as long as the tree is. A pivot that
        may be rounding is not judged: then the answer is False.
        """
        by = [formula.text for body in self.tree for formula in body.coordinates]
        if self.placed or sorted(by) != sorted(self.coordinates):
            return False
        frames = self._frames(q)
        inertia: dict[str, Array] = {}  # of what is beyond a joint, in the world's directions
        size: dict[str, float] = {}  # of what went into it
        for body in reversed(self.tree):
            (at, R), motions = frames[body.name]
            mass, root = self.roots[body.name]
            own = _spatial(mass**2, R @ self.centers[body.name], root @ R.T)
            beyond = own + inertia.pop(body.name, 0)
            scale = max(float(np.abs(beyond).max()), size.pop(body.name, 0.0))
            for _, kind, axis, point in reversed(motions):
                turn = [axis, np.cross(axis, at - point)]  # angular velocity, and velocity at `at`
                s = np.concatenate(turn if kind == "r" else [np.zeros(3), axis])
                u = beyond @ s
                if s @ u <= PIVOT * scale:
                    return False
                beyond = beyond - np.outer(u, u) / (s @ u)
            if body.parent != WORLD:
                shift = np.eye(6)
                shift[3:, :3] = -_cross(at - frames[body.parent][0][0])
                inertia[body.parent] = inertia.get(body.parent, 0) + shift.T @ beyond @ shift
                size[body.parent] = max(size.get(body.parent, 0.0), scale)
        return True

    def poses(self, q: Array) -> dict[str, Pose] | None:
        """Of each body's frame, of a placed one its centre's; None where a formula has no value."""
        try:
            held = {name: pose for name, (pose, _) in self._frames(q).items()}
            return held | (self._placed_at(q, 0.0) if self.placed else {})
        except (ArithmeticError, ValueError, TypeError):
            return None

    def _frames(self, q: Array) -> dict[str, tuple[Pose, list[Motion]]]:
        """Of each body its frame, and its joint's motions, in the world."""
        known = self._known(q)
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
                    R = R @ _about(axis, moved)
            out[body.name] = (at, R), motions
        return out

    def _known(self, q: Array) -> dict[str, float]:
        """Values of parameters, constants and coordinates."""
        return {**self.values, **dict(zip(self.coordinates, map(float, q), strict=True))}

    def _slopes(self, by: Formula, known: dict[str, float]) -> dict[int, float]:
        """What a joint moves by, over the coordinates; of a formula by central differences."""
        if by.text in self.index:
            return {self.index[by.text]: 1.0}
        slopes = {}
        for name in {node.id for node in by.names()} & self.index.keys():
            after, before = (
                self._number(by, {**known, name: known[name] + step}) for step in (STEP, -STEP)
            )
            slopes[self.index[name]] = (after - before) / (2 * STEP)
        return slopes

    def jacobian(self, q: Array, t: float) -> Jacobian | None:
        """At a state; None where a formula has no value there."""
        try:
            found = [*self._tree_rates(q), *self._placed_rates(q, t)]
            rotors = [*self._armatures(q)]
        except (ArithmeticError, ValueError, TypeError):
            return None
        moves, weighs = [], []
        for body, R, v, omega in found:
            mass, inertia = self.roots[body.name]
            moves += [v, omega]
            weighs += [mass * v, inertia @ R.T @ omega]
        return Jacobian(np.vstack(moves), np.vstack([*weighs, *rotors]))

    def _tree_rates(self, q: Array) -> Iterator[tuple[Body, Array, Array, Array]]:
        """Each body's rotation, and velocities of its centre and of turning over q: (3, nq)."""
        frames = self._frames(q)
        above: dict[str, list[Motion]] = {WORLD: []}  # all between a body and the world
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

    def _placed_rates(self, q: Array, t: float) -> Iterator[tuple[Body, Array, Array, Array]]:
        """The same of bodies placed by formulas, by central differences."""
        if not self.placed:
            return
        here = self._placed_at(q, t)
        v = {name: np.zeros((3, len(q))) for name in here}
        omega = {name: np.zeros((3, len(q))) for name in here}
        for k in range(len(q)):
            step = np.zeros(len(q))
            step[k] = STEP
            after, before = self._placed_at(q + step, t), self._placed_at(q - step, t)
            for name in here:
                v[name][:, k] = (after[name][0] - before[name][0]) / (2 * STEP)
                # R(q + h) R(q - h)^T = 1 + 2 h [omega] + ..., antisymmetric up to h^3
                turn = after[name][1] @ before[name][1].T / (4 * STEP)
                skew = turn - turn.T
                omega[name][:, k] = skew[2, 1], skew[0, 2], skew[1, 0]
        for body in self.placed:
            yield body, here[body.name][1], v[body.name], omega[body.name]

    def _placed_at(self, q: Array, t: float) -> dict[str, Pose]:
        """Centre of mass and rotation of each body that is placed by formulas."""
        known = {**self._known(q), "t": t}
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

    def joint_frame(self, body: Body) -> Pose:
        """Where the joint's frame stands in the parent's."""
        offset = self.vector(body.offset, self.values) if body.offset else np.zeros(3)
        return offset, self._rotation(body.rotation, self.values)

    def axes(self, body: Body) -> list[Array]:
        """The axis of each coordinate of a joint, in the frame that those before it moved."""
        axes = map(np.array, JOINTS[body.joint].motion_axes(body.axes))
        return [axis / np.linalg.norm(axis) for axis in axes]

    def _roots(self, body: Body) -> tuple[float, Array]:
        """The root of the mass, and of the inertia: 2 K = |root_m v|^2 + |root_I omega|^2."""
        inertia = [self._number(entry, self.values) for entry in body.inertia]
        moments, axes = np.linalg.eigh(spatial.tensor(inertia))
        root = np.sqrt(np.maximum(moments, 0))[:, None] * axes.T
        return math.sqrt(max(self._number(body.mass, self.values), 0)), root

    def _armatures(self, q: Array) -> Iterator[Array]:
        """A row (nq,) for each armature: its root times how fast its joint moves."""
        frames = self._frames(q)
        for body in self.tree:
            for armature, (slopes, *_) in zip(body.armature, frames[body.name][1], strict=False):
                row = np.zeros(len(q))
                row[[*slopes]] = [*slopes.values()]
                yield math.sqrt(max(self._number(armature, self.values), 0)) * row

    def vector(self, formulas_: Iterable[Formula], known: dict[str, float]) -> Array:
        """The values of formulas, where the names have those in `known`."""
        return np.array([self._number(formula, known) for formula in formulas_])

    def _rotation(self, turns: Iterable[Turn], known: dict[str, float]) -> Array:
        rotation = np.eye(3)
        for turn in turns:
            axis = np.eye(3)["xyz".index(turn.axis)]
            rotation = rotation @ _about(axis, self._number(turn.angle, known))
        return rotation

    def _number(self, formula: Formula, known: dict[str, float]) -> float:
        """The value of a formula; definitions are followed, and kept in `known`."""

        def lookup(name: str) -> float:
            if name not in known:
                known[name] = self._number(self.definitions[name], known)
            return known[name]

        value = float(formulas.evaluate(formula, formulas.NUMERIC, lookup))
        if not math.isfinite(value):
            raise ValueError("not finite")
        return value


def _cross(v: Array) -> Array:
    """[v] with [v] w = v x w."""
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _spatial(mass: float, center: Array, root: Array) -> Array:
    """The inertia (6, 6) of turning rate and velocity at a point: mass, its centre, root^T root."""
    c = _cross(center)
    coupled = mass * c
    return np.block([[root.T @ root - coupled @ c, coupled], [-coupled, mass * np.eye(3)]])


def _about(axis: Array, angle: float) -> Array:
    """The rotation by an angle about a unit axis."""
    return np.array(spatial.about(axis.tolist(), math.cos(angle), math.sin(angle)))


def _null(columns: Array) -> Array:
    """The null space, a row each, with as many zeros as elimination finds: (n - rank, n)."""
    n = columns.shape[1]
    sizes = np.linalg.norm(columns, axis=0)
    there = np.flatnonzero(sizes > NOTHING * sizes.max(initial=0.0))
    rows = [np.eye(n)[k] for k in range(n) if k not in there]
    if len(there):
        upper = np.linalg.qr(columns[:, there] / sizes[there], mode="r")  # as long as wide
        _, values, vectors = np.linalg.svd(upper)
        rank = int((values > RANK * values[0]).sum())
        for row in _eliminated(vectors[rank:]):
            full = np.zeros(n)
            full[there] = row / sizes[there]
            first = full[np.flatnonzero(np.abs(full) > 1e-3 * np.abs(full).max())[0]]
            rows.append(full / (np.abs(full).max() * np.sign(first)))
    return np.array(rows).reshape(-1, n)


def _eliminated(rows: Array) -> Array:
    """Gauss and Jordan's form of linearly independent rows."""
    rows = rows.copy()
    for k in range(len(rows)):
        pivot = np.unravel_index(np.abs(rows[k:]).argmax(), rows[k:].shape)
        rows[[k, k + int(pivot[0])]] = rows[[k + int(pivot[0]), k]]
        column = int(pivot[1])
        rows[k] /= rows[k, column]
        others = [i for i in range(len(rows)) if i != k]
        rows[others] -= np.outer(rows[others, column], rows[k])
    return rows
