"""The keys of a scene are described in one place; validation and the JSON Schema agree on them."""

from __future__ import annotations

import copy
import json
import tomllib
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from support.bad_scenes import BASES
from support.cases import SCENES
from support.scene_author import scene_text

from eomc.base.errors import SceneError
from eomc.cli.main import main
from eomc.scene import schema
from eomc.scene.read import parse
from eomc.scene.schema import Key, json_schema

jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
SCHEMA = json_schema()
VALIDATOR = jsonschema.Draft7Validator(SCHEMA)

TABLES = {
    name: key.table for name, key in schema.keys(schema.Document).items() if key.table is not None
}
MODELS = {"": schema.Document, **TABLES}
KEYS = {
    f"{table}.{name}".lstrip("."): key
    for table, model in MODELS.items()
    for name, key in schema.keys(model).items()
}
# values of every type in TOML; each is valid for some key
VALUES: list[Any] = [
    1, 0, -1.5, 2, 1e-9, 0.5, True, False, "", "x", "l*sin(theta)", "rk4", "auto", "double",
    "smooth", "parameters", "both", "record", "world", "xy", [], [1], ["x"], [1, 2], ["a", "b"],
    ["a", "b", "c"],
    [1, "x", 3], ["rk4", "dp8"], ["rk4", "ode45"], [["z", "pi/2"]], [["w", 1]], [["z", 1, 2]],
    [["z"]], [[0, 0], ["l", 0]], [[0, 0, 1], [1, 0, 0]], [[0, 0]], [["a", "b"], ["a", "b", "c"]],
    [["a"]], [True], [[True]], {}, {"tip": ["x", 0]}, {"tip": 1}, {"at": "a", "size": [1, 2]},
    [{"at": [0, 0], "radius": 0.1}], [{"at": "a", "radius": 1, "colour": 2}], [{"size": [1, 2]}],
    [{"at": "a", "size": [1, 2], "rotation": [["z", 1]]}], ["0", "inf"],
]  # fmt: skip


def accepts(key: Key, value: object) -> bool:
    """Return whether validation accepts a value for a key."""
    assert key.type
    try:
        key.type(copy.deepcopy(value))
    except ValueError:
        return False
    return True


def scene_texts() -> Iterator[tuple[str, str]]:
    """Yield scenes by name: those that come with eomc, those of tests, and random ones."""
    for file in sorted(SCENES.glob("*.toml")):
        yield file.name, file.read_text(encoding="utf-8")
    yield from BASES.items()
    for number in range(40):
        yield f"random scene {number}", scene_text(number)


TEXTS = dict(scene_texts())


@pytest.mark.parametrize("name", TEXTS)
def test_json_schema_accepts_valid_scenes(name: str) -> None:
    faults = [*VALIDATOR.iter_errors(tomllib.loads(TEXTS[name]))]
    assert [(fault.json_path, fault.message) for fault in faults] == []


def test_json_schema_is_one_itself() -> None:
    jsonschema.Draft7Validator.check_schema(SCHEMA)


@pytest.mark.parametrize("name", KEYS)
def test_json_schema_and_validation_accept_the_same_values(name: str) -> None:
    key = KEYS[name]
    if key.type is None or key.container:
        return
    validator = jsonschema.Draft7Validator(key.type.json_schema)
    decisions = [(value, accepts(key, value), validator.is_valid(value)) for value in VALUES]
    assert [value for value, by_eomc, by_schema in decisions if by_eomc != by_schema] == []
    assert any(by_eomc for _, by_eomc, _ in decisions)
    assert not all(by_eomc for _, by_eomc, _ in decisions)


def tree_with(table: str, name: str, value: object) -> dict[str, Any]:
    """Return the tree of a scene in which one table has one more entry."""
    tree = tomllib.loads(BASES["pendulum"])
    entry = {name: value}
    if not table:
        return tree | entry
    key = schema.keys(schema.Document)[table]
    if key.container == "array":
        return tree | {table: [entry]}
    return tree | {table: {"thing": entry} if key.container else entry}


@pytest.mark.parametrize("table", [table for table in MODELS if table != "event"])
def test_json_schema_refuses_unknown_keys(table: str) -> None:
    faults = VALIDATOR.iter_errors(tree_with(table, "no_key_of_a_scene", 1))
    messages = [part.message for fault in faults for part in (fault, *(fault.context or ()))]
    assert any("no_key_of_a_scene" in message for message in messages)


REQUIRED = [name for name, key in KEYS.items() if key.missing]


@pytest.mark.parametrize("name", [name for name in REQUIRED if "." not in name])
def test_both_refuse_scenes_without_a_required_entry(name: str) -> None:
    text = 'eomc = 1\nname = "a"\n[coordinates]\nx = {}\n[energy]\nkinetic = "x_dot**2/2"\n'
    tree = tomllib.loads(text)
    assert VALIDATOR.is_valid(tree)
    parse(text, "a.toml")
    del tree[name]
    assert not VALIDATOR.is_valid(tree)
    lines = text.splitlines()
    start = next(k for k, line in enumerate(lines) if line.split(" ")[0].strip("[]") == name)
    count = 2 if lines[start].startswith("[") else 1
    with pytest.raises(SceneError, match=f"{name}: missing|coordinates: "):
        parse("\n".join(lines[:start] + lines[start + count :]), "a.toml")


@pytest.mark.parametrize("name", [name for name in REQUIRED if "." in name])
def test_json_schema_requires_what_validation_requires_of_a_table(name: str) -> None:
    table, _, own = name.partition(".")
    tree = tree_with(table, "note", "")
    faults = [f"{fault.message} {fault.context}" for fault in VALIDATOR.iter_errors(tree)]
    assert any(f"'{own}' is a required property" in fault for fault in faults)


def test_energies_are_optional_in_scenes_of_bodies() -> None:
    tree = tomllib.loads(BASES["arm"])
    tree.pop("energy", None)
    assert VALIDATOR.is_valid(tree)
    del tree["body"]
    assert not VALIDATOR.is_valid(tree)


UNITS = set("m, rad, kg, s, N, J, W, unit, unit/s, m/s, rad/s, m/s^2, m/rad, kg m^2".split(", "))
UNITS |= {"N m", "N/m", "N m/rad", "N s/m", "N m s/rad"}


@pytest.mark.parametrize("name", KEYS)
def test_every_key_has_one_sentence_and_known_units(name: str) -> None:
    key = KEYS[name]
    assert key.about.endswith(".") and ". " not in key.about and len(key.about) < 100
    assert set(filter(None, key.unit.split(", "))) <= UNITS


def test_every_field_of_the_document_has_a_key() -> None:
    derived = {"written", "jump"}  # the keys of a table, and keys named by the scene
    for model in MODELS.values():
        assert {f.name for f in fields(model) if not f.metadata} <= derived


def test_command_writes_the_json_schema(tmp_path: Path) -> None:
    file = tmp_path / "scene.schema.json"
    result = CliRunner().invoke(main, ["schema"])
    assert result.exit_code == 0 and json.loads(result.output) == SCHEMA
    result = CliRunner().invoke(main, ["schema", "--out", str(file)])
    assert result.exit_code == 0 and json.loads(file.read_text(encoding="utf-8")) == SCHEMA
    assert "#:schema" in result.output
