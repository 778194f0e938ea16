"""Joints of a scene's bodies: kind, parent, coordinates, axes and what there is one of for each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from eomc.scene.assembly import WORLD
from eomc.scene.formulas import Formula, nearest, suggest
from eomc.scene.joints import JOINTS, MEANT, Z
from eomc.scene.schema import BodyTable, Document, PointTable
from eomc.scene.scope import Checker, Path
from eomc.scene.validate_loops import Loops
from eomc.scene.validate_values import ZERO


class Joints(Loops):
    """Checks what holds and moves bodies."""

    def __init__(self, check: Checker, doc: Document, known: Mapping[str, float]) -> None:
        super().__init__(check, doc, known)
        self.moved_by: dict[str, str] = {}  # each coordinate: the first body that it moves

    def _entry(self, name: str) -> BodyTable | PointTable:
        array, label = self.names[name]
        entries: Mapping[str, BodyTable | PointTable] = getattr(self.doc, array)
        return entries[label]

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
        axes = [found for axis in given if (found := self._unit(path, axis))]
        if len(axes) < len(given):
            return ()
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
