"""The layout of a scene file as pydantic models, with remedies for errors in it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any, Literal

import pydantic

from eomc.base import texts
from eomc.integrators.tableaux import METHODS
from eomc.scene import messages, spelling
from eomc.scene.aliases import ALIASES, ALIASES_OF
from eomc.scene.formulas import nearest

REALS, FRICTIONS = ("double", "float"), ("smooth", "stick")
DIRECTIONS, ACTIONS = ("both", "rising", "falling"), ("record", "stop", "jump")
MIN_TOLERANCE, MAX_TOLERANCE = 1e-15, 1e-2
MIN_FLOAT_TOLERANCE = 5e-7  # in single precision
DEFAULT_TOLERANCE = {"double": 1e-9, "float": 1e-5}  # of a scene with events, by its real type
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


_Limits = Annotated[tuple[float | str | None, ...], pydantic.PlainValidator(spelling.limits)]


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
    linearize: Annotated[bool | str, pydantic.PlainValidator(spelling.linearized)] = False
    discretize: pydantic.StrictBool = False
    frames: Annotated[bool | tuple[str, ...], pydantic.PlainValidator(spelling.frame_selection)] = (
        False
    )
    inverse_dynamics: pydantic.StrictBool = False
    momentum: pydantic.StrictBool = False
    tolerance: _Tolerance | None = None
    friction: Literal[FRICTIONS] = "smooth"  # type: ignore[valid-type]


def _as_table(key: str, value: object) -> object:
    """Return `m = 2.0` as `m = { value = 2.0 }`."""
    return value if isinstance(value, dict) else {key: value}


_Short = Annotated[QuantityTable, pydantic.BeforeValidator(partial(_as_table, "value"))]
_Formula = Annotated[OutputTable, pydantic.BeforeValidator(partial(_as_table, "formula"))]


_Vector = Annotated[tuple[float | str, ...], pydantic.PlainValidator(spelling.vector)]
_Each = Annotated[float | str | tuple[float | str, ...], pydantic.PlainValidator(spelling.each)]
_Rotation = Annotated[
    float | str | tuple[tuple[str, float | str], ...], pydantic.PlainValidator(spelling.rotation)
]
_Axes = Annotated[tuple[tuple[float, ...], ...], pydantic.PlainValidator(spelling.axes)]
_Names = Annotated[tuple[str, ...], pydantic.PlainValidator(spelling.names)]
_TwoNames = Annotated[tuple[str, ...], pydantic.PlainValidator(spelling.two_names)]
_TwoCoordinates = Annotated[tuple[str, ...], pydantic.PlainValidator(spelling.two_coordinates)]
_Points = Annotated[tuple[tuple[float | str, ...], ...], pydantic.PlainValidator(spelling.points)]


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


class _Between(_Table):
    """Common keys of springs and dampers."""

    coordinate: pydantic.StrictStr | None = None
    bodies: _TwoNames | None = None
    points: _Points | None = None
    turning: pydantic.StrictBool = False
    note: _Note = ""


class SpringTable(_Between):
    """A [[spring]] in the file."""

    stiffness: _Value
    length: _Value = 0.0


class DamperTable(_Between):
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


_Places = Annotated[tuple[spelling.Place, ...], pydantic.PlainValidator(spelling.places)]
_Lines = Annotated[tuple[Any, ...], pydantic.PlainValidator(spelling.lines)]
_Ends = Annotated[tuple[Any, ...], pydantic.PlainValidator(spelling.ends)]
_Boxes = Annotated[tuple[Any, ...], pydantic.PlainValidator(spelling.boxes)]
_Circles = Annotated[tuple[Any, ...], pydantic.PlainValidator(spelling.circles)]


class PictureTable(_Table):
    """The table [picture] in the file."""

    points: Annotated[dict[str, Any], pydantic.PlainValidator(spelling.named_points)] = {}
    dots: _Places = ()
    lines: _Lines = ()
    springs: _Ends = ()
    boxes: _Boxes = ()
    circles: _Circles = ()
    paths: _Places = ()
    axes: Annotated[str, pydantic.PlainValidator(spelling.plane_axes)] = ""


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


# --- faults in words ---

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
    here = spelling.short_toml(received)
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
