"""Checks of bodies and what acts on them: from tables to an Assembly. Independent of SymPy."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping
from graphlib import TopologicalSorter
from itertools import islice
from typing import Any

from eomc.base import names
from eomc.base.errors import SceneError
from eomc.scene.assembly import WORLD, Assembly, Damper, Force, LoopJoint, RigidBody, Spring, Vector
from eomc.scene.formulas import Formula, nearest, suggest
from eomc.scene.joints import CLOSING_ALIASES, CLOSINGS, JOINT_ALIASES, JOINTS, Z
from eomc.scene.schema import (
    BodyTable,
    DamperTable,
    Document,
    ForceTable,
    LoopTable,
    PointTable,
    SpringTable,
)
from eomc.scene.scope import Checker, Path, cycle_text, find_cycles
from eomc.scene.validate_tables import FRICTION_WIDTH, check_width, row_name_fault
from eomc.scene.validate_values import ORIGIN, ZERO, ValueChecker

_JOINT_KEYS = (
    "parent", "coordinates", "axis", "offset", "center", "armature", "damping", "friction",
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


def assemble(check: Checker, doc: Document, known: Mapping[str, float]) -> Assembly | None:
    """Check the bodies, points, springs, dampers, forces and loops of a scene and return them.

    known: values of constants and parameters by name. Errors are reported to `check`; after an
    error the result must not be used. Returns None if the scene has no such tables.
    """
    if not (doc.body or doc.point or doc.spring or doc.damper or doc.force or doc.loop):
        if doc.gravity is not None:
            check.report(
                ("gravity",),
                "acts on bodies, and there is no [[body]]: remove it, or write the weight "
                "into the potential energy",
            )
        return None
    return _Bodies(check, doc, known).assembly()


class _Bodies:
    def __init__(self, check: Checker, doc: Document, known: Mapping[str, float]) -> None:
        self.check, self.doc = check, doc
        self.values = ValueChecker(check, doc, known)
        self.joints = JointChecker(self.values)
        self.bodies: dict[str, RigidBody] = {}

    def assembly(self) -> Assembly:
        """Check all tables of bodies and what acts on them, and return the assembly."""
        gravity = self._gravity()
        self._check_names()
        for name, path in self.values.names.items():
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
        springs = [check_spring(self.values, ("spring", k), e) for k, e in self.doc.spring.items()]
        dampers = [check_damper(self.values, ("damper", k), e) for k, e in self.doc.damper.items()]
        forces = [check_force(self.values, ("force", k), e) for k, e in self.doc.force.items()]
        loop_checker = LoopChecker(self.values)
        loops = [loop_checker.loop(("loop", k), e) for k, e in self.doc.loop.items()]
        return Assembly(
            plane=self.values.dimension == 2,
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
                self.values.dimension = None
                if ("gravity",) not in self.check.repaired:
                    self.check.report(
                        ("gravity",),
                        'missing: add gravity = [0, "-9.81"] above the first [table] for a plane '
                        'scene, [0, 0, "-9.81"] for one in space, [0, 0] or [0, 0, 0] for none',
                    )
            return ORIGIN
        if len(entries) not in (2, 3):
            self.values.dimension = None
            self.check.report(
                ("gravity",),
                f"has two entries in a plane scene and three in space, here {len(entries)}",
            )
            return ORIGIN
        self.values.dimension = len(entries)
        return self.values.vector(("gravity",), entries)

    def _check_names(self) -> None:
        """Store the place of each body and point by its name; report names that can't be used."""
        entries = [(("body", label), entry.name) for label, entry in self.doc.body.items()]
        entries += [(("point", label), entry.name) for label, entry in self.doc.point.items()]
        for place, name in entries:
            path = (*place, "name")
            if why := names.fault(name):
                self.check.report(path, why)
            elif name == WORLD:
                self.check.report(
                    path, "'world' is the frame that does not move: name the body otherwise"
                )
                continue
            elif name in self.values.names:
                what = f"{self.values.names[name][0]} above"
                self.check.report(path, f"'{name}' is the name of a {what}: rename one of the two")
                continue
            self.values.names[name] = place
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
        mass, inertia = self.values.mass(path, entry)
        self.bodies[entry.name] = RigidBody(
            name=entry.name,
            mass=mass,
            inertia=inertia,
            center=ORIGIN,
            rotation=self.values.rotation(
                (*path, "rotation"), entry.rotation, self.values.position_formula
            ),
            position=self.values.vector(
                (*path, "position"), entry.position, self.values.position_formula
            ),
            note=entry.note,
        )

    def _center_text(self, name: str) -> str:
        point = self.values.names.get(name, ("body",))[0] == "point"
        return f"point '{name}'" if point else f"the centre of mass of body '{name}'"

    def _check_point(self, path: Path, entry: PointTable) -> None:
        """Check a [[point]], which is a massless body on a fixed joint."""
        place = self.values.vector((*path, "place"), entry.place)
        rotation = self.values.rotation((*path, "rotation"), entry.rotation, self.values.formula)
        parent = self.joints.parent((*path, "body"), entry.name, entry.body)
        self.values.has_inertia[entry.name] = False
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
        mass, inertia = self.values.mass(path, entry)
        center = self.values.vector((*path, "center"), entry.center)
        offset = self.values.vector((*path, "offset"), entry.offset)
        rotation = self.values.rotation((*path, "rotation"), entry.rotation, self.values.formula)
        if not joint:
            return
        coordinates = self.joints.coordinates((*path, "coordinates"), joint, entry)
        axes = self.joints.axes((*path, "axis"), joint, entry)
        per_coordinate: dict[str, Any] = {
            key: self.joints.per_coordinate((*path, key), joint, getattr(entry, key))
            for key in ("armature", "damping", "friction", "actuator")
        }
        width = None
        if per_coordinate["friction"]:
            width = FRICTION_WIDTH
        if entry.friction_width is not None:
            width, value = self.values.value((*path, "friction_width"), entry.friction_width)
            check_width(check, path, value, width, entry.friction)
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
                        (*self.values.names[body.name], "coordinates"),
                        f"'{text}' moves the joint of '{first}' already, and '{idle[0]}' moves "
                        f"none; did you mean '{idle[0]}'?",
                        text=text,
                    )

    # --- the tree ---------------------------------------------------------------------------------

    def _sorted_bodies(self) -> list[RigidBody]:
        """Return the bodies, parents before children, else in their order; cycles are reported."""
        graph = {name: [b.parent] if b.joint else [] for name, b in self.bodies.items()}
        for ring in islice(find_cycles(graph), SceneError.MAX_SHOWN):
            place = self.values.names[ring[0]]
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
        carries = dict(self.values.has_inertia)
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
                self.values.names[body.name],
                f"nothing that {by} would move has mass or inertia: "
                f"give '{body.name}' a mass, or its joint an armature",
            )


# --- joints ---------------------------------------------------------------------------------------


class JointChecker:
    """Checks the joints by which bodies are attached to their parents.

    A path is the tuple of keys of an entry in the scene, such as ("body", "arm", "joint").
    """

    def __init__(self, values: ValueChecker) -> None:
        self.values = values
        self.check, self.doc = values.check, values.doc
        self.first_body: dict[str, str] = {}  # first body that each coordinate moves

    def entry(self, name: str) -> BodyTable | PointTable:
        """Return the table in the scene of the body or point `name`."""
        array, label = self.values.names[name]
        entries: Mapping[str, BodyTable | PointTable] = getattr(self.doc, array)
        return entries[label]

    def kind(self, path: Path, entry: BodyTable) -> str:
        """Return the kind of joint of a body, a key of `joints.JOINTS`.

        path: keys of the body. entry: its table. If the kind is missing or unknown, or does not
        exist in plane scenes, report this and return "".
        """
        check, joint = self.check, entry.joint
        known = [k for k, kind in JOINTS.items() if kind.plane or self.values.dimension != 2]
        if joint is None:
            if {(*path, "joint"), (*path, "position")} & check.repaired:
                return ""  # reported already
            check.report(
                path,
                'say how the body is held: joint = "revolute" or another, or position = [...] with '
                "formulas in the coordinates",
            )
            return ""
        if joint not in JOINTS:
            near = JOINT_ALIASES.get(joint.lower(), "") or nearest(joint, JOINTS)
            remedy = f"; did you mean '{near}'?" if near else f": known are {', '.join(known)}"
            check.report((*path, "joint"), f"there is no joint '{joint}'{remedy}", text=joint)
            return ""
        if joint not in known:
            check.report(
                (*path, "joint"),
                f"a {joint} joint moves in space, and gravity has two entries, so the scene is "
                f"plane: give gravity a third, or use {', '.join(known)}",
                text=joint,
            )
            return ""
        return joint

    def parent(self, path: Path, name: str, parent: str | None) -> str | None:
        """Check the parent of the body `name` and return it, "world" if it is not given.

        If it can't be a parent, report this and return None.
        """
        if parent is None or parent == WORLD:
            return WORLD
        if parent not in self.values.names:
            remedy = suggest(parent, [WORLD, *self.values.names]) or ": declare it as a [[body]]"
            self.check.report(path, f"there is no body '{parent}'{remedy}", text=parent)
        elif parent == name:
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
        if text.isidentifier() and text not in coordinates:
            table = check.tables.get(text)
            near = suggest(text, coordinates) or ": add it to [coordinates]"
            why = f"'{text}' is not a coordinate{near}"
            if table:
                why = f"'{text}' stands in [{table}]: a joint moves by what is in [coordinates]"
            check.report(path, why, text=text)
            return None
        rule = "a joint moves by coordinates, or formulas of coordinates, parameters and constants"
        formula = check.formula(path, text, {*self.values.known, *coordinates}, rule)
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
        check, axis_count = self.check, JOINTS[joint].axis_count
        if path in check.repaired or self.values.dimension is None:
            return ()
        written = entry.axis
        if written is None:
            if axis_count and not JOINTS[joint].defaults:
                example = "[1, 0]" if self.values.dimension == 2 else "[1, 0, 0]"
                check.report(path, f"missing: a {joint} joint slides along one, axis = {example}")
                return (Z,) * axis_count
            return JOINTS[joint].defaults
        if not axis_count:
            check.report(path, f"a {joint} joint has no axis to choose: remove it")
            return ()
        if joint == "revolute" and self.values.dimension == 2:
            check.report(path, "in a plane scene joints turn about z: remove it")
            return ()
        if len(written) != axis_count:
            count = "one axis" if axis_count == 1 else "two axes, such as [[1, 0, 0], [0, 1, 0]]"
            check.report(path, f"a {joint} joint has {count}, here {len(written)}")
            return ()
        axes = [names_used for axis in written if (names_used := self.values.unit(path, axis))]
        if len(axes) < len(written):
            return ()
        if len(axes) == 2 and abs(sum(a * b for a, b in zip(*axes, strict=True))) > 1 - 1e-9:
            check.report(
                path, "the two axes are parallel, so the two angles are one: turn one of them"
            )
        return tuple(axes)

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
        checked = [self.values.value(path, entry) for entry in entries]
        for formula, value in checked:
            if value < 0 and key != "damping":
                self.check.report(path, f"is {value:g}, and can't be negative", text=formula.text)
                break
        return tuple(formula for formula, _ in checked)


# --- springs, dampers and forces ------------------------------------------------------------------


def check_spring(values: ValueChecker, path: Path, entry: SpringTable) -> Spring:
    """Check a [[spring]] table and return the spring.

    path: keys of the table in the scene. entry: the table. Errors are reported to `values.check`.
    """
    return Spring(
        stiffness=values.formula((*path, "stiffness"), entry.stiffness),
        length=values.formula((*path, "length"), entry.length),
        **_attachment(values, path, entry),
    )


def check_damper(values: ValueChecker, path: Path, entry: DamperTable) -> Damper:
    """Check a [[damper]] table and return the damper.

    path: keys of the table in the scene. entry: the table. Errors are reported to `values.check`.
    """
    return Damper(
        damping=values.formula((*path, "damping"), entry.damping),
        **_attachment(values, path, entry),
    )


def check_force(values: ValueChecker, path: Path, entry: ForceTable) -> Force:
    """Check a [[force]] table and return the force and torque that it applies to a body.

    path: keys of the table in the scene. entry: the table. The formulas of force and torque may use
    all names. Errors are reported to `values.check`.
    """
    check = values.check
    if entry.body not in values.names:
        remedy = suggest(entry.body, values.names) or ": declare it as a [[body]]"
        if entry.body == WORLD:
            remedy = ": what does not move needs no force"
        check.report((*path, "body"), f"there is no body '{entry.body}'{remedy}", text=entry.body)
    if entry.force is None and entry.torque is None:
        example = '[0, "F"]' if values.dimension == 2 else '[0, 0, "F"]'
        check.report(path, f"gives neither a force nor a torque: add force = {example}")
    if entry.point is not None and entry.force is None:
        check.report((*path, "point"), "a torque acts on the whole body: remove it")
    torque = entry.torque
    if values.dimension == 2 and torque is not None:
        if isinstance(torque, tuple):
            check.report((*path, "torque"), 'in a plane scene it is one formula, torque = "M"')
        torque = (0.0, 0.0, torque) if not isinstance(torque, tuple) else None
    elif torque is not None and not isinstance(torque, tuple):
        check.report((*path, "torque"), "has three entries in space, such as [0, 0, 1.5]")
        torque = None
    return Force(
        body=entry.body,
        point=values.vector((*path, "point"), entry.point),
        force=_world_vector(values, (*path, "force"), entry.force),
        torque=_world_vector(values, (*path, "torque"), torque, wide=3),
        in_body=entry.frame == "body",
    )


def _world_vector(
    values: ValueChecker,
    path: Path,
    entries: tuple[float | str, ...] | None,
    wide: int | None = None,
) -> Vector:
    """Return three checked formulas, which may use all names."""
    if entries is None or not (wide == len(entries) or values.fits(path, len(entries))):
        return ORIGIN
    x, y, *third = (values.check.formula(path, entry) or ZERO for entry in entries)
    return x, y, third[0] if third else ZERO


def _attachment(
    values: ValueChecker, path: Path, entry: SpringTable | DamperTable
) -> dict[str, Any]:
    """Return where a spring or damper acts, as arguments of `assembly.SpringDamper`."""
    check, kind = values.check, path[0]
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
        if entry.coordinate not in values.doc.coordinates:
            remedy = suggest(entry.coordinate, values.doc.coordinates)
            remedy = remedy or f": known are {', '.join([*values.doc.coordinates][:9])}"
            check.report(
                (*path, "coordinate"),
                f"'{entry.coordinate}' is not a coordinate{remedy}",
                text=entry.coordinate,
            )
        return {"coordinate": entry.coordinate}
    assert entry.bodies is not None
    first, second = values.two_bodies((*path, "bodies"), entry.bodies, f"a {kind} acts")
    if entry.turning:
        if values.dimension == 3:
            check.report(
                (*path, "turning"),
                f"a {kind} turns in plane scenes only: in space let it act along the "
                "'coordinate' of a joint",
            )
        if entry.points:
            check.report((*path, "points"), f"a turning {kind} has no points: remove them")
        return {"bodies": (first, second), "turning": True}
    points = entry.points or (None, None)
    one, other = (values.vector((*path, "points"), point) for point in points)
    return {"bodies": (first, second), "points": (one, other)}


# --- loops ----------------------------------------------------------------------------------------

_AXES_IN_WORDS = {
    1: "one axis, or one in each body's frame",
    2: "two axes, one in each body's frame",
}


class LoopChecker:
    """Checks the [[loop]] tables of a scene, also that their constraint equations differ in name.

    Errors are reported to the `check` of `values`.
    """

    def __init__(self, values: ValueChecker) -> None:
        self.values = values
        self.check, self.doc = values.check, values.doc
        self.rows = {*values.doc.constraints}  # names of constraint equations so far

    def loop(self, path: Path, entry: LoopTable) -> LoopJoint | None:
        """Check a [[loop]] table and return the loop, or None if its kind of joint is unknown.

        path: keys of the table in the scene. entry: the table. Errors are reported.
        """
        kind = self._kind(path, entry)
        if not kind or self.values.dimension is None:
            return None
        if kind == "gear":
            parts = self._gear(path, entry)
        else:
            bodies = self._bodies_of_loop(path, entry)
            parts = {
                "bodies": bodies,
                "points": self._ends(path, entry),
                "axes": self._axes_of_loop((*path, "axis"), kind, entry),
                "rotation": self.values.rotation(
                    (*path, "rotation"), entry.rotation, self.values.formula
                ),
                "length": self._distance((*path, "length"), kind, entry),
            }
        self._report_foreign_keys(path, kind, entry)
        loop = LoopJoint(entry.name, kind, note=entry.note, **parts)
        self._check_row_names(path, loop)
        return loop

    def _kind(self, path: Path, entry: LoopTable) -> str:
        """Return the kind of joint; "" if there is no such kind, which is reported."""
        if (*path, "joint") in self.check.repaired:
            return ""
        known = [k for k, kind in CLOSINGS.items() if kind.plane or self.values.dimension != 2]
        joint = entry.joint
        if joint in known:
            return joint
        if joint in CLOSINGS:
            instead = "revolute" if joint == "spherical" else "one of " + ", ".join(known)
            why = (
                f"a {joint} joint closes loops in space, and gravity has two entries, so the scene "
                f"is plane: give gravity a third, or use {instead}"
            )
        else:
            near = CLOSING_ALIASES.get(joint.lower(), "") or nearest(joint, CLOSINGS)
            near = near if near in known else ""
            remedy = f"; did you mean '{near}'?" if near else f": known are {', '.join(known)}"
            why = f"there is no joint '{joint}' that closes a loop{remedy}"
        self.check.report((*path, "joint"), why, text=joint)
        return ""

    def _bodies_of_loop(self, path: Path, entry: LoopTable) -> tuple[str, ...]:
        """Return the two bodies."""
        check = self.check
        if entry.bodies is None:
            if (*path, "bodies") not in check.repaired:
                what = 'missing: name the two that it joins, bodies = ["coupler", "rocker"]'
                check.report((*path, "bodies"), what)
            return (WORLD, WORLD)
        return self.values.two_bodies((*path, "bodies"), entry.bodies, "a loop closes")

    def _ends(self, path: Path, entry: LoopTable) -> tuple[Vector, ...]:
        """Return the position of the joint in the frame of each body; the origin of a [[point]]."""
        if entry.points is not None:
            one, other = (self.values.vector((*path, "points"), point) for point in entry.points)
            return one, other
        declared = {point.name for point in self.doc.point.values()}
        if (
            entry.bodies
            and not declared.issuperset(entry.bodies)
            and (*path, "points") not in self.check.repaired
        ):
            example = (
                '[[0, 0], ["l", 0]]' if self.values.dimension == 2 else '[[0, 0, 0], ["l", 0, 0]]'
            )
            self.check.report(
                (*path, "points"),
                f"missing: add points = {example}, where the joint is in the frame of each body",
            )
        return ORIGIN, ORIGIN

    def _axes_of_loop(
        self, path: Path, kind: str, entry: LoopTable
    ) -> tuple[tuple[float, float, float], ...]:
        """Return the axis in the frame of each body."""
        check, joint, written = self.check, CLOSINGS[kind], entry.axis
        across = "u" in joint.rows(self.values.dimension == 2)
        axis_count = joint.axes if self.values.dimension == 3 or across else 0
        if path in check.repaired:
            return ()
        if written is None:
            if axis_count and not joint.defaults:
                example = "[1, 0]" if self.values.dimension == 2 else "[1, 0, 0]"
                why = f"missing: a {kind} joint slides along one, of the first body"
                check.report(path, f"{why}: axis = {example}")
            return joint.defaults if axis_count else ()
        if not axis_count:
            plane = joint.axes and self.values.dimension == 2
            why = (
                "in a plane scene joints turn about z"
                if plane
                else f"a {kind} joint has no axis to choose"
            )
            check.report(path, f"{why}: remove it")
            return ()
        axes = [unit for axis in written if (unit := self.values.unit(path, axis))]
        if len(axes) < len(written):
            return ()
        single = not joint.defaults  # one axis, in the first body's frame
        if len(axes) > 2 or len(axes) < joint.axes or (single and len(axes) > 1):
            what = "one axis, of the first body" if single else _AXES_IN_WORDS[joint.axes]
            check.report(path, f"a {kind} joint has {what}, here {len(axes)}")
            return ()
        return (axes[0], axes[-1])

    def _distance(self, path: Path, kind: str, entry: LoopTable) -> Any:
        """Return the length of a joint of kind "distance", else None."""
        if kind != "distance" or path in self.check.repaired:
            return None
        if entry.length is None:
            self.check.report(path, 'missing: add length = "l", between the two points, m')
            return None
        length, value = self.values.value(path, entry.length)
        if value <= 0:
            meet = "revolute" if self.values.dimension == 2 else "spherical"
            why = f"is {value:g}, and must be greater than zero: points that meet are '{meet}'"
            self.check.report(path, why, text=length.text)
        return length

    def _gear(self, path: Path, entry: LoopTable) -> dict[str, Any]:
        """Return the coordinates, ratio and offset of a gear."""
        check, coordinates = self.check, entry.coordinates or ()
        if not coordinates and (*path, "coordinates") not in check.repaired:
            what = 'missing: name the two that it couples, coordinates = ["phi", "psi"]'
            check.report((*path, "coordinates"), what)
        for name in coordinates:
            if name not in self.doc.coordinates:
                remedy = suggest(name, self.doc.coordinates)
                remedy = remedy or f": known are {', '.join([*self.doc.coordinates][:9])}"
                why = f"'{name}' is not a coordinate{remedy}"
                check.report((*path, "coordinates"), why, text=name)
            check.used[name].append((*path, "coordinates"))
        if coordinates and coordinates[0] == coordinates[1]:
            why = f"a gear couples two coordinates, here both are '{coordinates[0]}'"
            check.report((*path, "coordinates"), why)
        ratio = ZERO
        if entry.ratio is not None:
            ratio, value = self.values.value((*path, "ratio"), entry.ratio)
            if value == 0:
                why = "is 0, so that the second coordinate does not move: give it no coordinate"
                check.report((*path, "ratio"), why, text=ratio.text)
        elif (*path, "ratio") not in check.repaired:
            why = 'missing: add ratio = "n", of the second coordinate over the first'
            check.report((*path, "ratio"), why)
        offset = self.values.formula((*path, "offset"), entry.offset) if entry.offset else ZERO
        return {"coordinates": coordinates, "ratio": ratio, "offset": offset}

    def _report_foreign_keys(self, path: Path, kind: str, entry: LoopTable) -> None:
        """Report keys that belong to other kinds of joints."""
        turned = any(row in ("rz",) for row in CLOSINGS[kind].rows(self.values.dimension == 2))
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
        check, path = self.check, (*path, "name")
        if path in check.repaired:
            return
        others = [e.name for e in self.doc.loop.values()]
        if why := names.fault(loop.name):
            check.report(path, why, text=loop.name)
        elif others.count(loop.name) > 1:
            why = f"'{loop.name}' is a loop already: rename one of the two"
            check.report(path, why, text=loop.name)
        else:
            for name in loop.rows(self.values.dimension == 2).values():
                why = row_name_fault(check, self.doc, name)
                if not why and name in self.rows:
                    why = f"'{name}' is a row of another constraint"
                if why:
                    check.report(path, f"a row of the loop: {why}: rename the loop", text=loop.name)
                self.rows.add(name)
