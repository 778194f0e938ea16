"""Names of a scene that C could not compile are renamed.

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
from support.cases import scene_system
from support.session import needs, tiers

import eomc
from eomc.base import names
from eomc.derive import lagrange
from eomc.emit.common import c_names
from eomc.model import system
from eomc.model.symbols import Coordinate
from eomc.program import program
from eomc.scene import read as scene
from eomc.toolchain.files import write_files

MODES = ["-xc -std=gnu99", "-xc -std=c99", "-xc -std=gnu17", "-xc++ -std=c++17"]
INCLUDE = f"-I{sysconfig.get_path('include')}"
OUTSIDE = "#include <math.h>\n#include <stdio.h>\n#include <stddef.h>\n"
# headers that a program may include before the header of a model: C's own headers and serial ports
HEADERS = """assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal
stdalign stdarg stdatomic stdbool stddef stdint stdio stdlib stdnoreturn string tgmath time uchar
wchar wctype termios""".split()


def list_macros(mode: str, text: str) -> set[str]:
    """Return the macros without arguments that a text defines."""
    command = [needs("cc"), *mode.split(), INCLUDE, "-dM", "-E", "-"]
    process = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
    return set(re.findall(r"^#define (\w+)(?!\S)", process.stdout, re.MULTILINE))


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
    macros_of_modes = {m for mode in MODES for m in list_macros(mode, OUTSIDE)}
    macros_of_modes |= list_macros("-xc -std=c99", "".join(f"#include <{h}.h>\n" for h in HEADERS))
    return frozenset(
        macros_of_modes | {m for mode in MODES[:1] for m in list_macros(mode, binding)}
    )


def test_compiler_lists_its_macros() -> None:
    assert len(macros()) > 1000
    assert {"NAN", "EOF", "errno", "M_PI", "CHAR_BIT", "Py_None", "stdout", "I", "B0"} <= macros()


def test_names_of_scenes_are_not_macros_in_c() -> None:
    accepted = {m for m in macros() if not names.fault(m)}
    assert len(accepted) > 1000
    used = {m: c_names.name_in_c(m, "scene") for m in accepted}
    assert {m for m, c in used.items() if c in macros()} == set()
    # and the names derived from them
    patterns = ("sin_{}", "cos_{}", "d_{}", "D_{}", "inv_d_{}", "l_{}_{}")
    derived = {m.format(c, c) for m in patterns for c in used.values()}
    coordinates = [Coordinate(c) for c in used.values()]
    derived |= {x.name for c in coordinates for x in (c.qd, c.qdd)}
    assert derived & macros() == set()


def test_enumerators_are_not_macros() -> None:
    """Each macro is split at each underscore into the names of a scene and of a coordinate."""
    for macro in sorted(macros()):
        for cut in [m.start() for m in re.finditer("_", macro)]:
            name, coordinate = macro[:cut].lower(), macro[cut + 1 :].lower()
            if macro.upper() != macro or names.fault(coordinate) or names.module_fault(name):
                continue
            assert c_names.may_be_enumerator_of_others(macro), macro


@cache
def program_from(text: str) -> dict[str, str]:
    return dict(eomc.sources(system.from_scene(scene.parse(text, "names.toml"))).files)


def scene_with_all_names(name: str, real: str = "double") -> str:
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
linearize = "products"
"""


def identifiers(text: str) -> set[str]:
    text = re.sub(r"/\*.*?\*/|\"[^\"\n]*\"", " ", text, flags=re.DOTALL)
    return set(re.findall(r"[A-Za-z_]\w*", text))


def scene_without_batches(name: str) -> str:
    """Return a scene without batches, with every implicit method."""
    return (
        scene_with_all_names(name).replace('["rk4", "dp8"]', '["rk4", "gauss8", "gauss16"]')
        .replace("batch = true\n", "")
    )  # fmt: skip


def test_generated_functions_and_macros_are_not_library_names() -> None:
    """A scene whose name would make a generated name a macro is refused."""
    suffixes = set()
    for text in (
        scene_with_all_names("scene"),
        scene_with_all_names("scene", "float"),
        scene_without_batches("scene"),
    ):
        for file, content in program_from(text).items():
            if file.endswith((".c", ".h")):
                suffixes |= {i[5:] for i in identifiers(content) if i.lower().startswith("scene_")}
    coordinates = {f"_{c}" for c in ("X", "THETA", "PUSH")}
    assert {"_params", "_C", "_OK", "_NQ", "_H"} <= suffixes
    for end in suffixes - coordinates:
        for macro in macros():
            if macro.endswith(end) and macro != end:
                assert names.module_fault(macro[: -len(end)]), macro


def write(folder: Path, files: dict[str, str]) -> None:
    write_files(files, folder)


def compile_forms(folder: Path, name: str, *flags: str) -> None:
    """Compile both forms; the optimised one also together with Python.h and as C++."""
    folder = folder / "fast"
    plain = [needs("cc"), "-std=c99", *flags, "-fsyntax-only", f"../{name}.c"]
    process = subprocess.run(plain, cwd=folder, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr[:3000]
    binding = f'#include <Python.h>\n#include "{name}.h"\n'
    (folder / "binding_.c").write_text(binding, encoding="utf-8")
    for mode, file in (("-std=gnu99", f"{name}.c"), ("-std=gnu99", "binding_.c"),
                       ("-xc++", "binding_.c")):  # fmt: skip
        process = subprocess.run(
            [needs("cc"), *mode.split(), INCLUDE, *flags, "-fsyntax-only", file],
            cwd=folder, capture_output=True, text=True,
        )  # fmt: skip
        assert process.returncode == 0, process.stderr[:3000]


ROLES = ("coordinates", "parameters", "inputs", "definitions")


def scene_with_names(role: str, names_of_role: list[str], run: str) -> str:
    """Return a scene whose names all have one role; each is used in an angle and in a product."""
    tables = dict.fromkeys(ROLES, "")
    value = {"parameters": "1.5", "definitions": '"sin(zzz)*zzz"'}.get(role, "{}")
    tables[role] = "".join(f"{n} = {value}\n" for n in names_of_role)
    tables["coordinates"] += "zzz = {}\n"
    total = " + ".join(f"({n}*zzz + sin({n})*{n})" for n in names_of_role)
    coordinates = [*names_of_role, "zzz"] if role == "coordinates" else ["zzz"]
    kinetic = " + ".join(f"{n}_dot**2*(2 + cos({n}))" for n in coordinates)
    energy = f'kinetic = "{kinetic}"\npotential = "{"zzz**2" if role == "inputs" else total}"\n'
    forces = f'zzz = "{total}"\n' if role == "inputs" else ""
    text = "".join(f"[{r}]\n{t}" for r, t in tables.items())
    return f'eomc = 1\nname = "scene"\n{text}[energy]\n{energy}[forces]\n{forces}[run]\n{run}\n'


@cache
def generated_identifiers() -> frozenset[str]:
    """Return every identifier of generated text that a scene could use as a name."""
    identifiers_of_files: set[str] = set()
    for text in (
        scene_with_all_names("scene"),
        scene_with_all_names("scene", "float"),
        scene_without_batches("scene"),
    ):
        for file, content in program_from(text).items():
            if file.endswith((".c", ".h")):
                identifiers_of_files |= identifiers(content)
    own_names = {"x", "theta", "zzz", "y", "m", "push"}
    return (
        frozenset(n for n in identifiers_of_files if not names.fault(n) and not n.endswith("_dot"))
        - own_names
    )


RUNS = {
    "batch": 'batch = true\nmethod = ["rk4", "dp8"]\nlinearize = "parameters"',
    "implicit": 'method = ["rk4", "gauss8", "gauss16"]\nlinearize = "parameters"',
    "float": 'batch = true\nreal = "float"\nlinearize = "parameters"',
}


@pytest.mark.slow
@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize("role", ROLES)
def test_generated_names_as_names_of_a_scene_compile(role: str, run: str, tmp_path: Path) -> None:
    """They are coordinates, parameters, inputs and definitions; -Wshadow finds collisions."""
    every = sorted(generated_identifiers())
    assert len(every) > 100
    step = 6 if role in ("coordinates", "inputs") else 30
    batches = range(0, len(every), step)
    # two batches of names; all of them would take an hour
    for first in random.Random(f"{role} {run}").sample(batches, 2):
        write(
            tmp_path, program_from(scene_with_names(role, every[first : first + step], RUNS[run]))
        )
        compile_forms(tmp_path, "scene", "-Werror=shadow")


SOME = "NAN INFINITY HUGE_VAL EOF errno NULL M_PI FP_NAN CHAR_BIT LONG_MAX EIO stdin linux".split()


@pytest.mark.slow
@pytest.mark.parametrize("role", ROLES)
def test_macros_as_names_compile(role: str, tmp_path: Path) -> None:
    macro_names = [n for n in SOME if not names.fault(n)]
    assert len(macro_names) >= 11
    for macros_of_scene, run in ((macro_names[:4], "batch"), (macro_names[4:8], "implicit")):
        files = program_from(scene_with_names(role, macros_of_scene, RUNS[run]))
        write(tmp_path, files)
        compile_forms(tmp_path, "scene")
    if role != "definitions":
        assert f"{macro_names[4]} is {macro_names[4]}_" in files["fast/scene.h"]


def test_parameter_named_I_compiles_with_complex_numbers(tmp_path: Path) -> None:
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
    write(tmp_path, program_from(text))
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
    functions_of_scene = program.build(lagrange.derive(scene_system("cartpole")))
    for name, function in functions_of_scene.functions.items():
        if not function.body:
            continue
        first = replace(function.body[0], name="NAN")
        odd = replace(function, body=(first, *function.body[1:]))
        renamed, _ = c_names.rename_for_c(
            replace(functions_of_scene, functions={**functions_of_scene.functions, name: odd})
        )
        assert renamed.functions[name].body[0].name == "NAN_", name


def test_coordinates_with_names_of_constraint_arguments_compile(tmp_path: Path) -> None:
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
    write(tmp_path, program_from(text))
    compile_forms(tmp_path, "scene", "-Werror=shadow")


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
    files = {f: c for f, c in program_from(text).items() if f.endswith((".c", ".h"))}
    ignored = r"/\*.*?\*/|\"[^\"\n]*\"|0x[0-9a-f]{8}u|\s+|(?<=EVENT_|RAINT_)(LEFT_ARM|ROBOT)_"
    return {f: re.sub(ignored, "", c, flags=re.DOTALL) for f, c in files.items()}


@pytest.mark.parametrize("prefix", tiers(["robot_", "left_arm_"], "robot_"))
def test_common_prefix_of_coordinates_is_removed_in_c(prefix: str) -> None:
    text = MECHANISM.replace("PREFIX_", prefix)
    assert code_of(text) == code_of(MECHANISM.replace("PREFIX_", ""))
    header = program_from(text)["robot.h"]
    assert f"ROBOT_LIFT, /* {prefix}lift, rad, of the arm */" in header
    assert f"ROBOT_LIFT_TORQUE, /* {prefix}lift_torque */" in header
    assert f"double mass; /* {prefix}mass */" in header
    assert f"{prefix}lift" in program_from(text)["__init__.py"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "old, new",
    [
        ("PREFIX_bend", "other_bend"),  # a coordinate without the prefix
        ("PREFIX_bend", "PREFIX_2"),  # no name remains
        ("PREFIX_bend", "PREFIX_I"),  # a macro remains
        ("above", "lift"),  # the name is in use
    ],
)
def test_prefix_is_preserved_where_names_without_it_are_invalid(old: str, new: str) -> None:
    text = MECHANISM.replace(old, new).replace("PREFIX_", "arm_")
    assert "ROBOT_ARM_LIFT," in program_from(text)["robot.h"]


def test_identifiers_have_no_consecutive_underscores() -> None:
    """C++ reserves such names.

    Names of compilers, which begin with two underscores, are excluded.
    """
    names_of_macros = "small NAN I".split()
    texts = (MECHANISM.replace("PREFIX_", "robot_"),
             scene_with_names("coordinates", names_of_macros, RUNS["batch"]),
             scene_with_names("inputs", names_of_macros, RUNS["implicit"]))  # fmt: skip
    for text in texts:
        for file, content in program_from(text).items():
            if file.endswith((".c", ".h")):
                reserved = {i for i in identifiers(content) if "__" in i.lstrip("_")}
                assert {i for i in reserved if not i.startswith("__")} == set(), file
