"""Checks of [[loop]]: bodies, points, axes and names of constraint equations."""

from __future__ import annotations

from typing import Any

from eomc.base import names
from eomc.scene.assembly import WORLD, Loop, Vector
from eomc.scene.formulas import nearest, suggest
from eomc.scene.joints import CLOSING_ALIASES, CLOSINGS
from eomc.scene.schema import LoopTable
from eomc.scene.scope import Path
from eomc.scene.validate_constraints import row_name_fault
from eomc.scene.validate_values import ORIGIN, ZERO, ValueChecker

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

    def loop(self, path: Path, entry: LoopTable) -> Loop | None:
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
        loop = Loop(entry.name, kind, note=entry.note, **parts)
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

    def _check_row_names(self, path: Path, loop: Loop) -> None:
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
