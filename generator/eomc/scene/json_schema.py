"""The JSON Schema of scene files, for editors that complete and check TOML."""

from __future__ import annotations

from typing import Any

from eomc.scene import schema
from eomc.scene.read import TABLES
from eomc.scene.schema import Key
from eomc.scene.toml_text import ARRAYS
from eomc.scene.value_types import entry

DIALECT = "http://json-schema.org/draft-07/schema#"  # the latest that TOML editors support in full
REPEAT = {
    "type": "string",
    "pattern": r"=.*\.\.",
    "description": 'Range over which the entry is repeated, such as "i = 1..n".',
}


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of a scene file as a dict.

    It accepts every valid scene. Rules that depend on other entries of a scene, such as which names
    a formula may use, are checked by `eomc build` alone.
    """
    scene = _table(schema.Document)
    for name in TABLES:
        value = scene["properties"][name]["additionalProperties"]
        tables = [x for x in value.get("anyOf", [value]) if x.get("type") == "object"]
        for one in tables:
            one["properties"]["repeat"] = REPEAT
        if not tables:  # formulas
            repeated = {
                "type": "object",
                "properties": {"repeat": REPEAT, "value": value},
                "required": ["repeat", "value"],
                "additionalProperties": False,
            }
            scene["properties"][name]["additionalProperties"] = {"anyOf": [value, repeated]}
    for name in ARRAYS:
        scene["properties"][name]["items"]["properties"]["repeat"] = REPEAT
    return {"$schema": DIALECT, "title": "Scene of eomc", **scene}


def _table(model: type) -> dict[str, Any]:
    keys = schema.keys(model)
    required = [name for name, key in keys.items() if key.missing and not key.unless]
    jump = "jump" in model.__dataclass_fields__  # type: ignore[attr-defined]
    out = {
        "type": "object",
        "properties": {name: _property(key) for name, key in keys.items()},
        "required": required,
        "additionalProperties": entry.json_schema if jump else False,
    }
    for name, key in keys.items():
        if key.unless and key.table:  # a required table
            condition = {"not": {"required": [key.unless]}}
            out |= {"if": condition, "then": {"required": [name], "properties": {
                name: {"required": [k for k, x in schema.keys(key.table).items() if x.missing]}
            }}}  # fmt: skip
    return out


def _property(key: Key) -> dict[str, Any]:
    unit = f" [{key.unit}]" if key.unit else ""
    description = {"description": f"{key.about}{unit}"}
    value: dict[str, Any] = dict(key.type.json_schema) if key.type else _table(key.table)
    if key.short:
        value = {"anyOf": [entry.json_schema, value]}
    if key.container == "table":
        value = {"type": "object", "additionalProperties": value}
        if key.missing:
            value["minProperties"] = 1
    elif key.container == "array":
        value = {"type": "array", "items": value}
    return description | value
