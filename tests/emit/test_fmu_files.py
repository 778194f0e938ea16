"""Test the text of FMUs without an importer: units of measurement, dependencies, C, determinism."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path

import pytest
from support.compilation import compiled, run
from support.fmus import BALL, FLOAT, RIG, derived_of
from support.payloads import FEW, PAYLOADS, RAW, derived, tokens, with_texts
from support.session import EVERYTHING, needs, tiers

from eomc import pipeline
from eomc.base import resources, texts
from eomc.emit import render
from eomc.emit.fmu import Unit, parse_unit
from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.toolchain.files import write_files

ODD = """
eomc = 1
name = "odd_names"
title = "Quotes \\" ' and ]]> & <b> --> here"
[coordinates]
theta = { unit = "<rad & \\"more\\">", note = "ends a comment: */ --> ' & é" }
near = { start = 1.0 }
[parameters]
MAX_FORCE = { value = 2.0, unit = "kg m^2/s^2" }
energy = 1.0
t_1 = 1.0
[energy]
kinetic = "(theta_dot**2 + near_dot**2)/2"
potential = "MAX_FORCE*cos(theta) + energy*near**2 + t_1*near"
"""


def unit_from(text: str, version: int) -> Unit:
    return render.unit(derived_of(text), version)


def derive_unit_again(text: str, version: int) -> Unit:
    return pipeline.unit(from_scene(parse(text, "test.toml")), version)


def description_of(unit: Unit) -> ET.Element:
    return ET.fromstring(unit.files["modelDescription.xml"])


@pytest.mark.parametrize(
    "text, attributes",
    [
        ("m", {"m": "1"}),
        ("N", {"kg": "1", "m": "1", "s": "-2"}),
        ("m/s^2", {"m": "1", "s": "-2"}),
        ("m/s2", {"m": "1", "s": "-2"}),
        ("m s**-2", {"m": "1", "s": "-2"}),
        ("m·s⁻²", {"m": "1", "s": "-2"}),
        ("N.m", {"kg": "1", "m": "2", "s": "-2"}),
        ("N m/rad", {"kg": "1", "m": "2", "s": "-2", "rad": "-1"}),
        ("N/(m/s)", {"kg": "1", "s": "-1"}),
        ("(N m)/s", {"kg": "1", "m": "2", "s": "-3"}),
        ("1/s", {"s": "-1"}),
        ("kN", {"kg": "1", "m": "1", "s": "-2", "factor": "1000.0"}),
        ("mm", {"m": "1", "factor": "0.001"}),
        ("g", {"kg": "1", "factor": "0.001"}),
        ("kg", {"kg": "1"}),
        ("min", {"s": "1", "factor": "60.0"}),
        ("deg", {"rad": "1", "factor": "0.017453292519943295"}),
        ("1", {}),
    ],
)
def test_units_of_measurement_have_si_exponents(text: str, attributes: dict[str, str]) -> None:
    meaning = parse_unit(text)
    assert meaning is not None and dict(meaning.attributes) == attributes


@pytest.mark.parametrize(
    "text",
    ["", " ", "furlong", "m/", "/m", "(m", "m)", "m^", "m^x", "m^99", "2 m", "m**2**2", "<b>", "°C",
     "m" + "/s" * 30, "((((", "^", "kkg", "k", "m^1.5"],
)  # fmt: skip
def test_unknown_units_have_no_si_exponents(text: str) -> None:
    assert parse_unit(text) is None


@pytest.mark.parametrize("version", [2, 3])
def test_same_scene_gives_the_same_text(version: int) -> None:
    first, second = unit_from(BALL, version), derive_unit_again(BALL, version)
    assert first == second
    other = derive_unit_again(BALL.replace("g = { value = 9.81", "g = { value = 9.82"), version)
    key = {2: "guid", 3: "instantiationToken"}[version]
    assert description_of(first).get(key) != description_of(other).get(key)
    assert f'"{description_of(first).get(key)}"' in first.files["sources/fmi/scene.h"]


@pytest.mark.parametrize("version", [2, 3])
def test_texts_are_escaped_and_names_are_those_of_the_scene(version: int) -> None:
    unit = unit_from(ODD, version)
    root = description_of(unit)
    assert root.get("description") == "Quotes \" ' and ]]> & <b> --> here"
    result = {v.get("name"): v for v in root.iter() if v.get("valueReference") and v.get("name")}
    assert result["theta"].get("description") == "ends a comment: */ --> ' & é"
    assert {"near", "near_dot", "der(near)", "MAX_FORCE", "energy", "energy.total"} <= {*result}
    # FMI does not define that unit, so it is omitted
    model = unit.files["modelDescription.xml"]
    assert "more" not in model and 'name="kg m^2/s^2"' in model


def test_dependencies_are_those_of_the_equations() -> None:
    root = description_of(unit_from(BALL, 3))
    name = {v.get("valueReference"): v.get("name") for v in root.find("ModelVariables") or ()}
    structure = root.find("ModelStructure")
    assert structure is not None
    result = {
        (e.tag, name[e.get("valueReference")]): {
            name[r] for r in str(e.get("dependencies")).split()
        }
        for e in structure
    }
    assert result["Output", "height"] == {"x", "y"}
    # the wind may follow its signal, which reads the time
    assert result["Output", "ax"] == {"x_dot", "wind", "t"}
    assert result["ContinuousStateDerivative", "der(y)"] == {"y_dot"}
    assert result["ContinuousStateDerivative", "der(y_dot)"] == set()
    assert result["InitialUnknown", "der(y_dot)"] == {"g"}
    assert result["InitialUnknown", "ax"] == {
        "x_dot", "wind", "t", "m", "inputs.follow_signals"
    }  # fmt: skip
    assert result["EventIndicator", "indicator.wall"] == {"x", "wind", "t"}


@pytest.mark.parametrize(
    ("version", "text"),
    [(3, BALL), *tiers([(2, BALL), *product((2, 3), (EVERYTHING, FLOAT, ODD))])],
)
def test_c_files_are_strict_and_have_no_static_variables(
    version: int, text: str, tmp_path: Path
) -> None:
    unit = unit_from(text, version)
    write_files(unit.files, tmp_path)
    # the headers of the standard declare functions without prototypes
    flags = """-std=c99 -Wall -Wextra -Wpedantic -Wconversion -Wdouble-promotion -Wshadow -Werror
    -O2 -fno-pic""".split()
    compiled(
        needs("gcc"), *flags, "-c", f"fmi/fmi{version}.c", "-o", "unit.o", cwd=tmp_path / "sources"
    )
    listed = run(needs("nm"), "unit.o", cwd=tmp_path / "sources").stdout.splitlines()
    kinds = {line.split()[-2] for line in listed}
    assert not kinds & set("BbCDd"), "globals that change"
    functions = [line.split()[-1] for line in listed if line.split()[-2] == "T"]
    assert functions and all(name.startswith(f"fmi{version}") for name in functions)


@pytest.mark.parametrize("version", [2, 3])
def test_statically_linked_units_have_a_prefix(version: int, tmp_path: Path) -> None:
    unit = unit_from(BALL, version)
    write_files(unit.files, tmp_path)
    command = [needs("gcc"), f"-DFMI{version}_FUNCTION_PREFIX=ball_", "-c", f"fmi/fmi{version}.c",
               "-o", "unit.o"]  # fmt: skip
    compiled(*command, cwd=tmp_path / "sources")
    listed = run(needs("nm"), "unit.o", cwd=tmp_path / "sources").stdout
    assert f" T ball_fmi{version}DoStep" in listed and f" T fmi{version}DoStep" not in listed


def test_the_licence_of_the_standard_is_included() -> None:
    text = resources.text("csrc", "fmi/LICENSE.txt")
    assert "2-Clause BSD" in text and "Modelica Association" in text
    for version in (2, 3):
        assert unit_from(FLOAT, version).files["documentation/licenses/fmi-headers.txt"] == text


@pytest.mark.parametrize("version", [2, 3])
def test_numeric_limits_become_min_and_max(
    version: int,
) -> None:
    root = description_of(unit_from(RIG, version))
    variables = {v.get("name"): v for v in root.find("ModelVariables") or ()}

    def attributes(name: str) -> dict[str, str]:
        v = variables[name]
        return {**v.attrib, **{k: x for inner in v for k, x in inner.attrib.items()}}

    force, pull, push = (attributes(name) for name in ("force", "pull", "push"))
    # the signal starts at 8 N; the applied value is the limit
    assert [float(force[key]) for key in ("min", "max", "start")] == [-1.0, 1.5, 1.5]
    assert not {"min", "max"} & {*pull} and "max" not in push and float(push["min"]) == 0
    assert attributes("x")["initial"] == attributes("x_dot")["initial"] == "approx"
    assert attributes("y")["initial"] == "exact"
    by_number = {attributes(name)["valueReference"]: name for name in variables}
    key = "index" if version == 2 else "valueReference"
    initial = {
        by_number[str(e.get(key))]: {by_number[r] for r in str(e.get("dependencies")).split()}
        for e in root.iter()
        if (e.tag == "InitialUnknown" or version == 2) and e.get("dependencies") is not None
    }
    assert initial["x"] == {"x0", "w"} and initial["x_dot"] == {"w"}


def test_constraints_are_exported_for_co_simulation_only() -> None:
    """An importer that integrates the model itself would drift off the constraints."""
    text = FLOAT.replace("[run]", '[constraints]\ndrive = "phi - phi**2/4 - t"\n[run]')
    text = text.replace("start = 0.5", "start = 0.5, guess = true")
    for version in (2, 3):
        description_of = unit_from(text, version).files["modelDescription.xml"]
        assert "<ModelExchange" not in description_of and "<CoSimulation" in description_of


def test_unknown_fmi_versions_are_refused() -> None:
    with pytest.raises(Exception, match=r"fmi: .* version of FMI, 2 or 3, here 1"):
        derive_unit_again(BALL, 1)


def unit_with_text(text: str, version: int) -> Unit:
    """Return an FMU whose scene has a text wherever a text is allowed."""
    model = derived()
    return render.unit(replace(model, system=with_texts(model.system, text)), version)


def without_digests(unit: Unit) -> dict[str, str]:
    """Return the sources of an FMU without the token of the build."""
    return {
        name.removeprefix("sources/"): re.sub(r"[0-9a-f-]{36}", "", text)
        for name, text in unit.files.items()
        if name.startswith("sources/")
    }


@cache
def unit_with_plain_text(version: int) -> dict[str, str]:
    return without_digests(unit_with_text("plain", version))


@cache
def plain_tokens(version: int, names: tuple[str, ...], folder: Path) -> str:
    return tokens({name: unit_with_plain_text(version)[name] for name in names}, folder)


@pytest.mark.parametrize("payload", tiers(PAYLOADS.values(), *FEW), ids=PAYLOADS)
@pytest.mark.parametrize("version", [2, 3])
def test_free_texts_do_not_change_c_files(
    payload: str, version: int, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Descriptions are read back unchanged, whatever they contain, and no C file contains them."""
    unit = unit_with_text(payload, version)
    for name, text in unit.files.items():
        assert not RAW.search(text.replace("\t", "")), name
    root = description_of(unit)
    words = {e.get("description") for e in root.iter() if e.get("description")}
    assert {texts.line(payload), root.get("description")} <= {*words, *map(texts.line, words)}
    result = without_digests(unit)
    assert result.keys() == unit_with_plain_text(version).keys()
    changed = {
        name: text for name, text in result.items() if text != unit_with_plain_text(version)[name]
    }
    assert {"fmi/scene.h", "fields.h", "fields.c"} <= changed.keys()
    folder = tmp_path_factory.getbasetemp() / f"plain{version}"
    folder.mkdir(exist_ok=True)
    expected = plain_tokens(version, tuple(changed), folder)
    assert re.sub(r"0x\w+u", "", tokens(changed, tmp_path)) == re.sub(r"0x\w+u", "", expected)
