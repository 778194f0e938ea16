"""Free text is data: every field is combined with every payload, and none is executed.

Text on terminals, in pages and in figures: test_texts_shown.py.
"""

from __future__ import annotations

import ast
import dataclasses
import json
import os
import re
import subprocess
import sys
import tomllib
import unicodedata
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
import pytest
import sympy
from support.payloads import (
    FEW,
    ORDINARY,
    PAYLOADS,
    RAW,
    TOUCH,
    derived,
    fields,
    filled,
    generated,
    nothing_ran,
    payloads,
    quoted,
    tokens,
    with_texts,
)
from support.session import needs, tiers

import eomc
from eomc.base import texts
from eomc.base.errors import EomcError, SceneError
from eomc.emit import render
from eomc.emit.common import templates
from eomc.model.system import System, from_scene
from eomc.report import equations_text
from eomc.report.equations_text import write_equations
from eomc.scene import schema
from eomc.scene.read import parse


@pytest.fixture(autouse=True)
def no_payload_runs() -> Iterator[None]:
    with nothing_ran():
        yield


@pytest.mark.parametrize("name", ["docstring", "comment"])
def test_payloads_run_when_pasted_into_code(name: str, tmp_path: Path) -> None:
    """Otherwise none of the tests below could fail."""
    with pytest.raises(AssertionError, match="a text was executed"), nothing_ran():
        if name == "docstring":
            exec(f'"""{PAYLOADS[name]}"""')
        else:
            (tmp_path / "x.c").write_text(f"int main(void) {{ return 0; }} /* {PAYLOADS[name]} */")
            subprocess.run([needs("gcc"), "x.c", "-o", "x"], cwd=tmp_path, check=True)
            subprocess.run(["./x"], cwd=tmp_path, check=True)


# --- the reader -----------------------------------------------------------------------------------


def should_be_refused(text: str, lines: bool) -> bool:
    """Return whether the reader should refuse a text, by the tables of Unicode."""
    control_categories = ("Cc", "Zl", "Zp", "Cs")
    marks = [
        unicodedata.lookup(f"{direction} MARK") for direction in ("LEFT-TO-RIGHT", "RIGHT-TO-LEFT")
    ]
    return any(
        (unicodedata.category(c) in control_categories and not (lines and c in "\t\n"))
        or (unicodedata.bidirectional(c) in "LRE RLE PDF LRO RLO LRI RLI FSI PDI".split())
        or c in (*marks, unicodedata.lookup("ARABIC LETTER MARK"))
        for c in text
    )


def test_every_free_text_field_of_a_scene_is_tested() -> None:
    """A new table must not be forgotten here; tables of one model count as one."""
    models: dict[str, Any] = {"": schema.Document} | {
        f.name: model
        for f in dataclasses.fields(schema.Document)
        if (model := f.metadata["key"].table)
    }
    known = {
        (model, f.name)
        for model in models.values()
        for f in dataclasses.fields(model)
        if f.metadata and f.metadata["key"].type in (schema.line, schema.note)
    }
    paths = (key.split(".") for _, key in fields())
    tested = {(models[path[0] if len(path) > 1 else ""], path[-1]) for path in paths}
    tested.add((schema.LoopTable, "note"))  # which has a test of its own, below
    assert tested == known and len(known) > 12


@pytest.mark.parametrize(
    ("which", "key"), tiers(fields(), *range(0, len(fields()), 4)), ids=[key for _, key in fields()]
)
def test_the_reader_refuses_hidden_characters_and_names_line_and_key(which: int, key: str) -> None:
    for name, payload in PAYLOADS.items():
        text = filled({which: payload})
        try:
            parse(text, "f.toml")
            refused = False
        except SceneError as error:
            refused = True
            (problem,) = error.problems
            if name == "half a character":  # which TOML itself cannot express
                assert "not TOML" in problem.message
            else:
                assert problem.key == key
                assert re.search(r"U\+[0-9A-F]{4}|line break", problem.message)
                assert f"{key.split('.')[-1]} = " in text.splitlines()[problem.line - 1]
            assert not RAW.search(str(error))
        assert refused == should_be_refused(payload, lines=key.endswith("note")), name


LOOP = """eomc = 1
name = "mesh"
gravity = [0, 0]
[coordinates]
a = { unit = "rad" }
b = { unit = "rad" }
[[body]]
name = "one"
joint = "revolute"
coordinates = "a"
inertia = 1
[[body]]
name = "two"
joint = "revolute"
coordinates = "b"
inertia = 1
[[loop]]
name = "gears"
joint = "gear"
coordinates = ["a", "b"]
ratio = 2
note = "@"
"""


@payloads
def test_loop_note_with_hidden_characters_is_refused(payload: str) -> None:
    """Scenes with this note are read but no code is generated from them here."""
    try:
        parse(LOOP.replace('"@"', quoted(payload)), "f.toml")
        refused = False
    except SceneError as error:
        refused = True
        assert not RAW.search(str(error))
    assert refused == should_be_refused(payload, lines=True)


@pytest.mark.slow
def test_ordinary_texts_and_multiline_notes_are_accepted() -> None:
    note = "first line\nsecond *line*,\n\n\tindented: θ"
    for which, key in fields():
        parse(filled({which: ORDINARY}), "f.toml")
        if key.endswith("note"):
            parse(filled({which: note}), "f.toml")
    system = from_scene(parse(filled({1: note, 3: note}), "f.toml"))
    files = eomc.sources(system).files
    assert " * first line second *line*, indented: θ\n" in files["fields.h"]
    assert "/* plain, first line second *line*, indented: θ */" in files["fields.h"]
    assert "x: plain, first line second *line*, indented: θ\n" in files["__init__.py"]


# --- what is generated ----------------------------------------------------------------------------


def code_without_literals(module_text: str) -> str:
    """Return the syntax tree of the Python module with empty string literals."""
    tree = ast.parse(module_text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            node.value = ""
    return ast.dump(tree)


@cache
def plain_files() -> dict[str, str]:
    return generated("plain", "f.toml")


@cache
def plain_tokens(folder: Path) -> str:
    return tokens(plain_files(), folder)


@pytest.mark.parametrize("payload", tiers(PAYLOADS.values(), *FEW), ids=PAYLOADS)
def test_texts_do_not_change_generated_code(
    payload: str, tmp_path: Path, tmp_path_factory: Any
) -> None:
    files, folder = generated(payload), tmp_path_factory.getbasetemp()
    assert tokens(files, tmp_path) == plain_tokens(folder)
    module_text = files["__init__.py"]
    assert code_without_literals(module_text) == code_without_literals(plain_files()["__init__.py"])
    assert repr(payload) in module_text
    for name, text in files.items():
        assert not RAW.search(text), name
        assert not re.search(r"(\\|\?\?/)$", text, re.M) or name.endswith(".py"), name
    doc = ast.get_docstring(ast.parse(module_text), clean=False)
    assert doc is not None and doc.startswith(texts.line(payload) + ": compiled equations")


def test_ordinary_text_is_written_unchanged(tmp_path: Path) -> None:
    files = generated(ORDINARY, "Καρό.toml")
    tokens(files, tmp_path)
    for name in ("fields.h", "fields.c", "main.c", "selftest.c", "__init__.py"):
        shown = ORDINARY.replace("\\", "\\\\") if name == "__init__.py" else ORDINARY
        assert shown in files[name], name
        assert "eomc build Καρό.toml" in files[name] or "'Καρό.toml'" in files[name]
    assert texts.line(ORDINARY) == ORDINARY and tomllib.loads(f"x = {texts.toml(ORDINARY)}") == {
        "x": ORDINARY
    }


def strings(value: Any) -> Iterator[str]:
    """Yield all strings in a value and in the containers in it."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for key, each in value.items():
            yield from strings(key)
            yield from strings(each)
    elif isinstance(value, (list, tuple, set)):
        for each in value:
            yield from strings(each)


def test_templates_read_free_text_only_as_free_text(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every attribute that a template reads, and every result of a call, is recorded."""
    values: list[Any] = []
    read_attribute, call = templates.Environment.getattr, jinja2.runtime.Context.call

    def getattr_(self: templates.Environment, obj: Any, attribute: str) -> Any:
        value = read_attribute(self, obj, attribute)
        values.extend([] if isinstance(obj, texts.FreeText) else [value])
        return value

    def call_(self: Any, *arguments: Any, **passed: Any) -> Any:
        values.append(call(self, *arguments, **passed))
        return values[-1]

    monkeypatch.setattr(templates.Environment, "getattr", getattr_)
    monkeypatch.setattr(jinja2.runtime.Context, "call", call_)
    model = derived()
    marked = replace(model, system=with_texts(model.system, "MARKED"))
    rendered = [render.render(marked, "_x").files["main.c"], render.unit(marked, 2).files]
    assert "MARKED" in str(rendered) and len(values) > 1000
    assert not [s for s in strings(values) if "MARKED" in s]


def test_printing_free_text_without_escape_raises() -> None:
    text = texts.FreeText("*/")
    for print_it in (str, "{}".format, lambda x: f"{x}", lambda x: "".join(map(str, [x]))):
        with pytest.raises(TypeError, match="free text"):
            print_it(text)
    environment = templates.environment()
    for template in ("{{ x }}", "{{ 'a' ~ x }}", "{{ [x, x] | join }}"):
        with pytest.raises(TypeError, match="free text"):
            environment.from_string(template).render(x=text)
    assert "*/" not in environment.from_string("{{ [x] }}{{ {'a': x} }}").render(x=text)
    with pytest.raises(jinja2.UndefinedError):
        environment.from_string("{{ x.coment }}").render(x=text)


IMPORTED = """
import importlib, json, sys
m = importlib.import_module("fields")
m.simulate(steps=3)
print(json.dumps([m.title, m.units, m.__doc__]))
"""


def run_module_and_programs(
    system: System, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> list[Any]:
    """Build and import the module in another process; compile and run the C programs too."""
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    built = eomc.build(system, folder)
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONIOENCODING": "utf-8"}
    process = subprocess.run(
        [sys.executable, "-c", IMPORTED], env=environment, capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr
    for file in ("main.c", "selftest.c"):
        command = [needs("gcc"), "-std=c99", "-Wall", "-Wextra", "-Werror", "-I."]
        parts = ("-o", file[:-2], file, "fields.c", "-lm")
        subprocess.run([*command, *parts], cwd=built.folder, check=True)
        printed = subprocess.run([f"./{file[:-2]}"], cwd=built.folder, capture_output=True)
        assert printed.returncode == 0 and not RAW.search(printed.stdout.decode())
    reported: list[Any] = json.loads(process.stdout)
    return reported


def test_all_payloads_at_once_build_import_and_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    all_payloads = " ".join(PAYLOADS.values())
    system = replace(with_texts(derived().system, all_payloads), digest="0" * 64)
    title, units, doc = run_module_and_programs(system, tmp_path, monkeypatch)
    assert title == all_payloads and units == dict.fromkeys(("x", "m", "g", "u", "y"), all_payloads)
    assert texts.line(all_payloads) in doc


@pytest.mark.slow
@payloads
def test_each_payload_builds_imports_and_runs(
    payload: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = replace(with_texts(derived().system, payload), digest="0" * 64)
    title, units, _ = run_module_and_programs(system, tmp_path, monkeypatch)
    assert title == payload and units == dict.fromkeys(("x", "m", "g", "u", "y"), payload)


@pytest.mark.parametrize(
    "payload", tiers(PAYLOADS.values(), *(PAYLOADS[k] for k in ("docstring", "spliced", "NUL"))),
    ids=PAYLOADS,
)  # fmt: skip
def test_systems_defined_in_python_generate_no_payload(payload: str) -> None:
    x, m = sympy.Symbol(payload), sympy.Symbol(payload + "m")
    v = sympy.Symbol(f"{payload}_dot")
    system = System.make(
        "made", {x: 1.0}, m * v**2 / 2, m * x**2, parameters={m: 1}, units={x: payload, m: payload},
        title=payload,
    )  # fmt: skip
    for name, text in eomc.sources(system).files.items():
        assert not RAW.search(text), name
        if name.endswith(".py"):
            ast.parse(text)
    namespace: dict[str, Any] = {}
    exec(write_equations(system, "python"), namespace)
    assert namespace["__doc__"].startswith(texts.line(payload) + ": D qdd")
    text, latex = (write_equations(system, form) for form in ("text", "latex"))
    ours = {"begin", "end", "ddot", "dot", "frac", "left", "mathrm", "quad", "right"}
    # only names, which are plain
    assert {*re.findall(r"\\([A-Za-z]+)", latex)} <= ours and not re.search("[$#%]", latex)
    for shown in (text, latex, equations_text.write_costs(system)):
        assert not RAW.search(shown)


def test_unchecked_names_are_not_written_to_code() -> None:
    whole = derived()
    x = whole.system.coordinates[0]
    for changed in (
        replace(whole.system, name="a */ b"),
        replace(whole.system, coordinates=(replace(x, name='x"'),)),
        replace(whole.system, definitions=((sympy.Symbol("a\n"), sympy.S.One),)),
    ):
        with pytest.raises(ValueError, match="is not a plain name"):
            render.render(replace(whole, system=changed), "_extension")


def test_titles_and_units_must_be_strings() -> None:
    x, v = sympy.symbols("x x_dot")

    class Odd(str):
        def __repr__(self) -> str:
            return f"__import__('os').system({TOUCH!r})"

    for wrong in (3, None, b"x", sympy.Symbol("x")):
        with pytest.raises(EomcError, match=r"units\.x: must be text, here"):
            System.make("made", [x], v**2, title="x", units={x: wrong})  # type: ignore[dict-item]
    system = System.make("made", [x], v**2, title=Odd("x"), units={x: Odd("y")})
    module_text = eomc.sources(system).files["__init__.py"]
    assert "system(" not in module_text and "title='x'" in module_text
