"""Valid scenes build with correct results; others are refused at their line, with a remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

import eomc
from eomc.base.errors import EomcError, SceneError
from eomc.model.system import System, from_scene
from eomc.scene.read import parse
from eomc.verify.check import check

BUILDS = Path(__file__).parents[2] / "build" / "tests" / "valid"


def text(
    name: str,
    coordinates: str = "x = { start = 0.3 }",
    parameters: str = "m = 1.25",
    definitions: str = "",
    kinetic: str = "m*x_dot**2/2",
    potential: str = "x**2/2",
    run: str = "",
) -> str:
    """Write a scene of one mass on a spring with the given parts replaced."""
    return f"""eomc = 1
name = "{name}"
[coordinates]
{coordinates}
[parameters]
{parameters}
[definitions]
{definitions}
[energy]
kinetic = "{kinetic}"
potential = "{potential}"
[run]
duration = 0.2
{run}
"""


def system_from(scene_text: str) -> System:
    return from_scene(parse(scene_text, "valid.toml"))


SENSITIVE = 'linearize = "parameters"'
VALID = {
    "two_kinds": text("two_kinds", potential="sqrt(2) + 1 + cos(x)**2 + x"),
    "three_kinds": text("three_kinds", potential="x*(pi + 1) + (sqrt(3) + exp(1) + 2)*cos(x)"),
    "gauss4_p": text("gauss4_p", kinetic="x_dot**2/2", potential="m + x**2", run="method='gauss4'"),
    "gauss8_p": text("gauss8_p", kinetic="x_dot**2/2", potential="m + x**2", run="method='gauss8'"),
    "q_E": text(
        "q_E", "E = { start = 0.3 }", kinetic="m*E_dot**2/2", potential="m*E**2/2", run=SENSITIVE
    ),
    "d_E": text("d_E", definitions="E = 'sin(x)'", potential="m*E**2", run=SENSITIVE),
    "short_names": text(
        "short_names",
        "I = { start = 0.3 }\nS = { start = 0.2 }",
        "N = 1.5\nbeta = 0.5",
        "zeta = 'sin(I)'\nQ = 'zeta*S'\nO = 'cos(S)'\ngamma = 'Q + O'",
        "N*(I_dot**2 + S_dot**2)/2",
        "beta*gamma + I**2 + S**2",
        SENSITIVE,
    ),
    "macros": text(
        "macros",
        "NAN = { start = 0.3 }\nerrno = { start = 0.2 }",
        "M_PI = 1.5\nEOF = 0.5",
        "HUGE_VAL = 'sin(NAN)'\nNULL = 'HUGE_VAL*errno'",
        "M_PI*(NAN_dot**2 + errno_dot**2)/2",
        "EOF*NULL + NAN**2 + errno**2",
        SENSITIVE,
    ),
    "algebra": text("algebra", "number = {}", kinetic="number_dot**2/2", potential="cos(number)"),
    "sinf": text("sinf_scene", "sinf = { start = 1 }", "fabsf = 1", "cosf = 'sin(sinf)*fabsf'",
                 "sinf_dot**2/2", "cos(sinf)*cosf", "real = 'float'"),
    "own": text("own", "own_D = { start = 1 }", "own_params = 1", "own_sincos = 'sin(own_D)*own_D'",
                "own_D_dot**2/2", "cos(own_D)*own_sincos*own_params"),
    # three angles of time and three of the state in one function, grouped by three
    "three_and_three": text(
        "three_and_three",
        "x = { start = 0.3 }\ny = { start = 0.2 }\nz = { start = 0.1 }",
        kinetic="m*(x_dot**2 + y_dot**2 + z_dot**2)/2",
        potential="x*sin(t) + y*sin(2*t) + z*sin(3*t) - cos(x) - cos(y) - cos(z)",
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", VALID)
def test_valid_scenes_agree_with_the_reference(name: str) -> None:
    built = system_from(VALID[name])
    rows = check(built, eomc.load(built, BUILDS), states=4).results
    values = [row for row in rows if row.name in ("D", "C", "g", "bias", "acceleration")]
    assert len(values) >= 4
    assert [row for row in values if not row.passed] == []


@pytest.mark.slow
def test_python_module_uses_the_names_of_the_scene() -> None:
    module = eomc.load(system_from(VALID["macros"]), BUILDS)
    assert list(module.coordinates) == ["NAN", "errno"]
    assert dict(module.defaults) == {"M_PI": 1.5, "EOF": 0.5}
    one, other = (module.acceleration([0.3, 0.2], [0, 0], params=p) for p in ({}, {"EOF": 0.7}))
    assert one[0] != other[0]
    header = (BUILDS / "macros" / "macros.h").read_text(encoding="utf-8")
    assert "Names that are changed in C: NAN is NAN_, errno is errno_" in header


LONG = "o = '(1234567/1234568)**64'\np = 'o**8'\n"  # with 7168 digits


@pytest.mark.parametrize(
    ("change", "key", "words"),
    [
        ({"potential": "x**2 + 0**x"}, "energy.potential", "raises 0 to a power that varies"),
        ({"definitions": "z = '1 - 1'", "potential": "z**x"}, "energy.potential", "raises 0 to a"),
        ({"definitions": "z = '1 - 1'", "potential": "x/z"}, "energy.potential", "divides by zero"),
        (
            {"definitions": "z = '-2'", "potential": "x*sqrt(z)"},
            "energy.potential",
            "no real value",
        ),
        ({"definitions": "z = '-2'", "potential": "x*z**0.5"}, "energy.potential", "no real"),
        *(
            (
                {"definitions": f"{LONG}r = '{longer}'", "potential": "x*r"},
                "definitions.r",
                "more than 10,000 digits",
            )
            for longer in ("p*p", "p/(1/p)", "p + p", "p - 2*p")
        ),
        (
            {"definitions": "a = '3**64'\nb = 'a**64'", "potential": "x*b"},
            "definitions.b",
            "not between 1e-300 and 1e300",
        ),
    ],
)
def test_meaningless_scene_is_refused_at_its_line(
    change: dict[str, str], key: str, words: str
) -> None:
    with pytest.raises(SceneError) as reported:
        system_from(text("refused", **change))
    (problem,) = reported.value.problems
    assert problem.key == key and words in problem.message and problem.line > 0


def test_number_beyond_doubles_is_refused_with_a_message() -> None:
    with pytest.raises(EomcError, match=r"a number of 2.0E\+580, more than a double can be"):
        eomc.sources(system_from(text("beyond", potential="(1e290*x)**2")))


@pytest.mark.parametrize(
    "name", ["main", "Main", "selftest", "binding", "UINT64", "INT8", "sig", "Py_nb", "numpy",
             "math", "sys", "cffi", "eomc", "test", "r"],
)  # fmt: skip
def test_names_that_shadow_files_or_modules_are_refused(name: str) -> None:
    with pytest.raises(SceneError) as reported:
        system_from(text(name))
    (problem,) = reported.value.problems
    assert problem.key == "name" and f"use {name}_scene" in problem.message and problem.line == 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["runtime", "batch", "estimate", "scene", "build", "uint64"])
def test_scenes_named_like_parts_of_a_build_are_built(name: str) -> None:
    module = eomc.load(system_from(text(name, run="batch = true")), BUILDS)
    assert module.acceleration([0.5], [0.0])[0] == pytest.approx(-0.4)
    assert module.simulate_batch([[0.5]], [[0.0]], steps=2).q.shape[0] == 1
