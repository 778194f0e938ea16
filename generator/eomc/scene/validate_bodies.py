"""Bodies, joints, springs and dampers of a scene: layout tables to a checked Assembly. No SymPy."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping
from graphlib import TopologicalSorter
from itertools import islice
from typing import Any

from eomc.base import names
from eomc.base.errors import MOST
from eomc.scene.assembly import WORLD, Assembly, Body, Vector
from eomc.scene.schema import BodyTable, Document, PointTable
from eomc.scene.scope import Checker, Path, ring_text, rings
from eomc.scene.validate_coordinates import FRICTION_WIDTH, check_width
from eomc.scene.validate_joints import Joints
from eomc.scene.validate_values import ORIGIN, ZERO

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
    if not (doc.body or doc.point or doc.spring or doc.damper or doc.force or doc.loop):
        if doc.gravity is not None:
            check.say(
                ("gravity",),
                "acts on bodies, and there is no [[body]]: remove it, or write the weight "
                "into the potential energy",
            )
        return None
    return _Bodies(check, doc, known).assembly()


class _Bodies(Joints):
    def __init__(self, check: Checker, doc: Document, known: Mapping[str, float]) -> None:
        super().__init__(check, doc, known)
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
        self._shared()
        ordered = self._ordered()
        self._inertia_of_joints(ordered)
        springs = [self._spring(("spring", k), e) for k, e in self.doc.spring.items()]
        dampers = [self._damper(("damper", k), e) for k, e in self.doc.damper.items()]
        forces = [self._force(("force", k), e) for k, e in self.doc.force.items()]
        loops = [self._loop(("loop", k), e) for k, e in self.doc.loop.items()]
        return Assembly(
            plane=self.wide == 2,
            gravity=gravity,
            bodies=tuple(ordered),
            springs=tuple(springs),
            dampers=tuple(dampers),
            forces=tuple(forces),
            loops=tuple(loop for loop in loops if loop),
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
            check_width(check, path, value, width, entry.friction)
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

    def _shared(self) -> None:
        """Joints that move by one coordinate while another moves none: a slip."""
        taken = {*self.moved_by, *self.check.used}
        idle = [c for c in self.doc.coordinates if not {c, f"{c}_dot"} & taken]
        for body in self.bodies.values() if idle else ():
            for text in (formula.text for formula in body.coordinates):
                first = self.moved_by.get(text, body.name)
                if first != body.name:
                    self.check.say(
                        (*self.names[body.name], "coordinates"),
                        f"'{text}' moves the joint of '{first}' already, and '{idle[0]}' moves "
                        f"none; did you mean '{idle[0]}'?",
                        text=text,
                    )

    # --- the tree ---------------------------------------------------------------------------------

    def _ordered(self) -> list[Body]:
        """Parents before children, else as written; rings of parents are reported."""
        graph = {name: [b.parent] if b.joint else [] for name, b in self.bodies.items()}
        for ring in islice(rings(graph), MOST):
            place = self.names[ring[0]]
            self.check.say(
                (*place, "body" if place[0] == "point" else "parent"),
                f"the parents form a loop: {ring_text(ring)}; let one of them be held by the "
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

    def _inertia_of_joints(self, ordered: Iterable[Body]) -> None:
        """Every joint that moves needs something to move, unless energies are given besides.

        What rows hold may have no inertia, such as a massless rod that closes a loop.
        """
        ordered = list(ordered)
        rows = self.doc.loop or self.doc.constraints
        if self.doc.energy.kinetic != 0.0 or rows or any(body.position for body in ordered):
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
                self.names[body.name],
                f"nothing that {by} would move has mass or inertia: "
                f"give '{body.name}' a mass, or its joint an armature",
            )
