"""Options of `eomc import`: lock joints, cut out a part, change the base, correct inertias, limits.

Limits of drives become limits of the scene's inputs, and limits of joints become stops: stiff,
dissipative springs. The contact force beyond a limit is that of Hunt and Crossley (1975),
k x (1 + d v), cut off at zero so that it never pulls; x is the penetration and v = dx/dt.
k = effort/depth, so that the full effort of the joint penetrates by `depth`. The effort is the
smaller of the joint's own limit and the largest total force of its drives. If the file gives
neither, it is the force that holds all bodies carried by the joint, stretched out, against gravity.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from eomc.base import texts
from eomc.base.errors import EomcError
from eomc.robots.geometry import (
    IDENTITY,
    ORIGIN,
    entries_text,
    has_nearest_valid,
    indefinite_message,
    nearest_valid,
    principal_moments,
    triangle_message,
    yaw_pitch_roll,
)
from eomc.robots.robot import (
    COUPLING_TOLERANCE,
    UNLIMITED,
    JointMotion,
    Range,
    Robot,
    RobotBody,
    body_pose,
    fix_body,
    free_motions,
    initial_poses,
    input_range,
    intersection,
    significant_inertia,
    with_joints_fixed,
)
from eomc.scene.formulas import suggest
from eomc.scene.scene import WORLD

_LIMITS = re.compile(r"limits of (\d+ )?joints?\b")  # in what readers leave out


def lock(robot: Robot, values: Mapping[str, float]) -> Robot:
    """Return the robot with joints fixed at given positions.

    `values` maps the name of a coordinate to its value (rad or m). Raises EomcError for unknown
    coordinates, and for those of a joint that has several.
    """
    owners = {m.name: body for body in robot.bodies for m in body.motions}
    for name in values:
        _refuse_unknown("lock", name, owners, "joint that moves")
        body = owners[name]
        if len(body.motions) > 1:
            those = ", ".join(m.name for m in body.motions)
            raise EomcError(
                f"--lock {name}: the {body.joint} joint of '{body.name}' moves by {those} "
                "together: only a joint with one coordinate can be frozen"
            )
        mimics = body.motions[0].mimics
        if mimics and mimics.coordinate not in values:
            raise EomcError(
                f"--lock {name}: it moves as '{mimics.coordinate}' does: lock that, and both are "
                "frozen"
            )
        if (
            mimics
            and abs(mimics.joint_position(values[mimics.coordinate]) - values[name])
            > COUPLING_TOLERANCE
        ):
            raise EomcError(
                f"--lock {name}: it moves as '{mimics.coordinate}' does, which puts it at "
                f"{mimics.joint_position(values[mimics.coordinate]):g} "
                f"{body.motions[0].unit}: lock it there"
            )
    for c in robot.couplings:
        if (
            c.coordinates <= values.keys()
            and abs(violation := c.residual(values)) > COUPLING_TOLERANCE
        ):
            those = " ".join(f"--lock {q}={values[q]:g}" for q in sorted(c.coordinates))
            raise EomcError(
                f"{those}: these values break the coupling {c.name} by {violation:g}: lock one "
                "of the joints only, and the coupling fixes the other, or give values that agree"
            )
    return with_joints_fixed(robot, values)


def _refuse_unknown(option: str, name: str, known: Collection[str], kind: str) -> None:
    """Raise EomcError if the name that an option of `eomc import` gives is not known."""
    if name not in known:
        near = suggest(name, known) or f"; there are {texts.listed(known)}"
        raise EomcError(f"--{option} {name}: no {kind} is called '{name}'{near}")


def cut(robot: Robot, root: str = "", tip: str = "") -> Robot:
    """Return a part of the robot: the bodies carried by `root`, or the chain from `root` to `tip`.

    Without `root`, the chain begins at the world. The root is fixed to the world in its pose at the
    start, so that the direction of gravity relative to it is unchanged. Bodies fixed to a body of
    the chain are retained, except those carried by the tip.

    Raises EomcError for unknown bodies, and if `tip` is not carried by `root`.
    """
    by_name = {body.name: body for body in robot.bodies}
    for option, name in (("root", root), ("tip", tip)):
        if name:
            _refuse_unknown(option, name, by_name, "body")
    selected = set(by_name)
    if root:
        selected = {root}
        for body in robot.bodies:
            if body.parent in selected:
                selected.add(body.name)
    if tip:
        if tip not in selected:
            raise EomcError(f"--tip {tip}: '{tip}' is not behind '{root}', which --root names")
        way = [tip]
        while (parent := by_name[way[-1]].parent) in selected:
            way.append(parent)
        selected = set(way)
        for body in robot.bodies:
            if body.joint == "fixed" and body.parent in selected and body.parent != tip:
                selected.add(body.name)
    bodies = [body for body in robot.bodies if body.name in selected]
    for k, body in enumerate(bodies):
        if body.name == root and body.parent != WORLD:
            bodies[k] = replace(fix_body(body, *initial_poses(robot.bodies)[root]), parent=WORLD)
    removed = tuple(name for name in by_name if name not in selected)
    left_out = ((f"cut off: {texts.listed(removed)}",) if removed else ()) + robot.left_out
    frozen: dict[str, float] = {}  # the joints between the world and the root, at their start
    above = by_name[root] if root and by_name[root].parent != WORLD else None
    while above:
        frozen |= {m.name: m.start for m in above.motions if not m.mimics}
        above = by_name.get(above.parent)
    return with_joints_fixed(replace(robot, bodies=tuple(bodies), left_out=left_out), frozen)


def with_nearest_inertias(robot: Robot) -> Robot:
    """Return the robot with each invalid inertia tensor replaced by the nearest valid one.

    A tensor is invalid if no body can have it. The replacements are noted in `left_out`.
    """
    bodies, words = [], []
    for body in robot.bodies:
        inertia = significant_inertia(body)
        if (indefinite_message(inertia) or triangle_message(inertia)) and has_nearest_valid(
            inertia
        ):
            (low, _, high), new = principal_moments(inertia)[0], nearest_valid(inertia)
            words.append(
                f"body {body.name}: its inertia {entries_text(inertia)} is that of no body "
                f"(principal moments {low:.4g} to {high:.4g} kg m^2): "
                f"{entries_text(new)} is in its place"
            )
            body = replace(body, inertia=new)
        bodies.append(body)
    return replace(robot, bodies=tuple(bodies), left_out=(*robot.left_out, *words))


def with_base(robot: Robot, free: bool) -> Robot:
    """Return the robot with its root body either free to move or fixed to the world.

    `free` selects which. A root body that becomes fixed keeps its pose at the start. One that
    becomes free starts in the pose in which it was fixed. Raises EomcError if several bodies are
    attached to the world.
    """
    roots = [body for body in robot.bodies if body.parent == WORLD]
    if len(roots) != 1:
        those = texts.listed(tuple(body.name for body in roots))
        raise EomcError(f"--base: {len(roots)} bodies stand on the world ({those}), not one")
    root = roots[0]
    root_body = root
    if free and root.joint == "fixed":
        names = {m.name for m in robot.motions}
        motions = free_motions()
        if names & {m.name for m in motions}:
            motions = free_motions("base")
        at = (*root.offset, *yaw_pitch_roll(root.rotation))
        motions = tuple(replace(m, start=s) for m, s in zip(motions, at, strict=True))
        root_body = replace(fix_body(root, ORIGIN, IDENTITY), joint="free", motions=motions)
    elif not free and root.motions:
        root_body = fix_body(root, *body_pose(root))
    if free and root_body.joint != "free":
        raise EomcError(
            f"--base free: '{root.name}' stands on the world by a {root.joint} joint, "
            "which the file gives it: --base free is for a root without one"
        )
    bodies = tuple(root_body if body is root else body for body in robot.bodies)
    frozen = {} if free else {m.name: m.start for m in root.motions}
    return with_joints_fixed(replace(robot, bodies=bodies), frozen)


def with_masses(robot: Robot, tip: str = "") -> Robot:
    """Return the robot with its moving masses as parameters, and a payload of 0 kg at its tips.

    With the name of a body as `tip`, only that body gets a payload. Otherwise each moving group of
    rigidly connected bodies that carries no further joint gets one, on its outermost body.
    """
    group, _ = _groups(robot)
    bodies = [
        replace(b, parameter=f"mass_{b.name}") if b.mass and group[b.name] != WORLD else b
        for b in robot.bodies
    ]
    taken = {b.name for b in bodies}
    tips = [tip] if tip else _tips(robot)
    for name in tips:
        end = f"_{name}" if len(tips) > 1 else ""
        load = f"load{end}"
        while load in taken:
            load += "_"
        note = f"a point mass in the origin of the frame of {name}"
        body = RobotBody(load, name, note=note, parameter=f"payload{end}")
        at = 1 + next(k for k, b in enumerate(bodies) if b.name == name)
        bodies.insert(at, body)
    return replace(robot, bodies=tuple(bodies))


def _groups(robot: Robot) -> tuple[dict[str, str], dict[str, int]]:
    """Return, for each body, the one whose joint moves it, and the fixed joints in between."""
    group, depth = {WORLD: WORLD}, {WORLD: 0}
    for b in robot.bodies:
        moves = b.joint != "fixed"
        group[b.name] = b.name if moves else group[b.parent]
        depth[b.name] = 0 if moves else depth[b.parent] + 1
    return group, depth


def _tips(robot: Robot) -> list[str]:
    """Return the deepest body, the last of several, of each rigid group at an end of the tree."""
    group, depth = _groups(robot)
    carries = {WORLD, *(group[b.parent] for b in robot.bodies if b.joint != "fixed")}
    tips: dict[str, str] = {}
    for b in robot.bodies:
        of = group[b.name]
        if of not in carries and depth[b.name] >= depth[tips.get(of, of)]:
            tips[of] = b.name
    return [*tips.values()]


# --- limits of drives, and stops at the limits of joints ------------------------------------------

# notes of the readers: on limits that take effect here, and on those of position and speed
_ACTING = re.compile(r"limits of (actuators|the actuators' force on joints), kept as notes")
_JOINTS = re.compile(r"^(limits of \d+ joints?)(?=: )")
_STOPS = "those of speed and effort are notes"  # a note of with_joint_stops


def with_input_limits(robot: Robot) -> Robot:
    """Return the robot with each input limited to the range of its drive and of its joint's force.

    Servos limit their force instead of their input. The force limits of a joint that several
    drives or tendons act on apply to the sum of their forces; they are left out and noted in
    `left_out`. Raises EomcError if no input has limits.
    """
    on = [q for d in robot.drives for _, q in robot.coordinate_terms(d.coordinate)]
    driven = {m.name: m.driven for m in robot.motions if m.driven != UNLIMITED}
    alone = {d.coordinate for d in robot.drives if on.count(d.coordinate) == 1}
    drives, excluded = [], []
    for d in robot.drives:
        force_range: Range | None = d.force_range
        if d.coordinate in driven and d.coordinate in alone:
            force_range = intersection(d.force_range, input_range(driven[d.coordinate], d.gear))
        if force_range is None:
            excluded.append(d.name)
        elif d.law:
            d = replace(d, law=replace(d.law, force=force_range))
        else:
            d = replace(d, limits=force_range)
        drives.append(d)
    free = [d.name for d in drives if d.limits == d.force_range == UNLIMITED]
    if len(free) == len(drives):
        raise EomcError("--limits: no input of this robot has limits")
    many = len(drives) - len(free)
    notes = [f"limits of drives: {many} of {len(drives)} inputs have them, and act within"]
    notes[0] += f"; without are {texts.listed(free, 4)}" if free else ""
    if shared := sorted(q for q in driven if q in on and q not in alone):
        words = "limits of force on joints that several inputs, or tendons, drive"
        notes.append(f"{words}: {texts.listed(shared)}")
    if excluded:
        notes.append(f"limits of force that exclude those of the input: {texts.listed(excluded)}")
    others = (
        _JOINTS.sub(r"\1, of position and speed", words).replace(_STOPS, "those of speed are notes")
        for words in robot.left_out
        if not _ACTING.match(words)
    )
    return replace(robot, drives=tuple(drives), limited=True, left_out=(*notes, *others))


DEPTHS = {"rad": 0.01, "m": 0.001}  # by a coordinate's unit
DAMPING = {"rad": 1.0, "m": 10.0}  # s/rad, s/m


@dataclass(frozen=True)
class Stop:
    """The stop of a coordinate at its limits: a spring that acts beyond them (see the module).

    Attributes
    ----------
    coordinate, unit : str
        Name of the coordinate, and its unit "rad" or "m".
    limits : (float, float)
        Lowest and highest position.
    effort : float
        The force (N or N m) at which the penetration of the limit is the depth in `DEPTHS`.
    known : bool
        Whether the file gives the effort. Otherwise it is estimated from the weight that the joint
        carries.
    """

    coordinate: str
    unit: str
    limits: tuple[float, float]
    effort: float
    known: bool


def with_joint_stops(robot: Robot) -> Robot:
    """Return the robot with stops (stiff springs) at its joint limits.

    Raises EomcError if no joint has limits.
    """
    stops = joint_stops(robot)
    if not stops:
        raise EomcError("--stops: no joint of this robot has limits")
    notes = [
        "stops: at limits of positions [forces] pushes back; those of speed and effort are notes"
    ]
    estimated = [s for s in stops if not s.known]
    if estimated:
        newton = {"rad": "N m", "m": "N"}
        those = texts.listed([f"{s.coordinate} ({s.effort:g} {newton[s.unit]})" for s in estimated])
        notes.append(f"stops whose effort is not known, and is taken from weights: {those}")
    other_notes = (words for words in robot.left_out if not _LIMITS.match(words))
    return replace(robot, stopped=True, left_out=(*notes, *other_notes))


def joint_stops(robot: Robot) -> list[Stop]:
    """Return a stop for each coordinate that has finite limits."""
    loads: dict[str, tuple[float, float]] = {}  # by body: mass, and largest mass times distance
    holding_effort: dict[str, float] = {}  # by coordinate: against gravity, N or N m
    g = math.hypot(*robot.gravity)
    for body in reversed(robot.bodies):  # children come before parents
        mass, moment = loads.get(body.name, (0.0, 0.0))
        mass, moment = mass + body.mass, moment + body.mass * math.hypot(*body.center)
        holding_effort |= {m.name: g * (moment if m.unit == "rad" else mass) for m in body.motions}
        more = mass, moment + mass * math.hypot(*body.offset)
        one, other = loads.get(body.parent, (0.0, 0.0)), more
        loads[body.parent] = one[0] + other[0], one[1] + other[1]
    drive_force: dict[str, float] = {}  # by coordinate: the sum over its drives
    for d in robot.drives:
        for factor, q in robot.coordinate_terms(d.coordinate):
            drive_force[q] = drive_force.get(q, 0.0) + (
                abs(factor) * d.max_force if factor else 0.0
            )

    def stop(m: JointMotion) -> Stop:
        effort = min(max(map(abs, m.driven)), drive_force.get(m.name, math.inf))
        known = 0 < effort < math.inf
        effort = effort if known else float(f"{holding_effort[m.name]:.3g}") or 1.0
        return Stop(m.name, m.unit, m.limits, effort, known)

    return [
        stop(m)
        for m in robot.motions
        if m.limits[0] < m.limits[1] and all(map(math.isfinite, m.limits))
    ]


def stop_parameters(unit: str) -> tuple[str, str]:
    """Return the names of the scene's parameters for stops: those of their depth and damping.

    `unit` is the unit of the coordinates of these stops, "rad" or "m".
    """
    kind = "slide" if unit == "m" else "turn"
    return f"stop_depth_{kind}", f"stop_damping_{kind}"
