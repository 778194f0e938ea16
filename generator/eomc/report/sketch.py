"""Draw what a scene declares of its shape: bodies, joints, springs and its [picture].

This is an independent forward kinematics, evaluated from the scene's formulas at many states at
once. It shares nothing with the derivation of the equations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eomc.base import spatial
from eomc.report.marks import Drawing, Marks
from eomc.scene import formulas
from eomc.scene.assembly import WORLD, Assembly, Between, LoopJoint, RigidBody, Turn
from eomc.scene.formulas import Formula
from eomc.scene.joints import JOINTS
from eomc.scene.scene import Scene, Shape

Array = NDArray[np.float64]
Pose = tuple[Array, Array]  # position (n, 3) and rotation (n, 3, 3) of a frame at n states
MAX_PATHS = 3

ARRAYS: Mapping[str, Any] = {
    **formulas.NUMERIC,
    **{name: getattr(np, name) for name in "sin cos tan sinh cosh tanh exp log sqrt sign".split()},
    "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "atan2": np.arctan2, "abs": np.abs,
    "heaviside": lambda x: np.heaviside(x, 0.5),
    "min": lambda *x: reduce(np.minimum, x),
    "max": lambda *x: reduce(np.maximum, x),
    "dot": lambda x: 0.0 * x,  # its argument is constant: others are refused by the scene's checks
}  # fmt: skip


def draw_declared(scene: Scene, values: Mapping[str, Any], t: Array, q: Array) -> Drawing | None:
    """Draw the bodies, joints, springs and [picture] that a scene declares, at n instants.

    values: parameters by name, each a number or an array (n,). t: times (n,), s. q: coordinates
    (n, nq). Returns None if the scene declares nothing that can be drawn.
    """
    with np.errstate(all="ignore"):  # what has no value is not drawn
        return _Sketch(scene, values, t, q).drawing()


class _Sketch:
    def __init__(self, scene: Scene, values: Mapping[str, Any], t: Array, q: Array) -> None:
        self.scene, self.n = scene, len(t)
        self.known: dict[str, Any] = {
            p.name: p.value for p in (*scene.constants, *scene.parameters)
        }
        self.known |= {name: values[name] for name in values.keys() & self.known.keys()}
        names = [c.name for c in scene.coordinates]  # columns of q after them are friction modes
        self.known |= dict(zip(names, q.T, strict=False)) | {"t": t}
        self.definitions = dict(scene.definitions)
        self.marks = Marks(self.n)
        world_pose = np.zeros((self.n, 3)), np.broadcast_to(np.eye(3), (self.n, 3, 3))
        self.poses: dict[str, Pose] = {WORLD: world_pose}
        self.joint_frames: dict[str, Pose] = {}  # frames of joints at zero displacement
        self.centers: dict[str, Array] = {}  # centres of mass, in the world frame

    def drawing(self) -> Drawing | None:
        """Return the drawing, or None if the scene declares nothing that can be drawn."""
        assembly, picture = self.scene.assembly, self.scene.picture
        if assembly:
            self._place(assembly)
            self._skeleton(assembly)
        if picture:
            for shape in picture.shapes:
                self._shape(shape)
        if assembly and not self.marks.paths:
            self._paths(assembly)
        plane = assembly.plane if assembly else bool(picture and picture.axes != "xyz")
        axes = picture.axes if picture else "xy" if plane else "xyz"
        units = {c.unit for c in self.scene.coordinates} | {p.unit for p in self.scene.parameters}
        unit = "m" if assembly or "m" in units else ""
        return self.marks.drawing(axes, unit, up=self._up(assembly))

    def _up(self, assembly: Assembly | None) -> int:
        """Return the index of the upward axis, opposite to gravity."""
        if assembly is None:
            return 2
        pull = np.abs([float(self._number(g)) for g in assembly.gravity])
        return int(pull.argmax()) if pull.any() else 2

    # --- values ----------------------------------------------------------------------------------

    def _number(self, formula: Formula) -> Any:
        return formulas.evaluate(formula, ARRAYS, self._lookup)

    def _lookup(self, name: str) -> Any:
        if name not in self.known:
            if name in self.definitions:
                self.known[name] = self._number(self.definitions[name])
            else:
                body, letter = name[:-2], name[-1]
                self.known[name] = self.centers[body][:, "xyz".index(letter)]
        return self.known[name]

    def _vector(self, entries: Sequence[Formula]) -> Array:
        """Evaluate a vector of formulas, (n, 3)."""
        columns = [np.broadcast_to(self._number(entry), self.n) for entry in entries]
        return np.stack(columns, axis=1).astype(float)

    def _rotation(self, turns: Sequence[Turn]) -> Array:
        """Return the rotation matrices of successive turns, (n, 3, 3)."""
        R = self.poses[WORLD][1]
        for turn in turns:
            R = R @ self._about(np.eye(3)["xyz".index(turn.axis)], self._number(turn.angle))
        return R

    def _about(self, axis: Sequence[float] | Array, angle: Any) -> Array:
        angle = np.broadcast_to(angle, self.n)
        rows = spatial.about(tuple(axis), np.cos(angle), np.sin(angle))
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)

    # --- bodies ----------------------------------------------------------------------------------

    def _place(self, assembly: Assembly) -> None:
        """Compute the poses of all frames, those of bodies on joints first."""
        for body in assembly.bodies:
            if body.joint:
                at, R = self.poses[body.parent]
                if body.offset:
                    at = at + _turned(R, self._vector(body.offset))
                R = R @ self._rotation(body.rotation)
                self.joint_frames[body.name] = at, R
                self.poses[body.name] = self._after_joint(body, at, R)
                at, R = self.poses[body.name]
                self.centers[body.name] = at + _turned(R, self._vector(body.center))
        for body in assembly.bodies:
            if body.position:
                pose = self._vector(body.position), self._rotation(body.rotation)
                self.poses[body.name], self.centers[body.name] = pose, pose[0]

    def _after_joint(self, body: RigidBody, at: Array, R: Array) -> Pose:
        kind = JOINTS[body.joint]
        along = zip(kind.motions, kind.motion_axes(body.axes), body.coordinates, strict=True)
        for motion, axis, by in along:
            unit = np.array(axis) / np.linalg.norm(axis)
            moved = self._number(by)
            if motion == "t":
                at = at + _turned(R, np.broadcast_to(moved, self.n)[:, None] * unit)
            else:
                R = R @ self._about(unit, moved)
        return at, R

    def _skeleton(self, assembly: Assembly) -> None:
        for body in assembly.bodies:
            if body.joint:
                self._draw_joint(body)
        for body in assembly.bodies:
            self._mass(body, assembly.plane)
        if not assembly.plane:
            self._boxes(assembly)
        for loop in assembly.loops:
            if loop.bodies:
                self._draw_loop(loop)
        for kind, some in (("spring", assembly.springs), ("damper", assembly.dampers)):
            for end in some:
                self._between(kind, end, assembly)

    def _draw_joint(self, body: RigidBody) -> None:
        """Draw the joint of a body, and a rod from the parent's frame to it."""
        marks, (seat, R) = self.marks, self.joint_frames[body.name]
        at = marks.point(seat)
        if body.parent != WORLD:
            marks.add("rod", marks.point(self.poses[body.parent][0]), at)
        motions = JOINTS[body.joint].motions
        if body.joint in ("free", "planar"):
            return
        if body.parent == WORLD and not body.point and "t" not in motions:
            marks.add("ground", at)
        if "t" in motions:
            axis = JOINTS[body.joint].motion_axes(body.axes)[motions.index("t")]
            direction = np.broadcast_to(self._number(body.coordinates[motions.index("t")]), self.n)
            unit = _turned(R, np.broadcast_to(np.array(axis) / np.linalg.norm(axis), (self.n, 3)))
            ends = (marks.point(seat + x * unit) for x in (direction.min(), direction.max()))
            marks.add("rail", *ends)
            marks.add("slide", marks.point(self.poses[body.name][0]))
        elif motions:
            marks.add("joint", at)
        if body.point:
            marks.add("point", marks.point(self.poses[body.name][0]))

    def _draw_loop(self, loop: LoopJoint) -> None:
        """Draw the joint that closes a loop, and rods from the frames of its bodies to it."""
        marks, ends = self.marks, list[Array]()
        for k, name in enumerate(loop.bodies):
            at, R = self.poses[name]
            ends.append(at + _turned(R, self._vector(loop.points[k])) if loop.points else at)
            marks.add(
                "ground" if name == WORLD else "rod", *self._support(name, marks.point(ends[k]))
            )
        first, second = map(marks.point, ends)
        if loop.joint == "distance":
            marks.add("rod", first, second)
        if loop.joint in ("prismatic", "cylindrical", "point-on-line"):
            unit = _turned(self.poses[loop.bodies[0]][1], np.tile(loop.axes[0], (self.n, 1)))
            direction = np.sum((ends[1] - ends[0]) * unit, axis=1)
            marks.add(
                "rail",
                *(marks.point(ends[0] + x * unit) for x in (direction.min(), direction.max())),
            )
            marks.add("slide", second)
        elif loop.joint != "weld":
            for end in (first, second) if loop.joint == "distance" else (first,):
                marks.add("joint", end)

    def _mass(self, body: RigidBody, plane: bool) -> None:
        """Draw the centre of mass; in the plane also the orientation of the body."""
        mass = float(self._number(body.mass))
        if mass <= 0:
            return
        marks, center, (origin, R) = self.marks, self.centers[body.name], self.poses[body.name]
        at = marks.point(center)
        if body.joint:
            marks.add("arm", marks.point(origin), at)
        if plane:
            radius = np.sqrt(max(float(self._number(body.inertia[2])), 0) / mass)  # of gyration
            marks.add("mass", at, *([marks.point(center + radius * R[:, :, 0])] if radius else []))
            return
        marks.add("mass", at)

    def _boxes(self, assembly: Assembly) -> None:
        """Draw inertia boxes of bodies in space whose rotation no line shows.

        Bodies that are fixed to one another share one box.
        """
        roots: dict[str, str] = {}
        for body in assembly.bodies:
            together = body.joint == "fixed" and body.parent != WORLD
            roots[body.name] = roots[body.parent] if together else body.name
        marks = self.marks
        lines = {m.points[0] for m in marks.marks if m.kind in ("rod", "arm")}
        for root in assembly.bodies:
            group = [b for b in assembly.bodies if roots[b.name] == root.name]
            shows_rotation = any(marks.point(self.poses[b.name][0]) in lines for b in group)
            if group and (root.joint in ("", "free") or not shows_rotation):
                self._inertia(group, self.poses[root.name][1])

    def _inertia(self, group: Sequence[RigidBody], R: Array) -> None:
        """Draw the box with the mass and inertia of bodies fixed to one another.

        `R` is the rotation of the box. With edges 2a, 2b, 2c, Ixx = m (b² + c²)/3.
        """
        masses = np.array([float(self._number(body.mass)) for body in group])
        if not masses.sum() > 0:
            return
        centers = np.stack([self.centers[body.name] for body in group])  # (bodies, n, 3)
        center = centers[0]  # exactly, where it is alone
        if len(group) > 1:
            center = np.tensordot(masses, centers, 1) / masses.sum()
        inertia_sum = np.zeros((3, 3))
        for body, m, own in zip(group, masses, centers, strict=True):
            d, turned = R[0].T @ (own[0] - center[0]), np.eye(3)
            if body is not group[0]:
                turned = R[0].T @ self.poses[body.name][1][0]
            inertia = [float(self._number(entry)) for entry in body.inertia]
            inertia_sum += turned @ spatial.tensor(inertia) @ turned.T
            inertia_sum += m * (d @ d * np.eye(3) - np.outer(d, d))
        if not np.isfinite(inertia_sum).all():
            return
        moments, axes = np.linalg.eigh(inertia_sum)
        halves = np.sqrt(np.maximum(3 * (moments.sum() / 2 - moments) / masses.sum(), 0))
        halves[halves < 1e-6 * halves.max(initial=0.0)] = 0
        if halves.any():
            tips = (R @ axes * halves).transpose(2, 0, 1)
            points = (self.marks.point(center + tip) for tip in tips)
            self.marks.add("inertia", self.marks.point(center), *points)

    def _between(self, kind: str, end: Between, assembly: Assembly) -> None:
        """Draw a spring or damper if its end points are known."""
        marks = self.marks
        if end.points and end.bodies:
            points = []
            for name, place in zip(end.bodies, end.points, strict=True):
                at, R = self.poses[name]
                points.append(marks.point(at + _turned(R, self._vector(place))))
                marks.add("ground" if name == WORLD else "rod", *self._support(name, points[-1]))
            marks.add(kind, *points)
            return
        for body in assembly.bodies:
            motions = JOINTS[body.joint].motions if body.joint else ""
            by = [formula.text for formula in body.coordinates]
            turns = end.turning and end.bodies and {body.name, body.parent} == {*end.bodies}
            if motions == "r" and (turns or by == [end.coordinate]) and kind == "spring":
                marks.add("spiral", marks.point(self.joint_frames[body.name][0]))
            elif motions == "t" and by == [end.coordinate]:
                ends = (self.joint_frames[body.name][0], self.poses[body.name][0])
                marks.add(kind, *map(marks.point, ends))

    def _support(self, name: str, point: int) -> tuple[int, ...]:
        """Return the points of the mark that supports a spring's end: ground or rod."""
        return (point,) if name == WORLD else (self.marks.point(self.poses[name][0]), point)

    def _paths(self, assembly: Assembly) -> None:
        """Add the paths of the scene's [[point]]s, or of the only body without children."""
        marks = self.marks
        tips = [b.name for b in assembly.bodies if b.point]
        if tips:
            for name in tips[:MAX_PATHS]:
                marks.path(name, marks.point(self.poses[name][0]))
            return
        parents = {b.parent for b in assembly.bodies if b.joint}
        leaves = [b.name for b in assembly.bodies if b.name not in parents]
        if len(leaves) == 1:
            marks.path(leaves[0], marks.point(self.centers[leaves[0]]))

    # --- the picture of a scene ------------------------------------------------------------------

    def _shape(self, shape: Shape) -> None:
        marks = self.marks
        at = [self._pose_of_place(place.name, place.at) for place in shape.places]
        points = [marks.point(x) for x, _ in at]
        if shape.kind == "path":
            name = shape.places[0].name
            marks.path(name or f"point {len(marks.paths) + 1}", points[0])
        elif shape.kind in ("dot", "line", "spring"):
            marks.add(shape.kind, *points)
        else:
            center, R = at[0]
            R = R @ self._rotation(shape.rotation)
            sizes = [float(self._number(size)) for size in shape.size]
            halves = sizes * 2 if shape.kind == "circle" else [size / 2 for size in sizes]
            tips = (marks.point(center + h * R[:, :, k]) for k, h in enumerate(halves))
            marks.add(shape.kind, points[0], *tips)

    def _pose_of_place(self, name: str, at: Sequence[Formula] | None) -> Pose:
        """Return the position of a place and the axes there."""
        return self.poses[name] if at is None else (self._vector(at), self.poses[WORLD][1])


def _turned(R: Array, v: Array) -> Array:
    turned: Array = np.einsum("nij,nj->ni", R, v)
    return turned
