"""Checks of the values of a scene, and of its tables except those of bodies.

`ValueChecker` checks formulas, vectors, rotations and inertias. Each function below checks the
entries of [coordinates], [constraints], [[event]] or [picture]. Independent of SymPy.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from mpmath import mp

from eomc.base import spatial, texts
from eomc.scene import formulas, hints, schema
from eomc.scene.formulas import Formula, FormulaError, Value, nearest, suggest
from eomc.scene.joints import Axis, Closing, Joint
from eomc.scene.scene import (
    WORLD,
    Assembly,
    NamedFormula,
    Picture,
    PicturePlace,
    SceneCoordinate,
    SceneEvent,
    Shape,
    Turn,
    Vector,
)
from eomc.scene.schema import BodyTable, Document, EventTable
from eomc.scene.scope import INPUT, VELOCITY, Checker, Path
from eomc.scene.toml_text import SourceMap
from eomc.scene.value_types import Place as Written

WORLD_TAKEN = {WORLD: "is the frame that does not move"}
MOMENT_TOLERANCE = 1e-6  # relative: files give moments of inertia to six digits and more

ZERO = formulas.parse("0")
ORIGIN: Vector = (ZERO, ZERO, ZERO)


class ValueChecker(Checker):
    """Checker of a scene that also checks vectors, rotations, masses and inertias.

    doc: the whole scene. known: values of constants and parameters by name, so far. body_paths: the
    place of each body and point by its name. dimension: number of components of a vector, 2 or 3;
    None if it is unknown.
    """

    def __init__(self, places: SourceMap) -> None:
        super().__init__(places)
        self.doc: Document = Document()
        self.known: dict[str, float] = {}
        self.body_paths: dict[str, Path] = {}
        self.dimension: int | None = 2
        self.checked: dict[Value, tuple[Formula, float]] = {}  # valid formulas by their text
        self.has_inertia: dict[str, bool] = {}

    def value(self, path: Path, value: Value, nonnegative: bool = False) -> tuple[Formula, float]:
        """Check an entry that may use constants and parameters; return its formula and its value.

        value: the entry, a number or the text of a formula. nonnegative: True if it must not be
        negative. The returned value is that for the scene's parameters. After an error, report it
        and return (formula of 0, nan).
        """
        if value not in self.checked:
            rule = f"'{path[-1]}' is made of numbers, constants and parameters"
            formula = self.formula(path, value, self.known, rule)
            number = self.number(path, formula, self.known)
            if formula is None or math.isnan(number):
                return ZERO, math.nan
            self.checked[value] = formula, number
        formula, number = self.checked[value]
        if nonnegative and number < 0:
            self.report(path, f"is {number:g}, and can't be negative", text=formula.text)
        return formula, number

    def parameter_formula(self, path: Path, value: Value) -> Formula:
        """Check an entry that may use constants and parameters, and return its formula.

        value: a number or the text of a formula. After an error, report it and return the formula
        of 0.
        """
        return self.value(path, value)[0]

    def position_formula(self, path: Path, value: Value) -> Formula:
        """Check a formula of a position or angle, and return it.

        It must not depend on inputs or velocities, and not contain dot(...). value: a number or the
        text of the formula. Errors are reported; if the formula can't be parsed, return 0.
        """
        formula = self.formula(path, value)
        if formula is None:
            return ZERO
        no_inputs = (
            f"'{path[-1]}' can't depend on inputs, whose rates nobody knows: "
            "let them act through an actuator or [forces]"
        )
        no_velocities = (
            f"'{path[-1]}' can't depend on velocities: it is made of coordinates, "
            "t, parameters, constants and definitions of these"
        )
        if not self.depends_on(path, formula, INPUT, no_inputs):
            if not self.depends_on(path, formula, VELOCITY, no_velocities):
                if any(formula.calls("dot")):
                    self.report(path, no_velocities, text=formula.text)
        self.check_smooth(path, formula)
        return formula

    def vector(
        self,
        path: Path,
        entries: Sequence[Value] | None,
        formula: Callable[[Path, Value], Formula] | None = None,
    ) -> Vector:
        """Check a vector and return its three components; in a plane scene, the third is 0.

        entries: two or three numbers or formulas; None for a vector of zeros. formula: the method
        that checks each entry, by default `parameter_formula`. Errors are reported.
        """
        if entries is None or not self.fits(path, len(entries)):
            return ORIGIN
        checked = [(formula or self.parameter_formula)(path, entry) for entry in entries]
        x, y, z = (*checked, ZERO, ZERO, ZERO)[:3]
        return x, y, z

    def fits(self, path: Path, entries: int) -> bool:
        """Return True if a vector with this number of entries fits the dimension of the scene.

        Vectors have two entries in a plane scene and three in space. Otherwise, report the error.
        """
        if entries == self.dimension:
            return True
        as_others = "as gravity has" if self.doc.gravity else "as the others here"
        words = {
            2: f"two entries in a plane scene, {as_others}",
            3: f"three entries in space, {as_others}",
            None: "two entries in the plane and three in space",
        }
        if self.dimension or not self.doc.body:
            self.report(path, f"vectors have {words[self.dimension]}, here {entries}")
        return False

    def unit(self, path: Path, axis: Sequence[float]) -> tuple[float, float, float] | None:
        """Return an axis as a unit vector of three components.

        axis: two numbers in a plane scene, three in space. After an error, report it and return
        None.
        """
        if not self.fits(path, len(axis)):
            return None
        size = math.hypot(*axis)
        if size < 1e-9:
            self.report(path, "the axis has no length, so no direction: give it one")
            return None
        x, y, *third = (entry / size for entry in axis)
        return x, y, third[0] if third else 0.0

    def kind(
        self, path: Path, joint: str, kinds: Mapping[str, Joint] | Mapping[str, Closing], what: str
    ) -> str:
        """Return a kind of joint if the scene can have it; else report why not, and return "".

        path: keys of the table in the scene. joint: the kind that it names. kinds: all kinds. what:
        what such a joint does, for a message.
        """
        known = [k for k, kind in kinds.items() if kind.plane or self.dimension != 2]
        if joint in known:
            return joint
        if joint in kinds:
            why = (
                f"a {joint} joint {what} in space, and gravity has two entries, so the scene is "
                f"plane: give gravity a third, or use {', '.join(known)}"
            )
        else:
            aliases = {other: k for k, kind in kinds.items() for other in kind.aliases}
            near = aliases.get(joint.lower(), "") or nearest(joint, kinds)
            remedy = (
                f"; did you mean '{near}'?" if near in known else f": known are {', '.join(known)}"
            )
            why = f"there is no joint '{joint}' that {what}{remedy}"
        self.report((*path, "joint"), why, text=joint)
        return ""

    def axes(
        self,
        path: Path,
        kind: str,
        written: Sequence[Sequence[float]] | None,
        counts: Mapping[int, str],
        defaults: tuple[Axis, ...],
    ) -> tuple[Axis, ...]:
        """Check the axes of a joint and return them as unit vectors. Errors are reported.

        kind: kind of the joint. written: its axes in the scene; None for the defaults. counts: the
        numbers of axes that it can have, each in words; empty if it has none. defaults: its axes
        if none are given; empty if they must be.
        """
        if path in self.repaired or self.dimension is None:
            return ()
        if written is None and (defaults or not counts):
            return defaults
        if written is None:
            example = "[1, 0]" if self.dimension == 2 else "[1, 0, 0]"
            fault = f"missing: a {kind} joint slides along {counts[1]}: axis = {example}"
        elif not counts and kind == "revolute":
            fault = "in a plane scene joints turn about z: remove it"
        elif not counts:
            fault = f"a {kind} joint has no axis to choose: remove it"
        elif len(written) not in counts:
            fault = f"a {kind} joint has {' or '.join(counts.values())}, here {len(written)}"
        else:
            axes = [unit for axis in written if (unit := self.unit(path, axis))]
            return tuple(axes) if len(axes) == len(written) else ()
        self.report(path, fault)
        return ()

    def is_coordinate(self, path: Path, name: str) -> bool:
        """Return True if `name` is a coordinate; else report that it is not."""
        coordinates = self.doc.coordinates
        if name in coordinates:
            return True
        remedy = suggest(name, coordinates) or f": known are {', '.join([*coordinates][:9])}"
        if table := self.tables.get(name):
            remedy = f": it stands in [{table}]"
        self.report(path, f"'{name}' is not a coordinate{remedy}", text=name)
        return False

    def is_body(self, path: Path, name: str) -> bool:
        """Return True if `name` is a body, a point or the world; else report that it is not."""
        if name == WORLD or name in self.body_paths:
            return True
        remedy = suggest(name, [WORLD, *self.body_paths]) or ": declare it as a [[body]]"
        self.report(path, f"there is no body '{name}'{remedy}", text=name)
        return False

    def two_bodies(self, path: Path, bodies: tuple[str, ...], kind: str) -> tuple[str, str]:
        """Check that the two bodies named by an entry exist and differ, and return their names.

        One of them may be "world". kind: the beginning of a message, such as "a spring acts".
        Errors are reported.
        """
        first, second = bodies
        for name in bodies:
            self.is_body(path, name)
        if first == second:
            self.report(path, f"{kind} between two bodies, here both are '{first}'")
        return first, second

    def rotation(
        self,
        path: Path,
        rotation: Any,
        formula: Callable[[Path, Value], Formula] | None = None,
    ) -> tuple[Turn, ...]:
        """Check a rotation and return its successive turns, each about an axis.

        rotation: an angle about z in a plane scene, or a tuple of pairs (axis, angle), or None for
        no rotation. formula: the method that checks an angle, by default `parameter_formula`.
        Errors are reported.
        """
        formula = formula or self.parameter_formula
        if rotation is None:
            return ()
        if not isinstance(rotation, tuple):
            if self.dimension == 3:
                self.report(
                    path, 'in space a rotation names its axis: write [["z", "pi/2"]], or more turns'
                )
            return (Turn("z", formula(path, rotation)),)
        for axis, _ in rotation:
            if axis != "z" and self.dimension == 2:
                self.report(path, f"a plane scene turns about z only, here about {axis}")
                break
        return tuple(Turn(axis, formula(path, angle)) for axis, angle in rotation)

    def mass(self, path: Path, entry: BodyTable) -> tuple[Formula, Any]:
        """Check the mass and the inertia of a body, and return their formulas.

        path: keys of the body in the scene. The inertia has the six components Ixx, Iyy, Izz, Ixy,
        Ixz, Iyz in kg m^2; those that are not given are 0. Errors are reported.
        """
        mass, value = self.value((*path, "mass"), entry.mass, nonnegative=True)
        inertia, moments = self._inertia((*path, "inertia"), entry.inertia)
        self.has_inertia[entry.name] = value != 0 or any(m != 0 for m in moments)
        return mass, inertia

    def _inertia(self, path: Path, inertia: Any) -> tuple[tuple[Formula, ...], list[float]]:
        nothing = (ZERO,) * 6
        if inertia is None or self.dimension is None:
            return nothing, [math.nan] if self.dimension is None else [0.0]
        single = not isinstance(inertia, tuple)
        entries = (inertia,) if single else inertia
        if self.dimension == 2 and not single:
            self.report(path, "a plane scene has one number for it, about z: write it alone")
            return nothing, [math.nan]
        if self.dimension == 3 and (single or len(entries) not in (3, 6)):
            here = "one number" if single else str(len(entries))
            self.report(
                path,
                "in space it has three entries, [Ixx, Iyy, Izz], or six, "
                f"[Ixx, Iyy, Izz, Ixy, Ixz, Iyz], here {here}",
            )
            return nothing, [math.nan]
        checked = [self.value(path, entry, nonnegative=self.dimension == 2) for entry in entries]
        moments, numbers = [f for f, _ in checked], [v for _, v in checked]
        if self.dimension == 2:
            return (ZERO, ZERO, moments[0], ZERO, ZERO, ZERO), numbers
        self._moments(path, [*numbers, 0.0, 0.0, 0.0][:6])
        return (*moments, ZERO, ZERO, ZERO)[:6], numbers

    def _moments(self, path: Path, inertia: Sequence[float]) -> None:
        """Report principal moments that no body can have.

        They are impossible if one is negative, or larger than the sum of the two others.
        """
        if not all(abs(x) < 1e150 for x in inertia):
            return
        tensor = mp.matrix(spatial.tensor(inertia))  # NumPy takes 0.1 s to load
        small, middle, large = sorted(map(float, mp.eigsy(tensor, eigvals_only=True)))
        tolerance = MOMENT_TOLERANCE * max(abs(small), abs(large))
        shown = f"{small:.4g}, {middle:.4g} and {large:.4g} kg m^2"
        if small < -tolerance:
            self.report(
                path,
                f"its principal moments are {shown}, and none can be negative: "
                "check signs and order, [Ixx, Iyy, Izz, Ixy, Ixz, Iyz]",
            )
        elif large > small + middle + tolerance:
            self.report(
                path,
                f"its principal moments are {shown}, and one is larger than the two others "
                "together, which no body has: check it, about the centre of mass",
            )


# --- coordinates ----------------------------------------------------------------------------------

SUSPICIOUS_ANGLE = 7.0  # rad, more than one turn
FRICTION_WIDTH = formulas.parse(schema.FRICTION_WIDTH)


def check_coordinates(check: ValueChecker) -> Iterator[SceneCoordinate]:
    """Check the table [coordinates] of a document and yield its coordinates.

    Errors are reported to `check`.
    """
    free = not (check.doc.constraints or check.doc.loop)
    for name, entry in check.doc.coordinates.items():
        path = ("coordinates", name)
        start = check.parameter_formula((*path, "start"), entry.start)
        rate = check.parameter_formula((*path, "rate"), entry.rate)
        if entry.unit == "rad" and isinstance(entry.start, (int, float)):
            check_turns(check, (*path, "start"), entry.start)
        fixed_keys = () if entry.guess else entry.written
        is_fixed, is_rate_fixed = (free or key in fixed_keys for key in ("start", "rate"))
        friction, width = None, FRICTION_WIDTH
        if entry.friction is not None:
            friction, _ = check.value((*path, "friction"), entry.friction, nonnegative=True)
        if entry.friction_width is not None:
            width = check_width(check, path, entry.friction_width, entry.friction)
        yield SceneCoordinate(
            name, entry.unit, start, rate, entry.note, is_fixed, is_rate_fixed, friction, width
        )


def check_turns(check: ValueChecker, path: tuple[str, ...], angle: float) -> None:
    """Report a warning if an angle in rad is larger than one turn, since degrees may be meant.

    path: keys of the entry in the scene.
    """
    if SUSPICIOUS_ANGLE <= abs(angle) < math.inf:
        message = (
            f"{angle:.6g} rad are {abs(angle) / math.tau:.3g} turns; for degrees write "
            f"{hints.degrees_formula(f'{angle:.15g}')}"
        )
        check.report(path, message, severity="warning")


def check_width(
    check: ValueChecker, path: tuple[str, ...], written: Value, friction: object
) -> Formula:
    """Check the entry `friction_width` of a coordinate or body, and return its formula.

    The width is the velocity within which Coulomb friction is smoothed, in rad/s or m/s. path: keys
    of the coordinate or body. written: the entry. friction: the entry `friction`, None if it is
    missing. Errors are reported.
    """
    path = (*path, "friction_width")
    width, value = check.value(path, written)
    if value <= 0:
        why = "must be greater than zero: the rate within which friction is smoothed"
        check.report(path, f"is {value:g}, and {why}", text=width.text)
    if friction is None:
        check.report(path, "there is no 'friction' with it: add it")
    return width


# --- constraints ----------------------------------------------------------------------------------

_MULTIPLIER = r"lambda(_\w+)?|(\w+_)?(multiplier|reaction)s?"


def check_constraints(check: ValueChecker) -> Iterator[NamedFormula]:
    """Check the table [constraints] of a document and yield its constraint equations.

    Errors are reported to `check`; faulty entries may be left out.
    """
    taken = names_taken_from_rows(check)
    for name, entry in check.doc.constraints.items():
        check.claim(("constraints", name), name, taken, "stands in [constraints] already")
        path = ("constraints", name, "formula")
        text = str(entry.formula)
        if (formula_text := hints.difference(text)) and not re.search("[<>]", text):
            why = f"a constraint is what is zero: write {formula_text}"
            check.report(path, why, text=text)
            continue
        formula = check.formula(path, entry.formula)
        if formula is None or path in check.repaired:  # reported already
            continue
        why = (
            "a constraint can't depend on inputs, whose rates nobody knows: let them act "
            "through [forces], or write the motion wanted as a function of t"
        )
        check.depends_on(path, formula, INPUT, why)
        check.check_smooth(path, formula)
        yield NamedFormula(name, entry.unit, formula, entry.note)


def names_in_use(doc: Document, tables: Mapping[str, str]) -> dict[str, str]:
    """Return a dict from names to words on what has them, such as "is the velocity of 'x'".

    tables: the table in which each name is declared.
    """
    taken = {name: f"stands in [{table}] already" for name, table in tables.items()}
    taken |= {f"{c}_dot": f"is the velocity of '{c}'" for c in doc.coordinates}
    return {**taken, "t": "is the time", "energy": "is K + P"}


def names_taken_from_rows(check: ValueChecker) -> dict[str, str]:
    """Return the names that no constraint equation can have, as `names_in_use` does."""
    taken = names_in_use(check.doc, check.tables)
    taken |= dict.fromkeys(check.doc.outputs, "stands in [outputs] already")
    taken |= {f"{c}_ddot": f"is the acceleration of '{c}'" for c in check.doc.coordinates}
    return taken | dict.fromkeys(check.centers - {*check.tables}, "is where a body or point is")


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
    check: ValueChecker, path: Path, text: Value, known: Sequence[str]
) -> bool:
    """Check that the formula of an output calls multipliers and reactions by known names.

    path: keys of the output in the scene. text: its formula. known: the names of all multipliers
    and reactions. Returns True, after reporting an error, if the formula uses another name for one.
    """
    rows = {name.removeprefix("lambda_") for name in known}
    rows |= {entry.name for entry in check.doc.loop.values()}
    if not rows:
        return False
    for word in re.finditer(r"(?<![\w.])[A-Za-z_]\w*", text := str(text)):
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


def check_guesses(check: ValueChecker) -> None:
    """Report a warning for each key `guess` in a scene without constraint equations.

    There it has no effect: it marks initial values that may be changed to satisfy constraints.
    """
    if not (check.doc.constraints or check.doc.loop):
        for name, entry in check.doc.coordinates.items():
            if entry.guess:
                check.report(
                    ("coordinates", name, "guess"),
                    "changes nothing: a guess is what [constraints] or a [[loop]] may move, and "
                    "there are none",
                    severity="warning",
                )


# --- events ---------------------------------------------------------------------------------------


def check_events(check: ValueChecker) -> Iterator[SceneEvent]:
    """Check the [[event]] tables of a document and yield the events.

    Errors are reported to `check`; faulty entries may be left out.
    """
    taken: dict[str, str] = {}
    for k, entry in check.doc.event.items():
        check.claim(("event", k, "name"), entry.name, taken, "is an event already")
        path = ("event", k, "when")
        if path in check.repaired:  # reported already
            continue
        if formula_text := hints.difference(str(entry.when)):
            why = f'it happens where a formula crosses zero: write "{formula_text}"'
            check.report(path, why)
            continue
        when = check.formula(path, entry.when)
        jump = tuple(_jump(check, k, entry))
        if when and not any(when.names()):
            check.report(
                ("event", k, "when"), "never crosses zero: it has no names", text=when.text
            )
        elif when:
            yield SceneEvent(entry.name, when, entry.direction, entry.action, jump, entry.note)


def _jump(check: ValueChecker, k: str, entry: EventTable) -> Iterator[tuple[str, Formula]]:
    """Yield (name, formula) for each coordinate, velocity or parameter that a jump sets."""
    state = [name for c in check.doc.coordinates for name in (c, f"{c}_dot")]
    state += check.doc.parameters
    for name, value in entry.jump.items():
        path = ("event", k, name)
        if name not in state:
            remedy = suggest(name, [*state, *schema.keys(EventTable)])
            if name in check.doc.inputs:
                remedy = hints.SWITCH_OFF.format(name=name)
            elif name in check.doc.constants:
                remedy = hints.MAKE_PARAMETER
            remedy = remedy or f": a jump sets {texts.listed(state, 9)}"
            check.report(path, f"'{name}' is no coordinate, velocity or parameter{remedy}")
        elif formula := check.formula(path, value):
            yield name, formula
    if entry.action == "jump" and not entry.jump:
        check.report(("event", k, "action"), f'a jump sets something: add {state[1]} = "..."')
    first = next((name for name in entry.jump if name in state), "")
    if first and entry.action != "jump":
        check.report(("event", k, first), f"only a jump sets '{first}': add action = \"jump\"")


# --- picture --------------------------------------------------------------------------------------

_SIMPLE = (("dots", "dot"), ("lines", "line"), ("springs", "spring"), ("paths", "path"))


def check_picture(check: ValueChecker) -> Picture | None:
    """Check the table [picture] of a scene and return the picture, or None if there is no table.

    Errors are reported to `check`.
    """
    return _Picture(check).checked() if check.doc.picture else None


class _Picture:
    def __init__(self, check: ValueChecker) -> None:
        doc = check.doc
        assert doc.picture is not None
        self.check, self.table = check, doc.picture
        self.bodies = [e.name for table in (doc.body, doc.point) for e in table.values()]
        # None: not known before the first vector
        check.dimension = len(doc.gravity) if doc.body and doc.gravity else None
        self.points: dict[str, Vector] = {}

    def checked(self) -> Picture:
        """Check the table [picture] and return the picture; errors are reported to `check`."""
        for name, at in (self.table.points or {}).items():
            self._declare(name, at)
        shapes = [*self._simple(), *self._solids()]
        if not shapes and not self.check.faults:
            self.check.report(
                ("picture",),
                "draws nothing: add dots, lines, springs, boxes, circles or paths, "
                'such as lines = [["cart", "tip"]]',
            )
        axes = "xyz" if self.check.dimension == 3 else self.table.axes or "xy"
        if self.table.axes and self.check.dimension == 3:
            self.check.report(("picture", "axes"), "is for pictures in the plane: remove it")
        return Picture(tuple(shapes), axes)

    def _declare(self, name: str, at: tuple[Value, ...]) -> None:
        path = ("picture", "points", name)
        taken = {**dict.fromkeys(self.bodies, "is a body or point already"), **WORLD_TAKEN}
        self.check.claim(path, name, taken, "")
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
                if kind == "box" and len(size) != (self.check.dimension or len(size)):
                    where = "in the plane" if self.check.dimension == 2 else "in space"
                    words = "two edges" if self.check.dimension == 2 else "three edges"
                    self.check.report(path, f"a box {where} has {words}, here {len(size)}")
                extent = (*path, "size" if kind == "box" else "radius")
                large = tuple(self.check.value(extent, x, nonnegative=True)[0] for x in size)
                yield Shape(
                    kind, (place,), large, self.check.rotation(path, rotation, self._formula)
                )

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

    def _vector(self, path: Path, entries: tuple[Value, ...]) -> Vector:
        if self.check.dimension not in (2, 3) and len(entries) in (2, 3):
            self.check.dimension = len(entries)
        return self.check.vector(path, entries, self._formula)

    def _formula(self, path: Path, value: Value) -> Formula:
        """Return a checked formula, which may use all names except inputs and velocities."""
        formula = self.check.formula(path, value)
        if formula is None:
            return ZERO
        for kind in (INPUT, VELOCITY):
            why = f"a picture can't depend on {kind}: it shows where things are"
            self.check.depends_on(path, formula, kind, why)
        return formula
