"""Degrees of freedom of a scene of bodies and joints: M = d(N - 1 - j) + sum f_i, and ranks.

The mobility formula (Chebychev, Grübler, Kutzbach; e.g. Angeles, *Fundamentals of Robotic
Mechanical Systems*) is compared with two ranks. The rank of the Jacobian of all body poses shows
coordinates that move no body, or that move bodies only as other coordinates do. The rank of the
mass matrix of the bodies shows coordinates that move no inertia. Both are computed by numerical
forward kinematics at random configurations and at the start, with finite differences for bodies
that are placed by formulas. If the joints of a tree can be eliminated one by one, no coordinate is
redundant and no rank is computed, so that thousands of bodies take seconds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from eomc.base.errors import EomcError, Problem
from eomc.base.texts import listed, plural
from eomc.model.kinematics import Array, Kinematics, NullSpaces
from eomc.scene import formulas
from eomc.scene.assembly import Assembly, Damper, RigidBody, Spring
from eomc.scene.formulas import Formula
from eomc.scene.joints import CLOSINGS, JOINTS

if TYPE_CHECKING:
    from eomc.scene.scene import Scene

COINCIDENCE_TOLERANCE = 1e-12  # relative distance below which two points coincide


@dataclass(frozen=True)
class Mobility:
    """Number of degrees of freedom of a mechanism, by the mobility formula and by rank.

    Attributes
    ----------
    scene
        Name of the scene.
    d
        Degrees of freedom of a free body: 3 in the plane, 6 in space.
    bodies
        Number of bodies, without the world.
    joints, loops
        Numbers of the joints in the tree and of the joints that close loops, by kind of joint. A
        body that is placed by formulas counts as a joint of a further kind.
    M
        Degrees of freedom by the mobility formula M = d(N - 1 - j) + sum f, with N bodies including
        the world and j joints that have f degrees of freedom each.
    coordinates
        Number of coordinates in the scene.
    rank
        Number of coordinates that move the bodies independently, at almost all configurations.
    remarks
        Messages on redundant or missing coordinates and on singular configurations.
    constraints
        Number of constraint equations that are written as formulas.
    """

    scene: str
    d: int
    bodies: int
    joints: Mapping[str, int]
    M: int
    coordinates: int
    rank: int
    remarks: tuple[str, ...]
    loops: Mapping[str, int] = field(default_factory=dict)
    constraints: int = 0

    def table(self) -> str:
        """Return the result as text of several lines for the terminal."""
        d, freedoms = self.d, partial(_freedoms, d=self.d)
        kinds = [f"{n} {kind} (f = {freedoms(kind)})" for kind, n in self.joints.items()]
        closing = [
            f"{n} {kind} (f = {_closure_freedoms(kind, d)})" for kind, n in self.loops.items()
        ]
        if closing:
            kinds.append("in loops " + ", ".join(closing))
        loops = sum(self.loops.values())
        j, total = self.bodies + loops, sum(n * freedoms(k) for k, n in self.joints.items())
        total += sum(n * _closure_freedoms(k, d) for k, n in self.loops.items())
        rows = f" - {self.constraints}" if self.constraints else ""
        where = "in the plane" if d == 3 else "in space"
        where += ", by the count" if loops or rows else ""
        lines = [
            f"{self.scene}: {self.M} {plural('freedom', self.M)} {where}",
            f"  N = {self.bodies + 1} links, the world among them",
            f"  j = {j} joints: {', '.join(kinds)}",
            f"  M = d(N - 1 - j) + sum f{' - constraints' if rows else ''} = "
            f"{d}({self.bodies + 1} - 1 - {j}) + {total}{rows} = {self.M}",
            f"  {self.coordinates} {plural('coordinate', self.coordinates)}, {self.rank} of them "
            "independent in how they move the bodies",
            *(f"  - {remark}" for remark in self.remarks),
        ]
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """Return the result as a dict that can be written as JSON."""
        return {
            "scene": self.scene, "d": self.d, "N": self.bodies + 1, "joints": dict(self.joints),
            "loops": dict(self.loops), "M": self.M, "coordinates": self.coordinates,
            "rank": self.rank, "remarks": list(self.remarks),
        }  # fmt: skip


def compute_mobility(scene: Scene) -> Mobility:
    """Compute the degrees of freedom of a scene and compare them with its coordinates.

    Raises EomcError if the scene has no bodies, or if the formulas of their positions can't be
    evaluated at any sampled configuration.
    """
    assembly = scene.assembly
    if not assembly or not assembly.bodies:
        names = [c.name for c in scene.coordinates]
        raise EomcError(
            f"{scene.file}: there is no [[body]], [[loop]] or [constraints] to count from: "
            f"each coordinate is a freedom, {listed(names)}"
        )
    d = 3 if assembly.plane else 6
    placed = [body for body in assembly.bodies if not body.joint]
    bodies = [body for body in assembly.bodies if not body.point]
    joints = Counter(body.joint or FORMULAS for body in bodies)
    loops = Counter(loop.joint for loop in assembly.loops)
    tree = sum(n * _freedoms(kind, d) for kind, n in joints.items())  # there N - 1 - j = 0
    closed = sum(n * (d - _closure_freedoms(kind, d)) for kind, n in loops.items())
    kinematics = Kinematics(scene, assembly)
    names = kinematics.coordinates
    samples = list(kinematics.sample_null_spaces())
    if not samples:
        raise EomcError(f"{scene.file}: the bodies' positions have no value at the states tried")
    generic = min(samples, key=lambda null: (len(null.moves), len(null.weighs)))
    rank = len(names) - len(generic.moves)
    remarks = [
        *_report_fixed_joints(assembly),
        *_report_shared_coordinates(assembly, {*names}),
        *_report_bodies_by_formulas(placed, d, rank, tree),
        *_report_idle_coordinates(generic, names, scene),
        *_report_consecutive_joints(assembly, kinematics),
        *_report_singular_start(kinematics, generic),
        *(f"{problem.key}: {problem.message}" for problem in find_coincident_ends(scene)),
    ]
    M, rows = tree - closed - len(scene.constraints), len(scene.constraints)
    return Mobility(
        scene.name, d, len(bodies), joints, M, len(names), rank, (*remarks,), loops, rows
    )


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
    kinematics = Kinematics(scene, assembly)
    poses = kinematics.poses(kinematics.start)
    if poses is None:
        return []
    problems = []
    for key, line in lines:
        assert line.bodies and line.points
        one, other = (
            poses[name][0] + poses[name][1] @ kinematics.vector(point, kinematics.values)
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


FORMULAS = "placed by formulas"


def _freedoms(kind: str, d: int) -> int:
    return d if kind == FORMULAS else len(JOINTS[kind].motions)


def _closure_freedoms(kind: str, d: int) -> int:
    """Return the degrees of freedom that a joint of a loop leaves."""
    return d - len(CLOSINGS[kind].rows(plane=d == 3))


# --- remarks -------------------------------------------------------------------------------------


def _report_fixed_joints(assembly: Assembly) -> Iterator[str]:
    rigid = [body.name for body in assembly.bodies if body.joint == "fixed" and not body.point]
    if rigid:
        yield f"fixed (f = 0), moving as one with what they are fixed to: {listed(rigid)}"


def _report_shared_coordinates(assembly: Assembly, names: set[str]) -> Iterator[str]:
    names_before: set[str] = set()
    motions, together = 0, []
    for body in assembly.bodies:
        by = {formula.text for formula in body.coordinates}
        if names_before & by or not by <= names:
            together.append(body.name)
        names_before |= by
        motions += len(body.coordinates)
    if motions > len(names):
        fewer = motions - len(names)
        yield (
            f"{listed(together)}: moved by coordinates of other joints; M counts every joint, the "
            f"coordinates are {fewer} fewer"
        )


def _report_bodies_by_formulas(
    placed: Sequence[RigidBody], d: int, rank: int, M: int
) -> Iterator[str]:
    if placed:
        yield (
            f"{listed([b.name for b in placed])}: M counts {d} freedoms for each body that is "
            f"placed by formulas; the formulas fix {M - rank} of the {M}, which leaves {rank}"
        )


def _report_idle_coordinates(at: NullSpaces, names: Sequence[str], scene: Scene) -> Iterator[str]:
    """Report coordinates that move no body, or that move bodies only in combinations."""
    ways = ["[energy] gives it inertia"] if any(scene.kinetic.names()) else []
    ways += ["a constraint decides it"] if scene.constrained else []
    result = f"D is singular unless {' or '.join(ways)}" if ways else "D is singular"
    for row in at.moves:
        yield f"redundant: {_combination(row, names)} moves no body; {result}"
    known = at.moves
    for row in at.weighs:
        more = np.vstack([known, row])
        if np.linalg.matrix_rank(more, tol=1e-4) > len(known):  # not a motion named above
            known = more
            what = _combination(row, names)
            yield f"without inertia: {what} moves nothing that has inertia against it; {result}"


def _report_consecutive_joints(assembly: Assembly, kinematics: Kinematics) -> Iterator[str]:
    """Report consecutive joints about the same line or along the same direction."""
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
        pair = above.coordinates[0].text, body.coordinates[0].text
        if len({*pair} & {*kinematics.coordinates}) < 2:
            continue  # they move together
        how = "turn about the same line" if turns else "slide along the same direction"
        yield (
            f"'{pair[0]}' and '{pair[1]}' {how}, one behind the other: only what lies between the "
            f"two joints distinguishes them, {above.name} needs inertia of its own"
        )


def _report_singular_start(kinematics: Kinematics, generic: NullSpaces) -> Iterator[str]:
    at_start = kinematics.null_spaces(kinematics.start, 0.0)
    names = kinematics.coordinates
    if at_start is None:
        yield "at the start the bodies' positions have no value"
        return
    for null, usual, what in (
        (at_start.moves, generic.moves, "move the bodies independently"),
        (at_start.weighs, generic.weighs, "have inertia"),
    ):
        if len(null) > len(usual):
            missing = listed([_combination(row, names) for row in null])
            yield (
                f"singular start: {len(names) - len(null)} coordinates {what} there, elsewhere "
                f"{len(names) - len(usual)}: there {missing} does not. Start with another value of "
                "the coordinate between, such as the pitch between yaw and roll"
            )
            return


def _combination(row: Array, names: Sequence[str]) -> str:
    """Return a motion as text: one coordinate, or velocities in a fixed ratio."""
    those = _moving_names(row, names)
    if len(those) == 1:
        return f"'{those[0]}'"
    rates = dict(zip(names, row, strict=True))
    return "the motion " + ", ".join(f"{name}_dot = {rates[name]:.4g}" for name in those)


def _moving_names(row: Array, names: Sequence[str]) -> list[str]:
    large = np.abs(row) > 1e-3 * np.abs(row).max()
    return [name for name, named in zip(names, large, strict=True) if named]
