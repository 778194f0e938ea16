"""Checks of bodies and what acts on them: from tables to an Assembly. Independent of SymPy."""

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
from eomc.scene.scope import Checker, Path, cycle_text, find_cycles
from eomc.scene.validate_coordinates import FRICTION_WIDTH, check_width
from eomc.scene.validate_joints import JointChecker
from eomc.scene.validate_loops import LoopChecker
from eomc.scene.validate_springs import check_damper, check_force, check_spring
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
        self.bodies: dict[str, Body] = {}

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
        self.bodies[entry.name] = Body(
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

    def _sorted_bodies(self) -> list[Body]:
        """Return the bodies, parents before children, else in their order; cycles are reported."""
        graph = {name: [b.parent] if b.joint else [] for name, b in self.bodies.items()}
        for ring in islice(find_cycles(graph), MOST):
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

    def _check_inertia(self, ordered: Iterable[Body]) -> None:
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
