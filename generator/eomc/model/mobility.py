"""M = d(N - 1 - j) + sum f_i: how many freedoms a scene of bodies and joints has, and which.

The count (Chebychev, Grübler, Kutzbach; e.g. Angeles, *Fundamentals of Robotic Mechanical
Systems*) is held against ranks: of the poses of all bodies over the coordinates, which shows
coordinates that move nothing or nothing of their own, and of the mass matrix of the bodies, which
shows those that move nothing with inertia. Both are taken from plain forward kinematics, of bodies
placed by formulas from its finite differences, at random states and at the start. Where the joints
of a tree can be eliminated one by one, nothing is redundant and no rank need be taken, which makes
thousands of bodies a matter of seconds.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from eomc.base.errors import EomcError, Problem
from eomc.scene import formulas
from eomc.scene.assembly import WORLD, Assembly, Body, Damper, Spring, Turn
from eomc.scene.formulas import Formula
from eomc.scene.joints import JOINTS

if TYPE_CHECKING:
    from eomc.scene.scene import Scene

Array = NDArray[np.float64]
Pose = tuple[Array, Array]  # where a body's frame is in the world: offset (3,), rotation (3, 3)
Motion = tuple[
    int, str, Array, Array
]  # coordinate, "t" or "r", axis and a point on it, in the world

STEP = 1e-5  # of central differences: their error is about 1e-10
NOTHING = 1e-7  # a column shorter than this, relative to the longest, is one of zeros
RANK = 1e-6  # a singular value of columns of length one, relative to the largest: a zero
TOGETHER = 1e-12  # apart, relative to how far both are from the origin: that is rounding
PIVOT = 1e-10  # of an inertia beside those that it is made of: above it, it is none of rounding
STATES = 3  # random ones; a rank that holds almost everywhere is the largest of them


@dataclass(frozen=True)
class Mobility:
    """What was counted and found. freedoms: of each joint, by kind; M: the count.

    coordinates: of the scene; rank: how many move the bodies independently, almost everywhere.
    remarks: in words, what is redundant, missing or singular.
    """

    scene: str
    d: int
    bodies: int
    joints: Mapping[str, int]
    M: int
    coordinates: int
    rank: int
    remarks: tuple[str, ...]

    def table(self) -> str:
        """For people."""
        kinds = ", ".join(
            f"{n} {kind} (f = {_freedoms(kind, self.d)})" for kind, n in self.joints.items()
        )
        j, total = self.bodies, sum(n * _freedoms(k, self.d) for k, n in self.joints.items())
        where = "in the plane" if self.d == 3 else "in space"
        lines = [
            f"{self.scene}: {self.M} {_plural('freedom', self.M)} {where}",
            f"  N = {self.bodies + 1} links, the world among them",
            f"  j = {j} joints: {kinds}",
            f"  M = d(N - 1 - j) + sum f = {self.d}({self.bodies + 1} - 1 - {j}) + {total} "
            f"= {self.M}",
            f"  {self.coordinates} {_plural('coordinate', self.coordinates)}, {self.rank} of them "
            "independent in how they move the bodies",
            *(f"  - {remark}" for remark in self.remarks),
        ]
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "scene": self.scene, "d": self.d, "N": self.bodies + 1, "joints": dict(self.joints),
            "M": self.M, "coordinates": self.coordinates, "rank": self.rank,
            "remarks": list(self.remarks),
        }  # fmt: skip


def count(scene: Scene) -> Mobility:
    """The mobility of a scene. Raises EomcError for one without bodies."""
    assembly = scene.assembly
    if not assembly or not assembly.bodies:
        raise EomcError(
            f"{scene.file}: the scene has no [[body]]: mobility is counted from bodies and joints"
        )
    d = 3 if assembly.plane else 6
    placed = [body for body in assembly.bodies if not body.joint]
    joints = Counter(body.joint or FORMULAS for body in assembly.bodies)
    M = sum(n * _freedoms(kind, d) for kind, n in joints.items())  # a tree: N - 1 - j = 0
    kinematics = _Kinematics(scene, assembly)
    names = kinematics.coordinates
    found = list(kinematics.states())
    if not found:
        raise EomcError(f"{scene.file}: the bodies' positions have no value at the states tried")
    generic = min(found, key=lambda null: (len(null.moves), len(null.weighs)))
    rank = len(names) - len(generic.moves)
    remarks = [
        *_fixed(assembly),
        *_shared(assembly),
        *_formulas_fix(placed, d, names, rank, M),
        *_moves_nothing(generic, names, bool(scene.kinetic.names())),
        *_in_a_row(assembly, kinematics),
        *_singular_start(kinematics, generic),
        *(f"{problem.key}: {problem.message}" for problem in meeting(scene)),
    ]
    return Mobility(scene.name, d, len(assembly.bodies), joints, M, len(names), rank, (*remarks,))


def meeting(scene: Scene) -> list[Problem]:
    """A warning for each spring and damper whose ends meet at the start.

    Its force has no direction there. A spring without rest length needs none.
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
    kinematics = _Kinematics(scene, assembly)
    poses = kinematics.poses(kinematics.start)
    if poses is None:
        return []
    found = []
    for key, line in lines:
        assert line.bodies and line.points
        one, other = (
            poses[name][0] + poses[name][1] @ kinematics._vector(point, kinematics.values)
            for name, point in zip(line.bodies, line.points, strict=True)
        )
        size = max(float(np.abs(one).max()), float(np.abs(other).max()))
        if float(np.linalg.norm(one - other)) <= TOGETHER * size:
            what = "its ends meet at the start, where its force has no direction: "
            remedy = "start elsewhere, or choose other points"
            if isinstance(line, Spring):
                remedy += ", or a rest length of zero, which needs no direction"
            found.append(scene.problem(key, what + remedy, severity="warning"))
    return found


def _is_zero(formula: Formula, scene: Scene) -> bool:
    """Whether it is zero whatever the parameters are."""
    constants = {c.name: c.value for c in scene.constants}
    if any(node.id not in constants for node in formula.names()):
        return False
    return float(formulas.evaluate(formula, formulas.NUMERIC, constants.__getitem__)) == 0


FORMULAS = "placed by formulas"


@dataclass(frozen=True)
class _Jacobian:
    """Over the coordinates, a column each.

    moves: velocities and angular velocities of all bodies, m/s and rad/s a unit of rate. weighs:
    these times the roots of their inertias, so that D = weighs^T weighs.
    """

    moves: Array
    weighs: Array


@dataclass(frozen=True)
class _Null:
    """Motions that move no body, and those that move nothing with inertia, a row each."""

    moves: Array
    weighs: Array


def _freedoms(kind: str, d: int) -> int:
    return d if kind == FORMULAS else len(JOINTS[kind].motions)


# --- what there is to say -------------------------------------------------------------------------


def _fixed(assembly: Assembly) -> Iterator[str]:
    rigid = [body.name for body in assembly.bodies if body.joint == "fixed"]
    if rigid:
        yield f"fixed (f = 0), moving as one with what they are fixed to: {_listed(rigid)}"


def _shared(assembly: Assembly) -> Iterator[str]:
    holders: dict[str, list[str]] = {}
    for body in assembly.bodies:
        for name in body.coordinates:
            holders.setdefault(name, []).append(body.name)
    for name, bodies in holders.items():
        if len(bodies) > 1:
            yield (
                f"'{name}' moves {len(bodies)} joints, those of {_listed(bodies)}: M counts each, "
                f"they are {len(bodies) - 1} fewer"
            )


def _formulas_fix(
    placed: Sequence[Body], d: int, names: Sequence[str], rank: int, M: int
) -> Iterator[str]:
    if placed:
        yield (
            f"{_listed(b.name for b in placed)}: M counts {d} freedoms for each body that is "
            f"placed by formulas; the formulas fix {M - rank} of the {M}, which leaves {rank}"
        )


def _moves_nothing(at: _Null, names: Sequence[str], by_hand: bool) -> Iterator[str]:
    """Coordinates that no body hangs on, or that move bodies only in combinations."""
    result = "D is singular" + (" unless [energy] gives it inertia" if by_hand else "")
    for row in at.moves:
        yield f"redundant: {_combination(row, names)} moves no body; {result}"
    known = at.moves
    for row in at.weighs:
        more = np.vstack([known, row])
        if np.linalg.matrix_rank(more, tol=1e-4) > len(known):  # not a motion told above
            known = more
            what = _combination(row, names)
            yield f"without inertia: {what} moves nothing that has inertia against it; {result}"


def _in_a_row(assembly: Assembly, kinematics: _Kinematics) -> Iterator[str]:
    """Joints one behind the other about the same line, or along the same direction."""
    by_name = {body.name: body for body in assembly.bodies}
    for body in assembly.bodies:
        if body.joint not in ("revolute", "prismatic"):
            continue
        offset, rotation = kinematics.frames[body.name]
        above = by_name.get(body.parent)
        while above is not None and above.joint == "fixed":
            o, r = kinematics.frames[above.name]
            offset, rotation = o + r @ offset, r @ rotation
            above = by_name.get(above.parent)
        if above is None or above.joint != body.joint:
            continue
        first = kinematics.axes(above)[0]
        second = rotation @ kinematics.axes(body)[0]
        parallel = float(np.linalg.norm(np.cross(first, second))) < 1e-9
        turns = body.joint == "revolute"
        if not parallel or (turns and float(np.linalg.norm(np.cross(offset, first))) > 1e-9):
            continue
        how = "turn about the same line" if turns else "slide along the same direction"
        pair = above.coordinates[0], body.coordinates[0]
        yield (
            f"'{pair[0]}' and '{pair[1]}' {how}, one behind the other: only what lies between the "
            f"two joints tells them apart, {above.name} needs inertia of its own"
        )


def _singular_start(kinematics: _Kinematics, generic: _Null) -> Iterator[str]:
    at_start = kinematics.null(kinematics.start, 0.0)
    names = kinematics.coordinates
    if at_start is None:
        yield "at the start the bodies' positions have no value"
        return
    for null, usual, what in (
        (at_start.moves, generic.moves, "move the bodies independently"),
        (at_start.weighs, generic.weighs, "have inertia"),
    ):
        if len(null) > len(usual):
            lost = _listed([_combination(row, names) for row in null])
            yield (
                f"singular start: {len(names) - len(null)} coordinates {what} there, elsewhere "
                f"{len(names) - len(usual)}: there {lost} does not. Start with another value of "
                "the coordinate between, such as the pitch between yaw and roll"
            )
            return


def _combination(row: Array, names: Sequence[str]) -> str:
    """A motion in words: one coordinate, or rates in a fixed proportion."""
    those = _named(row, names)
    if len(those) == 1:
        return f"'{those[0]}'"
    rates = dict(zip(names, row, strict=True))
    return "the motion " + ", ".join(f"{name}_dot = {rates[name]:.4g}" for name in those)


def _named(row: Array, names: Sequence[str]) -> list[str]:
    large = np.abs(row) > 1e-3 * np.abs(row).max()
    return [name for name, named in zip(names, large, strict=True) if named]


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


# --- forward kinematics ---------------------------------------------------------------------------


class _Kinematics:
    """A scene's bodies at a state, in plain numbers."""

    def __init__(self, scene: Scene, assembly: Assembly) -> None:
        self.coordinates = [c.name for c in scene.coordinates]
        self.values = {p.name: p.value for p in (*scene.parameters, *scene.constants)}
        self.definitions = dict(scene.definitions)
        self.start = np.array(scene.start()[0])
        self.tree = [body for body in assembly.bodies if body.joint]
        self.placed = [body for body in assembly.bodies if not body.joint]
        # these hang on parameters only
        self.frames = {body.name: self.joint_frame(body) for body in self.tree}
        self.centers = {body.name: self._vector(body.center, self.values) for body in self.tree}
        self.roots = {body.name: self._roots(body) for body in assembly.bodies}
        self.armature = np.diag(np.sqrt(self._armature(assembly)))

    def states(self) -> Iterator[_Null]:
        """At random states: coordinates not too far from the start, where formulas have values."""
        random = np.random.default_rng(0)
        for _ in range(STATES):
            q = self.start + random.uniform(-0.7, 0.7, len(self.start))
            if null := self.null(q, random.uniform(0, 1)):
                yield null
                if not len(null.weighs):
                    return

    def null(self, q: Array, t: float) -> _Null | None:
        """What moves nothing at a state; None where a formula has no value there."""
        if self.is_regular(q):
            return _Null(*np.zeros((2, 0, len(q))))
        found = self.jacobian(q, t)
        return _Null(_null(found.moves), _null(found.weighs)) if found else None

    def is_regular(self, q: Array) -> bool:
        """Whether every joint of a tree, armature left out, is seen to have inertia of its own.

        The joints are eliminated from the last one inwards (articulated bodies; Featherstone,
        *Rigid Body Dynamics Algorithms*, ch. 7), which takes as long as the tree is. A pivot that
        may be rounding is not judged: then the answer is False.
        """
        if self.placed or len({c for b in self.tree for c in b.coordinates}) < len(q):
            return False
        frames = self._frames(q)
        inertia: dict[str, Array] = {}  # of what is beyond a joint, in the world's directions
        size: dict[str, float] = {}  # of what went into it
        for body in reversed(self.tree):
            (at, turned), motions = frames[body.name]
            mass, root = self.roots[body.name]
            own = _spatial(mass**2, turned @ self.centers[body.name], root @ turned.T)
            beyond = own + inertia.pop(body.name, 0)
            scale = max(float(np.abs(beyond).max()), size.pop(body.name, 0.0))
            for kind, axis in reversed(motions):
                s = np.concatenate([axis, np.zeros(3)] if kind == "r" else [np.zeros(3), axis])
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
        held = {name: pose for name, (pose, _) in self._frames(q).items()}
        try:
            return held | (self._placed_at(q, 0.0) if self.placed else {})
        except (ArithmeticError, ValueError, TypeError):
            return None

    def _frames(self, q: Array) -> dict[str, tuple[Pose, list[tuple[str, Array]]]]:
        """Of each body its frame, and its joint's motions: "t" or "r" and the axis in the world."""
        index = {name: k for k, name in enumerate(self.coordinates)}
        out: dict[str, tuple[Pose, list[tuple[str, Array]]]] = {
            WORLD: ((np.zeros(3), np.eye(3)), [])
        }
        for body in self.tree:
            at, turned = out[body.parent][0]
            offset, rotation = self.frames[body.name]
            at, turned = at + turned @ offset, turned @ rotation
            motions = []
            kinds = JOINTS[body.joint].motions  # slides come before turns, so points stay
            for kind, axis, name in zip(kinds, self.axes(body), body.coordinates, strict=True):
                motions.append((kind, turned @ axis))
                if kind == "t":
                    at = at + turned @ axis * q[index[name]]
                else:
                    turned = turned @ _turn(axis, q[index[name]])
            out[body.name] = (at, turned), motions
        return out

    def jacobian(self, q: Array, t: float) -> _Jacobian | None:
        """At a state; None where a formula has no value there."""
        try:
            found = [*self._tree_rates(q), *self._placed_rates(q, t)]
        except (ArithmeticError, ValueError, TypeError):
            return None
        moves, weighs = [], []
        for body, turned, v, omega in found:
            mass, inertia = self.roots[body.name]
            moves += [v, omega]
            weighs += [mass * v, inertia @ turned.T @ omega]
        return _Jacobian(np.vstack(moves), np.vstack([*weighs, self.armature]))

    def _tree_rates(self, q: Array) -> Iterator[tuple[Body, Array, Array, Array]]:
        """Each body's rotation, and velocities of its centre and of turning over q: (3, nq)."""
        held = self._held(q)
        for body in self.tree:
            (at, turned), above = held[body.name]
            center = at + turned @ self.centers[body.name]
            v, omega = np.zeros((3, len(q))), np.zeros((3, len(q)))
            for k, kind, axis, point in above:
                if kind == "t":
                    v[:, k] += axis
                else:
                    v[:, k] += np.cross(axis, center - point)
                    omega[:, k] += axis
            yield body, turned, v, omega

    def _held(self, q: Array) -> dict[str, tuple[Pose, list[Motion]]]:
        """The frame of each body in the world, and all motions between the two."""
        index = {name: k for k, name in enumerate(self.coordinates)}
        held: dict[str, tuple[Pose, list[Motion]]] = {WORLD: ((np.zeros(3), np.eye(3)), [])}
        for body in self.tree:
            (at, turned), above = held[body.parent]
            offset, rotation = self.frames[body.name]
            at, turned, above = at + turned @ offset, turned @ rotation, list(above)
            kinds = JOINTS[body.joint].motions  # slides come before turns, so points stay
            for kind, axis, name in zip(kinds, self.axes(body), body.coordinates, strict=True):
                k = index[name]
                if kind == "t":
                    above.append((k, kind, turned @ axis, at))
                    at = at + turned @ axis * q[k]
                else:
                    above.append((k, kind, turned @ axis, at))
                    turned = turned @ _turn(axis, q[k])
            held[body.name] = (at, turned), above
        return held

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
            ahead, behind = self._placed_at(q + step, t), self._placed_at(q - step, t)
            for name in here:
                v[name][:, k] = (ahead[name][0] - behind[name][0]) / (2 * STEP)
                # R(q + h) R(q - h)^T = 1 + 2 h [omega] + ..., antisymmetric up to h^3
                turn = ahead[name][1] @ behind[name][1].T / (4 * STEP)
                skew = turn - turn.T
                omega[name][:, k] = skew[2, 1], skew[0, 2], skew[1, 0]
        for body in self.placed:
            yield body, here[body.name][1], v[body.name], omega[body.name]

    def _placed_at(self, q: Array, t: float) -> dict[str, Pose]:
        """Centre of mass and rotation of each body that is placed by formulas."""
        known = {**self.values, **dict(zip(self.coordinates, map(float, q), strict=True)), "t": t}
        for name, ((at, turned), _) in self._held(q).items():
            if name != WORLD:
                center = at + turned @ self.centers[name]
                known |= {f"{name}_{x}": float(c) for x, c in zip("xyz", center, strict=True)}
        return {
            body.name: (
                self._vector(body.position or (), known),
                self._turned(body.rotation, known),
            )
            for body in self.placed
        }

    def joint_frame(self, body: Body) -> Pose:
        """Where the joint's frame stands in the parent's."""
        offset = self._vector(body.offset, self.values) if body.offset else np.zeros(3)
        return offset, self._turned(body.rotation, self.values)

    def axes(self, body: Body) -> list[Array]:
        """The axis of each coordinate of a joint, in the frame that those before it moved."""
        axes = map(np.array, JOINTS[body.joint].along(body.axes))
        return [axis / np.linalg.norm(axis) for axis in axes]

    def _roots(self, body: Body) -> tuple[float, Array]:
        """The root of the mass, and of the inertia: 2 K = |root_m v|^2 + |root_I omega|^2."""
        xx, yy, zz, xy, xz, yz = (self._number(entry, self.values) for entry in body.inertia)
        moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        root = np.sqrt(np.maximum(moments, 0))[:, None] * axes.T
        return math.sqrt(max(self._number(body.mass, self.values), 0)), root

    def _armature(self, assembly: Assembly) -> list[float]:
        by_name = dict.fromkeys(self.coordinates, 0.0)
        for body in assembly.bodies:
            for name, armature in zip(body.coordinates, body.armature, strict=False):
                by_name[name] += max(self._number(armature, self.values), 0)
        return list(by_name.values())

    def _vector(self, formulas_: Iterable[Formula], known: dict[str, float]) -> Array:
        return np.array([self._number(formula, known) for formula in formulas_])

    def _turned(self, turns: Iterable[Turn], known: dict[str, float]) -> Array:
        rotation = np.eye(3)
        for turn in turns:
            axis = np.eye(3)["xyz".index(turn.axis)]
            rotation = rotation @ _turn(axis, self._number(turn.angle, known))
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


def _turn(axis: Array, angle: float) -> Array:
    """The rotation by an angle about a unit axis (Rodrigues)."""
    cross = _cross(axis)
    turned: Array = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return turned


def _listed(those: Iterable[str]) -> str:
    names = list(those)
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")


def _plural(word: str, n: int) -> str:
    if n == 1:
        return word
    return word[:-1] + "ies" if word.endswith("y") else word + "s"
