"""No text, however broken, makes the reader fail otherwise than in words, or run anything."""

import sys
import warnings
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eomc import formulas, scene, system
from eomc.formulas import FormulaError
from eomc.problems import EomcError

fuzz = settings(max_examples=150, deadline=None, derandomize=True, database=None)

CARTPOLE = Path(__file__).parents[1].joinpath("scenes/cartpole.toml").read_text(encoding="utf-8")
SMALL = """eomc = 1
name = "small"
coordinates.x = { start = "2*a", rate = 0.5 }
[constants]
a = 0.5
[parameters.m]
value = "a/2"
unit = "kg"
[inputs]
f = { signal = "sin(t)" }
[definitions]
v = "dot(x)"
w = '''
  v*x
  + max(x, 0)
'''
[energy]
kinetic = "m*v**2/2"
potential = 3
dissipation = "x_dot**2/10"
[forces]
x = "f - w"
"""
TEXTS = (CARTPOLE, SMALL)

TOKENS = """+ - * / ** ( ) ,
. ^ ' " \\ [ ] { } = == < > # ; : ! @ % & | ~ 0 1 2.5 1e5 1e400 .5 5. 0x1f
1_0 1j 9**9**9 x theta x_dot theta_dot x_ddot t pi e dot( sin( cos( sqrt( log( min( max( atan2(
abs( sign( heaviside( if else and or not in is lambda None True False nan inf import
__import__('os').system('id') eval( exec( open( canary( x.__class__ θ ² − \t \n \x00 \\theta
dot(dot(x)) (x-x) 0/0 /0 **0.5 **-1 **x (-1)""".replace("\n", " ").split(" ")

EVENTS = ("exec", "os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "open")
watch: list[str] | None = None


def _audit(event, args):
    if watch is not None and event in EVENTS:
        watch.append(f"{event} {args}")


sys.addaudithook(_audit)


def harmless(text):
    """Read `text`: a scene or an error in words, and nothing is run or opened."""
    global watch
    watch = []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            system.from_scene(scene.parse(text, "fuzz.toml"))
    except EomcError as fault:
        assert str(fault).startswith("fuzz.toml")
    finally:
        seen, watch = watch, None
    assert not seen


@pytest.fixture(scope="module", autouse=True)
def warm():
    for text in TEXTS:  # SymPy imports some of its modules late
        system.from_scene(scene.parse(text))


edits = st.tuples(
    st.sampled_from(["delete", "double", "insert", "token", "line", "double line", "cut"]),
    st.floats(0, 1, exclude_max=True),
    st.sampled_from(TOKENS),
    st.characters(codec="utf-8"),
)


def edited(text, edit):
    kind, where, token, character = edit
    at = int(where * len(text))
    lines = text.split("\n")
    row = int(where * len(lines))
    return {
        "delete": text[:at] + text[at + 1 :],
        "double": text[:at] + text[at : at + 1] + text[at:],
        "insert": text[:at] + character + text[at:],
        "token": text[:at] + token + text[at:],
        "line": "\n".join(lines[:row] + lines[row + 1 :]),
        "double line": "\n".join(lines[: row + 1] + lines[row:]),
        "cut": text[:at],
    }[kind]


@fuzz
@given(st.sampled_from(TEXTS), st.lists(edits, min_size=1, max_size=4))
def test_broken_scenes(text, changes):
    for change in changes:
        text = edited(text, change)
    harmless(text)


@fuzz
@given(st.lists(st.sampled_from(TOKENS), min_size=1, max_size=8), st.booleans(), st.data())
def test_random_formulas_in_scenes(tokens, blank, data):
    formula = (" " if blank else "").join(tokens)
    quoted = '"' + formula.replace("\\", "\\\\").replace('"', '\\"') + '"'
    quoted = quoted.replace("\n", "\\n").replace("\t", "\\t").replace("\x00", "\\u0000")
    key = data.draw(
        st.sampled_from(['"2*a"', '"a/2"', '"sin(t)"', '"dot(x)"', '"m*v**2/2"', '"f - w"'])
    )
    harmless(SMALL.replace(key, quoted))


values = st.recursive(
    st.sampled_from(["1", "-2.5", "true", "nan", "-inf", '"x"', '""', "1979-05-27", "07:32:00"]),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3).map(lambda v: f"[{', '.join(v)}]"),
        inner.map(lambda v: f"{{ value = {v}, float = {v} }}"),
        inner.map(lambda v: f"{{ start = {v}, signal = {v} }}"),
    ),
    max_leaves=3,
)
tables = ["coordinates", "parameters", "inputs", "definitions", "energy", "forces", "run", "eomc"]


@fuzz
@given(st.lists(st.tuples(st.sampled_from([*tables, "x", "float", "m"]), values), max_size=5))
def test_values_of_any_type_anywhere(entries):
    harmless("\n".join(f"{key} = {value}" for key, value in dict(entries).items()))
    inside = "\n".join(f"{key} = {value}" for key, value in dict(entries).items())
    for table in ("coordinates", "parameters", "energy", "definitions", "run"):
        harmless(SMALL + f"[{table}]\n{inside}\n")
        harmless(f"eomc = 1\nname = 'n'\n[{table}]\n{inside}\n")


@fuzz
@given(st.text(st.sampled_from("xtabc019.eE+-*/()^, _'\"\\#=<[]{}θ\n\t"), max_size=40))
def test_random_formula_texts(text):
    try:
        formula = formulas.parse(text)
    except FormulaError as fault:
        assert fault.message
        assert 0 <= fault.column <= max(len(text), 1)
    else:
        assert formula.text == text.replace("\n", " ").replace("\t", " ").strip(" ")


@pytest.mark.parametrize(
    "text",
    [
        "x = " + "[" * 5000,
        "x = " + "{a=" * 5000,
        "a." * 5000 + "b = 1",
        "x = [\n" + "[],\n" * 20000,
        "x = [\n" + "[],\n" * 20000 + "]",
        "g = " + "9" * 5000,
        "eomc = " + "9" * 400,
        SMALL.replace("potential = 3", "potential = " + "9" * 400),
        SMALL.replace("potential = 3", "potential = 1e308"),
        "[definitions]\n" + "".join(f'a{i} = "a{i}"\n' for i in range(300)),
        SMALL.replace("dot(x)", "dot(" * 100 + "x" + ")" * 100),
        SMALL.replace("v = ", "".join(f'y{i} = "y{(i + 1) % 300}"\n' for i in range(300)) + "v = "),
        "".join(f"k{i} = 1\n" for i in range(3000)),
        SMALL.replace("\n", "\r\n"),
        SMALL.replace("\n", "\r"),
        "\ufeff" + SMALL,
        "\ud800",
        b"\xff\xfee\x00",
        b"\x00" * 100,
    ],
    ids=range(19),
)  # fmt: skip
def test_hostile_files(text):
    harmless(text)
