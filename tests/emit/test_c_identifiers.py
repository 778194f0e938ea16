"""Names that a scene may use are renamed where C could not compile them.

They must collide neither with macros of headers nor with other generated names. The macros are
those of the compiler that runs the tests, for the headers that the generated files, the binding of
cffi and Python.h include, in the dialects that they are compiled as.
"""

from __future__ import annotations

import random
import re
import subprocess
import sysconfig
from dataclasses import replace
from functools import cache
from pathlib import Path

import cffi
import pytest
from cases import scene_system
from conftest import needs

import eomc
from eomc.base import names
from eomc.derive import lagrange
from eomc.emit import c_names
from eomc.model import from_scene as system
from eomc.model.symbols import Coordinate
from eomc.program import program
from eomc.scene import read as scene
from eomc.toolchain.files import write_files

MODES = ["-xc -std=gnu99", "-xc -std=c99", "-xc -std=gnu17", "-xc++ -std=c++17"]
INCLUDE = f"-I{sysconfig.get_path('include')}"
OUTSIDE = "#include <math.h>\n#include <stdio.h>\n#include <stddef.h>\n"
# what a program may include before the header of a model: C's own headers, and serial ports
HEADERS = """assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal
stdalign stdarg stdatomic stdbool stddef stdint stdio stdlib stdnoreturn string tgmath time uchar
wchar wctype termios""".split()


def dumped(mode: str, text: str) -> set[str]:
    """Return the macros without arguments that a text defines."""
    command = [needs("cc"), *mode.split(), INCLUDE, "-dM", "-E", "-"]
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
    return set(re.findall(r"^#define (\w+)(?!\S)", done.stdout, re.MULTILINE))


@cache
def macros() -> frozenset[str]:
    """Return all macros that are visible in generated C."""
    ffi = cffi.FFI()
    ffi.cdef("int nothing(void);")
    ffi.set_source("binding", OUTSIDE, compiler_verbose=0)
    target = Path(__file__).parents[2] / "build" / "tests" / "macros.c"
    target.parent.mkdir(parents=True, exist_ok=True)
    ffi.emit_c_code(str(target))
    binding = target.read_text(encoding="utf-8")
    found = {m for mode in MODES for m in dumped(mode, OUTSIDE)}
    found |= dumped("-xc -std=c99", "".join(f"#include <{h}.h>\n" for h in HEADERS))
    return frozenset(found | {m for mode in MODES[:1] for m in dumped(mode, binding)})


def test_the_compiler_lists_its_macros() -> None:
    assert len(macros()) > 1000
    assert {"NAN", "EOF", "errno", "M_PI", "CHAR_BIT", "Py_None", "stdout", "I", "B0"} <= macros()


def test_no_name_of_a_scene_is_a_macro_in_c() -> None:
    accepted = {m for m in macros() if not names.fault(m)}
    assert len(accepted) > 1000
    used = {m: c_names.name_in_c(m, "scene") for m in accepted}
    assert {m for m, c in used.items() if c in macros()} == set()
    # and what is made of names
    made = ("sin_{}", "cos_{}", "d_{}", "D_{}", "inv_d_{}", "l_{}_{}")
    derived = {m.format(c, c) for m in made for c in used.values()}
    coordinates = [Coordinate(c) for c in used.values()]
    derived |= {x.name for c in coordinates for x in (c.qd, c.qdd)}
    assert derived & macros() == set()


def test_no_enumerator_is_a_macro() -> None:
    """Each macro is cut at each underscore into the names of a scene and of a coordinate."""
    for macro in sorted(macros()):
        for cut in [m.start() for m in re.finditer("_", macro)]:
            name, coordinate = macro[:cut].lower(), macro[cut + 1 :].lower()
            if macro.upper() != macro or names.fault(coordinate) or names.module_fault(name):
                continue
            assert c_names.may_be_enumerator_of_others(macro), macro


def made(text: str) -> dict[str, str]:
    return dict(eomc.sources(system.from_scene(scene.parse(text, "names.toml"))).files)


def whole(name: str, real: str = "double") -> str:
    """Return a scene with everything that adds C names: batches, derivatives, implicit methods."""
    return f"""eomc = 1
name = "{name}"
[coordinates]
x = {{ start = 0.1 }}
theta = {{ start = 0.2 }}
[parameters]
m = 1.5
[inputs]
push = {{ signal = "sin(t)*x" }}
[definitions]
y = "x*cos(theta) + m*t"
[energy]
kinetic = "m*(x_dot**2 + dot(y)**2 + (2 + cos(2*theta))*theta_dot**2)/2"
potential = "m*x**2/2 + sin(theta)*y"
[forces]
x = "push"
[run]
real = "{real}"
method = ["rk4", "dp8"]
batch = true
linearize = "parameters"
"""


def identifiers(text: str) -> set[str]:
    text = re.sub(r"/\*.*?\*/|\"[^\"\n]*\"", " ", text, flags=re.DOTALL)
    return set(re.findall(r"[A-Za-z_]\w*", text))


def single(name: str) -> str:
    """Return a scene without batches, with every implicit method."""
    return (
        whole(name).replace('["rk4", "dp8"]', '["rk4", "gauss8", "gauss16"]')
        .replace("batch = true\n", "")
    )  # fmt: skip


def test_no_function_or_macro_of_a_scene_is_one_of_the_library() -> None:
    """A scene's name with which a generated name would be a macro is refused."""
    behind = set()
    for text in (whole("scene"), whole("scene", "float"), single("scene")):
        for file, content in made(text).items():
            if file.endswith((".c", ".h")):
                behind |= {i[5:] for i in identifiers(content) if i.lower().startswith("scene_")}
    coordinates = {f"_{c}" for c in ("X", "THETA", "PUSH")}
    assert {"_params", "_C", "_OK", "_NQ", "_H"} <= behind
    for end in behind - coordinates:
        for macro in macros():
            if macro.endswith(end) and macro != end:
                assert names.module_fault(macro[: -len(end)]), macro


def write(folder: Path, files: dict[str, str]) -> None:
    write_files(files, folder)


def compiled(folder: Path, name: str, *flags: str) -> None:
    """Compile both forms; the optimised one also together with Python.h and as C++."""
    folder = folder / "fast"
    plain = [needs("cc"), "-std=c99", *flags, "-fsyntax-only", f"../{name}.c"]
    done = subprocess.run(plain, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[:3000]
    binding = f'#include <Python.h>\n#include "{name}.h"\n'
    (folder / "binding_.c").write_text(binding, encoding="utf-8")
    for mode, file in (("-std=gnu99", f"{name}.c"), ("-std=gnu99", "binding_.c"),
                       ("-xc++", "binding_.c")):  # fmt: skip
        done = subprocess.run(
            [needs("cc"), *mode.split(), INCLUDE, *flags, "-fsyntax-only", file],
            cwd=folder, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr[:3000]


ROLES = ("coordinates", "parameters", "inputs", "definitions")


def of_names(role: str, given: list[str], run: str) -> str:
    """Return a scene whose names all have one role; each is used in an angle and in a product."""
    tables = dict.fromkeys(ROLES, "")
    value = {"parameters": "1.5", "definitions": '"sin(zzz)*zzz"'}.get(role, "{}")
    tables[role] = "".join(f"{n} = {value}\n" for n in given)
    tables["coordinates"] += "zzz = {}\n"
    total = " + ".join(f"({n}*zzz + sin({n})*{n})" for n in given)
    moved = [*given, "zzz"] if role == "coordinates" else ["zzz"]
    kinetic = " + ".join(f"{n}_dot**2*(2 + cos({n}))" for n in moved)
    energy = f'kinetic = "{kinetic}"\npotential = "{"zzz**2" if role == "inputs" else total}"\n'
    forces = f'zzz = "{total}"\n' if role == "inputs" else ""
    text = "".join(f"[{r}]\n{t}" for r, t in tables.items())
    return f'eomc = 1\nname = "scene"\n{text}[energy]\n{energy}[forces]\n{forces}[run]\n{run}\n'


@cache
def ours() -> frozenset[str]:
    """Return every identifier of generated text that a scene could use as a name."""
    found: set[str] = set()
    for text in (whole("scene"), whole("scene", "float"), single("scene")):
        for file, content in made(text).items():
            if file.endswith((".c", ".h")):
                found |= identifiers(content)
    gone = {"x", "theta", "zzz", "y", "m", "push"}
    return frozenset(n for n in found if not names.fault(n) and not n.endswith("_dot")) - gone


RUNS = {
    "batch": 'batch = true\nmethod = ["rk4", "dp8"]\nlinearize = "parameters"',
    "implicit": 'method = ["rk4", "gauss8", "gauss16"]\nlinearize = "parameters"',
    "float": 'batch = true\nreal = "float"\nlinearize = "parameters"',
}


@pytest.mark.slow
@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize("role", ROLES)
def test_names_of_our_own_do_not_collide(role: str, run: str, tmp_path: Path) -> None:
    """They are coordinates, parameters, inputs and definitions; -Wshadow finds collisions."""
    every = sorted(ours())
    assert len(every) > 100
    step = 6 if role in ("coordinates", "inputs") else 30
    batches = range(0, len(every), step)
    for first in random.Random(f"{role} {run}").sample(batches, 2):  # all would take an hour
        write(tmp_path, made(of_names(role, every[first : first + step], RUNS[run])))
        compiled(tmp_path, "scene", "-Werror=shadow")


SOME = "NAN INFINITY HUGE_VAL EOF errno NULL M_PI FP_NAN CHAR_BIT LONG_MAX EIO stdin linux".split()


@pytest.mark.slow
@pytest.mark.parametrize("role", ROLES)
def test_macros_as_names_compile(role: str, tmp_path: Path) -> None:
    given = [n for n in SOME if not names.fault(n)]
    assert len(given) >= 11
    for names_given, run in ((given[:4], "batch"), (given[4:8], "implicit")):
        files = made(of_names(role, names_given, RUNS[run]))
        write(tmp_path, files)
        compiled(tmp_path, "scene")
    if role != "definitions":
        assert f"{given[4]} is {given[4]}_" in files["fast/scene.h"]


def test_a_parameter_named_I_compiles_with_complex_numbers(tmp_path: Path) -> None:
    """`I` is the imaginary unit of <complex.h>, which <tgmath.h> includes."""
    text = """eomc = 1
name = "scene"
[coordinates]
theta = {}
[parameters]
I = 2.0
[energy]
kinetic = "I*theta_dot**2/2"
"""
    write(tmp_path, made(text))
    program = (
        "#include <tgmath.h>\n#include <scene.h>\nint main(void) { return scene_defaults.I_ != 2; }"
    )
    (tmp_path / "program.c").write_text(program, encoding="utf-8")
    command = [needs("cc"), "-std=c99", "-I.", "program.c", "scene.c", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    assert subprocess.run(["./a.out"], cwd=tmp_path).returncode == 0


def test_accelerations_are_renamed_with_their_coordinates() -> None:
    """`small` may be a macro, so C calls the coordinate small_. Its acceleration keeps its name."""
    text = """eomc = 1
name = "one"
[coordinates]
small = {}
[energy]
kinetic = "small_dot**2"
[outputs]
a = "small_ddot*small"
[run]
inverse_dynamics = true
"""
    source = eomc.sources(system.from_scene(scene.parse(text, "one.toml"))).files["one.c"]
    assert "SMALL" in source and re.search(r"\bsmall_ddot\b", source)
    assert re.search(r"\bsmall_\b", source) and not re.search(r"\bsmall\b", source)


def test_temporaries_get_names_that_are_valid_in_c() -> None:
    made = program.build(lagrange.derive(scene_system("cartpole")))
    for name, function in made.functions.items():
        if not function.body:
            continue
        first = replace(function.body[0], name="NAN")
        odd = replace(function, body=(first, *function.body[1:]))
        found, _ = c_names.rename_for_c(replace(made, functions={**made.functions, name: odd}))
        assert found.functions[name].body[0].name == "NAN_", name


def test_coordinates_may_be_called_as_the_arguments_of_constraints_are(tmp_path: Path) -> None:
    """`A` is the name of the Jacobian."""
    text = """eomc = 1
name = "scene"
[coordinates]
A = { start = 0.6 }
phi = { start = 0.8, guess = true }
lack = { start = 0.1 }
[energy]
kinetic = "A_dot**2 + phi_dot**2 + lack_dot**2"
[constraints]
rod = "A**2 + phi**2 + lack*A - 1"
turn = "A*phi_dot - lack_dot"
"""
    write(tmp_path, made(text))
    compiled(tmp_path, "scene", "-Werror=shadow")


MECHANISM = """eomc = 1
name = "robot"
gravity = [0, -9.81]
[coordinates]
PREFIX_lift = { unit = "rad", start = 0.2, rate = 1, note = "of the arm" }
PREFIX_bend = { start = 0.1 }
[parameters]
PREFIX_mass = 2
above = 0.5
[inputs]
PREFIX_lift_torque = { signal = "sin(t)" }
[[body]]
name = "upper"
joint = "revolute"
coordinates = "PREFIX_lift"
mass = "PREFIX_mass"
center = [0.5, 0]
actuator = "PREFIX_lift_torque"
[[body]]
name = "lower"
parent = "upper"
joint = "revolute"
coordinates = "PREFIX_bend"
offset = [1, 0]
mass = 1
center = [0.3, 0]
friction = 0.2
[[event]]
name = "stop"
when = "PREFIX_lift - above"
action = "jump"
PREFIX_lift_dot = "-PREFIX_lift_dot"
above = "above + 0.1"
[run]
tolerance = 1e-9
friction = "stick"
batch = true
"""


def code_of(text: str) -> dict[str, str]:
    """Return the C files of a scene without comments, strings, stamps and white space.

    Enumerators of events and constraints keep the full names of joints; here they are shortened.
    """
    files = {f: c for f, c in made(text).items() if f.endswith((".c", ".h"))}
    ignored = r"/\*.*?\*/|\"[^\"\n]*\"|0x[0-9a-f]{8}u|\s+|(?<=EVENT_|RAINT_)(LEFT_ARM|ROBOT)_"
    return {f: re.sub(ignored, "", c, flags=re.DOTALL) for f, c in files.items()}


@pytest.mark.parametrize("prefix", ["robot_", "left_arm_"])
def test_a_prefix_that_all_coordinates_of_a_mechanism_share_is_left_out_in_c(prefix: str) -> None:
    text = MECHANISM.replace("PREFIX_", prefix)
    assert code_of(text) == code_of(MECHANISM.replace("PREFIX_", ""))
    header = made(text)["robot.h"]
    assert f"ROBOT_LIFT, /* {prefix}lift, rad, of the arm */" in header
    assert f"ROBOT_LIFT_TORQUE, /* {prefix}lift_torque */" in header
    assert f"double mass; /* {prefix}mass */" in header
    assert f"{prefix}lift" in made(text)["__init__.py"]


@pytest.mark.parametrize(
    "old, new",
    [
        ("PREFIX_bend", "other_bend"),  # a coordinate without the prefix
        ("PREFIX_bend", "PREFIX_2"),  # no name remains
        ("PREFIX_bend", "PREFIX_I"),  # a macro remains
        ("above", "lift"),  # the name is in use
    ],
)
def test_a_prefix_stays_where_names_without_it_would_not_serve(old: str, new: str) -> None:
    text = MECHANISM.replace(old, new).replace("PREFIX_", "arm_")
    assert "ROBOT_ARM_LIFT," in made(text)["robot.h"]


def test_no_identifier_has_two_underscores_in_a_row() -> None:
    """Such names are reserved in C++. Names of compilers, which begin with two, are left out."""
    names_of_macros = "small NAN I".split()
    texts = (MECHANISM.replace("PREFIX_", "robot_"),
             of_names("coordinates", names_of_macros, RUNS["batch"]),
             of_names("inputs", names_of_macros, RUNS["implicit"]))  # fmt: skip
    for text in texts:
        for file, content in made(text).items():
            if file.endswith((".c", ".h")):
                found = {i for i in identifiers(content) if "__" in i.lstrip("_")}
                assert {i for i in found if not i.startswith("__")} == set(), file
