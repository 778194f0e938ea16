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
from eomc.scene.schema import BodyTable, Document
from eomc.scene.scope import Checker, Path, ring_text, rings
from eomc.scene.validate_springs import Springs
from eomc.scene.validate_values import ORIGIN, ZERO

FRICTION_WIDTH = formulas.parse("0.01")  # rad/s or m/s

_OF_JOINTS = (
    "parent", "coordinates", "axis", "offset", "center", "armature", "damping", "friction",
    "friction_width", "actuator",
)  # fmt: skip


def centers(doc: Document) -> set[str]:
    """The names that bodies on joints give to the position of their centres of mass."""
    letters = "xy" if doc.gravity and len(doc.gravity) == 2 else "xyz"
    return {
        f"{body.name}_{letter}"
        for body in doc.body.values()
        if body.position is None
        for letter in letters
    }


def assemble(check: Checker, doc: Document, known: Mapping[str, float]) -> Assembly | None:
    """The bodies of a scene and what acts between them; None where there is nothing of it.

    known: the values of constants and parameters. Faults are reported to `check`; with faults the
    assembly is not to be used.
    """
    if not (doc.body or doc.spring or doc.damper or doc.force):
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
        self.moved_by: dict[str, str] = {}  # each coordinate: the first body that it moves
        self.bodies: dict[str, Body] = {}

    def assembly(self) -> Assembly:
        gravity = self._gravity()
        self._names()
        labels = self.names.values()
        for label in labels:
            entry, path = self.doc.body[label], ("body", label)
            if entry.position is None:
                self._jointed(path, entry)
            else:
                self._placed(path, entry)
        self._shared()
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
        for label, entry in self.doc.body.items():
            path, name = ("body", label, "name"), entry.name
            if why := names.fault(name):
                self.check.say(path, why)
            elif name == WORLD:
                self.check.say(
                    path, "'world' is the frame that does not move: name the body otherwise"
                )
                continue
            elif name in self.names:
                self.check.say(path, f"'{name}' is the name of a body above: rename one of the two")
                continue
            self.names[name] = label
        for name in sorted(self.check.centers & {*self.check.tables}):
            body = name[:-2]
            self.check.say(
                (self.check.tables[name], name),
                f"'{name}' is where the centre of mass of body '{body}' is: use that, or choose "
                "another name",
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

    def _jointed(self, path: Path, entry: BodyTable) -> None:
        """A body held by a joint."""
        check = self.check
        joint = self._joint(path, entry)
        parent = self._parent((*path, "parent"), entry)
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

    def _parent(self, path: Path, entry: BodyTable) -> str | None:
        parent = WORLD if entry.parent is None else entry.parent
        if parent == WORLD:
            return parent
        if parent not in self.names:
            remedy = suggest(parent, [WORLD, *self.names]) or ": declare it as a [[body]]"
            self.check.say(path, f"there is no body '{parent}'{remedy}", text=parent)
        elif parent == entry.name:
            self.check.say(
                path, f"'{parent}' is its own parent: name another body, or world", text=parent
            )
        elif self.doc.body[self.names[parent]].position is not None:
            self.check.say(
                path,
                f"'{parent}' is placed by formulas, and can't be a parent: give it a joint, "
                "or place this body by formulas too",
                text=parent,
            )
        else:
            return parent
        return None

    def _coordinates(self, path: Path, joint: str, entry: BodyTable) -> tuple[Formula, ...] | None:
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
        made = [self._coordinate(path, text) for text in given]
        sound = tuple(formula for formula in made if formula)
        for name in self._moved(sound):
            self.moved_by.setdefault(name, entry.name)
        return sound if len(sound) == len(made) else None

    def _coordinate(self, path: Path, text: str) -> Formula | None:
        """A coordinate, or a formula of coordinates; None where it has a fault."""
        check, coordinates = self.check, self.doc.coordinates
        if text.isidentifier() and text not in coordinates:
            table = check.tables.get(text)
            near = suggest(text, coordinates) or ": add it to [coordinates]"
            why = f"'{text}' is not a coordinate{near}"
            if table:
                why = f"'{text}' stands in [{table}]: a joint moves by what is in [coordinates]"
            check.say(path, why, text=text)
            return None
        rule = "a joint moves by coordinates, or formulas of coordinates, parameters and constants"
        formula = check.formula(path, text, {*self.known, *coordinates}, rule)
        if formula is None:
            return None
        fault = ""
        if any(formula.calls("dot")):
            fault = f"dot(...) can't be used here: {rule}"
        elif not any(node.id in coordinates for node in formula.names()):
            fault = f"'{formula.shown}' has no coordinate in it: what does not move is 'fixed'"
        if fault:
            check.say(path, fault, text=formula.text)
            return None
        check.smooth(path, formula)
        return formula

    def _moved(self, formulas_: Iterable[Formula]) -> dict[str, None]:
        """The coordinates in formulas."""
        found = (node.id for formula in formulas_ for node in formula.names())
        return dict.fromkeys(name for name in found if name in self.doc.coordinates)

    def _shared(self) -> None:
        """Joints that move by one coordinate while another moves none: a slip."""
        taken = {*self.moved_by, *self.check.used}
        idle = [c for c in self.doc.coordinates if not {c, f"{c}_dot"} & taken]
        for body in self.bodies.values() if idle else ():
            for text in (formula.text for formula in body.coordinates):
                first = self.moved_by.get(text, body.name)
                if first != body.name:
                    self.check.say(
                        ("body", self.names[body.name], "coordinates"),
                        f"'{text}' moves the joint of '{first}' already, and '{idle[0]}' moves "
                        f"none; did you mean '{idle[0]}'?",
                        text=text,
                    )

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
            self.check.say(
                ("body", self.names[ring[0]], "parent"),
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
        heavy = [b for b in ordered if carries[b.name] or b.armature]
        resisted = self._moved(formula for body in heavy for formula in body.coordinates)
        for body in ordered:
            moved = self._moved(body.coordinates)
            if body.parent in reported or not moved or moved.keys() & resisted:
                continue
            reported.add(body.name)
            resisted |= moved  # once
            by = " and ".join(formula.text for formula in body.coordinates)
            self.check.say(
                ("body", self.names[body.name]),
                f"nothing that {by} would move has mass or inertia: "
                f"give '{body.name}' a mass, or its joint an armature",
            )
