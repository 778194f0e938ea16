"""Checks of the joints of bodies: kind, parent, coordinates, axes and values per coordinate."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from eomc.scene.assembly import WORLD
from eomc.scene.formulas import Formula, nearest, suggest
from eomc.scene.joints import JOINT_ALIASES, JOINTS, Z
from eomc.scene.schema import BodyTable, PointTable
from eomc.scene.scope import Path
from eomc.scene.validate_values import ZERO, ValueChecker


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
