"""The layout of a scene file as pydantic models, with remedies for errors in it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any, Literal

import pydantic

from eomc.base import texts
from eomc.integrators.tableaux import METHODS
from eomc.scene import messages
from eomc.scene.formulas import nearest

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


def entry(value: object) -> float | str:
    """Check that a TOML value is a finite number or a text (a formula), and return it.

    Numbers are returned as float. Raises ValueError otherwise.
    """
    if isinstance(value, str):
        return value
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            if math.isfinite(number := float(value)):
                return number
        except OverflowError:
            pass
        raise ValueError(f"must be a finite number, here {short_toml(value)}")
    raise ValueError(f"must be a number or a formula in quotes, here {short_toml(value)}")


def vector(value: object) -> tuple[float | str, ...]:
    """Check that a TOML value is a list of numbers and formulas, and return it as a tuple.

    Raises ValueError otherwise.
    """
    if not isinstance(value, list) or not value:
        raise ValueError(
            f"must be a list of numbers and formulas, such as [0, 1.5], here {short_toml(value)}"
        )
    return tuple(map(entry, value))


def scalar_or_list(value: object) -> float | str | tuple[float | str, ...]:
    """Check that a TOML value is a number or formula, or a list of these.

    Returns the single value, or a tuple with the values of the list, such as one for each
    coordinate of a joint. Raises ValueError otherwise.
    """
    return tuple(map(entry, value)) if isinstance(value, list) else entry(value)


def rotation(value: object) -> float | str | tuple[tuple[str, float | str], ...]:
    """Check that a TOML value is an angle, or a list of turns such as [["z", "pi/2"]].

    Returns the angle, or a tuple of pairs (axis, angle). Angles are numbers or formulas in rad.
    Raises ValueError otherwise.
    """
    if not isinstance(value, list):
        return entry(value)
    turns = []
    for turn in value:
        if not (isinstance(turn, list) and len(turn) == 2 and turn[0] in ("x", "y", "z")):
            raise ValueError(
                'must be a list of turns, each an axis and an angle, such as [["z", "pi/2"]], '
                f"here {short_toml(value)}"
            )
        turns.append((turn[0], entry(turn[1])))
    return tuple(turns)


def axes(value: object) -> tuple[tuple[float, ...], ...]:
    """Check that a TOML value is one axis, such as [0, 0, 1], or a list of axes.

    Returns a tuple of axes, each a tuple of floats. Raises ValueError otherwise.
    """
    axes: list[Any] = [value]
    if isinstance(value, list) and value and isinstance(value[0], list):
        axes = value
    for axis in axes:
        if not (isinstance(axis, list) and axis and all(map(_is_number, axis))):
            raise ValueError(
                f"must be a list of numbers, such as [0, 0, 1], here {short_toml(value)}"
            )
    return tuple(tuple(float(entry) for entry in axis) for axis in axes)


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) < 1e100


def limits(value: object) -> tuple[float | str | None, ...]:
    """Check that a TOML value is a pair of limits, such as [-1, 1] or [0, inf].

    Returns the smallest and the largest value, each a number, a formula, or None if infinite.
    Raises ValueError otherwise.
    """
    if not (isinstance(value, list) and len(value) == 2):
        raise ValueError(
            "must be the least and the largest value, such as [-1, 1] or [0, inf], "
            f"here {short_toml(value)}"
        )
    unbounded = (("-inf", -math.inf), ("inf", "+inf", math.inf))
    return tuple(None if x in none else entry(x) for x, none in zip(value, unbounded, strict=True))


def names(value: object) -> tuple[str, ...]:
    """Check that a TOML value is a name or a list of names, and return a tuple of the names.

    Raises ValueError otherwise.
    """
    names_ = value if isinstance(value, list) else [value]
    if not all(isinstance(name, str) for name in names_):
        raise ValueError(f"must be a name in quotes, or a list of names, here {short_toml(value)}")
    return tuple(names_)


def two_names(value: object) -> tuple[str, ...]:
    """Check that a TOML value is a list of the names of two bodies, and return it as a tuple.

    Raises ValueError otherwise. The bodies need not exist.
    """
    names_ = names(value)
    if len(names_) != 2:
        raise ValueError(
            f'must name two bodies, such as ["world", "cart"], here {short_toml(value)}'
        )
    return names_


def two_coordinates(value: object) -> tuple[str, ...]:
    """Check that a TOML value is a list of the names of two coordinates; return it as a tuple.

    Raises ValueError otherwise. The coordinates need not exist.
    """
    names_ = names(value)
    if len(names_) != 2:
        raise ValueError(
            f'must name two coordinates, such as ["phi", "psi"], here {short_toml(value)}'
        )
    return names_


def points(value: object) -> tuple[tuple[float | str, ...], ...]:
    """Check that a TOML value is a list of two points, such as [[0, 0], ["l", 0]].

    Returns a tuple of two vectors of numbers and formulas. Raises ValueError otherwise.
    """
    if not (isinstance(value, list) and len(value) == 2):
        raise ValueError(
            f'must be two points, such as [[0, 0], ["l", 0]], here {short_toml(value)}'
        )
    return tuple(map(vector, value))


# --- [run] ---------------------------------------------------------------------------------------


def linearization(value: object) -> bool | str:
    """Check the value of `linearize` in [run]: true, false or "parameters"; return it.

    Raises ValueError otherwise.
    """
    if isinstance(value, bool) or value == "parameters":
        return value
    raise ValueError(f'must be true, false or "parameters", here {short_toml(value)}')


def frame_selection(value: object) -> bool | tuple[str, ...]:
    """Check the value of `frames` in [run]: true, false or a list of names of bodies and points.

    Returns a bool (all frames or none), or a tuple of the names. Raises ValueError otherwise.
    """
    if isinstance(value, bool):
        return value
    if isinstance(value, list) and all(isinstance(name, str) for name in value):
        return tuple(dict.fromkeys(value))
    example = 'true, or a list of bodies and points such as ["tip"]'
    raise ValueError(f"must be {example}, here {short_toml(value)}")


# --- [picture] ------------------------------------------------------------------------------------

Place = str | tuple[float | str, ...]  # a name, or a vector


def named_points(value: object) -> dict[str, tuple[float | str, ...]]:
    """Check that a TOML value is a table of points, and return their vectors by name.

    Each vector is a tuple of numbers and formulas. Raises ValueError otherwise.
    """
    if not isinstance(value, dict):
        raise ValueError(
            f'must be a table, such as {{ tip = ["x", "l*cos(theta)"] }}, here {short_toml(value)}'
        )
    return {name: vector(entries) for name, entries in value.items()}


def _place(value: object) -> Place:
    return value if isinstance(value, str) else vector(value)


def places(value: object) -> tuple[Place, ...]:
    """Check that a TOML value is a list of points, each a name or a vector; return it as a tuple.

    Raises ValueError otherwise.
    """
    if not isinstance(value, list):
        raise ValueError(f'must be a list of points, such as ["tip"], here {short_toml(value)}')
    return tuple(map(_place, value))


def lines(value: object) -> tuple[tuple[Place, ...], ...]:
    """Check that a TOML value is a list of lines, each a list of two points or more.

    Returns a tuple of lines, each a tuple of points (names or vectors). Raises ValueError
    otherwise.
    """
    example = 'a list of lines, such as [["cart", "tip"]]'
    if not isinstance(value, list):
        raise ValueError(f"must be {example}, here {short_toml(value)}")
    for line in value:
        if not (isinstance(line, list) and len(line) >= 2):
            raise ValueError(
                f"must be {example}, each through two points or more: {short_toml(line)}"
            )
    return tuple(map(places, value))


def ends(value: object) -> tuple[tuple[Place, ...], ...]:
    """Check that a TOML value is a list of pairs of points, such as the ends of springs.

    Returns a tuple of pairs of points (names or vectors). Raises ValueError otherwise.
    """
    pairs = lines(value)
    for pair in pairs:
        if len(pair) != 2:
            raise ValueError(f"each goes from a point to another, here there are {len(pair)}")
    return pairs


Solid = tuple[Place, tuple[float | str, ...], object]  # place, size, rotation


def boxes(value: object) -> tuple[Solid, ...]:
    """Check that a TOML value is a list of boxes, such as { at = "cart", size = [0.4, 0.2] }.

    Returns a tuple of (centre, edges, rotation), where the rotation is None if it is not given.
    Raises ValueError otherwise.
    """
    return _solids(value, "size", '{ at = "cart", size = [0.4, 0.2] }')


def circles(value: object) -> tuple[Solid, ...]:
    """Check that a TOML value is a list of circles, such as { at = "wheel", radius = 0.1 }.

    Returns a tuple of (centre, (radius,), rotation), where the rotation is None if it is not given.
    Raises ValueError otherwise.
    """
    return _solids(value, "radius", '{ at = "wheel", radius = 0.1 }')


def _solids(value: object, size: str, example: str) -> tuple[Solid, ...]:
    keys = ("at", size, "rotation")
    out = []
    for table in value if isinstance(value, list) else [value]:
        if not isinstance(table, dict) or not {"at", size} <= table.keys() <= {*keys}:
            raise ValueError(
                f"must be a list of tables with {keys[0]}, {keys[1]} and perhaps {keys[2]}, "
                f"such as [{example}], here {short_toml(table)}"
            )
        extent = table[size]
        large = vector(extent) if size == "size" else (entry(extent),)
        turned = rotation(table["rotation"]) if "rotation" in table else None
        out.append((_place(table["at"]), large, turned))
    return tuple(out)


def plane_axes(value: object) -> str:
    """Check that a TOML value is "xy", "xz" or "yz", the axes of a plane picture; return it.

    The first axis is drawn to the right, the second upwards. Raises ValueError otherwise.
    """
    if value in ("xy", "xz", "yz"):
        return str(value)
    raise ValueError(
        'must be "xy", "xz" or "yz", what is drawn to the right and upwards, '
        f"here {short_toml(value)}"
    )


# --- tables ---------------------------------------------------------------------------------------

_NAMES = (*METHODS, "auto")

_Number = Annotated[float, pydantic.Field(strict=True, allow_inf_nan=False)]
_Value = _Number | pydantic.StrictStr

_Line = Annotated[pydantic.StrictStr, pydantic.AfterValidator(texts.checked_line)]
_Note = Annotated[pydantic.StrictStr, pydantic.AfterValidator(texts.checked_lines)]
_Positive = Annotated[float, pydantic.Field(strict=True, gt=0, allow_inf_nan=False)]


_Tolerance = Annotated[
    float, pydantic.Field(strict=True, ge=MIN_TOLERANCE, le=MAX_TOLERANCE, allow_inf_nan=False)
]


class _Table(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class _Coordinate(_Table):
    unit: _Line = ""
    start: _Value = 0.0
    rate: _Value = 0.0
    guess: pydantic.StrictBool = False
    friction: _Value | None = None
    friction_width: _Value | None = None
    note: _Note = ""


class QuantityTable(_Table):
    """A parameter or constant in the file."""

    value: _Value
    unit: _Line = ""
    note: _Note = ""


_Limits = Annotated[tuple[float | str | None, ...], pydantic.PlainValidator(limits)]


class _Input(_Table):
    unit: _Line = ""
    signal: _Value = 0.0
    limits: _Limits = (None, None)
    note: _Note = ""


class OutputTable(_Table):
    """An output or constraint in the file."""

    formula: _Value
    unit: _Line = ""
    note: _Note = ""


class _Energy(_Table):
    kinetic: _Value
    potential: _Value = 0.0
    dissipation: _Value = 0.0


def _as_tuple(value: object) -> object:
    """Return `method = "rk4"` as a list of one; the first method is the default of runs."""
    if isinstance(value, list) and value:
        return tuple(dict.fromkeys(map(str, value)))
    return (value,)


_Methods = Annotated[
    tuple[Literal[_NAMES], ...],  # type: ignore[valid-type]
    pydantic.BeforeValidator(_as_tuple),
]


class _Run(_Table):
    h: _Positive = 0.001
    duration: _Positive = 10.0
    methods: _Methods = pydantic.Field(default=("rk4",), alias="method")
    real: Literal[REALS] = "double"  # type: ignore[valid-type]
    batch: pydantic.StrictBool = False
    linearize: Annotated[bool | str, pydantic.PlainValidator(linearization)] = False
    discretize: pydantic.StrictBool = False
    frames: Annotated[bool | tuple[str, ...], pydantic.PlainValidator(frame_selection)] = False
    inverse_dynamics: pydantic.StrictBool = False
    momentum: pydantic.StrictBool = False
    tolerance: _Tolerance | None = None
    friction: Literal[FRICTIONS] = "smooth"  # type: ignore[valid-type]


def _as_table(key: str, value: object) -> object:
    """Return `m = 2.0` as `m = { value = 2.0 }`."""
    return value if isinstance(value, dict) else {key: value}


_Short = Annotated[QuantityTable, pydantic.BeforeValidator(partial(_as_table, "value"))]
_Formula = Annotated[OutputTable, pydantic.BeforeValidator(partial(_as_table, "formula"))]


_Vector = Annotated[tuple[float | str, ...], pydantic.PlainValidator(vector)]
_Each = Annotated[float | str | tuple[float | str, ...], pydantic.PlainValidator(scalar_or_list)]
_Rotation = Annotated[
    float | str | tuple[tuple[str, float | str], ...], pydantic.PlainValidator(rotation)
]
_Axes = Annotated[tuple[tuple[float, ...], ...], pydantic.PlainValidator(axes)]
_Names = Annotated[tuple[str, ...], pydantic.PlainValidator(names)]
_TwoNames = Annotated[tuple[str, ...], pydantic.PlainValidator(two_names)]
_TwoCoordinates = Annotated[tuple[str, ...], pydantic.PlainValidator(two_coordinates)]
_Points = Annotated[tuple[tuple[float | str, ...], ...], pydantic.PlainValidator(points)]


class BodyTable(_Table):
    """A [[body]] in the file; missing keys are None."""

    name: pydantic.StrictStr
    note: _Note = ""
    parent: pydantic.StrictStr | None = None
    joint: pydantic.StrictStr | None = None
    coordinates: _Names | None = None
    axis: _Axes | None = None
    offset: _Vector | None = None
    position: _Vector | None = None
    rotation: _Rotation | None = None
    mass: _Value = 0.0
    center: _Vector | None = None
    inertia: _Each | None = None
    armature: _Each | None = None
    damping: _Each | None = None
    friction: _Each | None = None
    friction_width: _Value | None = None
    actuator: _Each | None = None


class PointTable(_Table):
    """A [[point]] in the file."""

    name: pydantic.StrictStr
    body: pydantic.StrictStr
    place: _Vector | None = None
    rotation: _Rotation | None = None
    note: _Note = ""


class _SpringDamperTable(_Table):
    """Common keys of springs and dampers."""

    coordinate: pydantic.StrictStr | None = None
    bodies: _TwoNames | None = None
    points: _Points | None = None
    turning: pydantic.StrictBool = False
    note: _Note = ""


class SpringTable(_SpringDamperTable):
    """A [[spring]] in the file."""

    stiffness: _Value
    length: _Value = 0.0


class DamperTable(_SpringDamperTable):
    """A [[damper]] in the file."""

    damping: _Value


class ForceTable(_Table):
    """A [[force]] in the file."""

    body: pydantic.StrictStr
    point: _Vector | None = None
    force: _Vector | None = None
    torque: _Each | None = None
    frame: Literal["world", "body"] = "world"
    note: _Note = ""


class LoopTable(_Table):
    """A [[loop]] in the file; missing keys are None."""

    name: pydantic.StrictStr
    joint: pydantic.StrictStr
    bodies: _TwoNames | None = None
    points: _Points | None = None
    axis: _Axes | None = None
    rotation: _Rotation | None = None
    length: _Value | None = None
    coordinates: _TwoCoordinates | None = None
    ratio: _Value | None = None
    offset: _Value | None = None
    note: _Note = ""


class EventTable(_Table):
    """An [[event]] in the file; other keys are coordinates and velocities after a jump."""

    model_config = pydantic.ConfigDict(extra="allow", frozen=True)

    name: pydantic.StrictStr
    when: _Value
    direction: Literal[DIRECTIONS] = "both"  # type: ignore[valid-type]
    action: Literal[ACTIONS] = "record"  # type: ignore[valid-type]
    note: _Note = ""


_Places = Annotated[tuple[Place, ...], pydantic.PlainValidator(places)]
_Lines = Annotated[tuple[Any, ...], pydantic.PlainValidator(lines)]
_Ends = Annotated[tuple[Any, ...], pydantic.PlainValidator(ends)]
_Boxes = Annotated[tuple[Any, ...], pydantic.PlainValidator(boxes)]
_Circles = Annotated[tuple[Any, ...], pydantic.PlainValidator(circles)]


class PictureTable(_Table):
    """The table [picture] in the file."""

    points: Annotated[dict[str, Any], pydantic.PlainValidator(named_points)] = {}
    dots: _Places = ()
    lines: _Lines = ()
    springs: _Ends = ()
    boxes: _Boxes = ()
    circles: _Circles = ()
    paths: _Places = ()
    axes: Annotated[str, pydantic.PlainValidator(plane_axes)] = ""


class Document(_Table):
    """A whole scene file."""

    eomc: Literal[1]
    name: pydantic.StrictStr
    title: _Line = ""
    note: _Note = ""
    gravity: _Vector | None = None
    coordinates: dict[str, _Coordinate] = pydantic.Field(min_length=1)
    parameters: dict[str, _Short] = {}
    constants: dict[str, _Short] = {}
    inputs: dict[str, _Input] = {}
    definitions: dict[str, _Value] = {}
    energy: _Energy
    forces: dict[str, _Value] = {}
    constraints: dict[str, _Formula] = {}
    outputs: dict[str, _Formula] = {}
    body: dict[str, BodyTable] = {}
    point: dict[str, PointTable] = {}
    spring: dict[str, SpringTable] = {}
    damper: dict[str, DamperTable] = {}
    force: dict[str, ForceTable] = {}
    loop: dict[str, LoopTable] = {}
    event: dict[str, EventTable] = {}
    picture: PictureTable | None = None
    run: _Run = _Run()


def read(tree: Mapping[str, Any]) -> Document:
    """Check the layout of a scene given as a tree of dicts and lists, and return its document.

    Raises pydantic.ValidationError if the layout is wrong.
    """
    energy = tree.get("energy", {})
    if tree.get("body") and isinstance(energy, dict):  # bodies have energies of their own
        tree = {**tree, "energy": {"kinetic": 0.0, **energy}}
    return Document.model_validate(tree)


# --- faults in words ------------------------------------------------------------------------------

# keys of other programs and textbooks, and the keys of a scene that they stand for
ALIASES = {
    "dt": "h", "step": "h", "time": "duration", "tend": "duration", "t_end": "duration",
    "initial": "start", "init": "start", "velocity": "rate", "units": "unit", "val": "value",
    "variables": "coordinates", "params": "parameters", "const": "constants", "x0": "start",
    "q0": "start", "v0": "rate", "qd0": "rate", "speed": "rate", "t_final": "duration",
    "tf": "duration", "T_end": "duration", "tmax": "duration", "stepsize": "h", "step_size": "h",
    "integrator": "method", "solver": "method", "dofs": "coordinates",
    "range": "limits", "bounds": "limits", "limit": "limits", "saturation": "limits",
    "T": "kinetic", "K": "kinetic",
    "V": "potential", "U": "potential", "P": "potential", "R": "dissipation",
}  # fmt: skip
ALIASES_OF = {
    "body": {
        "origin": "offset", "xyz": "offset", "translation": "offset", "at": "offset",
        "pos": "position", "rpy": "rotation", "angle": "rotation", "orientation": "rotation",
        "com": "center", "cog": "center", "centre": "center", "type": "joint", "kind": "joint",
        "coordinate": "coordinates", "q": "coordinates", "m": "mass", "I": "inertia",
        "J": "inertia", "moment": "inertia", "c": "damping", "b": "damping", "d": "damping",
        "mu": "friction", "coulomb": "friction", "width": "friction_width", "motor": "actuator",
        "torque": "actuator", "force": "actuator", "input": "actuator", "id": "name",
    },
    "point": {
        "parent": "body", "link": "body", "at": "place", "offset": "place", "position": "place",
        "xyz": "place", "point": "place", "origin": "place", "rpy": "rotation",
        "angle": "rotation", "orientation": "rotation", "id": "name",
    },
    "spring": {
        "k": "stiffness", "c": "stiffness", "constant": "stiffness", "rest": "length",
        "l": "length", "l0": "length", "rest_length": "length", "free_length": "length",
        "torsional": "turning", "angular": "turning", "rotational": "turning",
        "between": "bodies", "joint": "coordinate", "ends": "points", "anchors": "points",
    },
    "damper": {
        "c": "damping", "b": "damping", "d": "damping", "coefficient": "damping",
        "torsional": "turning", "angular": "turning", "rotational": "turning",
        "between": "bodies", "joint": "coordinate", "ends": "points", "anchors": "points",
    },
    "force": {
        "at": "point", "position": "point", "place": "point", "offset": "point", "link": "body",
        "F": "force", "direction": "force", "moment": "torque", "M": "torque", "axes": "frame",
    },
    "loop": {
        "type": "joint", "kind": "joint", "between": "bodies", "body": "bodies", "point": "points",
        "anchors": "points", "ends": "points", "axes": "axis", "direction": "axis", "l": "length",
        "distance": "length", "coordinate": "coordinates", "angle": "rotation", "factor": "ratio",
        "multiplier": "ratio", "orientation": "rotation", "rpy": "rotation", "id": "name",
    },
    "event": {
        "condition": "when", "function": "when", "if": "when", "expr": "when", "zero": "when",
        "type": "action", "then": "action", "do": "action", "id": "name",
    },
}  # fmt: skip

_FIRST_KEY = {
    "coordinates": "start", "inputs": "signal", "outputs": "formula", "constraints": "formula",
}  # fmt: skip
_MODELS: Mapping[str, type[_Table]] = {
    "coordinates": _Coordinate,
    "parameters": QuantityTable,
    "constants": QuantityTable,
    "inputs": _Input,
    "outputs": OutputTable,
    "constraints": OutputTable,
    "energy": _Energy,
    "body": BodyTable,
    "point": PointTable,
    "spring": SpringTable,
    "damper": DamperTable,
    "force": ForceTable,
    "loop": LoopTable,
    "event": EventTable,
    "picture": PictureTable,
    "run": _Run,
}


def table_at(tree: Any, path: tuple[str, ...]) -> dict[str, Any]:
    """Return the table (dict) in a tree that the keys `path` lead to, or {} if there is none."""
    for part in path:
        tree = tree.get(part) if isinstance(tree, dict) else None
    return tree if isinstance(tree, dict) else {}


def has_entry(tree: dict[str, Any], path: tuple[str, ...]) -> bool:
    """Return True if the tree has an entry that the keys `path` lead to."""
    return path[-1] in table_at(tree, path[:-1])


def error_path(error: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the keys that lead to the faulty entry of a pydantic error.

    error: an item of ValidationError.errors(). The name of a union's alternative, which pydantic
    appends to the keys, is removed.
    """
    path = tuple(map(str, error["loc"]))
    if path[:2] == ("run", "method"):  # whichever of a list
        return path[:2]
    branch = path[-1] in ("float", "str") and error["type"] in _UNION_ERRORS
    return path[:-1] if branch else path


_UNION_ERRORS = ("float_type", "string_type", "finite_number")


def _keys(path: tuple[str, ...]) -> list[str]:
    """Return the keys that are allowed beside the last one of `path`."""
    model = _MODELS[path[0]] if len(path) > 1 else Document
    return [field.alias or name for name, field in model.model_fields.items()]


def intended_key(path: tuple[str, ...]) -> str:
    """Return the valid key that was probably meant by an unknown key, or "".

    path: the keys that lead to the unknown key, which is the last of them.
    """
    known, last = _keys(path), path[-1]
    alias = ALIASES_OF.get(path[0], {}).get(last, "") if len(path) > 2 else ""
    alias = alias or ALIASES.get(last, "")
    near = alias if alias in known else nearest(path[-1], known)
    # a table's entries are judged by what it is taken for: 'damping' is no 'spring'
    is_unrelated = len(path) == 1 and near != alias and not nearest(path[-1], [near], 0.7)
    return "" if is_unrelated else near


def explain(error: Mapping[str, Any], path: tuple[str, ...]) -> str:
    """Return the message, with a remedy, for a pydantic error in the layout of a scene.

    error: an item of ValidationError.errors(). path: the keys that lead to the faulty entry.
    """
    kind, received, last = str(error["type"]), error.get("input"), path[-1]
    here = short_toml(received)
    if kind == "missing":
        where = (path[0], last) if path[0] in ALIASES_OF else path
        return "missing: " + _MISSING.get(where, f"add {last} = ...")
    if kind == "value_error":
        return str(error["ctx"]["error"])
    if (
        kind == "extra_forbidden"
        and path[0] == "energy"
        and last in ("lagrangian", "Lagrangian", "L")
    ):
        return (
            f"unknown key '{last}': give L = K - P as kinetic = K and potential = P, where the "
            "potential can have terms linear in the velocities"
        )
    if kind == "extra_forbidden":
        near = intended_key(path)
        remedy = f"; did you mean '{near}'?" if near else f": known are {', '.join(_keys(path))}"
        return f"unknown {'table' if isinstance(received, dict) else 'key'} '{last}'{remedy}"
    if path == ("eomc",):
        return f"format {here} is not known to this version, which reads eomc = 1"
    if kind == "too_short":
        return 'none is declared: add at least one, such as x = { unit = "m", start = 0.0 }'
    if path[:2] == ("run", "method"):
        return f"unknown method {here}: known are {', '.join(_NAMES)}"
    if path in (("run", "real"), ("run", "friction")):
        what, words = ("type", REALS) if last == "real" else ("friction", FRICTIONS)
        return f"unknown {what} {here}: known are {', '.join(words)}"
    if path[0] == "event" and last in ("direction", "action"):
        known = DIRECTIONS if last == "direction" else ACTIONS
        return f"unknown {last} {here}: known are {', '.join(known)}"
    if path == ("run", "tolerance"):
        return f"must be a number from 1e-15 to 1e-2, here {here}"
    if kind == "greater_than":
        return f"must be greater than zero, here {here}"
    if kind == "finite_number":
        return f"must be a finite number, here {here}"
    if kind in ("dict_type", "model_type", "model_attributes_type"):
        if len(path) == 1:
            return f"'{last}' is a table: write [{last}] and its entries below"
        key = _FIRST_KEY.get(path[0], "value")
        value = here if isinstance(received, (int, float, str)) else "..."
        return f"'{last}' is a table: write {last} = {{ {key} = {value} }}"
    if kind == "bool_type":
        return f"must be true or false, here {here}"
    if path[0] == "run":
        return f"must be a number, here {here}{messages.number_remedy(received)}"
    if last == "frame":
        return f'must be "world" or "body", whose axes the entries are along, here {here}'
    if last in ("unit", "note", "name", "title", "parent", "joint", "coordinate"):
        return f"must be text in quotes, here {here}"
    return f"must be a number or a formula in quotes, here {here}"


_MISSING: Mapping[tuple[str, ...], str] = {
    ("eomc",): "begin the scene with eomc = 1, its format",
    ("name",): 'add name = "...", which names the module and begins every C symbol',
    ("coordinates",): 'add [coordinates] with entries such as x = { unit = "m", start = 0.0 }',
    ("energy",): 'add [energy] with kinetic = "..." and potential = "..."',
    ("energy", "kinetic"): 'add kinetic = "..."',
    ("body", "name"): 'give the body a name: name = "..."',
    ("point", "name"): 'give the point a name: name = "..."',
    ("point", "body"): 'name the body that it is fixed to: body = "..."',
    ("spring", "stiffness"): 'add stiffness = "..."',
    ("damper", "damping"): 'add damping = "..."',
    ("loop", "name"): 'give the loop a name: name = "..."',
    ("loop", "joint"): 'say what closes it: joint = "revolute" or another',
    ("event", "name"): 'give the event a name: name = "..."',
    ("event", "when"): 'add when = "...", whose zeros are the event',
    ("force", "body"): 'name the body that it acts on, body = "..."; a force along a coordinate '
    'stands in [forces], x = "F - b*x_dot"',
}


_REQUIRED = ("name", "stiffness", "damping", "when")  # keys of entries of arrays


def repair(tree: dict[str, Any], path: tuple[str, ...]) -> None:
    """Replace the faulty entry at `path` in the tree by a valid one, or remove it.

    The tree is changed so that all other entries can be checked; the error is reported elsewhere.
    """
    table, last = table_at(tree, path[:-1]), path[-1]
    value = table.get(last)
    if len(path) == 1 and isinstance(value, list) and all(isinstance(g, dict) for g in value):
        table[last] = {key: value for g in value for key, value in g.items()}  # [[parameters]]
    elif path in _PLACEHOLDERS:
        table[last] = _PLACEHOLDERS[path]
    elif len(path) == 3 and last in _REQUIRED:
        table[last] = f"{path[0]}_{path[1]}" if last == "name" else 1.0
    elif path[0] == "loop" and last == "joint":
        table[last] = ""
    elif len(path) == 3 and last == "body" and path[0] in ("force", "point"):
        bodies = table_at(tree, ("body",))  # where there are none, no table
        table[last] = next((table_at(bodies, (b,)).get("name", b) for b in bodies), "world")
    elif len(path) == 2 and path[0] in ("definitions", "forces"):
        table[last] = "0"
    elif len(path) == 2 and path[0] in ("coordinates", "inputs"):
        table[last] = {}
    elif last in ("value", "formula"):
        table_at(tree, path[:1])[path[1]] = 1.0
    else:
        table.pop(last, None)


_PLACEHOLDERS: Mapping[tuple[str, ...], Any] = {
    ("eomc",): 1,
    ("name",): "scene",
    ("energy",): {"kinetic": "0"},
    ("energy", "kinetic"): "0",
}
