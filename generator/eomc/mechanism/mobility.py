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

from eomc.base.errors import EomcError
from eomc.base.texts import listed, plural
from eomc.model.kinematics import (
    Array,
    Kinematics,
    NullSpaces,
    find_coincident_ends,
    moved_subspace,
)
from eomc.runtime import rank
from eomc.scene.joints import CLOSINGS, JOINTS
from eomc.scene.scene import Assembly, RigidBody

if TYPE_CHECKING:
    from eomc.scene.scene import Scene


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
        where += ", by the mobility formula" if loops or rows else ""
        lines = [
            f"{self.scene}: {self.M} {plural('degree', self.M)} of freedom {where}",
            f"  N = {self.bodies + 1} links, including the world",
            f"  j = {j} joints: {', '.join(kinds)}",
            f"  M = d(N - 1 - j) + sum f{' - constraints' if rows else ''} = "
            f"{d}({self.bodies + 1} - 1 - {j}) + {total}{rows} = {self.M}",
            f"  {self.coordinates} {plural('coordinate', self.coordinates)}, of which {self.rank} "
            f"{'moves' if self.rank == 1 else 'move'} the bodies independently",
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
            f"each coordinate is a degree of freedom, {listed(names)}"
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
            f"{listed([b.name for b in placed])}: M counts {d} degrees of freedom for each body "
            f"that is placed by formulas; the formulas fix {M - rank} of the {M}, "
            f"which leaves {rank}"
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
        sizes = np.asarray(np.linalg.svd(rank.unit_rows(more), compute_uv=False))
        if rank.count(sizes) > len(known):  # not a motion named above
            known = more
            what = _combination(row, names)
            yield f"without inertia: {what} moves nothing that has inertia against it; {result}"


def _report_consecutive_joints(assembly: Assembly, kinematics: Kinematics) -> Iterator[str]:
    """Report consecutive joints about the same line or along the same direction."""
    by_name, at = {body.name: body for body in assembly.bodies}, kinematics.values
    for body in assembly.bodies:
        above = by_name.get(body.parent)
        while above is not None and above.joint == "fixed":
            above = by_name.get(above.parent)
        if not (above and len(above.coordinates) == len(body.coordinates) == 1):
            continue
        # with the upper joint as it is: what it moves does not change its own motion
        ((first, one),), ((second, other),) = at.motions[above.name], at.motions[body.name]
        first, second = first[0], moved_subspace(second[0], (one - other)[0])
        first, second = (s / np.linalg.norm(s) for s in (first, second))
        if min(np.linalg.norm(first - second), np.linalg.norm(first + second)) > 1e-9:
            continue
        pair = above.coordinates[0].text, body.coordinates[0].text
        if len({*pair} & {*kinematics.coordinates}) < 2:
            continue  # they move together
        how = (
            "slide along the same direction" if not np.any(first[:3])
            else "move on the same screw" if np.any(first[3:])
            else "turn about the same line"
        )  # fmt: skip
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
