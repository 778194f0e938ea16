"""Checks of the tables [coordinates], [constraints], [[event]] and [picture] of a scene.

Each function checks the entries of one table and yields them as checked data. Independent of SymPy.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from eomc.base import names, texts
from eomc.scene import formulas, messages
from eomc.scene.assembly import WORLD, Assembly, Turn, Vector
from eomc.scene.formulas import Formula, FormulaError, suggest
from eomc.scene.scene import (
    Picture,
    PicturePlace,
    SceneConstraint,
    SceneCoordinate,
    SceneEvent,
    Shape,
)
from eomc.scene.schema import BodyTable, Document, EventTable
from eomc.scene.schema import Place as Written
from eomc.scene.scope import INPUT, VELOCITY, Checker, Path
from eomc.scene.validate_values import ORIGIN, ZERO

SUSPICIOUS_ANGLE = 7.0  # rad, more than one turn
FRICTION_WIDTH = formulas.parse("0.01")  # rad/s or m/s


def check_coordinates(
    check: Checker, doc: Document, known: Mapping[str, float]
) -> Iterator[SceneCoordinate]:
    """Check the table [coordinates] of a document and yield its coordinates.

    known: values of constants and parameters by name. Errors are reported to `check`; faulty
    entries may be left out.
    """

    def formula(name: str, key: str, value: float | str) -> tuple[Formula | None, float]:
        path = ("coordinates", name, key)
        rule = f"a {key} is made of numbers, constants and parameters"
        checked = check.formula(path, value, known, rule)
        return checked, check.number(path, checked, known)

    free = not (doc.constraints or doc.loop)
    for name, entry in doc.coordinates.items():
        start, rate = (formula(name, key, getattr(entry, key))[0] for key in ("start", "rate"))
        if entry.unit == "rad" and isinstance(entry.start, (int, float)):
            check_turns(check, ("coordinates", name, "start"), entry.start)
        fixed_keys = () if entry.guess else entry.model_fields_set
        is_fixed, is_rate_fixed = (free or key in fixed_keys for key in ("start", "rate"))
        friction, width = None, FRICTION_WIDTH
        if entry.friction is not None:
            friction, value = formula(name, "friction", entry.friction)
            if friction and value < 0:
                path = ("coordinates", name, "friction")
                check.report(path, f"is {value:g}, and can't be negative", text=friction.text)
        if entry.friction_width is not None:
            checked, value = formula(name, "friction_width", entry.friction_width)
            width = checked or FRICTION_WIDTH
            check_width(check, ("coordinates", name), value, checked, entry.friction)
        if start and rate:
            yield SceneCoordinate(
                name, entry.unit, start, rate, entry.note, is_fixed, is_rate_fixed, friction, width
            )


def check_turns(check: Checker, path: tuple[str, ...], angle: float) -> None:
    """Report a warning if an angle in rad is larger than one turn, since degrees may be meant.

    path: keys of the entry in the scene.
    """
    if SUSPICIOUS_ANGLE <= abs(angle) < math.inf:
        message = (
            f"{angle:.6g} rad are {abs(angle) / math.tau:.3g} turns; for degrees write "
            f"{messages.degrees_formula(f'{angle:.15g}')}"
        )
        check.report(path, message, severity="warning")


def check_width(
    check: Checker, path: tuple[str, ...], value: float, width: Formula | None, friction: object
) -> None:
    """Report an error if the entry `friction_width` is not positive or has no `friction` with it.

    The width is the velocity within which Coulomb friction is smoothed. path: keys of the
    coordinate or body. value: value of the width in rad/s or m/s. width: formula of the width.
    friction: the entry `friction`, None if it is missing.
    """
    path = (*path, "friction_width")
    if value <= 0:
        check.report(
            path,
            f"is {value:g}, and must be greater than zero: the rate within which friction is "
            "smoothed",
            text=width.text if width else None,
        )
    if friction is None:
        check.report(path, "there is no 'friction' with it: add it")


# --- constraints ----------------------------------------------------------------------------------

_MULTIPLIER = r"lambda(_\w+)?|(\w+_)?(multiplier|reaction)s?"


def check_constraints(check: Checker, doc: Document) -> Iterator[SceneConstraint]:
    """Check the table [constraints] of a document and yield its constraint equations.

    Errors are reported to `check`; faulty entries may be left out.
    """
    for name, entry in doc.constraints.items():
        if why := row_name_fault(check, doc, name):
            end = "" if names.fault(name) else ": give the constraint a name of its own"
            check.report(("constraints", name), why + end)
        path = ("constraints", name, "formula")
        if isinstance(entry.formula, str) and (why := _equation_remedy(entry.formula)):
            check.report(path, why, text=entry.formula)
            continue
        formula = check.formula(path, entry.formula)
        if formula is None or path in check.repaired:  # reported already
            continue
        if INPUT in check.kinds_of(formula.tree):
            check.report(
                path,
                "a constraint can't depend on inputs, whose rates nobody knows: let them act "
                "through [forces], or write the motion wanted as a function of t",
                check.find_part(formula, INPUT),
                formula.text,
            )
        check.check_smooth(path, formula)
        yield SceneConstraint(name, entry.unit, formula, entry.note)


def _equation_remedy(text: str) -> str:
    """Return what to write in place of an equation; "" if the text is not an equation."""
    sides = [side.strip() for side in text.replace("==", "=").split("=")]
    if len(sides) != 2 or not all(sides):
        return ""
    left, right = sides
    if right == "0":
        return f"a constraint is what is zero, without '= 0': write {left}"
    right = right if re.fullmatch(r"[\w.*/()]+", right) else f"({right})"
    return f"a constraint is what is zero: write {left} - {right}"


def row_name_fault(check: Checker, doc: Document, name: str) -> str:
    """Return the reason why a constraint equation can't be called `name`, or "" if it can.

    A name is refused if it is not valid or if the scene uses it already.
    """
    taken = {n: f"stands in [{table}]" for n, table in check.tables.items()}
    taken |= dict.fromkeys(doc.outputs, "stands in [outputs]")
    taken |= {f"{c}_dot": f"is the velocity of '{c}'" for c in doc.coordinates}
    taken |= {f"{c}_ddot": f"is the acceleration of '{c}'" for c in doc.coordinates}
    taken |= dict.fromkeys(check.centers - {*check.tables}, "is where a body or point is")
    taken |= {"energy": "is K + P"}
    if why := names.fault(name):
        return why
    return f"'{name}' {taken[name]} already" if name in taken else ""


def force_names(doc: Document, assembly: Assembly | None) -> list[str]:
    """Return the names by which outputs refer to constraint forces.

    They are the Lagrange multipliers, such as lambda_rod, also those of friction that sticks, and
    the components of the reactions of loops, such as hinge_force_x.
    """
    plane, loops = (assembly.plane, assembly.loops) if assembly else (True, ())
    rows = [*doc.constraints, *(row for loop in loops for row in loop.rows(plane).values())]
    if doc.run.friction == "stick":
        with_friction = {
            n for b in doc.body.values() if b.friction is not None for n in _coordinates_of(b)
        }
        with_friction |= {name for name, c in doc.coordinates.items() if c.friction is not None}
        rows += [f"{name}_sticks" for name in doc.coordinates if name in with_friction]
    reactions = [name for loop in loops for name in loop.reactions(plane)]
    return [*(f"lambda_{row}" for row in rows), *reactions]


def _coordinates_of(body: BodyTable) -> tuple[str, ...]:
    return body.coordinates or ()


def reports_unknown_multiplier(
    check: Checker, doc: Document, path: Path, text: float | str, known: Sequence[str]
) -> bool:
    """Check that the formula of an output calls multipliers and reactions by known names.

    path: keys of the output in the scene. text: its formula. known: the names of all multipliers
    and reactions. Returns True, after reporting an error, if the formula uses another name for one.
    """
    rows = {name.removeprefix("lambda_") for name in known}
    rows |= {entry.name for entry in doc.loop.values()}
    if not rows or not isinstance(text, str):
        return False
    for word in re.finditer(r"(?<![\w.])[A-Za-z_]\w*", text):
        named = word[0] in rows or re.fullmatch(_MULTIPLIER, word[0])
        if named and word[0] not in check.kinds:
            matching = [name for name in known if word[0] in rows and word[0] in name]
            message = (
                f"'{word[0]}' can't be used here: multipliers and reactions are called "
                f"{texts.listed(matching or known, 6)}"
            )
            check.report(path, message, FormulaError(message, word.start(), len(word[0])), text)
            return True
    return False


def check_guesses(check: Checker, doc: Document) -> None:
    """Report a warning for each key `guess` in a scene without constraint equations.

    There it has no effect: it marks initial values that may be changed to satisfy constraints.
    """
    if not (doc.constraints or doc.loop):
        for name, entry in doc.coordinates.items():
            if entry.guess:
                check.report(
                    ("coordinates", name, "guess"),
                    "changes nothing: a guess is what [constraints] or a [[loop]] may move, and "
                    "there are none",
                    severity="warning",
                )


# --- events ---------------------------------------------------------------------------------------

COMPARISON = re.compile(r"\s*([^<>=!]+?)\s*(?:[<>]=?|==)\s*([^<>=!]+?)\s*")
INPUT_REMEDY = ": write '{name}*on' where it acts, with a parameter on = 1, and set that to 0"
CONSTANT_REMEDY = ", and does not change in a run: make it a parameter"


def check_events(check: Checker, doc: Document) -> Iterator[SceneEvent]:
    """Check the [[event]] tables of a document and yield the events.

    Errors are reported to `check`; faulty entries may be left out.
    """
    names_so_far: set[str] = set()
    for k, entry in doc.event.items():
        if why := names.fault(entry.name):
            check.report(("event", k, "name"), why, text=entry.name)
        elif entry.name in names_so_far:
            why = f"'{entry.name}' is an event already: rename one of the two"
            check.report(("event", k, "name"), why, text=entry.name)
        names_so_far.add(entry.name)
        path = ("event", k, "when")
        if path in check.repaired:  # reported already
            continue
        if isinstance(entry.when, str) and (match := COMPARISON.fullmatch(entry.when)):
            less = match[2] if re.fullmatch(r"[\w.]+", match[2]) else f"({match[2]})"
            check.report(
                path, f'it happens where a formula crosses zero: write "{match[1]} - {less}"'
            )
            continue
        when = check.formula(path, entry.when)
        jump = tuple(_jump(check, doc, k, entry))
        if when and not any(when.names()):
            check.report(
                ("event", k, "when"), "never crosses zero: it has no names", text=when.text
            )
        elif when:
            yield SceneEvent(entry.name, when, entry.direction, entry.action, jump, entry.note)


def _jump(
    check: Checker, doc: Document, k: str, entry: EventTable
) -> Iterator[tuple[str, Formula]]:
    """Yield (name, formula) for each coordinate, velocity or parameter that a jump sets."""
    state = [name for c in doc.coordinates for name in (c, f"{c}_dot")]
    state += doc.parameters
    assignments = entry.model_extra or {}
    for name, value in assignments.items():
        path = ("event", k, name)
        if name not in state:
            remedy = suggest(name, [*state, *EventTable.model_fields])
            if name in doc.inputs:
                remedy = INPUT_REMEDY.format(name=name)
            elif name in doc.constants:
                remedy = CONSTANT_REMEDY
            remedy = remedy or f": a jump sets {texts.listed(state, 9)}"
            check.report(path, f"'{name}' is no coordinate, velocity or parameter{remedy}")
        elif isinstance(value, bool) or not isinstance(value, (int, float, str)):
            check.report(path, "must be a number or a formula in quotes")
        elif formula := check.formula(path, float(value) if isinstance(value, int) else value):
            yield name, formula
    if entry.action == "jump" and not assignments:
        check.report(("event", k, "action"), f'a jump sets something: add {state[1]} = "..."')
    first = next((name for name in assignments if name in state), "")
    if first and entry.action != "jump":
        check.report(("event", k, first), f"only a jump sets '{first}': add action = \"jump\"")


# --- picture --------------------------------------------------------------------------------------

_SIMPLE = (("dots", "dot"), ("lines", "line"), ("springs", "spring"), ("paths", "path"))


def check_picture(check: Checker, doc: Document, known: Mapping[str, float]) -> Picture | None:
    """Check the table [picture] of a scene and return the picture, or None if there is no table.

    known: values of constants and parameters by name. Errors are reported to `check`.
    """
    return _Picture(check, doc, known).checked() if doc.picture else None


class _Picture:
    def __init__(self, check: Checker, doc: Document, known: Mapping[str, float]) -> None:
        assert doc.picture is not None
        self.check, self.known, self.table = check, known, doc.picture
        self.bodies = [e.name for table in (doc.body, doc.point) for e in table.values()]
        dimension = len(doc.gravity) if doc.body and doc.gravity else 0
        self.dimension = (
            dimension if dimension in (2, 3) else 0
        )  # 0: not known before the first vector
        self.points: dict[str, Vector] = {}

    def checked(self) -> Picture:
        """Check the table [picture] and return the picture; errors are reported to `check`."""
        for name, at in self.table.points.items():
            self._declare(name, at)
        shapes = [*self._simple(), *self._solids()]
        if not shapes and not self.check.faults:
            self.check.report(
                ("picture",),
                "draws nothing: add dots, lines, springs, boxes, circles or paths, "
                'such as lines = [["cart", "tip"]]',
            )
        axes = "xyz" if self.dimension == 3 else self.table.axes or "xy"
        if self.table.axes and self.dimension == 3:
            self.check.report(("picture", "axes"), "is for pictures in the plane: remove it")
        return Picture(tuple(shapes), axes)

    def _declare(self, name: str, at: tuple[float | str, ...]) -> None:
        path = ("picture", "points", name)
        if why := names.fault(name):
            self.check.report(path, why)
        elif name == WORLD or name in self.bodies:
            what = "the frame that does not move" if name == WORLD else "a body or point already"
            self.check.report(path, f"'{name}' is {what}: name the point otherwise")
        self.points[name] = self._vector(path, at)

    def _simple(self) -> Iterator[Shape]:
        for key, kind in _SIMPLE:
            for entry in getattr(self.table, key):
                many = entry if key in ("lines", "springs") else (entry,)
                places = tuple(self._place(("picture", key), written) for written in many)
                yield Shape(kind, places)

    def _solids(self) -> Iterator[Shape]:
        for key, kind in (("boxes", "box"), ("circles", "circle")):
            path = ("picture", key)
            for at, size, rotation in getattr(self.table, key):
                place = self._place(path, at)
                if kind == "box" and self.dimension and len(size) != self.dimension:
                    where = "in the plane" if self.dimension == 2 else "in space"
                    words = "two edges" if self.dimension == 2 else "three edges"
                    self.check.report(path, f"a box {where} has {words}, here {len(size)}")
                large = tuple(self._size(path, entry) for entry in size)
                yield Shape(kind, (place,), large, self._rotation(path, rotation))

    def _place(self, path: Path, written: Written) -> PicturePlace:
        if not isinstance(written, str):
            return PicturePlace("", self._vector(path, written))
        if written in self.points:
            return PicturePlace(written, self.points[written])
        if written == WORLD or written in self.bodies:
            return PicturePlace(written, None)
        known = [*self.points, *self.bodies]
        near = suggest(written, known)
        remedy = near or ': add it to [picture.points], such as tip = ["x", "l*cos(theta)"]'
        self.check.report(path, f"'{written}' is no point{remedy}", text=written)
        return PicturePlace(written, ORIGIN)

    def _vector(self, path: Path, entries: tuple[float | str, ...]) -> Vector:
        self.dimension = self.dimension or (len(entries) if len(entries) in (2, 3) else 0)
        if len(entries) != self.dimension:
            words = {2: "two entries, as the others here", 3: "three entries, as the others here"}
            count_text = words.get(self.dimension, "two entries in the plane and three in space")
            self.check.report(path, f"a point has {count_text}, not {len(entries)}")
            return ORIGIN
        checked = [self._formula(path, entry) for entry in entries]
        x, y, z = (*checked, ZERO)[:3]
        return x, y, z

    def _formula(self, path: Path, value: float | str) -> Formula:
        """Return a checked formula, which may use all names except inputs and velocities."""
        check = self.check
        formula = check.formula(path, value)
        if formula is None:
            return ZERO
        kinds = check.kinds_of(formula.tree)
        for kind in (INPUT, VELOCITY):
            if kind in kinds:
                why = f"a picture can't depend on {kind}: it shows where things are"
                check.report(path, why, check.find_part(formula, kind), formula.text)
        return formula

    def _size(self, path: Path, value: float | str) -> Formula:
        """Return a checked length, a formula of parameters that is not negative."""
        rule = "a size is made of numbers, constants and parameters"
        formula = self.check.formula(path, value, self.known, rule)
        if self.check.number(path, formula, self.known) < 0:
            self.check.report(path, "a size is not negative", text=formula.text if formula else "")
        return formula or ZERO

    def _rotation(self, path: Path, rotation: Any) -> tuple[Turn, ...]:
        if rotation is None:
            return ()
        if not isinstance(rotation, tuple):
            if self.dimension == 3:
                why = 'in space a rotation names its axis: write [["z", "pi/2"]], or more turns'
                self.check.report(path, why)
            return (Turn("z", self._formula(path, rotation)),)
        if self.dimension == 2 and any(axis != "z" for axis, _ in rotation):
            self.check.report(path, "in the plane a rotation is an angle: write it alone")
        return tuple(Turn(axis, self._formula(path, angle)) for axis, angle in rotation)
