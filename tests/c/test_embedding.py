"""The generated C: compilers accept it, it computes the same as the module, no unused code."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support.cases import fast_files, fast_kit, scene_system
from support.compilation import MATHEMATICS, STRICT, compiled, run
from support.session import EVERYTHING, MODULES, ROOT, Modules, needs, tiers

import eomc
from eomc import pipeline
from eomc.emit.common import c_names
from eomc.emit.optimised.files import PLACEHOLDERS
from eomc.model import system
from eomc.model.system import System
from eomc.scene import read as scene
from eomc.toolchain.files import write_files
from eomc.verify import symbolic

NAMES = [
    "cartpole",  # neither inputs nor time
    "cartpole_driven",  # an input, its signal a function of time
    "kapitza_pendulum",  # time in the kinetic energy
    "foucault_pendulum",  # a part of the kinetic energy that is linear in the velocities
    "mass_spring",  # no angle, and D is constant
    "everything",  # every function of the formula language, and awkward names
]


@cache
def read_system(name: str) -> System:
    if name == "everything":
        return system.from_scene(scene.parse(EVERYTHING, "everything.toml"))
    return scene_system(name)


def module(name: str) -> ModuleType:
    modules = Modules()
    return modules.of_text(EVERYTHING) if name == "everything" else modules(name)


@cache
def generated(name: str) -> dict[str, str]:
    """Return the C files of a scene, with optimised C in place of portable C."""
    return fast_files(module(name))


@pytest.fixture
def kit(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Folder with the generated files of a scene."""
    write_files(generated(request.param), tmp_path)
    return tmp_path


def kits_of(*quick: str) -> pytest.MarkDecorator:
    values = tiers([(n, n) for n in NAMES], *quick)
    return pytest.mark.parametrize(("kit", "name"), values, indirect=["kit"])


kits, few_kits = kits_of("cartpole", "everything"), kits_of("cartpole")
# Combinations of the quick tier.
STRICTLY = {("everything", "gcc", "-O0"), ("everything", "clang", "-O0")}
driven = pytest.mark.parametrize("kit", ["cartpole_driven"], indirect=True)


def table(text: str) -> tuple[list[str], np.ndarray]:
    """Return the column names and the numbers of a CSV text."""
    head, *rows = text.splitlines()
    return head.split(","), np.array([[float(x) for x in row.split(",")] for row in rows])


def rows_of(name: str, module: ModuleType) -> np.ndarray:
    """Return the rows that main.c should print, computed by the Python module."""
    s = read_system(name).run
    steps = max(1, int(np.ceil(s.duration / s.h * (1 - 1e-12))))
    trajectory = module.simulate(steps=steps, every=max(1, steps // 200))
    outputs = trajectory.outputs.values()
    return np.column_stack([trajectory.t, trajectory.q, trajectory.qd, *outputs, trajectory.energy])


# --- compilers -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kit", "name", "compiler", "level"),
    [
        pytest.param(n, n, *how, marks=() if (n, *how) in STRICTLY else pytest.mark.slow)
        for n in NAMES
        for how in product(("gcc", "clang"), ("-O0", "-O2"))
    ],
    indirect=["kit"],
)
def test_strict_compilers_issue_no_warnings(
    kit: Path, name: str, compiler: str, level: str
) -> None:
    """Compile source, header, example and self-test, separately and together."""
    (kit / "header.c").write_text(f'#include "{name}.h"\n#include "{name}.h"\n')
    files = [f"{name}.c", "main.c", "selftest.c", "header.c"]
    compiled(needs(compiler), *STRICT, level, "-I.", "-c", *files, cwd=kit)


@kits
def test_source_compiles_as_cpp(kit: Path, name: str) -> None:
    strict = ["-std=c++11", *STRICT[1:], "-fsyntax-only"]
    compiled(needs("g++"), *strict, "-x", "c++", f"{name}.c", cwd=kit)


@few_kits
def test_cpp_program_links_the_c_object(kit: Path, name: str) -> None:
    driven = "double t = 0;" if " double t" in step_of(name) else ""
    arguments = ", ".join(
        {"q": "q", "qd": "qd", "t": "t", "h": "0.001", "u": "nullptr", "p": "&p"}[a]
        for a in re.findall(r"(\w+)(?:\[\w+\])?(?:,|$)", step_of(name))
    )
    params = f"{name}_params p = {name}_defaults;" if read_system(name).parameters else ""
    (kit / "use.cpp").write_text(
        f"""#include "{name}.h"
int main() {{
    double q[{name.upper()}_NQ], qd[{name.upper()}_NQ];
    {params} {driven}
    for (int i = 0; i < {name.upper()}_NQ; i++) {{ q[i] = {name}_q0[i]; qd[i] = {name}_qd0[i]; }}
    return {name}_rk4_step({arguments}) != {name.upper()}_OK;
}}
""",
        encoding="utf-8",
    )
    compiled(needs("gcc"), "-std=c99", "-O0", "-c", f"{name}.c", cwd=kit)
    compiled(needs("g++"), "-Wall", "-Wextra", "-Werror", "use.cpp", f"{name}.o", "-lm", cwd=kit)
    assert run("./a.out", cwd=kit).returncode == 0


def step_of(name: str) -> str:
    """Return the prototype of rk4_step as one line."""
    header = " ".join(generated(name)[f"{name}.h"].split())
    match = re.search(rf"{name}_rk4_step\(([^)]*)\);", header)
    assert match
    return match[1]


# --- results -----------------------------------------------------------------------------------


Printed = Callable[[str, str], str]


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> Printed:
    """Return a function that compiles a scene's example with a command and returns its output."""

    @cache
    def compile_and_run(name: str, command: str) -> str:
        folder = tmp_path_factory.mktemp(name)
        write_files(generated(name), folder)
        compiler, *flags = command.split()
        files = ("-I.", "main.c", f"{name}.c", "-lm")
        compiled(needs(compiler), "-std=c99", *flags, *files, cwd=folder)
        process = run("./a.out", cwd=folder)
        assert (process.returncode, process.stderr) == (0, "")
        return process.stdout

    return compile_and_run


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_example_and_module_give_the_same_numbers(
    name: str, printed: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Require equal bits under the same flags, and 1e-9 relative to the module's usual build.

    Without FMA, gnu99 (used for modules) and c99 give the same arithmetic.
    """
    columns, values = table(printed(name, "cc -O2"))
    names = [c.name for c in read_system(name).coordinates]
    outputs = [o.name for o in read_system(name).outputs]
    assert columns == ["t", *names, *(f"{n}_dot" for n in names), *outputs, "energy"]
    usual = rows_of(name, module(name))
    np.testing.assert_allclose(values, usual, rtol=0, atol=1e-9 * np.max(np.abs(usual)))
    monkeypatch.setenv("EOMC_CFLAGS", "-O2")
    assert np.array_equal(
        values, rows_of(name, eomc.load(read_system(name), MODULES.parent / "embedded"))
    )


@pytest.mark.parametrize(
    "command", tiers(["gcc -O0", "gcc -O3", "clang -O2", "gcc -O2 -std=gnu99"], "clang -O2")
)
def test_compilers_agree_to_the_last_bit(command: str, printed: Printed) -> None:
    """Use the processor's baseline instruction set, where the compiler contracts no operations."""
    assert printed("cartpole", command) == printed("cartpole", "cc -O2")


@few_kits
def test_self_test_passes_and_detects_a_wrong_number(kit: Path, name: str) -> None:
    def outcome() -> tuple[int, str]:
        compiled("cc", "-std=c99", "-O0", "-I.", "selftest.c", f"{name}.c", "-lm", cwd=kit)
        process = run("./a.out", cwd=kit)
        return process.returncode, process.stdout

    status, words = outcome()
    assert status == 0 and re.fullmatch(rf"{name}: right in \d+ cases\n", words)
    source = (kit / f"{name}.c").read_text(encoding="utf-8")
    right = (
        f"    {read_system(name).parameters[0].value}, /* {read_system(name).parameters[0].name} */"
    )
    assert right in source
    wrong = source.replace(right, right.replace(",", "*1.001,", 1))
    (kit / f"{name}.c").write_text(wrong, encoding="utf-8")
    status, words = outcome()
    assert status == 1
    assert "is off by" in words
    assert re.search(rf"{name}: WRONG in \d+ cases\n$", words)


@driven
def test_header_and_source_of_different_builds_are_refused(kit: Path) -> None:
    header = kit / "cartpole_driven.h"
    text = header.read_text(encoding="utf-8")
    stamp = re.search(r"_STAMP (0x[0-9a-f]+)u", text)
    assert stamp
    header.write_text(text.replace(stamp[1], "0x12345678"), encoding="utf-8")
    process = run("cc", "-std=c99", "-c", "cartpole_driven.c", cwd=kit)
    assert process.returncode != 0
    assert "#error" in process.stderr
    assert "cartpole_driven.h is of another build or form than this file" in process.stderr


# --- contents ------------------------------------------------------------------------------------

# Functions of <math.h>, and GNU's sincos, which gcc calls for a sine and a cosine of one angle.


def symbols(kit: Path, name: str, *flags: str) -> list[tuple[str, str]]:
    """Return (kind, name) of every symbol in the object file; see nm(1)."""
    compiled("cc", "-std=c99", *flags, "-c", f"{name}.c", cwd=kit)
    lines = run(needs("nm"), "-P", f"{name}.o", cwd=kit).stdout.splitlines()
    return [(line.split()[1], line.split()[0]) for line in lines]


@few_kits
def test_object_has_prefixed_symbols_no_writable_data_and_calls_libm_only(
    kit: Path, name: str
) -> None:
    """Global symbols begin with the scene's name; nothing is writable; only libm is called."""
    symbol_table = symbols(kit, name, "-O2")
    for kind, symbol in symbol_table:
        if kind == "U":
            assert symbol in MATHEMATICS, symbol
        elif kind.isupper():
            assert symbol.startswith(f"{name}_"), symbol
    assert not [s for kind, s in symbol_table if kind in "BbDdCcSsGg"], "writable data"
    assert {s for kind, s in symbol_table if kind == "R"} == {
        f"{name}_{what}" for what in ("defaults", "q0", "qd0")
    }
    assert ("T", f"{name}_rk4_step") in symbol_table


def test_enumerators_differ_from_library_macros(tmp_path: Path) -> None:
    """Use a coordinate E of a scene m, because math.h defines M_E."""
    text = """
eomc = 1
name = "m"
[coordinates]
E = { start = 1 }
[energy]
kinetic = "E_dot**2/2"
"""
    write_files(fast_kit(eomc.sources(system.from_scene(scene.parse(text)))), tmp_path)
    compiled("cc", "-std=gnu99", "-include", "math.h", "-c", "m.c", cwd=tmp_path)


def test_enumerators_differ_from_generated_macros() -> None:
    """Collect every suffix of the prefix in templates and csrc; such a name is a macro already."""
    templates = [p for p in (ROOT / "templates").rglob("*.jinja") if "CMake" not in p.name]
    texts = [p.read_text(encoding="utf-8") for p in templates]
    texts += [p.read_text(encoding="utf-8") for p in (ROOT / "csrc").rglob("*.h")]
    texts += [p.read_text(encoding="utf-8") for p in (ROOT / "generator").rglob("*.py")]
    pattern = r'(?:\{\{ PREFIX \}\}|PREFIX\}|PREFIX ~ "|\bEOMC)_([A-Z][A-Z_]*[A-Z]|H\b)'
    macros = {name for text in texts for name in re.findall(pattern, text)} - {
        "CACHE",
        "CFLAGS",
        "PROCESSOR",
    }
    macros -= set(PLACEHOLDERS)
    for file in (ROOT / "csrc" / "solver").glob("*.[ch]"):
        text = re.sub(r"/\*.*?\*/", "", file.read_text(encoding="utf-8"), flags=re.DOTALL)
        for enumerators in re.findall(r"(?ms)^(?:typedef )?enum \{(.*?)\}", text):
            macros |= set(re.findall(r"(?:^|,)\s*EOM_(\w+)", enumerators))
    lanes = {f"{lane}_COUNT" for lane in ("WIDE", "TWO", "FOUR", "PREDICTION")}
    assert macros | lanes | {"ROLLED", "UNROLL"} == c_names.OWN_MACROS


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rolled", "tile", "fast_fma", "unroll"])
def test_coordinates_may_have_the_names_of_generated_macros(name: str, tmp_path: Path) -> None:
    text = (ROOT / "scenes" / "cartpole.toml").read_text(encoding="utf-8")
    text = re.sub(r"\bx(?=\b|_dot)", name, text).replace("[run]\n", "[run]\nbatch = true\n")
    write_files(fast_kit(eomc.sources(system.from_scene(scene.parse(text)))), tmp_path)
    program = f"""
        #include <stdio.h>
        #include "cartpole.h"
        int main(void) {{
            double q[CARTPOLE_NQ] = {{ 0.0, 0.5 }}, qd[CARTPOLE_NQ] = {{ 0.25, 0.0 }};
            cartpole_rk4_step(q, qd, 0.5, &cartpole_defaults);
            printf("%.17g", q[CARTPOLE_{name.upper()}_]);
            return 0;
        }}"""
    (tmp_path / "told.c").write_text(program, encoding="utf-8")
    compiled("cc", "-std=gnu99", "told.c", "cartpole.c", "-lm", "-o", "told", cwd=tmp_path)
    process = subprocess.run([str(tmp_path / "told")], capture_output=True, text=True, check=True)
    trusted = symbolic.reference_for(scene_system("cartpole"))
    _, q, _ = trusted.simulate([0.0, 0.5], [0.25, 0.0], h=0.5, steps=1)
    assert float(process.stdout) == pytest.approx(q[-1][0], rel=1e-12)


@kits_of("everything")
def test_unused_features_are_absent(kit: Path, name: str) -> None:
    """Without inputs there is no signal, u or tau; without time no t; without batch no batch
    functions.
    """
    names = {symbol for _, symbol in symbols(kit, name, "-O0")}
    inputs = name in ("cartpole_driven", "everything")
    timed = inputs or name == "kapitza_pendulum"
    assert (f"{name}_signal" in names) == inputs
    assert (f"{name}_tau" in names) == inputs
    assert (f"{name}_power" in names) == timed
    assert (f"{name}_sincos" in names) == (name not in ("mass_spring", "foucault_pendulum"))
    assert (" double t" in step_of(name)) == timed
    assert ("*u" in step_of(name)) == inputs
    assert not [n for n in names if "batch" in n or "dop" in n]
    header = (kit / f"{name}.h").read_text(encoding="utf-8")
    assert bool(re.search(r"\bdouble \*?u\b", header)) == inputs
    assert bool(re.search(r"\bdouble t\b", header.split("_options;")[0])) == timed


@driven
def test_two_scenes_link_into_one_program(kit: Path) -> None:
    """Their prefixes separate them, also within one translation unit."""
    for file, text in fast_kit(eomc.sources(read_system("kapitza_pendulum"))).items():
        if file.startswith("kapitza"):
            (kit / file).write_text(text, encoding="utf-8")
    (kit / "both.c").write_text(
        '#include "cartpole_driven.c"\n#include "kapitza_pendulum.c"\n'
        "int main(void) { return CARTPOLE_DRIVEN_NQ + KAPITZA_PENDULUM_NQ - 3; }\n"
    )
    compiled("cc", *STRICT, "both.c", "-lm", cwd=kit)
    assert run("./a.out", cwd=kit).returncode == 0


@kits
def test_numbers_in_c_are_the_exact_doubles(kit: Path, name: str) -> None:
    """Read parameters and initial values back from the C and require equal doubles."""
    source = (kit / f"{name}.c").read_text(encoding="utf-8")
    for p in read_system(name).parameters:
        match = re.search(rf"^    (\S+), /\* {p.name}_? \*/$", source, re.MULTILINE)
        assert match
        assert float(match[1]) == p.value
    for array, key in ((f"{name}_q0", "start"), (f"{name}_qd0", "rate")):
        match = re.search(rf"{array}\[\w+\] = \{{ (.*) \}};", source)
        assert match
        numbers = [float(x) for x in match[1].split(", ")]
        assert numbers == [getattr(c, key) for c in read_system(name).coordinates]


def test_fast_math_is_refused_at_compile_time(tmp_path: Path) -> None:
    """-ffast-math breaks the reduction of angles, so it must not compile."""
    write_files(generated("cartpole"), tmp_path)
    process = run("cc", "-std=c99", "-O2", "-ffast-math", "-c", "cartpole.c", cwd=tmp_path)
    assert process.returncode != 0
    assert "-ffast-math" in process.stderr


BOUNCING = """eomc = 1
name = "bouncing"
[coordinates]
y = { unit = "m", start = 1.0 }
[energy]
kinetic = "y_dot**2/2"
potential = "9.81*y"
[[event]]
name = "impact"
when = "y"
direction = "falling"
action = "jump"
y_dot = "-0.9*y_dot"
[[event]]
name = "late"
when = "t - 1.234"
action = "stop"
[outputs]
height = "y + t"
[run]
h = 0.01
duration = 3.0
tolerance = 1e-10
"""


@pytest.mark.slow
def test_example_with_events_uses_adaptive_steps(modules: Modules, tmp_path: Path) -> None:
    (tmp_path / "bouncing.toml").write_text(BOUNCING, encoding="utf-8")
    pipeline.write_c(tmp_path / "bouncing.toml", tmp_path / "c")
    compiled("cc", *STRICT, "-O0", "-I.", "main.c", "bouncing.c", "-lm", cwd=tmp_path / "c")
    head, *rows = run("./a.out", cwd=tmp_path / "c").stdout.splitlines()
    values = np.array([[float(x) for x in row.split(",")] for row in rows])
    times = [*(3.0 * k / 200 for k in range(83)), 1.234]
    expected = modules.unoptimised(BOUNCING).simulate(times=times)
    assert head == "t,y,y_dot,height,energy"
    columns = [times, expected["y"], expected["y_dot"], expected["height"], expected.energy]
    np.testing.assert_allclose(values, np.column_stack(columns), atol=1e-12)
