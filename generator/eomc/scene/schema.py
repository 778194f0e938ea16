"""The layout of a scene file: its tables and their keys, with remedies for errors in it.

Each key of a table is a field of a dataclass, with its type, its default, its unit and one sentence
on its meaning. Validation, error messages, the JSON Schema of `eomc schema` and the reference of
scene keys all come from these fields. `read` converts the tree of a TOML text to a `Document`.
Faulty entries are reported, and have their defaults in the document, so that all others can be
checked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from eomc.base.errors import SceneError
from eomc.scene import hints
from eomc.scene.formulas import Value, nearest
from eomc.scene.scope import UNKNOWN, Checker, Path
from eomc.scene.toml_text import ARRAYS
from eomc.scene.value_types import (
    Place,
    Solid,
    ValueType,
    axes,
    choice,
    ends,
    entry,
    flag,
    frame_selection,
    limits,
    line,
    lines,
    methods,
    named_points,
    names,
    note,
    places,
    points,
    positive,
    rotation,
    scalar_or_list,
    short_toml,
    solids,
    text,
    tolerance,
    two_names,
    vector,
    version,
)

WORLD = "world"  # the inertial frame, as a parent or at the end of a spring
REALS, FRICTIONS = ("double", "float"), ("smooth", "stick")
LINEARIZATIONS = (True, False, "parameters", "products")
FRAMES, PLANES = (WORLD, "body"), ("xy", "xz", "yz")
DIRECTIONS, ACTIONS = ("both", "rising", "falling"), ("record", "stop", "jump")
MIN_FLOAT_TOLERANCE = 5e-7  # in single precision
DEFAULT_TOLERANCE = {"double": 1e-9, "float": 1e-5}  # of a scene with events, by its real type
FRICTION_WIDTH = "0.01"  # rad/s or m/s

# --- tables ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Key:
    """A key or table that a scene may contain, stored in the metadata of a field.

    Attributes
    ----------
    about : str
        One sentence on its meaning.
    name : str
        The key, if it is not the name of the field.
    type : ValueType or None
        Type of the value; None for tables.
    unit : str
        Unit of the value.
    default_text : str
        What applies if the key is not written, for the reference; by default the field's default.
    missing : str
        The remedy if the key is missing; empty if it is optional.
    unless : str
        Table of the scene beside which a required key is optional.
    table : type or None
        Dataclass of the table, or of each table in a table or array of tables.
    container : str
        "" for a single table, "table" for a table of tables, "array" for an array of tables.
    first : str
        Key that each of several tables begins with.
    short : bool
        Whether the value of `first` may stand for the whole table.
    """

    about: str
    name: str = ""
    type: ValueType[Any] | None = None
    unit: str = ""
    default_text: str = ""
    missing: str = ""
    unless: str = ""
    table: Any = None
    container: str = ""
    first: str = ""
    short: bool = False


def key(type: ValueType[Any], about: str, default: Any = None, **more: Any) -> Any:
    """Return a field for a key of a table; `more` are attributes of its `Key`."""
    return field(default=default, metadata={"key": Key(about, type=type, **more)})


def table(model: type, about: str, **more: Any) -> Any:
    """Return a field for a table, None if there is none."""
    return field(default=None, metadata={"key": Key(about, table=model, **more)})


def tables(model: type, about: str, first: str = "", **more: Any) -> Any:
    """Return a field for a table of tables, or without `first` for an array of tables.

    The value is a dict of the tables by their names.
    """
    container = "table" if first else "array"
    several = Key(about, table=model, container=container, first=first, **more)
    return field(default_factory=dict, metadata={"key": several})


def entries(about: str, unit: str = "") -> Any:
    """Return a field for a table of formulas, a dict of the formulas by their names."""
    formulas = Key(about, type=entry, unit=unit, container="table")
    return field(default_factory=dict, metadata={"key": formulas})


def keys(model: type) -> dict[str, Key]:
    """Return the keys of a table by their names."""
    return {
        f.metadata["key"].name or f.name: f.metadata["key"] for f in fields(model) if f.metadata
    }


_NOTE = "Free text for people, in comments of the C header."


@dataclass(frozen=True)
class CoordinateTable:
    """A coordinate in the file. written: the valid keys of its table."""

    unit: str = key(line, 'Unit for people and plots; "rad" marks an angle.', "")
    start: Value = key(
        entry, "Initial value, a formula of constants and parameters.", 0.0, unit="unit"
    )
    rate: Value = key(
        entry, "Initial velocity, a formula of constants and parameters.", 0.0, unit="unit/s"
    )
    guess: bool = key(
        flag, "Whether the assembly of constraints may change the initial values.", False
    )
    friction: Value | None = key(entry, "Coulomb friction along the coordinate.", unit="N, N m")
    friction_width: Value | None = key(
        entry,
        "Velocity within which smoothed friction rises to its full value.",
        unit="m/s, rad/s",
        default_text=FRICTION_WIDTH,
    )
    note: str = key(note, "Free text for people.", "")
    written: frozenset[str] = frozenset()


@dataclass(frozen=True)
class QuantityTable:
    """A parameter or constant in the file."""

    value: Value = key(
        entry, "Value, a formula of constants.", 1.0, unit="unit", missing="add value = ..."
    )
    unit: str = key(line, "Unit for people.", "")
    note: str = key(note, _NOTE, "")


@dataclass(frozen=True)
class InputTable:
    """An input in the file."""

    unit: str = key(line, "Unit for people.", "")
    signal: Value = key(
        entry,
        "Value where the caller gives none, a formula of time, state and parameters.",
        0.0,
        unit="unit",
    )
    limits: tuple[Value | None, ...] = key(
        limits,
        "Smallest and largest value that acts, formulas of constants and parameters.",
        (None, None),
        unit="unit",
        default_text="none",
    )
    note: str = key(note, _NOTE, "")


@dataclass(frozen=True)
class OutputTable:
    """An output or constraint in the file."""

    formula: Value = key(
        entry,
        "The computed quantity; of a constraint, the quantity that is zero along every motion.",
        1.0,
        unit="unit",
        missing="add formula = ...",
    )
    unit: str = key(line, "Unit for people and plots.", "")
    note: str = key(note, _NOTE, "")


@dataclass(frozen=True)
class EnergyTable:
    """The table [energy] in the file."""

    kinetic: Value = key(
        entry,
        "Kinetic energy K; the energies of bodies are added to it.",
        0.0,
        unit="J",
        missing=f'add kinetic = "..."; {hints.GIVE_ENERGIES}',
        unless="body",
    )
    potential: Value = key(
        entry, "Potential energy P, or a generalized potential U of the velocities.", 0.0, unit="J"
    )
    dissipation: Value = key(
        entry, "Rayleigh dissipation function R, whose force is -dR/dqd.", 0.0, unit="W"
    )


@dataclass(frozen=True)
class RunSettings:
    """Settings of the table [run] of a scene: generated code, and defaults of simulations."""

    h: float = key(positive, "Step size of fixed steps.", 0.001, unit="s")
    duration: float = key(positive, "Duration of a simulation.", 10.0, unit="s")
    methods: tuple[str, ...] = key(
        methods,
        'Methods to generate; simulations use the first; "auto" selects adaptive steps.',
        ("rk4",),
        name="method",
        default_text='"rk4"',
    )
    real: str = key(choice("type", REALS), "C type of all computations.", "double")
    batch: bool = key(flag, "Generate functions for many trajectories at once.", False)
    linearize: bool | str = key(
        choice("value", LINEARIZATIONS),
        "Generate derivatives of the accelerations, by parameters too, and products with vectors.",
        False,
    )
    discretize: bool = key(
        flag, "Generate derivatives of a step by state and inputs; includes linearize.", False
    )
    frames: bool | tuple[str, ...] = key(
        frame_selection,
        "Bodies and points whose poses, velocities, accelerations and Jacobians are generated.",
        False,
    )
    inverse_dynamics: bool = key(flag, "Generate the inverse dynamics D qdd + C qd + g.", False)
    momentum: bool = key(
        flag, "Generate mass, centre of mass, momentum and angular momentum of all bodies.", False
    )
    tolerance: float | None = key(
        tolerance, "Tolerance of adaptive steps; without it steps have a fixed size."
    )
    friction: str = key(
        choice("friction", FRICTIONS),
        'Model of Coulomb friction: smoothed, or exact with sticking and sliding ("stick").',
        "smooth",
    )

    @property
    def needs_derivatives(self) -> bool:
        """True if derivatives of the accelerations must be generated.

        They are needed for `linearize` and, to differentiate steps, for `discretize`.
        """
        return bool(self.linearize) or self.discretize

    @property
    def by_parameters(self) -> bool:
        """True if derivatives with respect to the parameters must be generated."""
        return self.linearize in ("parameters", "products")


_TWO_BODIES = two_names('bodies, such as ["world", "cart"]')
_TWO_COORDINATES = two_names('coordinates, such as ["phi", "psi"]')
_ORIGIN = "origin"


@dataclass(frozen=True)
class BodyTable:
    """A [[body]] in the file; missing keys are None."""

    name: str = key(
        text,
        "Name of the body and of its frame.",
        missing='give the body a name: name = "..."',
    )
    note: str = key(note, "Free text for people.", "")
    parent: str | None = key(text, "Body that the joint is fixed to.", default_text='"world"')
    joint: str | None = key(
        text, "Kind of the joint.", default_text="required, unless position is written"
    )
    coordinates: tuple[str, ...] | None = key(
        names, "Coordinates of the joint in its order, or formulas of coordinates."
    )
    axis: tuple[tuple[float, ...], ...] | None = key(
        axes, "Axis of the joint in its frame, of any length but zero.", default_text="by joint"
    )
    pitch: Value | None = key(
        entry,
        "Displacement of a screw joint along its axis for each radian.",
        unit="m/rad",
        default_text="required for screw",
    )
    offset: tuple[Value, ...] | None = key(
        vector, "Position of the joint in the parent's frame.", unit="m", default_text=_ORIGIN
    )
    position: tuple[Value, ...] | None = key(
        vector,
        "Centre of mass in the world, formulas of coordinates; it replaces the joint.",
        unit="m",
    )
    rotation: Any = key(
        rotation, "Rotation of the joint's frame in the parent's frame.", unit="rad"
    )
    mass: Value = key(entry, "Mass of the body.", 0.0, unit="kg")
    center: tuple[Value, ...] | None = key(
        vector, "Centre of mass in the body's frame.", unit="m", default_text=_ORIGIN
    )
    inertia: Value | tuple[Value, ...] | None = key(
        scalar_or_list,
        "Moment of inertia about the centre of mass; in space [Ixx, Iyy, Izz, Ixy, Ixz, Iyz].",
        unit="kg m^2",
        default_text="0",
    )
    armature: Value | tuple[Value, ...] | None = key(
        scalar_or_list,
        "Inertia of the drive along each coordinate.",
        unit="kg, kg m^2",
        default_text="0",
    )
    damping: Value | tuple[Value, ...] | None = key(
        scalar_or_list,
        "Viscous damping along each coordinate.",
        unit="N s/m, N m s/rad",
        default_text="0",
    )
    friction: Value | tuple[Value, ...] | None = key(
        scalar_or_list,
        "Coulomb friction along each coordinate.",
        unit="N, N m",
        default_text="0",
    )
    friction_width: Value | None = key(
        entry,
        "Velocity within which smoothed friction rises to its full value.",
        unit="m/s, rad/s",
        default_text=FRICTION_WIDTH,
    )
    actuator: Value | tuple[Value, ...] | None = key(
        scalar_or_list,
        "Force or torque of the drive along each coordinate.",
        unit="N, N m",
        default_text="0",
    )


@dataclass(frozen=True)
class PointTable:
    """A [[point]] in the file."""

    name: str = key(
        text,
        "Name of the point and of its frame.",
        missing='give the point a name: name = "..."',
    )
    body: str = key(
        text,
        "Body or point that it is fixed to.",
        WORLD,
        missing='name the body that it is fixed to: body = "..."',
    )
    place: tuple[Value, ...] | None = key(
        vector, "Position in the frame of the body.", unit="m", default_text=_ORIGIN
    )
    rotation: Any = key(rotation, "Rotation of its frame in the frame of the body.", unit="rad")
    note: str = key(note, "Free text for people.", "")


@dataclass(frozen=True)
class SpringDamperTable:
    """Common keys of springs and dampers."""

    coordinate: str | None = key(text, "Coordinate that it acts along, in place of two bodies.")
    bodies: tuple[str, ...] | None = key(_TWO_BODIES, "The two bodies or points that it joins.")
    points: tuple[tuple[Value, ...], ...] | None = key(
        points, "Its ends in the frames of the two bodies.", unit="m", default_text="origins"
    )
    turning: bool = key(
        flag, "Act on the difference of the angles, second minus first; plane scenes only.", False
    )
    note: str = key(note, "Free text for people.", "")


@dataclass(frozen=True)
class SpringTable(SpringDamperTable):
    """A [[spring]] in the file."""

    stiffness: Value = key(
        entry, "Stiffness.", 1.0, unit="N/m, N m/rad", missing='add stiffness = "..."'
    )
    length: Value = key(entry, "Length, angle or position at rest.", 0.0, unit="m, rad")


@dataclass(frozen=True)
class DamperTable(SpringDamperTable):
    """A [[damper]] in the file."""

    damping: Value = key(
        entry, "Damping.", 1.0, unit="N s/m, N m s/rad", missing='add damping = "..."'
    )


_FORCE_BODY = (
    'name the body that it acts on, body = "..."; a force along a coordinate stands in [forces], '
    'x = "F - b*x_dot"'
)


@dataclass(frozen=True)
class ForceTable:
    """A [[force]] in the file."""

    body: str = key(text, "Body or point that it acts on.", WORLD, missing=_FORCE_BODY)
    point: tuple[Value, ...] | None = key(
        vector, "Point of application in the frame of the body.", unit="m", default_text=_ORIGIN
    )
    force: tuple[Value, ...] | None = key(vector, "Components of the force.", unit="N")
    torque: Value | tuple[Value, ...] | None = key(
        scalar_or_list, "Components of the moment; one formula in the plane.", unit="N m"
    )
    frame: str = key(
        choice("frame", FRAMES), "Frame along whose axes the components are given.", "world"
    )
    note: str = key(note, "Free text for people.", "")


@dataclass(frozen=True)
class LoopTable:
    """A [[loop]] in the file; missing keys are None."""

    name: str = key(
        text,
        "Name of the loop, with which its constraint equations begin.",
        missing='give the loop a name: name = "..."',
    )
    joint: str = key(
        text,
        "Kind of the joint that closes the loop.",
        "",
        missing='say what closes it: joint = "revolute" or another',
    )
    bodies: tuple[str, ...] | None = key(_TWO_BODIES, "The two bodies or points that it joins.")
    points: tuple[tuple[Value, ...], ...] | None = key(
        points, "The joint in the frame of each body.", unit="m", default_text="origins"
    )
    axis: tuple[tuple[float, ...], ...] | None = key(
        axes,
        "Axis of the joint in the first body's frame, or one in the frame of each body.",
        default_text="by joint",
    )
    rotation: Any = key(
        rotation, "Rotation of the second body's frame in the first body's frame.", unit="rad"
    )
    length: Value | None = key(
        entry,
        "Distance between the two points.",
        unit="m",
        default_text="required for distance",
    )
    coordinates: tuple[str, ...] | None = key(
        _TWO_COORDINATES, "The two coordinates of a gear.", default_text="required for gear"
    )
    ratio: Value | None = key(
        entry,
        "Second coordinate of a gear over the first.",
        default_text="required for gear",
    )
    offset: Value | None = key(
        entry, "Second coordinate of a gear where the first is zero.", default_text="0"
    )
    note: str = key(note, "Free text for people.", "")


@dataclass(frozen=True)
class EventTable:
    """An [[event]] in the file. jump: its other keys, coordinates and velocities after a jump."""

    name: str = key(text, "Name of the event.", missing='give the event a name: name = "..."')
    when: Value = key(
        entry,
        "Event function, whose zeros are the events.",
        1.0,
        missing='add when = "...", whose zeros are the event',
    )
    direction: str = key(
        choice("direction", DIRECTIONS),
        "Which sign changes of the event function count.",
        "both",
    )
    action: str = key(
        choice("action", ACTIONS),
        "Effect of the event: record it, stop the simulation, or change the state.",
        "record",
    )
    note: str = key(note, "Free text for people.", "")
    jump: Mapping[str, Value] = field(default_factory=dict)


@dataclass(frozen=True)
class PictureTable:
    """The table [picture] in the file."""

    points: Mapping[str, tuple[Value, ...]] | None = key(
        named_points, "Names of points for the other keys; nothing is drawn.", unit="m"
    )
    dots: tuple[Place, ...] = key(places, "Points that are drawn as dots.", ())
    lines: tuple[tuple[Place, ...], ...] = key(lines, "Lines, each through two points or more.", ())
    springs: tuple[tuple[Place, ...], ...] = key(ends, "Springs, each between two points.", ())
    boxes: tuple[Solid, ...] = key(
        solids("size", '{ at = "cart", size = [0.4, 0.2] }'),
        "Boxes, each with its centre `at`, the lengths of its edges `size` and a `rotation`.",
        (),
        unit="m, rad",
    )
    circles: tuple[Solid, ...] = key(
        solids("radius", '{ at = "wheel", radius = 0.1 }'),
        "Circles, each with its centre `at`, its `radius` and a `rotation`.",
        (),
        unit="m, rad",
    )
    paths: tuple[Place, ...] = key(
        places, "Points whose paths are drawn over the whole simulation.", ()
    )
    axes: str = key(
        choice("axes", PLANES),
        "Axes to the right and upwards of a picture in the plane.",
        "",
        default_text='"xy"',
    )


_ADD_COORDINATES = 'add [coordinates] with entries such as x = { unit = "m", start = 0.0 }'
_ADD_NAME = 'add name = "...", which names the module and begins every C symbol'


@dataclass(frozen=True)
class Document:
    """A whole scene file."""

    eomc: int = key(
        version,
        "Version of the scene format.",
        1,
        missing="begin the scene with eomc = 1, its format",
    )
    name: str = key(
        text,
        "Name of the Python module and of the folder in build/, prefix of every C name.",
        "scene",
        missing=_ADD_NAME,
    )
    title: str = key(line, "Title for headings.", "", default_text="from the name")
    note: str = key(note, "Free text for people, in the C header.", "")
    gravity: tuple[Value, ...] | None = key(
        vector,
        "Gravitational acceleration; two entries make a plane scene, three a scene in space.",
        unit="m/s^2",
        default_text="required with bodies",
    )
    coordinates: dict[str, CoordinateTable] = tables(
        CoordinateTable,
        "Generalized coordinates in the order of q; the velocity of theta is theta_dot.",
        "start",
        missing=_ADD_COORDINATES,
    )
    parameters: dict[str, QuantityTable] = tables(
        QuantityTable,
        "Quantities that can be changed without compiling again.",
        "value",
        short=True,
    )
    constants: dict[str, QuantityTable] = tables(
        QuantityTable, "Quantities that are fixed in the generated code.", "value", short=True
    )
    inputs: dict[str, InputTable] = tables(
        InputTable, "Inputs u, given by the caller or by a signal.", "signal"
    )
    definitions: dict[str, Value] = entries("Names for expressions; each may use those above it.")
    energy: EnergyTable = table(
        EnergyTable,
        "Energies from which the equations of motion are derived.",
        missing='add [energy] with kinetic = "..." and potential = "..."',
        unless="body",
    )
    forces: dict[str, Value] = entries(
        "Generalized forces, each under the name of its coordinate.", "N, N m"
    )
    constraints: dict[str, OutputTable] = tables(
        OutputTable,
        "Constraint equations: quantities that are zero along every motion.",
        "formula",
        short=True,
    )
    outputs: dict[str, OutputTable] = tables(
        OutputTable,
        "Quantities that are computed from state, inputs and accelerations on request.",
        "formula",
        short=True,
    )
    body: dict[str, BodyTable] = tables(BodyTable, "Rigid bodies on joints.")
    point: dict[str, PointTable] = tables(PointTable, "Frames that are fixed to bodies.")
    spring: dict[str, SpringTable] = tables(
        SpringTable, "Springs between two bodies or along a coordinate."
    )
    damper: dict[str, DamperTable] = tables(
        DamperTable, "Dampers between two bodies or along a coordinate."
    )
    force: dict[str, ForceTable] = tables(ForceTable, "Forces and moments on bodies.")
    loop: dict[str, LoopTable] = tables(LoopTable, "Joints that close loops of bodies.")
    event: dict[str, EventTable] = tables(
        EventTable,
        'Events; the other keys of one with action = "jump" give the state after the jump.',
    )
    picture: PictureTable | None = table(
        PictureTable, "Drawing of the scene; the equations do not depend on it."
    )
    run: RunSettings = table(RunSettings, "What code is generated, and defaults of simulations.")


# --- reading --------------------------------------------------------------------------------------


def read(tree: Mapping[str, Any], check: Checker) -> Document:
    """Convert the tree of a scene to its document. Errors are reported to `check`.

    Raises SceneError with all errors so far if there are no coordinates, on which all else depends.
    """
    document: Document = _Reader(check, tree).table(Document, tree, ())
    if not document.coordinates:
        if ("coordinates",) not in check.repaired:
            why = 'give at least one coordinate, such as x = { unit = "m", start = 0.0 }'
            check.report(("coordinates",), why)
        raise SceneError(check.problems)
    return document


class _Reader:
    """Converter of trees to tables, that reports faulty entries."""

    def __init__(self, check: Checker, scene: Mapping[str, Any]) -> None:
        self.check = check
        self.scene = scene

    def table(self, model: Any, tree: Mapping[str, Any], path: Path) -> Any:
        """Return the table at `path`; faulty entries have their defaults."""
        known, values = [*keys(model)], dict[str, Any]()
        jump = "jump" in model.__dataclass_fields__
        tree = dict(tree) if jump else self._with_intended_keys(known, tree, path)
        for f in fields(model):
            if not f.metadata:
                continue
            key: Key = f.metadata["key"]
            name = key.name or f.name
            here = (*path, name)
            if name in tree:
                self._add_entry(values, f.name, key, tree[name], here)
            elif key.missing and not (key.unless and self.scene.get(key.unless)):
                self._fault(here, f"missing: {key.missing}")
            if f.name == "name" and len(path) == 2:
                values.setdefault("name", "_".join(path))
            elif key.table and not key.container and f.name != "picture":
                values.setdefault(f.name, key.table())
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
        self, values: dict[str, Any], name: str, key: Key, value: Any, path: Path
    ) -> None:
        if key.type and not key.container:
            values |= self._entries(key.type, {path[-1]: value}, path[:-1], name)
            return
        if not isinstance(value, dict):
            self._fault(path, f"'{path[-1]}' is a table: write [{path[-1]}] and its entries below")
            each = value if isinstance(value, list) else []
            value = {k: x for one in each if isinstance(one, dict) for k, x in one.items()}
            if not value:
                return
        if key.type:
            values[name] = dict.fromkeys(value, 0.0) | self._entries(key.type, value, path)
        elif key.container:
            values[name] = {k: self._short_table(key, x, (*path, k)) for k, x in value.items()}
        else:
            values[name] = self.table(key.table, value, path)

    def _short_table(self, key: Key, value: Any, path: Path) -> Any:
        first, name = key.first, path[-1]
        if not isinstance(value, dict) and key.short:
            value = {first: value}
        elif not isinstance(value, dict):
            here = short_toml(value) if isinstance(value, (int, float, str)) else "..."
            self._fault(path, f"'{name}' is a table: write {name} = {{ {first} = {here} }}")
            value = {}
        return self.table(key.table, value, path)

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


REPEATABLE_TABLES = (  # whose entries may be repeated
    "constants", "parameters", "coordinates", "inputs", "definitions", "forces", "constraints",
)  # fmt: skip
# the latest version that editors of TOML support in full
JSON_SCHEMA_DIALECT = "http://json-schema.org/draft-07/schema#"
REPEAT_KEY = {
    "type": "string",
    "pattern": r"=.*\.\.",
    "description": 'Range over which the entry is repeated, such as "i = 1..n".',
}


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of a scene file as a dict.

    It accepts every valid scene. Rules that depend on other entries of a scene, such as which names
    a formula may use, are checked by `eomc build` alone.
    """
    scene = _table_schema(Document)
    for name in REPEATABLE_TABLES:
        value = scene["properties"][name]["additionalProperties"]
        tables = [x for x in value.get("anyOf", [value]) if x.get("type") == "object"]
        for one in tables:
            one["properties"]["repeat"] = REPEAT_KEY
        if not tables:  # formulas
            repeated = {
                "type": "object",
                "properties": {"repeat": REPEAT_KEY, "value": value},
                "required": ["repeat", "value"],
                "additionalProperties": False,
            }
            scene["properties"][name]["additionalProperties"] = {"anyOf": [value, repeated]}
    for name in ARRAYS:
        scene["properties"][name]["items"]["properties"]["repeat"] = REPEAT_KEY
    return {"$schema": JSON_SCHEMA_DIALECT, "title": "Scene of eomc", **scene}


def _table_schema(model: type) -> dict[str, Any]:
    own = keys(model)
    required = [name for name, key in own.items() if key.missing and not key.unless]
    jump = "jump" in model.__dataclass_fields__  # type: ignore[attr-defined]
    out = {
        "type": "object",
        "properties": {name: _property_schema(key) for name, key in own.items()},
        "required": required,
        "additionalProperties": entry.json_schema if jump else False,
    }
    for name, key in own.items():
        if key.unless and key.table:  # a required table
            condition = {"not": {"required": [key.unless]}}
            out |= {"if": condition, "then": {"required": [name], "properties": {
                name: {"required": [k for k, x in keys(key.table).items() if x.missing]}
            }}}  # fmt: skip
    return out


def _property_schema(key: Key) -> dict[str, Any]:
    unit = f" [{key.unit}]" if key.unit else ""
    description = {"description": f"{key.about}{unit}"}
    value: dict[str, Any] = dict(key.type.json_schema) if key.type else _table_schema(key.table)
    if key.short:
        value = {"anyOf": [entry.json_schema, value]}
    if key.container == "table":
        value = {"type": "object", "additionalProperties": value}
        if key.missing:
            value["minProperties"] = 1
    elif key.container == "array":
        value = {"type": "array", "items": value}
    return description | value
