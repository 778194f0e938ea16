"""No text makes the reader fail other than with a message, or execute anything."""

import codecs
import re
import sys
import warnings
from functools import cache
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eomc.base.errors import EomcError
from eomc.model.system import from_scene
from eomc.scene import formulas
from eomc.scene.formulas import FormulaError
from eomc.scene.read import parse

few = settings(max_examples=12, deadline=None, derandomize=True, database=None)
many = settings(few, max_examples=150)

CARTPOLE = Path(__file__).parents[2].joinpath("scenes/cartpole.toml").read_text(encoding="utf-8")
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
BODIES = """eomc = 1
name = "bodies"
gravity = [0, "-g"]
[constants]
n = 3
[coordinates]
"q[i]" = { repeat = "i = 1..n", start = "0.1*i" }
[parameters]
l = 0.5
g = 9.81
[definitions]
h = "link2_x + q3"
[[body]]
repeat = "i = 1..n-1"
name = "link[i]"
joint = "revolute"
coordinates = "q[i]"
offset = ["l", 0]
rotation = "pi/2"
mass = "2*l"
center = ["i*l", 0]
inertia = 1
friction = 0.1
actuator = "-q[i]"
[[body]]
name = "slide"
parent = "link[n-1]"
joint = "prismatic"
coordinates = "q[n]"
axis = [1, 0]
mass = 3
[[body]]
name = "bob"
position = ["h", "l"]
rotation = "q[1]"
mass = 1
[[spring]]
bodies = ["world", "bob"]
points = [[0, 1], ["l", 0]]
stiffness = 1
length = 0.1
[[damper]]
bodies = ["link1", "slide"]
turning = true
damping = 2
"""
SPACE = """eomc = 1
name = "space"
gravity = [0, 0, -9.81]
coordinates = { x = {}, y = {}, z = {}, a = {}, b = {}, c = {} }
[[body]]
name = "top"
joint = "free"
coordinates = ["x", "y", "z", "a", "b", "c"]
rotation = [["z", 1], ["x", "pi/2"]]
mass = 1
inertia = [1, 2, 2.5, 0.1, 0, 0]
damping = [0, 0, 0, 1, 1, 1]
[[body]]
name = "arm"
parent = "top"
joint = "fixed"
offset = [0, 0, 1]
mass = 1
"""
TEXTS = (CARTPOLE, SMALL, BODIES, SPACE)

TOKENS = """+ - * / ** ( ) ,
. ^ ' " \\ [ ] { } = == < > # ; : ! @ % & | ~ 0 1 2.5 1e5 1e400 .5 5. 0x1f
1_0 1j 9**9**9 x theta x_dot theta_dot x_ddot t pi e dot( sin( cos( sqrt( log( min( max( atan2(
abs( sign( heaviside( if else and or not in is lambda None True False nan inf import
__import__('os').system('id') eval( exec( open( canary( x.__class__ θ ² − \t \n \x00 \\theta
[i] [n] [n-1] [-1] [i/2] i n [[body]] [[spring]] [body] world link1 link2_x repeat=
axis= joint= "fixed" "free" "revolute" parent= name= [0,0] [0,0,0] ["z",1]
dot(dot(x)) (x-x) 0/0 /0 **0.5 **-1 **x (-1)""".replace("\n", " ").split(" ")

EVENTS = ("exec", "os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "open")
watched_events: list[str] | None = None


def _audit(event, args):
    if watched_events is not None and event in EVENTS:
        watched_events.append(f"{event} {args}")


@cache
def _hooked():
    sys.addaudithook(_audit)  # cannot be removed: it would slow the tests of other files as well


def read_without_side_effects(text):
    """Read `text`: the result is a scene or an error message, and nothing is executed or opened."""
    global watched_events
    _hooked()
    watched_events = []
    try:
        with warnings.catch_warnings(action="error"):
            from_scene(parse(text, "fuzz.toml"))
    except EomcError as error:
        assert str(error).startswith("fuzz.toml")
    finally:
        events, watched_events = watched_events, None
    assert not events


@pytest.fixture(scope="module", autouse=True)
def warm():
    codecs.lookup("unicode_escape")  # Python imports its codecs late, SymPy some of its modules
    for text in TEXTS:
        from_scene(parse(text))


def in_two_tiers(examples, test):
    """Define a test with few examples and one of the slow tier with many."""
    return few(examples(test)), pytest.mark.slow(many(examples(test)))


def slow_version(text):
    return pytest.param(text, marks=pytest.mark.slow)


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


def broken_scenes(text, changes):
    for change in changes:
        text = edited(text, change)
    read_without_side_effects(text)


broken = given(st.sampled_from(TEXTS), st.lists(edits, min_size=1, max_size=4))
test_broken_scenes, test_many_broken_scenes = in_two_tiers(broken, broken_scenes)


def formulas_in_scenes(tokens, blank, data):
    formula = (" " if blank else "").join(tokens)
    quoted = '"' + formula.replace("\\", "\\\\").replace('"', '\\"') + '"'
    quoted = quoted.replace("\n", "\\n").replace("\t", "\\t").replace("\x00", "\\u0000")
    key = data.draw(
        st.sampled_from(['"2*a"', '"a/2"', '"sin(t)"', '"dot(x)"', '"m*v**2/2"', '"f - w"'])
    )
    read_without_side_effects(SMALL.replace(key, quoted))


test_random_formulas_in_scenes, test_many_random_formulas_in_scenes = in_two_tiers(
    given(st.lists(st.sampled_from(TOKENS), min_size=1, max_size=8), st.booleans(), st.data()),
    formulas_in_scenes,
)


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
arrays = ["body", "spring", "damper", "gravity"]
keys = """name parent joint coordinates axis offset position rotation mass center inertia armature
damping friction friction_width actuator coordinate bodies points turning stiffness length
repeat""".split()


def values_anywhere(entries):
    read_without_side_effects("\n".join(f"{key} = {value}" for key, value in dict(entries).items()))
    inside = "\n".join(f"{key} = {value}" for key, value in dict(entries).items())
    for table in ("coordinates", "parameters", "energy", "definitions", "run"):
        read_without_side_effects(SMALL + f"[{table}]\n{inside}\n")
        read_without_side_effects(f"eomc = 1\nname = 'n'\n[{table}]\n{inside}\n")


keyed = st.tuples(st.sampled_from([*tables, "x", "float", "m"]), values)
test_values_of_any_type_anywhere, test_many_values_of_any_type_anywhere = in_two_tiers(
    given(st.lists(keyed, max_size=5)), values_anywhere
)


sized = st.recursive(
    st.sampled_from(["0", "1", "-2.5", "1e99", "true", "inf", '"q1"', '"link1"', '"world"', '"z"',
                     '"l"', '"q[n]"', '"i = 1..n"', '"i = n..9999999999"', '"free"',
                     '"revolute"', '""']),
    lambda inner: st.lists(inner, max_size=3).map(lambda v: f"[{', '.join(v)}]"),
    max_leaves=7,
)  # fmt: skip


def values_in_bodies(text, array, entries, value):
    entry = "\n".join(f"{key} = {value}" for key, value in entries.items())
    read_without_side_effects(f"{text}[[{array}]]\n{entry}\n")
    read_without_side_effects(
        "\n".join(line for line in text.split("\n") if line.split(" =")[0] not in entries)
    )
    key = next(iter(entries), "mass")
    read_without_side_effects(
        re.sub(rf"(?m)^({key}) = .*$", lambda match: f"{key} = {value}", text)
    )
    for at_top in arrays:
        read_without_side_effects(f"{at_top} = {value}\n" + text.replace("gravity", "#", 1))


test_bodies_with_values_of_any_type, test_many_bodies_with_values_of_any_type = in_two_tiers(
    given(
        st.sampled_from([BODIES, SPACE]),
        st.sampled_from(["body", "spring", "damper"]),
        st.dictionaries(st.sampled_from(keys), sized, max_size=6),
        sized,
    ),
    values_in_bodies,
)


def formula_texts(text):
    try:
        formula = formulas.parse(text)
    except FormulaError as error:
        assert error.message
        assert 0 <= error.column <= max(len(text), 1)
    else:
        assert formula.text == text.replace("\n", " ").replace("\t", " ").strip(" ")


test_random_formula_texts, test_many_random_formula_texts = in_two_tiers(
    given(st.text(st.sampled_from("xtabc019.eE+-*/()^, _'\"\\#=<[]{}θ\n\t"), max_size=40)),
    formula_texts,
)


@pytest.mark.parametrize(
    "text",
    [
        "x = " + "[" * 5000,
        "x = " + "{a=" * 5000,
        "a." * 5000 + "b = 1",
        "x = [\n" + "[],\n" * 20000,
        slow_version("x = [\n" + "[],\n" * 20000 + "]"),
        "g = " + "9" * 5000,
        "eomc = " + "9" * 400,
        SMALL.replace("potential = 3", "potential = " + "9" * 400),
        SMALL.replace("potential = 3", "potential = 1e308"),
        "[definitions]\n" + "".join(f'a{i} = "a{i}"\n' for i in range(300)),
        SMALL.replace("dot(x)", "dot(" * 100 + "x" + ")" * 100),
        SMALL.replace("v = ", "".join(f'y{i} = "y{(i + 1) % 300}"\n' for i in range(300)) + "v = "),
        "".join(f"k{i} = 1\n" for i in range(300)),
        slow_version("".join(f"k{i} = 1\n" for i in range(3000))),
        SMALL.replace("\n", "\r\n"),
        SMALL.replace("\n", "\r"),
        BODIES.replace("n = 3", "n = 20000"),
        BODIES.replace("n = 3", "n = 3\nm = 1").replace("1..n-1", "1..-" + "9" * 5000),
        BODIES.replace("q[n]", "q[" + "n+" * 4000 + "1]"),
        BODIES.replace("n = 3", "n = 9999").replace('"0.1*i"', f'"{"i+" * 4900}1"'),
        BODIES + "[[body]]\n" * 300,
        slow_version(BODIES + "[[body]]\n" * 3000),
        BODIES + '[[body]]\nname = "a"\nparent = "a"\n' * 1000,
        "\ufeff" + SMALL,
        "\ud800",
        b"\xff\xfee\x00",
        b"\x00" * 100,
    ],
    ids=range(27),
)  # fmt: skip
def test_hostile_files(text):
    read_without_side_effects(text)
