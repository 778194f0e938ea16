"""The layout of a scene file: its tables and keys as pydantic models, and their faults in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import pydantic

from eomc.formulas import nearest

METHODS = ("rk4", "dp8")
REALS = ("double", "float")

_Number = Annotated[float, pydantic.Field(strict=True, allow_inf_nan=False)]
_Value = _Number | pydantic.StrictStr
_Positive = Annotated[float, pydantic.Field(strict=True, gt=0, allow_inf_nan=False)]


class _Table(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class _Coordinate(_Table):
    unit: pydantic.StrictStr = ""
    start: _Value = 0.0
    rate: _Value = 0.0
    note: pydantic.StrictStr = ""


class QuantityTable(_Table):
    """A parameter or constant as it is written."""

    value: _Value
    unit: pydantic.StrictStr = ""
    note: pydantic.StrictStr = ""


class _Input(_Table):
    unit: pydantic.StrictStr = ""
    signal: _Value = 0.0
    note: pydantic.StrictStr = ""


class _Energy(_Table):
    kinetic: _Value
    potential: _Value = 0.0
    dissipation: _Value = 0.0


def _listed(value: object) -> object:
    """`method = "rk4"` says the same as `method = ["rk4"]`; the first is what runs use."""
    if isinstance(value, list) and value:
        return tuple(dict.fromkeys(map(str, value)))
    return (value,)


_Methods = Annotated[
    tuple[Literal[METHODS], ...],  # type: ignore[valid-type]
    pydantic.BeforeValidator(_listed),
]


class _Run(_Table):
    h: _Positive = 0.001
    duration: _Positive = 10.0
    method: _Methods = ("rk4",)
    real: Literal[REALS] = "double"  # type: ignore[valid-type]
    batch: pydantic.StrictBool = False


def _spelled_out(value: object) -> object:
    """`m = 2.0` says the same as `m = { value = 2.0 }`."""
    return value if isinstance(value, dict) else {"value": value}


_Short = Annotated[QuantityTable, pydantic.BeforeValidator(_spelled_out)]


class Document(_Table):
    """A whole scene as it is written."""

    eomc: Literal[1]
    name: pydantic.StrictStr
    title: pydantic.StrictStr = ""
    note: pydantic.StrictStr = ""
    coordinates: dict[str, _Coordinate] = pydantic.Field(min_length=1)
    parameters: dict[str, _Short] = {}
    constants: dict[str, _Short] = {}
    inputs: dict[str, _Input] = {}
    definitions: dict[str, _Value] = {}
    energy: _Energy
    forces: dict[str, _Value] = {}
    run: _Run = _Run()


# --- faults in words ---

_MODELS: Mapping[str, type[_Table]] = {
    "coordinates": _Coordinate,
    "parameters": QuantityTable,
    "constants": QuantityTable,
    "inputs": _Input,
    "energy": _Energy,
    "run": _Run,
}

# what people write instead of our keys
_ALIASES = {
    "dt": "h", "step": "h", "time": "duration", "tend": "duration", "t_end": "duration",
    "initial": "start", "init": "start", "velocity": "rate", "units": "unit", "val": "value",
    "variables": "coordinates", "params": "parameters", "T": "kinetic", "K": "kinetic",
    "V": "potential", "U": "potential", "P": "potential", "R": "dissipation",
}  # fmt: skip


def table_at(tree: Any, path: tuple[str, ...]) -> dict[str, Any]:
    """The table at `path`; an empty one where there is none."""
    for part in path:
        tree = tree.get(part) if isinstance(tree, dict) else None
    return tree if isinstance(tree, dict) else {}


def has(tree: dict[str, Any], path: tuple[str, ...]) -> bool:
    """Whether the entry at `path` is there."""
    return path[-1] in table_at(tree, path[:-1])


def place(error: Mapping[str, Any]) -> tuple[str, ...]:
    """pydantic's place without the branch of a union."""
    path = tuple(map(str, error["loc"]))
    if path[:2] == ("run", "method"):  # whichever of a list
        return path[:2]
    branch = path[-1] in ("float", "str") and error["type"] in _OF_BRANCHES
    return path[:-1] if branch else path


_OF_BRANCHES = ("float_type", "string_type", "finite_number")


def _keys(path: tuple[str, ...]) -> list[str]:
    """The keys that may stand beside the last of `path`."""
    model = _MODELS[path[0]] if len(path) > 1 else Document
    return list(model.model_fields)


def meant(path: tuple[str, ...]) -> str:
    """The key that the last of `path` may have been meant for, or the empty string."""
    known, alias = _keys(path), _ALIASES.get(path[-1], "")
    return alias if alias in known else nearest(path[-1], known)


def _toml(value: object) -> str:
    """A value as TOML writes it, shortened."""
    if isinstance(value, bool):
        text = str(value).lower()
    elif isinstance(value, dict):
        text = "a table"
    else:
        text = repr(value) if isinstance(value, (str, list, float, int)) else str(value)
    return text if len(text) <= 40 else text[:37] + "..."


def say(error: Mapping[str, Any], path: tuple[str, ...]) -> str:
    """One of pydantic's faults in our words, with the remedy."""
    kind, given, last = str(error["type"]), error.get("input"), path[-1]
    here = _toml(given)
    if kind == "missing":
        return "missing: " + _MISSING.get(path, f"add {last} = ...")
    if kind == "extra_forbidden":
        near = meant(path)
        remedy = f"; did you mean '{near}'?" if near else f": known are {', '.join(_keys(path))}"
        return f"unknown {'table' if isinstance(given, dict) else 'key'} '{last}'{remedy}"
    if path == ("eomc",):
        return f"format {here} is not known to this version, which reads eomc = 1"
    if kind == "too_short":
        return 'none is declared: add at least one, such as x = { unit = "m", start = 0.0 }'
    if path[:2] == ("run", "method"):
        return f"unknown method {here}: known are {', '.join(METHODS)}"
    if path == ("run", "real"):
        return f"unknown type {here}: known are {', '.join(REALS)}"
    if kind == "greater_than":
        return f"must be greater than zero, here {here}"
    if kind == "finite_number":
        return f"must be a finite number, here {here}"
    if kind in ("dict_type", "model_type", "model_attributes_type"):
        if len(path) == 1:
            return f"'{last}' is a table: write [{last}] and its entries below"
        key = {"coordinates": "start", "inputs": "signal"}.get(path[0], "value")
        value = here if isinstance(given, (int, float, str)) else "..."
        return f"'{last}' is a table: write {last} = {{ {key} = {value} }}"
    if path == ("run", "batch"):
        return f"must be true or false, here {here}"
    if path[0] == "run":
        return f"must be a number, here {here}"
    if last in ("unit", "note", "name", "title"):
        return f"must be text in quotes, here {here}"
    return f"must be a number or a formula in quotes, here {here}"


_MISSING: Mapping[tuple[str, ...], str] = {
    ("eomc",): "begin the scene with eomc = 1, its format",
    ("name",): 'add name = "...", which names the module and begins every C symbol',
    ("coordinates",): 'add [coordinates] with entries such as x = { unit = "m", start = 0.0 }',
    ("energy",): 'add [energy] with kinetic = "..." and potential = "..."',
    ("energy", "kinetic"): 'add kinetic = "..."',
}


def mend(tree: dict[str, Any], path: tuple[str, ...]) -> None:
    """Put something harmless in a faulty entry's place, so that the rest can be checked."""
    table, last = table_at(tree, path[:-1]), path[-1]
    given = table.get(last)
    if isinstance(given, list) and given and all(isinstance(g, dict) for g in given):
        table[last] = {key: value for g in given for key, value in g.items()}  # [[parameters]]
    elif path in _HARMLESS:
        table[last] = _HARMLESS[path]
    elif len(path) == 2 and path[0] in ("definitions", "forces"):
        table[last] = "0"
    elif len(path) == 2 and path[0] in ("coordinates", "inputs"):
        table[last] = {}
    elif last == "value":
        table_at(tree, path[:1])[path[1]] = 1.0
    else:
        table.pop(last, None)


_HARMLESS: Mapping[tuple[str, ...], Any] = {
    ("eomc",): 1,
    ("name",): "scene",
    ("energy",): {"kinetic": "0"},
    ("energy", "kinetic"): "0",
}
