"""The layout of a scene file: its tables and their keys, with remedies for errors in it.

`read` converts the tree of a TOML text to a `Document`. Each key of a table is a field of a
dataclass with the function that checks its value. Faulty entries are reported, and have their
defaults in the document, so that all others can be checked.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

from eomc.base import texts
from eomc.base.errors import SceneError
from eomc.integrators.tableaux import METHODS
from eomc.scene import hints
from eomc.scene.formulas import Formula, Value, nearest
from eomc.scene.scope import UNKNOWN, Checker, Path

WORLD = "world"  # the inertial frame, as a parent or at the end of a spring
REALS, FRICTIONS = ("double", "float"), ("smooth", "stick")
DIRECTIONS, ACTIONS = ("both", "rising", "falling"), ("record", "stop", "jump")
MIN_TOLERANCE, MAX_TOLERANCE = 1e-15, 1e-2
MIN_FLOAT_TOLERANCE = 5e-7  # in single precision
DEFAULT_TOLERANCE = {"double": 1e-9, "float": 1e-5}  # of a scene with events, by its real type

# --- values that may be written in several ways ---------------------------------------------------
# each function raises ValueError with a remedy


def short_toml(value: object) -> str:
    """Return a value as it is written in TOML, shortened to 40 characters, for messages."""
    if isinstance(value, bool):
        text = str(value).lower()
    elif isinstance(value, dict):
        text = "a table"
    else:
        text = repr(value) if isinstance(value, (str, list, float, int)) else str(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _expected(what: str, value: object) -> ValueError:
    return ValueError(f"must be {what}, here {short_toml(value)}")


def entry(value: object) -> Value:
    """Check that a value is a finite number or a formula, and return it.

    Numbers are returned as float. Raises ValueError otherwise.
    """
    if isinstance(value, (str, Formula)):
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _expected("a number or a formula in quotes", value)
    if not abs(value) < math.inf or abs(value) > sys.float_info.max:
        raise _expected("a finite number", value)
    return float(value)


def vector(value: object) -> tuple[Value, ...]:
    """Check that a TOML value is a list of numbers and formulas, and return it as a tuple.

    Raises ValueError otherwise.
    """
    if not isinstance(value, list) or not value:
        raise _expected("a list of numbers and formulas, such as [0, 1.5]", value)
    return tuple(map(entry, value))


def scalar_or_list(value: object) -> Value | tuple[Value, ...]:
    """Check that a TOML value is a number or formula, or a list of these.

    Returns the single value, or a tuple with the values of the list, such as one for each
    coordinate of a joint. Raises ValueError otherwise.
    """
    return tuple(map(entry, value)) if isinstance(value, list) else entry(value)


def rotation(value: object) -> Value | tuple[tuple[str, Value], ...]:
    """Check that a TOML value is an angle, or a list of turns such as [["z", "pi/2"]].

    Returns the angle, or a tuple of pairs (axis, angle). Angles are numbers or formulas in rad.
    Raises ValueError otherwise.
    """
    if not isinstance(value, list):
        return entry(value)
    for turn in value:
        if not (isinstance(turn, list) and len(turn) == 2 and turn[0] in ("x", "y", "z")):
            what = 'a list of turns, each an axis and an angle, such as [["z", "pi/2"]]'
            raise _expected(what, value)
    return tuple((axis, entry(angle)) for axis, angle in value)


def axes(value: object) -> tuple[tuple[float, ...], ...]:
    """Check that a TOML value is one axis, such as [0, 0, 1], or a list of axes.

    Returns a tuple of axes, each a tuple of floats. Raises ValueError otherwise.
    """
    several = isinstance(value, list) and value and isinstance(value[0], list)
    out: list[Any] = value if several else [value]  # type: ignore[assignment]
    for axis in out:
        if not (isinstance(axis, list) and axis and all(map(_is_number, axis))):
            raise _expected("a list of numbers, such as [0, 0, 1]", value)
    return tuple(tuple(map(float, axis)) for axis in out)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e100


def limits(value: object) -> tuple[Value | None, ...]:
    """Check that a TOML value is a pair of limits, such as [-1, 1] or [0, inf].

    Returns the smallest and the largest value, each a number, a formula, or None if infinite.
    Raises ValueError otherwise.
    """
    if not (isinstance(value, list) and len(value) == 2):
        raise _expected("the least and the largest value, such as [-1, 1] or [0, inf]", value)
    unbounded = (("-inf", -math.inf), ("inf", "+inf", math.inf))
    return tuple(None if x in none else entry(x) for x, none in zip(value, unbounded, strict=True))


def names(value: object) -> tuple[str, ...]:
    """Check that a TOML value is a name or a list of names, and return a tuple of the names.

    Raises ValueError otherwise.
    """
    names_ = value if isinstance(value, list) else [value]
    if not all(isinstance(name, str) for name in names_):
        raise _expected("a name in quotes, or a list of names", value)
    return tuple(names_)


def two_names(what: str, value: object) -> tuple[str, ...]:
    """Check that a TOML value is a list of two names, and return it as a tuple.

    what: what they name, with an example, for the message. Raises ValueError otherwise.
    """
    if len(names_ := names(value)) != 2:
        raise ValueError(f"must name two {what}, here {short_toml(value)}")
    return names_


def points(value: object) -> tuple[tuple[Value, ...], ...]:
    """Check that a TOML value is a list of two points, such as [[0, 0], ["l", 0]].

    Returns a tuple of two vectors of numbers and formulas. Raises ValueError otherwise.
    """
    if not (isinstance(value, list) and len(value) == 2):
        raise _expected('two points, such as [[0, 0], ["l", 0]]', value)
    return tuple(map(vector, value))


def text(value: object) -> str:
    """Check that a TOML value is a text, and return it. Raises ValueError otherwise."""
    if isinstance(value, str):
        return value
    raise _expected("text in quotes", value)


def line(value: object) -> str:
    """Check that a TOML value is a text in one line without hidden characters, and return it."""
    return texts.checked_line(text(value))


def note(value: object) -> str:
    """Check that a TOML value is a text without hidden characters, and return it."""
    return texts.checked_lines(text(value))


def flag(value: object) -> bool:
    """Check that a TOML value is true or false, and return it. Raises ValueError otherwise."""
    if isinstance(value, bool):
        return value
    raise _expected("true or false", value)


def choice(what: str, words: Sequence[str], value: object) -> str:
    """Check that a TOML value is one of some words, and return it. Raises ValueError otherwise.

    what: what the word names, for the message.
    """
    if value in words:
        return str(value)
    raise ValueError(f"unknown {what} {short_toml(value)}: known are {', '.join(words)}")


def version(value: object) -> int:
    """Check that a TOML value is the version 1 of the format. Raises ValueError otherwise."""
    if value != 1 or isinstance(value, bool):
        here = short_toml(value)
        raise ValueError(f"format {here} is not known to this version, which reads eomc = 1")
    return 1


# --- [run] ---------------------------------------------------------------------------------------


def linearization(value: object) -> bool | str:
    """Check the value of `linearize` in [run]: true, false or "parameters"; return it.

    Raises ValueError otherwise.
    """
    if isinstance(value, bool) or value == "parameters":
        return value
    raise _expected('true, false or "parameters"', value)


def frame_selection(value: object) -> bool | tuple[str, ...]:
    """Check the value of `frames` in [run]: true, false or a list of names of bodies and points.

    Returns a bool (all frames or none), or a tuple of the names. Raises ValueError otherwise.
    """
    if isinstance(value, bool):
        return value
    if isinstance(value, list) and all(isinstance(name, str) for name in value):
        return tuple(dict.fromkeys(value))
    raise _expected('true, or a list of bodies and points such as ["tip"]', value)


def positive(value: object) -> float:
    """Check that a TOML value is a positive, finite number, and return it as float.

    Raises ValueError otherwise.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        here = f"{short_toml(value)}{hints.number_remedy(value)}"
        raise ValueError(f"must be a number, here {here}")
    if value <= 0:
        raise _expected("greater than zero", value)
    return float(entry(value))  # type: ignore[arg-type]  # finite


def tolerance(value: object) -> float:
    """Check that a TOML value is a tolerance of adaptive steps. Raises ValueError otherwise."""
    if isinstance(value, (int, float)) and MIN_TOLERANCE <= value <= MAX_TOLERANCE:
        return float(value)
    raise _expected("a number from 1e-15 to 1e-2", value)


def methods(value: object) -> tuple[str, ...]:
    """Check that a TOML value is the name of a stepper or a list of names; return a tuple.

    The first is the default of runs. Raises ValueError for unknown names.
    """
    each = value if isinstance(value, list) and value else [value]
    return tuple(dict.fromkeys(choice("method", (*METHODS, "auto"), name) for name in each))


# --- [picture] ------------------------------------------------------------------------------------

Place = str | tuple[Value, ...]  # a name, or a vector


def named_points(value: object) -> dict[str, tuple[Value, ...]]:
    """Check that a TOML value is a table of points, and return their vectors by name.

    Each vector is a tuple of numbers and formulas. Raises ValueError otherwise.
    """
    if not isinstance(value, dict):
        raise _expected('a table, such as { tip = ["x", "l*cos(theta)"] }', value)
    return {name: vector(entries) for name, entries in value.items()}


def _place(value: object) -> Place:
    return value if isinstance(value, str) else vector(value)


def places(value: object) -> tuple[Place, ...]:
    """Check that a TOML value is a list of points, each a name or a vector; return it as a tuple.

    Raises ValueError otherwise.
    """
    if not isinstance(value, list):
        raise _expected('a list of points, such as ["tip"]', value)
    return tuple(map(_place, value))


def lines(value: object) -> tuple[tuple[Place, ...], ...]:
    """Check that a TOML value is a list of lines, each a list of two points or more.

    Returns a tuple of lines, each a tuple of points (names or vectors). Raises ValueError
    otherwise.
    """
    example = 'a list of lines, such as [["cart", "tip"]]'
    if not isinstance(value, list):
        raise _expected(example, value)
    for line in value:
        if not (isinstance(line, list) and len(line) >= 2):
            what = f"{example}, each through two points or more: {short_toml(line)}"
            raise ValueError(f"must be {what}")
    return tuple(map(places, value))


def ends(value: object) -> tuple[tuple[Place, ...], ...]:
    """Check that a TOML value is a list of pairs of points, such as the ends of springs.

    Returns a tuple of pairs of points (names or vectors). Raises ValueError otherwise.
    """
    for pair in (pairs := lines(value)):
        if len(pair) != 2:
            raise ValueError(f"each goes from a point to another, here there are {len(pair)}")
    return pairs


Solid = tuple[Place, tuple[Value, ...], object]  # place, size, rotation


def solids(size: str, example: str, value: object) -> tuple[Solid, ...]:
    """Check that a TOML value is a list of boxes or circles.

    size: the key of their size, "size" for the edges of a box or "radius". example: one of them.
    Returns a tuple of (centre, edges or radius, rotation), where the rotation is None if it is not
    given. Raises ValueError otherwise.
    """
    out = []
    tables: list[Any] = value if isinstance(value, list) else [value]
    for table in tables:
        keys = table.keys() if isinstance(table, dict) else set()
        if not {"at", size} <= keys <= {"at", size, "rotation"}:
            what = f"a list of tables with at, {size} and perhaps rotation, such as [{example}]"
            raise _expected(what, table)
        large = vector(table[size]) if size == "size" else (entry(table[size]),)
        turned = rotation(table["rotation"]) if "rotation" in table else None
        out.append((_place(table["at"]), large, turned))
    return tuple(out)


def plane_axes(value: object) -> str:
    """Check that a TOML value is "xy", "xz" or "yz", the axes of a plane picture; return it.

    The first axis is drawn to the right, the second upwards. Raises ValueError otherwise.
    """
    if value in ("xy", "xz", "yz"):
        return str(value)
    raise _expected('"xy", "xz" or "yz", what is drawn to the right and upwards', value)


# --- tables ---------------------------------------------------------------------------------------


def key(
    check: Callable[[object], Any], default: Any = None, missing: str = "", name: str = ""
) -> Any:
    """Return a field for a key of a table.

    check: function that converts its value and raises ValueError with a remedy. default: value
    where there is no entry, or a faulty one. missing: the remedy where there is none, if the key is
    required. name: the key, by default the name of the field.
    """
    return field(default=default, metadata={"check": check, "missing": missing, "name": name})


def table(model: type, missing: str = "") -> Any:
    """Return a field for a table, None if there is none. missing: the remedy if it is required."""
    return field(default=None, metadata={"table": model, "missing": missing})


def tables(model: type, first: str = "", short: bool = False, missing: str = "") -> Any:
    """Return a field for a table of tables, a dict from their names to them.

    first: a key of each. short: whether its value may stand for the table.
    """
    metadata = {"tables": model, "first": first, "short": short, "missing": missing}
    return field(default_factory=dict, metadata=metadata)


def entries() -> Any:
    """Return a field for a table of formulas, a dict from their names to them."""
    return field(default_factory=dict, metadata={"entries": entry})


@dataclass(frozen=True)
class CoordinateTable:
    """A coordinate in the file. written: the valid keys of its table."""

    unit: str = key(line, "")
    start: Value = key(entry, 0.0)
    rate: Value = key(entry, 0.0)
    guess: bool = key(flag, False)
    friction: Value | None = key(entry)
    friction_width: Value | None = key(entry)
    note: str = key(note, "")
    written: frozenset[str] = frozenset()


@dataclass(frozen=True)
class QuantityTable:
    """A parameter or constant in the file."""

    value: Value = key(entry, 1.0, missing="add value = ...")
    unit: str = key(line, "")
    note: str = key(note, "")


@dataclass(frozen=True)
class InputTable:
    """An input in the file."""

    unit: str = key(line, "")
    signal: Value = key(entry, 0.0)
    limits: tuple[Value | None, ...] = key(limits, (None, None))
    note: str = key(note, "")


@dataclass(frozen=True)
class OutputTable:
    """An output or constraint in the file."""

    formula: Value = key(entry, 1.0, missing="add formula = ...")
    unit: str = key(line, "")
    note: str = key(note, "")


@dataclass(frozen=True)
class EnergyTable:
    """The table [energy] in the file."""

    kinetic: Value = key(entry, 0.0, missing=f'add kinetic = "..."; {hints.GIVE_ENERGIES}')
    potential: Value = key(entry, 0.0)
    dissipation: Value = key(entry, 0.0)


@dataclass(frozen=True)
class RunSettings:
    """Settings of the table [run] of a scene: what code is generated, and defaults of simulations.

    Attributes
    ----------
    h, duration : float
        Default step size and duration of a simulation, s.
    methods : tuple of str
        The steppers to generate; the first is the default.
    real : str
        C type of all computations.
    batch : bool
        Generate functions for many trajectories at once.
    linearize : bool or "parameters"
        Generate derivatives of the accelerations, "parameters" also those by the parameters.
    discretize : bool
        Generate derivatives of steps.
    frames : bool or tuple of str
        Bodies and points whose poses, velocities, accelerations and Jacobians are generated; True
        for all.
    inverse_dynamics, momentum : bool
        Generate these functions.
    tolerance : float or None
        Tolerance of adaptive steps; None for fixed steps.
    friction : str
        "smooth", or "stick" if Coulomb friction of joints and coordinates holds them exactly.
    """

    h: float = key(positive, 0.001)
    duration: float = key(positive, 10.0)
    methods: tuple[str, ...] = key(methods, ("rk4",), name="method")
    real: str = key(partial(choice, "type", REALS), "double")
    batch: bool = key(flag, False)
    linearize: bool | str = key(linearization, False)
    discretize: bool = key(flag, False)
    frames: bool | tuple[str, ...] = key(frame_selection, False)
    inverse_dynamics: bool = key(flag, False)
    momentum: bool = key(flag, False)
    tolerance: float | None = key(tolerance)
    friction: str = key(partial(choice, "friction", FRICTIONS), "smooth")

    @property
    def needs_derivatives(self) -> bool:
        """True if derivatives of the accelerations must be generated.

        They are needed for `linearize` and, to differentiate steps, for `discretize`.
        """
        return bool(self.linearize) or self.discretize


_TWO_BODIES = partial(two_names, 'bodies, such as ["world", "cart"]')
_TWO_COORDINATES = partial(two_names, 'coordinates, such as ["phi", "psi"]')


@dataclass(frozen=True)
class BodyTable:
    """A [[body]] in the file; missing keys are None."""

    name: str = key(text, missing='give the body a name: name = "..."')
    note: str = key(note, "")
    parent: str | None = key(text)
    joint: str | None = key(text)
    coordinates: tuple[str, ...] | None = key(names)
    axis: tuple[tuple[float, ...], ...] | None = key(axes)
    pitch: Value | None = key(entry)
    offset: tuple[Value, ...] | None = key(vector)
    position: tuple[Value, ...] | None = key(vector)
    rotation: Any = key(rotation)
    mass: Value = key(entry, 0.0)
    center: tuple[Value, ...] | None = key(vector)
    inertia: Value | tuple[Value, ...] | None = key(scalar_or_list)
    armature: Value | tuple[Value, ...] | None = key(scalar_or_list)
    damping: Value | tuple[Value, ...] | None = key(scalar_or_list)
    friction: Value | tuple[Value, ...] | None = key(scalar_or_list)
    friction_width: Value | None = key(entry)
    actuator: Value | tuple[Value, ...] | None = key(scalar_or_list)


@dataclass(frozen=True)
class PointTable:
    """A [[point]] in the file."""

    name: str = key(text, missing='give the point a name: name = "..."')
    body: str = key(text, WORLD, missing='name the body that it is fixed to: body = "..."')
    place: tuple[Value, ...] | None = key(vector)
    rotation: Any = key(rotation)
    note: str = key(note, "")


@dataclass(frozen=True)
class SpringDamperTable:
    """Common keys of springs and dampers."""

    coordinate: str | None = key(text)
    bodies: tuple[str, ...] | None = key(_TWO_BODIES)
    points: tuple[tuple[Value, ...], ...] | None = key(points)
    turning: bool = key(flag, False)
    note: str = key(note, "")


@dataclass(frozen=True)
class SpringTable(SpringDamperTable):
    """A [[spring]] in the file."""

    stiffness: Value = key(entry, 1.0, missing='add stiffness = "..."')
    length: Value = key(entry, 0.0)


@dataclass(frozen=True)
class DamperTable(SpringDamperTable):
    """A [[damper]] in the file."""

    damping: Value = key(entry, 1.0, missing='add damping = "..."')


def _frame(value: object) -> str:
    if value in ("world", "body"):
        return str(value)
    raise _expected('"world" or "body", whose axes the entries are along', value)


_FORCE_BODY = (
    'name the body that it acts on, body = "..."; a force along a coordinate stands in [forces], '
    'x = "F - b*x_dot"'
)


@dataclass(frozen=True)
class ForceTable:
    """A [[force]] in the file."""

    body: str = key(text, WORLD, missing=_FORCE_BODY)
    point: tuple[Value, ...] | None = key(vector)
    force: tuple[Value, ...] | None = key(vector)
    torque: Value | tuple[Value, ...] | None = key(scalar_or_list)
    frame: str = key(_frame, "world")
    note: str = key(note, "")


@dataclass(frozen=True)
class LoopTable:
    """A [[loop]] in the file; missing keys are None."""

    name: str = key(text, missing='give the loop a name: name = "..."')
    joint: str = key(text, "", missing='say what closes it: joint = "revolute" or another')
    bodies: tuple[str, ...] | None = key(_TWO_BODIES)
    points: tuple[tuple[Value, ...], ...] | None = key(points)
    axis: tuple[tuple[float, ...], ...] | None = key(axes)
    rotation: Any = key(rotation)
    length: Value | None = key(entry)
    coordinates: tuple[str, ...] | None = key(_TWO_COORDINATES)
    ratio: Value | None = key(entry)
    offset: Value | None = key(entry)
    note: str = key(note, "")


@dataclass(frozen=True)
class EventTable:
    """An [[event]] in the file. jump: its other keys, coordinates and velocities after a jump."""

    name: str = key(text, missing='give the event a name: name = "..."')
    when: Value = key(entry, 1.0, missing='add when = "...", whose zeros are the event')
    direction: str = key(partial(choice, "direction", DIRECTIONS), "both")
    action: str = key(partial(choice, "action", ACTIONS), "record")
    note: str = key(note, "")
    jump: Mapping[str, Value] = field(default_factory=dict)


@dataclass(frozen=True)
class PictureTable:
    """The table [picture] in the file."""

    points: Mapping[str, tuple[Value, ...]] | None = key(named_points)
    dots: tuple[Place, ...] = key(places, ())
    lines: tuple[tuple[Place, ...], ...] = key(lines, ())
    springs: tuple[tuple[Place, ...], ...] = key(ends, ())
    boxes: tuple[Solid, ...] = key(
        partial(solids, "size", '{ at = "cart", size = [0.4, 0.2] }'), ()
    )
    circles: tuple[Solid, ...] = key(
        partial(solids, "radius", '{ at = "wheel", radius = 0.1 }'), ()
    )
    paths: tuple[Place, ...] = key(places, ())
    axes: str = key(plane_axes, "")


_ADD_COORDINATES = 'add [coordinates] with entries such as x = { unit = "m", start = 0.0 }'
_ADD_NAME = 'add name = "...", which names the module and begins every C symbol'


@dataclass(frozen=True)
class Document:
    """A whole scene file."""

    eomc: int = key(version, 1, missing="begin the scene with eomc = 1, its format")
    name: str = key(text, "scene", missing=_ADD_NAME)
    title: str = key(line, "")
    note: str = key(note, "")
    gravity: tuple[Value, ...] | None = key(vector)
    coordinates: dict[str, CoordinateTable] = tables(
        CoordinateTable, "start", missing=_ADD_COORDINATES
    )
    parameters: dict[str, QuantityTable] = tables(QuantityTable, "value", short=True)
    constants: dict[str, QuantityTable] = tables(QuantityTable, "value", short=True)
    inputs: dict[str, InputTable] = tables(InputTable, "signal")
    definitions: dict[str, Value] = entries()
    energy: EnergyTable = table(
        EnergyTable, missing='add [energy] with kinetic = "..." and potential = "..."'
    )
    forces: dict[str, Value] = entries()
    constraints: dict[str, OutputTable] = tables(OutputTable, "formula", short=True)
    outputs: dict[str, OutputTable] = tables(OutputTable, "formula", short=True)
    body: dict[str, BodyTable] = tables(BodyTable)
    point: dict[str, PointTable] = tables(PointTable)
    spring: dict[str, SpringTable] = tables(SpringTable)
    damper: dict[str, DamperTable] = tables(DamperTable)
    force: dict[str, ForceTable] = tables(ForceTable)
    loop: dict[str, LoopTable] = tables(LoopTable)
    event: dict[str, EventTable] = tables(EventTable)
    picture: PictureTable | None = table(PictureTable)
    run: RunSettings = table(RunSettings)


# --- reading --------------------------------------------------------------------------------------


def keys(model: type) -> list[str]:
    """Return the keys of a table."""
    return [f.metadata.get("name") or f.name for f in fields(model) if f.metadata]


def read(tree: Mapping[str, Any], check: Checker) -> Document:
    """Convert the tree of a scene to its document. Errors are reported to `check`.

    Raises SceneError with all errors so far if there are no coordinates, on which all else depends.
    """
    energy = tree.get("energy", {})
    if tree.get("body") and isinstance(energy, dict):  # bodies have energies of their own
        tree = {**tree, "energy": {"kinetic": 0.0, **energy}}
    document: Document = _Reader(check).table(Document, tree, ())
    if not document.coordinates:
        if ("coordinates",) not in check.repaired:
            why = 'give at least one coordinate, such as x = { unit = "m", start = 0.0 }'
            check.report(("coordinates",), why)
        raise SceneError(check.problems)
    return document


class _Reader:
    """Converter of trees to tables, that reports faulty entries."""

    def __init__(self, check: Checker) -> None:
        self.check = check

    def table(self, model: Any, tree: Mapping[str, Any], path: Path) -> Any:
        """Return the table at `path`; faulty entries have their defaults."""
        known, values = keys(model), dict[str, Any]()
        jump = "jump" in model.__dataclass_fields__
        tree = dict(tree) if jump else self._with_intended_keys(known, tree, path)
        for name, f in zip(known, (f for f in fields(model) if f.metadata), strict=True):
            here = (*path, name)
            if name not in tree and f.metadata.get("missing"):
                self._fault(here, f"missing: {f.metadata['missing']}")
            elif name in tree:
                self._add_entry(values, f.name, f.metadata, tree[name], here)
            if f.name == "name" and len(path) == 2:
                values.setdefault("name", "_".join(path))
            elif f.metadata.get("table") and f.name != "picture":
                values.setdefault(f.name, f.metadata["table"]())
        if jump:
            values["jump"] = self._entries(
                entry, {k: x for k, x in tree.items() if k not in known}, path
            )
        if "written" in model.__dataclass_fields__:
            values["written"] = frozenset(values)
        return model(**values)

    def _fault(self, path: Path, message: str) -> None:
        self.check.report(path, message)
        self.check.repaired.add(path)

    def _add_entry(
        self, values: dict[str, Any], name: str, metadata: Mapping[str, Any], value: Any, path: Path
    ) -> None:
        if check := metadata.get("check"):
            values |= self._entries(check, {path[-1]: value}, path[:-1], name)
            return
        if not isinstance(value, dict):
            self._fault(path, f"'{path[-1]}' is a table: write [{path[-1]}] and its entries below")
            each = value if isinstance(value, list) else []
            value = {k: x for one in each if isinstance(one, dict) for k, x in one.items()}
            if not value:
                return
        if model := metadata.get("table"):
            values[name] = self.table(model, value, path)
        elif check := metadata.get("entries"):
            values[name] = dict.fromkeys(value, 0.0) | self._entries(check, value, path)
        else:
            values[name] = {k: self._short_table(metadata, x, (*path, k)) for k, x in value.items()}

    def _short_table(self, metadata: Mapping[str, Any], value: Any, path: Path) -> Any:
        first, name = metadata["first"], path[-1]
        if not isinstance(value, dict) and metadata["short"]:
            value = {first: value}
        elif not isinstance(value, dict):
            here = short_toml(value) if isinstance(value, (int, float, str)) else "..."
            self._fault(path, f"'{name}' is a table: write {name} = {{ {first} = {here} }}")
            value = {}
        return self.table(metadata["tables"], value, path)

    def _entries(
        self, check: Callable[[object], Any], tree: Mapping[str, Any], path: Path, name: str = ""
    ) -> dict[str, Any]:
        """Return the valid ones of some entries, converted. name: another name of the entry."""
        out = {}
        for k, value in tree.items():
            try:
                out[name or k] = check(value)
            except ValueError as fault:
                self._fault((*path, k), str(fault))
        return out

    def _with_intended_keys(
        self, known: Sequence[str], tree: Mapping[str, Any], path: Path
    ) -> dict[str, Any]:
        """Return the entries of a table; unknown keys are reported, and replaced if possible."""
        entries_ = {k: x for k, x in tree.items() if k in known}
        for name, value in tree.items():
            if name in known:
                continue
            intended = _intended_key(known, name, path)
            what = "table" if isinstance(value, dict) else "key"
            remedy = (
                f"; did you mean '{intended}'?" if intended else f": known are {', '.join(known)}"
            )
            if path == ("energy",) and name in hints.LAGRANGIANS:
                remedy = f": {hints.GIVE_ENERGIES}"
            self.check.report((*path, name), f"unknown {what} '{name}'{remedy}")
            if intended and intended not in entries_:
                entries_[intended] = value
                self.check.places.rename((*path, name), (*path, intended))
            elif isinstance(value, dict):
                self.check.kinds |= dict.fromkeys(value, frozenset({UNKNOWN}))
        return entries_


def _intended_key(known: Sequence[str], name: str, path: Path) -> str:
    """Return the key that was probably meant by an unknown key, or ""."""
    alias = hints.KEYS_OF_ARRAYS.get(path[0], {}).get(name, "") if len(path) > 1 else ""
    alias = alias or hints.KEYS.get(name, "")
    near = alias if alias in known else nearest(name, known)
    # a table's entries are judged by what it is taken for: 'damping' is no 'spring'
    is_unrelated = not path and near != alias and not nearest(name, [near], 0.7)
    return "" if is_unrelated else near
