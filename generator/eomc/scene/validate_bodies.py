"""Checks of bodies and what acts on them: from tables to an Assembly. Independent of SymPy."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping
from graphlib import TopologicalSorter
from itertools import islice
from typing import Any

from eomc.base import names
from eomc.base.errors import SceneError
from eomc.scene.formulas import Formula, Value
from eomc.scene.joints import CLOSINGS, JOINTS
from eomc.scene.scene import WORLD, Assembly, Damper, Force, LoopJoint, RigidBody, Spring, Vector
from eomc.scene.schema import (
    BodyTable,
    DamperTable,
    Document,
    ForceTable,
    LoopTable,
    PointTable,
    SpringTable,
)
from eomc.scene.scope import Path, cycle_text, find_cycles
from eomc.scene.validate_tables import (
    FRICTION_WIDTH,
    ORIGIN,
    WORLD_TAKEN,
    ZERO,
    ValueChecker,
    check_width,
    names_taken_from_rows,
)

_JOINT_KEYS = (
    "parent", "coordinates", "axis", "pitch", "offset", "center", "armature", "damping", "friction",
    "friction_width", "actuator",
)  # fmt: skip


def center_names(doc: Document) -> set[str]:
    """Return the names, such as link_x, by which formulas refer to positions of bodies and points.

    They are the components of the position of each [[point]], and of the centre of mass of each
    body that is held by a joint.
    """
    letters = "xy" if doc.gravity and len(doc.gravity) == 2 else "xyz"
    named = [body.name for body in doc.body.values() if body.position is None]
    named += [point.name for point in doc.point.values()]
    return {f"{name}_{letter}" for name in named for letter in letters}


def assemble(check: ValueChecker) -> Assembly | None:
    """Check the bodies, points, springs, dampers, forces and loops of a scene and return them.

    Errors are reported to `check`; after an error the result must not be used. Returns None if the
    scene has no such tables.
    """
    doc = check.doc
    if not (doc.body or doc.point or doc.spring or doc.damper or doc.force or doc.loop):
        if doc.gravity is not None:
            check.report(
                ("gravity",),
                "acts on bodies, and there is no [[body]]: remove it, or write the weight "
                "into the potential energy",
            )
        return None
    return _Bodies(check).assembly()


class _Bodies:
    def __init__(self, check: ValueChecker) -> None:
        self.check, self.doc = check, check.doc
        self.joints = JointChecker(check)
        self.bodies: dict[str, RigidBody] = {}

    def assembly(self) -> Assembly:
        """Check all tables of bodies and what acts on them, and return the assembly."""
        gravity = self._gravity()
        self._check_names()
        for name, path in self.check.body_paths.items():
            entry = self.joints.entry(name)
            if isinstance(entry, PointTable):
                self._check_point(path, entry)
            elif entry.position is None:
                self._check_jointed_body(path, entry)
            else:
                self._check_placed_body(path, entry)
        self._check_shared_coordinates()
        ordered = self._sorted_bodies()
        self._check_inertia(ordered)
        springs = [check_spring(self.check, ("spring", k), e) for k, e in self.doc.spring.items()]
        dampers = [check_damper(self.check, ("damper", k), e) for k, e in self.doc.damper.items()]
        forces = [check_force(self.check, ("force", k), e) for k, e in self.doc.force.items()]
        loop_checker = LoopChecker(self.check)
        loops = [loop_checker.loop(("loop", k), e) for k, e in self.doc.loop.items()]
        return Assembly(
            plane=self.check.dimension == 2,
            gravity=gravity,
            bodies=tuple(ordered),
            springs=tuple(springs),
            dampers=tuple(dampers),
            forces=tuple(forces),
            loops=tuple(loop for loop in loops if loop),
        )

    # --- the scene ------------------------------------------------------------------------------

    def _gravity(self) -> Vector:
        entries = self.doc.gravity
        if entries is None:
            if self.doc.body:
                self.check.dimension = None
                self.check.report_missing(
                    ("gravity",),
                    'add gravity = [0, "-9.81"] above the first [table] for a plane '
                    'scene, [0, 0, "-9.81"] for one in space, [0, 0] or [0, 0, 0] for none',
                )
            return ORIGIN
        if len(entries) not in (2, 3):
            self.check.dimension = None
            self.check.report(
                ("gravity",),
                f"has two entries in a plane scene and three in space, here {len(entries)}",
            )
            return ORIGIN
        self.check.dimension = len(entries)
        return self.check.vector(("gravity",), entries)

    def _check_names(self) -> None:
        """Store the place of each body and point by its name; report names that can't be used."""
        entries = [(("body", label), entry.name) for label, entry in self.doc.body.items()]
        entries += [(("point", label), entry.name) for label, entry in self.doc.point.items()]
        taken = dict(WORLD_TAKEN)
        for place, name in entries:
            what = f"is the name of a {place[0]} already"
            self.check.claim((*place, "name"), name, taken, what)
            if name != WORLD:
                self.check.body_paths.setdefault(name, place)
        for name in sorted(self.check.centers & {*self.check.tables}):
            body = name[:-2]
            self.check.report(
                (self.check.tables[name], name),
                f"'{name}' is where {self._center_text(body)} is: use that, or choose another name",
            )

    # --- bodies -----------------------------------------------------------------------------------

    def _check_placed_body(self, path: Path, entry: BodyTable) -> None:
        """Check a body placed by formulas."""
        if entry.joint is not None:
            self.check.report(
                (*path, "position"),
                "a body is held by a joint or placed by 'position', not both: remove one of the "
                "two (a joint's place in the parent's frame is 'offset')",
            )
            return
        for key in _JOINT_KEYS:
            if getattr(entry, key) is not None:
                why = (
                    "'position' is the centre of mass already"
                    if key == "center"
                    else "the body is placed by 'position' and has no joint"
                )
                remedy = ", and let forces act through [forces]" if key == "actuator" else ""
                self.check.report((*path, key), f"{why}: remove '{key}'{remedy}")
        mass, inertia = self.check.mass(path, entry)
        self.bodies[entry.name] = RigidBody(
            name=entry.name,
            mass=mass,
            inertia=inertia,
            center=ORIGIN,
            rotation=self.check.rotation(
                (*path, "rotation"), entry.rotation, self.check.position_formula
            ),
            position=self.check.vector(
                (*path, "position"), entry.position, self.check.position_formula
            ),
            note=entry.note,
        )

    def _center_text(self, name: str) -> str:
        point = self.check.body_paths.get(name, ("body",))[0] == "point"
        return f"point '{name}'" if point else f"the centre of mass of body '{name}'"

    def _check_point(self, path: Path, entry: PointTable) -> None:
        """Check a [[point]], which is a massless body on a fixed joint."""
        place = self.check.vector((*path, "place"), entry.place)
        rotation = self.check.rotation((*path, "rotation"), entry.rotation)
        parent = self.joints.parent((*path, "body"), entry.name, entry.body)
        self.check.has_inertia[entry.name] = False
        if parent is not None:
            self.bodies[entry.name] = RigidBody(
                name=entry.name,
                mass=ZERO,
                inertia=(ZERO,) * 6,
                center=ORIGIN,
                rotation=rotation,
                parent=parent,
                joint="fixed",
                offset=place,
                note=entry.note,
                point=True,
            )

    def _check_jointed_body(self, path: Path, entry: BodyTable) -> None:
        """Check a body on a joint."""
        check = self.check
        joint = self.joints.kind(path, entry)
        parent = self.joints.parent((*path, "parent"), entry.name, entry.parent)
        mass, inertia = self.check.mass(path, entry)
        center = self.check.vector((*path, "center"), entry.center)
        offset = self.check.vector((*path, "offset"), entry.offset)
        rotation = self.check.rotation((*path, "rotation"), entry.rotation)
        if not joint:
            return
        coordinates = self.joints.coordinates((*path, "coordinates"), joint, entry)
        axes = self.joints.axes((*path, "axis"), joint, entry)
        pitch = self.joints.pitch((*path, "pitch"), joint, entry)
        per_coordinate: dict[str, Any] = {
            key: self.joints.per_coordinate((*path, key), joint, getattr(entry, key))
            for key in ("armature", "damping", "friction", "actuator")
        }
        width = None
        if per_coordinate["friction"]:
            width = FRICTION_WIDTH
        if entry.friction_width is not None:
            width = check_width(check, path, entry.friction_width, entry.friction)
        if parent is None or coordinates is None:
            return
        self.bodies[entry.name] = RigidBody(
            name=entry.name,
            mass=mass,
            inertia=inertia,
            center=center,
            rotation=rotation,
            parent=parent,
            joint=joint,
            coordinates=coordinates,
            axes=axes,
            pitch=pitch,
            offset=offset,
            friction_width=width,
            note=entry.note,
            **per_coordinate,
        )

    def _check_shared_coordinates(self) -> None:
        """Report joints that share a coordinate while another one is unused: likely a slip."""
        taken = {*self.joints.first_body, *self.check.used}
        idle = [c for c in self.doc.coordinates if not {c, f"{c}_dot"} & taken]
        for body in self.bodies.values() if idle else ():
            for text in (formula.text for formula in body.coordinates):
                first = self.joints.first_body.get(text, body.name)
                if first != body.name:
                    self.check.report(
                        (*self.check.body_paths[body.name], "coordinates"),
                        f"'{text}' moves the joint of '{first}' already, and '{idle[0]}' moves "
                        f"none; did you mean '{idle[0]}'?",
                        text=text,
                    )

    # --- the tree ---------------------------------------------------------------------------------

    def _sorted_bodies(self) -> list[RigidBody]:
        """Return the bodies, parents before children, else in their order; cycles are reported."""
        graph = {name: [b.parent] if b.joint else [] for name, b in self.bodies.items()}
        for ring in islice(find_cycles(graph), SceneError.MAX_SHOWN):
            place = self.check.body_paths[ring[0]]
            self.check.report(
                (*place, "body" if place[0] == "point" else "parent"),
                f"the parents form a loop: {cycle_text(ring)}; let one of them be held by the "
                "world, and close the loop with a [[loop]]",
                text=ring[1],
            )
            for name in ring[1:]:
                self.bodies.pop(name, None)
        rank = {name: k for k, name in enumerate([WORLD, *self.bodies])}
        tree, ready, out = TopologicalSorter(graph), list[tuple[int, str]](), []
        tree.prepare()
        while tree.is_active():
            for name in tree.get_ready():
                heapq.heappush(ready, (rank.get(name, -1), name))
            _, name = heapq.heappop(ready)
            tree.done(name)
            if name in self.bodies:
                out.append(self.bodies[name])
        return out

    def _check_inertia(self, ordered: Iterable[RigidBody]) -> None:
        """Report joints that move nothing with inertia.

        Nothing is reported if energies are given as well or if there are constraints, where bodies
        such as a rod that closes a loop may be massless.
        """
        ordered = list(ordered)
        rows = self.doc.loop or self.doc.constraints
        if self.doc.energy.kinetic != 0.0 or rows or any(body.position for body in ordered):
            return
        carries = dict(self.check.has_inertia)
        for body in reversed(ordered):
            if body.parent in carries:
                carries[body.parent] |= carries[body.name]
        reported: set[str] = set()
        heavy = [b for b in ordered if carries[b.name] or b.armature]
        resisted = self.joints.coordinates_in(
            formula for body in heavy for formula in body.coordinates
        )
        for body in ordered:
            moved = self.joints.coordinates_in(body.coordinates)
            if body.parent in reported or not moved or moved.keys() & resisted:
                continue
            reported.add(body.name)
            resisted |= moved  # once
            by = " and ".join(formula.text for formula in body.coordinates)
            self.check.report(
                self.check.body_paths[body.name],
                f"nothing that {by} would move has mass or inertia: "
                f"give '{body.name}' a mass, or its joint an armature",
            )


# --- joints ---------------------------------------------------------------------------------------


class JointChecker:
    """Checks the joints by which bodies are attached to their parents.

    A path is the tuple of keys of an entry in the scene, such as ("body", "arm", "joint").
    """

    def __init__(self, check: ValueChecker) -> None:
        self.check, self.doc = check, check.doc
        self.first_body: dict[str, str] = {}  # first body that each coordinate moves

    def entry(self, name: str) -> BodyTable | PointTable:
        """Return the table in the scene of the body or point `name`."""
        array, label = self.check.body_paths[name]
        entries: Mapping[str, BodyTable | PointTable] = getattr(self.doc, array)
        return entries[label]

    def kind(self, path: Path, entry: BodyTable) -> str:
        """Return the kind of joint of a body, a key of `joints.JOINTS`.

        path: keys of the body. entry: its table. If the kind is missing or unknown, or does not
        exist in plane scenes, report this and return "".
        """
        if entry.joint is not None:
            return self.check.kind(path, entry.joint, JOINTS, "moves a body")
        if not {(*path, "joint"), (*path, "position")} & self.check.repaired:  # reported already
            self.check.report(
                path,
                'say how the body is held: joint = "revolute" or another, or position = [...] with '
                "formulas in the coordinates",
            )
        return ""

    def parent(self, path: Path, name: str, parent: str | None) -> str | None:
        """Check the parent of the body `name` and return it, "world" if it is not given.

        If it can't be a parent, report this and return None.
        """
        if parent is None or parent == WORLD:
            return WORLD
        if not self.check.is_body(path, parent):
            return None
        if parent == name:
            self.check.report(
                path, f"'{parent}' is its own parent: name another body, or world", text=parent
            )
        elif getattr(self.entry(parent), "position", None) is not None:
            self.check.report(
                path,
                f"'{parent}' is placed by formulas, and can't be a parent: give it a joint, "
                "or place this body by formulas too",
                text=parent,
            )
        else:
            return parent
        return None

    def coordinates(self, path: Path, joint: str, entry: BodyTable) -> tuple[Formula, ...] | None:
        """Check the entry `coordinates` of a body and return its formulas.

        There is one formula of coordinates for each motion of the joint. joint: kind of the joint.
        After an error, report it and return None.
        """
        check, written, count = self.check, entry.coordinates or (), len(JOINTS[joint].motions)
        if path in check.repaired:
            return None
        if len(written) != count:
            count_text = "one coordinate" if count == 1 else f"{count or 'no'} coordinates"
            order = f" ({JOINTS[joint].order})" if JOINTS[joint].order else ""
            here = ", ".join(written) or "none"
            listed = ", ".join(f'"q{k}"' for k in range(1, count + 1))
            example = listed if count == 1 else f"[{listed}]"
            remedy = f": add coordinates = {example}" if not written else ""
            remedy = remedy if count else ": remove it"
            check.report(path, f"a {joint} joint has {count_text}{order}, here {here}{remedy}")
            return None
        checked = [self._coordinate(path, text) for text in written]
        sound = tuple(formula for formula in checked if formula)
        for name in self.coordinates_in(sound):
            self.first_body.setdefault(name, entry.name)
        return sound if len(sound) == len(checked) else None

    def _coordinate(self, path: Path, text: str) -> Formula | None:
        """Return a checked coordinate or formula of coordinates; None after an error."""
        check, coordinates = self.check, self.doc.coordinates
        if text.isidentifier() and not self.check.is_coordinate(path, text):
            return None
        rule = "a joint moves by coordinates, or formulas of coordinates, parameters and constants"
        formula = check.formula(path, text, {*self.check.known, *coordinates}, rule)
        if formula is None:
            return None
        fault = ""
        if any(formula.calls("dot")):
            fault = f"dot(...) can't be used here: {rule}"
        elif not any(node.id in coordinates for node in formula.names()):
            fault = f"'{formula.shown}' has no coordinate in it: what does not move is 'fixed'"
        if fault:
            check.report(path, fault, text=formula.text)
            return None
        check.check_smooth(path, formula)
        return formula

    def coordinates_in(self, formulas_: Iterable[Formula]) -> dict[str, None]:
        """Return the names of the coordinates that occur in formulas, as keys of a dict."""
        names_used = (node.id for formula in formulas_ for node in formula.names())
        return dict.fromkeys(name for name in names_used if name in self.doc.coordinates)

    def axes(
        self, path: Path, joint: str, entry: BodyTable
    ) -> tuple[tuple[float, float, float], ...]:
        """Check the entry `axis` of a body and return the axes of its joint as unit vectors.

        joint: kind of the joint. If no axes are given, return its defaults. Errors are reported.
        """
        count = JOINTS[joint].axis_count
        if joint == "revolute" and self.check.dimension == 2:
            count = 0
        words = ("", "one axis", "two axes, such as [[1, 0, 0], [0, 1, 0]]")
        counts = {count: words[count]} if count else {}
        axes = self.check.axes(path, joint, entry.axis, counts, JOINTS[joint].defaults)
        if len(axes) == 2 and abs(sum(a * b for a, b in zip(*axes, strict=True))) > 1 - 1e-9:
            why = "the two axes are parallel, so the two angles are one: turn one of them"
            self.check.report(path, why)
        return axes

    def pitch(self, path: Path, joint: str, entry: BodyTable) -> Formula | None:
        """Check the entry `pitch` of a body and return its formula; None for most joints.

        Only screw joints have a pitch, in m/rad. joint: kind of the joint. Errors are reported.
        """
        if JOINTS[joint].has_pitch and entry.pitch is not None:
            return self.check.parameter_formula(path, entry.pitch)
        if JOINTS[joint].has_pitch:
            why = "what it moves along its axis for each radian, in m"
            self.check.report_missing(
                path, f'a {joint} joint has one, {why}: pitch = "lead/(2*pi)"'
            )
        elif entry.pitch is not None:
            self.check.report(path, f"a {joint} joint has no pitch: remove it")
        return None

    def per_coordinate(self, path: Path, joint: str, written: Any) -> tuple[Formula, ...]:
        """Check an entry with one value for each coordinate of a joint, such as `damping`.

        path: keys of the entry. joint: kind of the joint. written: the entry; one number or formula
        for all coordinates, a tuple with one for each, or None if it is missing. Returns a tuple of
        one formula for each coordinate. Returns () if the entry is missing. After an error, report
        it and return ().
        """
        count, key = len(JOINTS[joint].motions), path[-1]
        if written is None:
            return ()
        if not count:
            self.check.report(path, f"a fixed joint does not move: remove '{key}'")
            return ()
        entries = written if isinstance(written, tuple) else (written,) * count
        if len(entries) != count:
            each = f", or a list of {count}, one for each coordinate" if count > 1 else ""
            self.check.report(path, f"give one for the joint{each}, here {len(entries)}")
            return ()
        if key == "actuator":
            return tuple(self.check.formula(path, entry) or ZERO for entry in entries)
        checked = {x: self.check.value(path, x, key != "damping")[0] for x in {*entries}}
        return tuple(checked[x] for x in entries)


# --- springs, dampers and forces ------------------------------------------------------------------


def check_spring(check: ValueChecker, path: Path, entry: SpringTable) -> Spring:
    """Check a [[spring]] table and return the spring.

    path: keys of the table in the scene. entry: the table. Errors are reported to `check`.
    """
    return Spring(
        stiffness=check.parameter_formula((*path, "stiffness"), entry.stiffness),
        length=check.parameter_formula((*path, "length"), entry.length),
        **_attachment(check, path, entry),
    )


def check_damper(check: ValueChecker, path: Path, entry: DamperTable) -> Damper:
    """Check a [[damper]] table and return the damper.

    path: keys of the table in the scene. entry: the table. Errors are reported to `check`.
    """
    return Damper(
        damping=check.parameter_formula((*path, "damping"), entry.damping),
        **_attachment(check, path, entry),
    )


def check_force(check: ValueChecker, path: Path, entry: ForceTable) -> Force:
    """Check a [[force]] table and return the force and torque that it applies to a body.

    path: keys of the table in the scene. entry: the table. The formulas of force and torque may use
    all names. Errors are reported to `check`.
    """
    if (*path, "body") in check.repaired:  # reported already
        pass
    elif check.is_body((*path, "body"), entry.body) and entry.body == WORLD:
        why = "what does not move needs no force: remove it"
        check.report((*path, "body"), why, text=WORLD)
    if entry.force is None and entry.torque is None:
        example = '[0, "F"]' if check.dimension == 2 else '[0, 0, "F"]'
        check.report(path, f"gives neither a force nor a torque: add force = {example}")
    if entry.point is not None and entry.force is None:
        check.report((*path, "point"), "a torque acts on the whole body: remove it")
    torque = entry.torque
    if check.dimension == 2 and torque is not None:
        if isinstance(torque, tuple):
            check.report((*path, "torque"), 'in a plane scene it is one formula, torque = "M"')
        torque = (0.0, 0.0, torque) if not isinstance(torque, tuple) else None
    elif torque is not None and not isinstance(torque, tuple):
        check.report((*path, "torque"), "has three entries in space, such as [0, 0, 1.5]")
        torque = None
    return Force(
        body=entry.body,
        point=check.vector((*path, "point"), entry.point),
        force=_world_vector(check, (*path, "force"), entry.force),
        torque=_world_vector(check, (*path, "torque"), torque, wide=3),
        in_body=entry.frame == "body",
    )


def _world_vector(
    check: ValueChecker,
    path: Path,
    entries: tuple[Value, ...] | None,
    wide: int | None = None,
) -> Vector:
    """Return three checked formulas, which may use all names."""
    if entries is None or not (wide == len(entries) or check.fits(path, len(entries))):
        return ORIGIN
    x, y, *third = (check.formula(path, entry) or ZERO for entry in entries)
    return x, y, third[0] if third else ZERO


def _attachment(
    check: ValueChecker, path: Path, entry: SpringTable | DamperTable
) -> dict[str, Any]:
    """Return where a spring or damper acts, as arguments of `assembly.SpringDamper`."""
    kind = path[0]
    if (entry.coordinate is None) == (entry.bodies is None):
        if not {(*path, "coordinate"), (*path, "bodies")} & check.repaired:
            check.report(
                path,
                f"a {kind} acts along a 'coordinate' or between two 'bodies': give "
                + ("one of the two" if entry.coordinate is None else "one of the two only"),
            )
        return {}
    if entry.coordinate is not None:
        for key in ("points", "turning"):
            if getattr(entry, key):
                check.report((*path, key), f"belongs to a {kind} between 'bodies': remove it")
        check.is_coordinate((*path, "coordinate"), entry.coordinate)
        return {"coordinate": entry.coordinate}
    assert entry.bodies is not None
    first, second = check.two_bodies((*path, "bodies"), entry.bodies, f"a {kind} acts")
    if entry.turning:
        if check.dimension == 3:
            check.report(
                (*path, "turning"),
                f"a {kind} turns in plane scenes only: in space let it act along the "
                "'coordinate' of a joint",
            )
        if entry.points:
            check.report((*path, "points"), f"a turning {kind} has no points: remove them")
        return {"bodies": (first, second), "turning": True}
    points = entry.points or (None, None)
    one, other = (check.vector((*path, "points"), point) for point in points)
    return {"bodies": (first, second), "points": (one, other)}


# --- loops ----------------------------------------------------------------------------------------

_TWO_AXES = {2: "two axes, one in each body's frame"}
_ONE_AXIS = {1: "one axis", **_TWO_AXES}


class LoopChecker:
    """Checks the [[loop]] tables of a scene, also that their constraint equations differ in name.

    Errors are reported to `check`.
    """

    def __init__(self, check: ValueChecker) -> None:
        self.check, self.doc = check, check.doc
        rows = dict.fromkeys(check.doc.constraints, "is a row of another constraint")
        self.rows = names_taken_from_rows(check) | rows  # names in use
        self.loops: dict[str, str] = {}

    def loop(self, path: Path, entry: LoopTable) -> LoopJoint | None:
        """Check a [[loop]] table and return the loop, or None if its kind of joint is unknown.

        path: keys of the table in the scene. entry: the table. Errors are reported.
        """
        if (*path, "joint") in self.check.repaired:
            return None
        kind = self.check.kind(path, entry.joint, CLOSINGS, "closes loops")
        if not kind or self.check.dimension is None:
            return None
        if kind == "gear":
            parts = self._gear(path, entry)
        else:
            bodies = self._bodies_of_loop(path, entry)
            parts = {
                "bodies": bodies,
                "points": self._ends(path, entry),
                "axes": self._axes_of_loop((*path, "axis"), kind, entry),
                "rotation": self.check.rotation(
                    (*path, "rotation"), entry.rotation, self.check.parameter_formula
                ),
                "length": self._distance((*path, "length"), kind, entry),
            }
        self._report_foreign_keys(path, kind, entry)
        loop = LoopJoint(entry.name, kind, note=entry.note, **parts)
        self._check_row_names(path, loop)
        return loop

    def _bodies_of_loop(self, path: Path, entry: LoopTable) -> tuple[str, ...]:
        """Return the two bodies."""
        check = self.check
        if entry.bodies is None:
            what = 'name the two that it joins, bodies = ["coupler", "rocker"]'
            check.report_missing((*path, "bodies"), what)
            return (WORLD, WORLD)
        return self.check.two_bodies((*path, "bodies"), entry.bodies, "a loop closes")

    def _ends(self, path: Path, entry: LoopTable) -> tuple[Vector, ...]:
        """Return the position of the joint in the frame of each body; the origin of a [[point]]."""
        if entry.points is not None:
            one, other = (self.check.vector((*path, "points"), point) for point in entry.points)
            return one, other
        declared = {point.name for point in self.doc.point.values()}
        if entry.bodies and not declared.issuperset(entry.bodies):
            zero = ", 0" * (self.check.dimension == 3)
            example = f'[[0, 0{zero}], ["l", 0{zero}]]'
            self.check.report_missing(
                (*path, "points"),
                f"add points = {example}, where the joint is in the frame of each body",
            )
        return ORIGIN, ORIGIN

    def _axes_of_loop(
        self, path: Path, kind: str, entry: LoopTable
    ) -> tuple[tuple[float, float, float], ...]:
        """Return the axis in the frame of each body."""
        joint = CLOSINGS[kind]
        counts: dict[int, str] = {}
        if self.check.dimension == 3 or "u" in joint.rows(plane=True):
            counts = {0: {}, 1: _ONE_AXIS, 2: _TWO_AXES}[joint.axes]
            if not joint.defaults and joint.axes:
                counts = {1: "one axis, of the first body"}
        axes = self.check.axes(path, kind, entry.axis, counts, joint.defaults if counts else ())
        return (axes[0], axes[-1]) if axes else ()

    def _distance(self, path: Path, kind: str, entry: LoopTable) -> Any:
        """Return the length of a joint of kind "distance", else None."""
        if kind != "distance" or path in self.check.repaired:
            return None
        if entry.length is None:
            self.check.report_missing(path, 'add length = "l", between the two points, m')
            return None
        length, value = self.check.value(path, entry.length)
        if value <= 0:
            meet = "revolute" if self.check.dimension == 2 else "spherical"
            why = f"is {value:g}, and must be greater than zero: points that meet are '{meet}'"
            self.check.report(path, why, text=length.text)
        return length

    def _gear(self, path: Path, entry: LoopTable) -> dict[str, Any]:
        """Return the coordinates, ratio and offset of a gear."""
        check, coordinates = self.check, entry.coordinates or ()
        if not coordinates:
            what = 'name the two that it couples, coordinates = ["phi", "psi"]'
            check.report_missing((*path, "coordinates"), what)
        for name in coordinates:
            self.check.is_coordinate((*path, "coordinates"), name)
            check.used[name].append((*path, "coordinates"))
        if coordinates and coordinates[0] == coordinates[1]:
            why = f"a gear couples two coordinates, here both are '{coordinates[0]}'"
            check.report((*path, "coordinates"), why)
        ratio = ZERO
        if entry.ratio is not None:
            ratio, value = self.check.value((*path, "ratio"), entry.ratio)
            if value == 0:
                why = "is 0, so that the second coordinate does not move: give it no coordinate"
                check.report((*path, "ratio"), why, text=ratio.text)
        else:
            why = 'add ratio = "n", of the second coordinate over the first'
            check.report_missing((*path, "ratio"), why)
        offset = (
            self.check.parameter_formula((*path, "offset"), entry.offset) if entry.offset else ZERO
        )
        return {"coordinates": coordinates, "ratio": ratio, "offset": offset}

    def _report_foreign_keys(self, path: Path, kind: str, entry: LoopTable) -> None:
        """Report keys that belong to other kinds of joints."""
        turned = any(row in ("rz",) for row in CLOSINGS[kind].rows(self.check.dimension == 2))
        of_bodies = kind != "gear"
        belongs = {
            "bodies": of_bodies, "points": of_bodies, "axis": of_bodies, "rotation": turned,
            "length": kind == "distance", "coordinates": not of_bodies, "ratio": not of_bodies,
            "offset": not of_bodies,
        }  # fmt: skip
        for key, allowed in belongs.items():
            if getattr(entry, key) is not None and not allowed:
                remedy = "remove it"
                if key == "rotation" and of_bodies and CLOSINGS[kind].axes:
                    remedy = "give axis in the frame of each body, [[0, 0, 1], [1, 0, 0]]"
                self.check.report((*path, key), f"a {kind} joint has no '{key}': {remedy}")

    def _check_row_names(self, path: Path, loop: LoopJoint) -> None:
        """Report a name of the loop or of its constraint equations that is in use already."""
        path = (*path, "name")
        if path in self.check.repaired:
            return
        if self.check.claim(path, loop.name, self.loops, "is a loop already"):
            for name in loop.rows(self.check.dimension == 2).values():
                why = names.fault(name) or (name in self.rows and f"'{name}' {self.rows[name]}")
                if why:
                    why = f"a row of the loop: {why}: rename the loop"
                    self.check.report(path, why, text=loop.name)
                self.rows[name] = "is a row of another constraint"
