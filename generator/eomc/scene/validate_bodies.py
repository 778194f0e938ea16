"""Bodies, joints, springs and dampers of a scene: layout tables to a checked Assembly. No SymPy."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Mapping
from graphlib import TopologicalSorter
from itertools import islice
from typing import Any

from eomc.base import names
from eomc.base.errors import MOST
from eomc.scene import formulas
from eomc.scene.assembly import WORLD, Assembly, Body, Vector
from eomc.scene.formulas import Formula, nearest, suggest
from eomc.scene.joints import JOINTS, MEANT, Z
from eomc.scene.schema import BodyTable, Document, PointTable
from eomc.scene.scope import Checker, Path, ring_text, rings
from eomc.scene.validate_springs import Springs
from eomc.scene.validate_values import ORIGIN, ZERO

FRICTION_WIDTH = formulas.parse("0.01")  # rad/s or m/s

_OF_JOINTS = (
    "parent", "coordinates", "axis", "offset", "center", "armature", "damping", "friction",
    "friction_width", "actuator",
)  # fmt: skip


def centers(doc: Document) -> set[str]:
    """The names that bodies on joints give to the position of their centres of mass, and points."""
    letters = "xy" if doc.gravity and len(doc.gravity) == 2 else "xyz"
    named = [body.name for body in doc.body.values() if body.position is None]
    named += [point.name for point in doc.point.values()]
    return {f"{name}_{letter}" for name in named for letter in letters}


def assemble(check: Checker, doc: Document, known: Mapping[str, float]) -> Assembly | None:
    """The bodies of a scene and what acts between them; None where there is nothing of it.

    known: the values of constants and parameters. Faults are reported to `check`; with faults the
    assembly is not to be used.
    """
    if not (doc.body or doc.point or doc.spring or doc.damper or doc.force):
        if doc.gravity is not None:
            check.say(
                ("gravity",),
                "acts on bodies, and there is no [[body]]: remove it, or write the weight "
                "into the potential energy",
            )
        return None
    return _Bodies(check, doc, known).assembly()


class _Bodies(Springs):
    def __init__(self, check: Checker, doc: Document, known: Mapping[str, float]) -> None:
        super().__init__(check, doc, known)
        self.moved_by: dict[str, str] = {}  # each coordinate and the body whose joint it moves
        self.bodies: dict[str, Body] = {}

    def assembly(self) -> Assembly:
        gravity = self._gravity()
        self._names()
        for name, path in self.names.items():
            entry = self._entry(name)
            if isinstance(entry, PointTable):
                self._point(path, entry)
            elif entry.position is None:
                self._jointed(path, entry)
            else:
                self._placed(path, entry)
        ordered = self._ordered()
        self._inertia_of_joints(ordered)
        springs = [self._spring(("spring", k), e) for k, e in self.doc.spring.items()]
        dampers = [self._damper(("damper", k), e) for k, e in self.doc.damper.items()]
        forces = [self._force(("force", k), e) for k, e in self.doc.force.items()]
        return Assembly(
            plane=self.wide == 2,
            gravity=gravity,
            bodies=tuple(ordered),
            springs=tuple(springs),
            dampers=tuple(dampers),
            forces=tuple(forces),
        )

    # --- the scene ------------------------------------------------------------------------------

    def _gravity(self) -> Vector:
        given = self.doc.gravity
        if given is None:
            if self.doc.body:
                self.wide = None
                if ("gravity",) not in self.check.mended:
                    self.check.say(
                        ("gravity",),
                        'missing: add gravity = [0, "-9.81"] above the first [table] for a plane '
                        'scene, [0, 0, "-9.81"] for one in space, [0, 0] or [0, 0, 0] for none',
                    )
            return ORIGIN
        if len(given) not in (2, 3):
            self.wide = None
            self.check.say(
                ("gravity",),
                f"has two entries in a plane scene and three in space, here {len(given)}",
            )
            return ORIGIN
        self.wide = len(given)
        return self._vector(("gravity",), given)

    def _names(self) -> None:
        entries = [(("body", label), entry.name) for label, entry in self.doc.body.items()]
        entries += [(("point", label), entry.name) for label, entry in self.doc.point.items()]
        for place, name in entries:
            path = (*place, "name")
            if why := names.fault(name):
                self.check.say(path, why)
            elif name == WORLD:
                self.check.say(
                    path, "'world' is the frame that does not move: name the body otherwise"
                )
                continue
            elif name in self.names:
                what = f"{self.names[name][0]} above"
                self.check.say(path, f"'{name}' is the name of a {what}: rename one of the two")
                continue
            self.names[name] = place
        for name in sorted(self.check.centers & {*self.check.tables}):
            body = name[:-2]
            self.check.say(
                (self.check.tables[name], name),
                f"'{name}' is where {self._what(body)} is: use that, or choose another name",
            )

    # --- bodies -----------------------------------------------------------------------------------

    def _placed(self, path: Path, entry: BodyTable) -> None:
        """A body placed by formulas."""
        if entry.joint is not None:
            self.check.say(
                (*path, "position"),
                "a body is held by a joint or placed by 'position', not both: remove one of the "
                "two (a joint's place in the parent's frame is 'offset')",
            )
            return
        for key in _OF_JOINTS:
            if getattr(entry, key) is not None:
                why = (
                    "'position' is the centre of mass already"
                    if key == "center"
                    else "the body is placed by 'position' and has no joint"
                )
                remedy = ", and let forces act through [forces]" if key == "actuator" else ""
                self.check.say((*path, key), f"{why}: remove '{key}'{remedy}")
        mass, inertia = self._mass(path, entry)
        self.bodies[entry.name] = Body(
            name=entry.name,
            mass=mass,
            inertia=inertia,
            center=ORIGIN,
            rotation=self._rotation((*path, "rotation"), entry.rotation, self._moving),
            position=self._vector((*path, "position"), entry.position, self._moving),
            note=entry.note,
        )

    def _entry(self, name: str) -> BodyTable | PointTable:
        array, label = self.names[name]
        entries: Mapping[str, BodyTable | PointTable] = getattr(self.doc, array)
        return entries[label]

    def _what(self, name: str) -> str:
        point = self.names.get(name, ("body",))[0] == "point"
        return f"point '{name}'" if point else f"the centre of mass of body '{name}'"

    def _point(self, path: Path, entry: PointTable) -> None:
        """A frame on a body, which is one without mass on a fixed joint."""
        place = self._vector((*path, "place"), entry.place)
        rotation = self._rotation((*path, "rotation"), entry.rotation, self._formula)
        parent = self._parent((*path, "body"), entry.name, entry.body)
        self.heavy[entry.name] = False
        if parent is not None:
            self.bodies[entry.name] = Body(
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

    def _jointed(self, path: Path, entry: BodyTable) -> None:
        """A body held by a joint."""
        check = self.check
        joint = self._joint(path, entry)
        parent = self._parent((*path, "parent"), entry.name, entry.parent)
        mass, inertia = self._mass(path, entry)
        center = self._vector((*path, "center"), entry.center)
        offset = self._vector((*path, "offset"), entry.offset)
        rotation = self._rotation((*path, "rotation"), entry.rotation, self._formula)
        if not joint:
            return
        coordinates = self._coordinates((*path, "coordinates"), joint, entry)
        axes = self._axes((*path, "axis"), joint, entry)
        of_joint: dict[str, Any] = {
            key: self._each((*path, key), joint, getattr(entry, key))
            for key in ("armature", "damping", "friction", "actuator")
        }
        width = None
        if of_joint["friction"]:
            width = FRICTION_WIDTH
        if entry.friction_width is not None:
            width, value = self._value((*path, "friction_width"), entry.friction_width)
            if value <= 0:
                check.say(
                    (*path, "friction_width"),
                    f"is {value:g}, and must be greater than zero: the rate within which friction "
                    "is smoothed",
                    text=width.text,
                )
            if entry.friction is None:
                check.say((*path, "friction_width"), "there is no 'friction' with it: add it")
        if parent is None or coordinates is None:
            return
        self.bodies[entry.name] = Body(
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
            **of_joint,
        )

    def _joint(self, path: Path, entry: BodyTable) -> str:
        """The kind of joint, or the empty string where it is not known."""
        check, joint = self.check, entry.joint
        known = [k for k, kind in JOINTS.items() if kind.plane or self.wide != 2]
        if joint is None:
            if {(*path, "joint"), (*path, "position")} & check.mended:
                return ""  # reported already
            check.say(
                path,
                'say how the body is held: joint = "revolute" or another, or position = [...] with '
                "formulas in the coordinates",
            )
            return ""
        if joint not in JOINTS:
            near = MEANT.get(joint.lower(), "") or nearest(joint, JOINTS)
            remedy = f"; did you mean '{near}'?" if near else f": known are {', '.join(known)}"
            check.say((*path, "joint"), f"there is no joint '{joint}'{remedy}", text=joint)
            return ""
        if joint not in known:
            check.say(
                (*path, "joint"),
                f"a {joint} joint moves in space, and gravity has two entries, so the scene is "
                f"plane: give gravity a third, or use {', '.join(known)}",
                text=joint,
            )
            return ""
        return joint

    def _parent(self, path: Path, name: str, parent: str | None) -> str | None:
        """The body that carries `name`; None where it can't be one."""
        if parent is None or parent == WORLD:
            return WORLD
        if parent not in self.names:
            remedy = suggest(parent, [WORLD, *self.names]) or ": declare it as a [[body]]"
            self.check.say(path, f"there is no body '{parent}'{remedy}", text=parent)
        elif parent == name:
            self.check.say(
                path, f"'{parent}' is its own parent: name another body, or world", text=parent
            )
        elif getattr(self._entry(parent), "position", None) is not None:
            self.check.say(
                path,
                f"'{parent}' is placed by formulas, and can't be a parent: give it a joint, "
                "or place this body by formulas too",
                text=parent,
            )
        else:
            return parent
        return None

    def _coordinates(self, path: Path, joint: str, entry: BodyTable) -> tuple[str, ...] | None:
        check, given, wanted = self.check, entry.coordinates or (), len(JOINTS[joint].motions)
        if path in check.mended:
            return None
        if len(given) != wanted:
            count = "one coordinate" if wanted == 1 else f"{wanted or 'no'} coordinates"
            order = f" ({JOINTS[joint].order})" if JOINTS[joint].order else ""
            here = ", ".join(given) or "none"
            listed = ", ".join(f'"q{k}"' for k in range(1, wanted + 1))
            example = listed if wanted == 1 else f"[{listed}]"
            remedy = f": add coordinates = {example}" if not given else ""
            remedy = remedy if wanted else ": remove it"
            check.say(path, f"a {joint} joint has {count}{order}, here {here}{remedy}")
            return None
        sound = True
        for name in given:
            if name not in self.doc.coordinates:
                sound = False
                table = check.tables.get(name)
                if table:
                    why = f"'{name}' stands in [{table}]: a joint moves by what is in [coordinates]"
                else:
                    near = suggest(name, self.doc.coordinates) or ": add it to [coordinates]"
                    why = f"'{name}' is not a coordinate{near}"
                check.say(path, why, text=name)
            elif name in self.moved_by:
                sound = False
                check.say(
                    path,
                    f"'{name}' moves the joint of '{self.moved_by[name]}' already: each joint has "
                    "coordinates of its own",
                    text=name,
                )
            self.moved_by.setdefault(name, entry.name)
        return given if sound else None

    def _axes(
        self, path: Path, joint: str, entry: BodyTable
    ) -> tuple[tuple[float, float, float], ...]:
        """Unit axes; the joint's own where none are written."""
        check, wanted = self.check, JOINTS[joint].given
        if path in check.mended or self.wide is None:
            return ()
        given = entry.axis
        if given is None:
            if wanted and not JOINTS[joint].defaults:
                example = "[1, 0]" if self.wide == 2 else "[1, 0, 0]"
                check.say(path, f"missing: a {joint} joint slides along one, axis = {example}")
                return (Z,) * wanted
            return JOINTS[joint].defaults
        if not wanted:
            check.say(path, f"a {joint} joint has no axis to choose: remove it")
            return ()
        if joint == "revolute" and self.wide == 2:
            check.say(path, "in a plane scene joints turn about z: remove it")
            return ()
        if len(given) != wanted:
            count = "one axis" if wanted == 1 else "two axes, such as [[1, 0, 0], [0, 1, 0]]"
            check.say(path, f"a {joint} joint has {count}, here {len(given)}")
            return ()
        axes: list[tuple[float, float, float]] = []
        for axis in given:
            if not self._fits(path, len(axis)):
                return ()
            size = math.hypot(*axis)
            if size < 1e-9:
                check.say(path, "the axis has no length, so no direction: give it one")
                return ()
            x, y, *third = (entry / size for entry in axis)
            axes.append((x, y, third[0] if third else 0.0))
        if len(axes) == 2 and abs(sum(a * b for a, b in zip(*axes, strict=True))) > 1 - 1e-9:
            check.say(
                path, "the two axes are parallel, so the two angles are one: turn one of them"
            )
        return tuple(axes)

    def _each(self, path: Path, joint: str, given: Any) -> tuple[Formula, ...]:
        """One formula for each coordinate of the joint."""
        count, key = len(JOINTS[joint].motions), path[-1]
        if given is None:
            return ()
        if not count:
            self.check.say(path, f"a fixed joint does not move: remove '{key}'")
            return ()
        entries = given if isinstance(given, tuple) else (given,) * count
        if len(entries) != count:
            each = f", or a list of {count}, one for each coordinate" if count > 1 else ""
            self.check.say(path, f"give one for the joint{each}, here {len(entries)}")
            return ()
        if key == "actuator":
            return tuple(self.check.formula(path, entry) or ZERO for entry in entries)
        made = [self._value(path, entry) for entry in entries]
        for formula, value in made:
            if value < 0 and key != "damping":
                self.check.say(path, f"is {value:g}, and can't be negative", text=formula.text)
                break
        return tuple(formula for formula, _ in made)

    # --- the tree ---------------------------------------------------------------------------------

    def _ordered(self) -> list[Body]:
        """Parents before children, else as written; rings of parents are reported."""
        graph = {name: [b.parent] if b.joint else [] for name, b in self.bodies.items()}
        for ring in islice(rings(graph), MOST):
            place = self.names[ring[0]]
            self.check.say(
                (*place, "body" if place[0] == "point" else "parent"),
                f"the parents form a loop: {ring_text(ring)}; let one of them be held by the "
                "world, and close the loop with stiff springs",
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

    def _inertia_of_joints(self, ordered: Iterable[Body]) -> None:
        """Every joint that moves needs something to move, unless energies are given besides."""
        ordered = list(ordered)
        kinetic = self.doc.energy.kinetic
        if kinetic != 0.0 or any(body.position for body in ordered):
            return
        carries = dict(self.heavy)
        for body in reversed(ordered):
            if body.parent in carries:
                carries[body.parent] |= carries[body.name]
        reported: set[str] = set()
        for body in ordered:
            if (
                carries[body.name]
                or body.parent in reported
                or not body.coordinates
                or body.armature
            ):
                continue
            reported.add(body.name)
            self.check.say(
                self.names[body.name],
                f"nothing that {' and '.join(body.coordinates)} would move has mass or inertia: "
                f"give '{body.name}' a mass, or its joint an armature",
            )
