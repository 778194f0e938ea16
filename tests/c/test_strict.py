"""Portable C under all standards and levels, sanitizers, valgrind and MISRA; its object code.

The object has no heap use, writable data or recursion, and a bounded stack, as read from the
compiler's output.
"""

from __future__ import annotations

import os
import re
import sys
from itertools import product
from pathlib import Path

import pytest
from c.test_plain import NAMES, VARIANTS, assembled_system, generated, kit
from support.cases import SCENES
from support.compilation import MATHEMATICS, STRICT, clang, compiled, run
from support.generator_mutants import RICH
from support.session import ROOT, needs, tiers

import eomc
from eomc.base.errors import EomcError
from eomc.model import system
from eomc.scene import read as scene
from eomc.toolchain import compiler, sizes

pytestmark = pytest.mark.usefixtures("quickly_compiled")
LEVELS = ("-O0", "-O1", "-O2", "-O3", "-Os")
C, CPP = ("c99", "c11", "c17"), ("c++11", "c++14", "c++17", "c++20")
MOST = ["cartpole", "everything", "steppers", "driven", "single", "verlet", "chain", "rod"]
FUNCTIONS = MATHEMATICS | {f"{name}f" for name in MATHEMATICS}  # also of single precision


@pytest.mark.slow
@pytest.mark.parametrize(("which", "name"), [*product(("gcc", "g++", "clang", "clang++"), MOST)])
def test_compilers_issue_no_warnings(which: str, name: str, tmp_path: Path) -> None:
    title = kit(name, tmp_path)
    cpp = which.endswith("++")
    call = clang(cpp) if which.startswith("clang") else [needs(which)]
    files = [f"{title}.c"] if cpp else [f"{title}.c", "main.c", "selftest.c"]
    language = ["-x", "c++"] if cpp else []
    for standard, level in product(CPP if cpp else C, LEVELS):
        how = [f"-std={standard}", *STRICT[1:], level, "-I.", "-c", *language]
        for file in files:
            compiled(*call, *how, file, cwd=tmp_path)


def rich_files(name: str) -> dict[str, str]:
    """Return the C of a scene with adaptive steps or events."""
    if name == "stick":
        text = STICK
    else:
        options, tables = RICH[name]
        text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
        text = text.replace("[run]\n", "[run]\n" + options) + tables
    return dict(eomc.sources(system.from_scene(scene.parse(text, f"{name}.toml"))).files)


@pytest.mark.slow
@pytest.mark.parametrize("name", RICH)
def test_adaptive_steps_and_events_compile_without_warnings(name: str, tmp_path: Path) -> None:
    files = rich_files(name)
    for file in (f"{name}.c", f"{name}.h"):
        (tmp_path / file).write_text(files[file], encoding="utf-8")
    for call, standard, language in (
        ([needs("gcc")], "c99", []),
        ([needs("g++")], "c++20", ["-x", "c++"]),
        (clang(False), "c99", []),
    ):
        how = [f"-std={standard}", *STRICT[1:], "-O1", "-I.", "-c", *language]
        compiled(*call, *how, f"{name}.c", cwd=tmp_path)


STICK = """eomc = 1
name = "stick"
[coordinates]
x = { start = 1.0, friction = 1 }
[energy]
kinetic = "x_dot**2/2"
potential = "5*x**2"
[run]
friction = "stick"
tolerance = 1e-9
"""
TRAPS = """#define _GNU_SOURCE
#include <fenv.h>
static __attribute__((constructor)) void enable(void)
{
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
}
"""


@pytest.mark.slow
@pytest.mark.parametrize("folder", [".", "fast"])
@pytest.mark.parametrize("name", ["stick", *RICH])
def test_runs_raise_no_floating_point_exceptions(name: str, folder: str, tmp_path: Path) -> None:
    for file, content in {**rich_files(name), "traps.c": TRAPS}.items():
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(content, encoding="utf-8")
    sources = ("main.c", "traps.c", f"{folder}/{name}.c", f"-I{folder}", "-lm", "-o", "main")
    compiled(needs("gcc"), "-std=gnu99", "-O1", *sources, cwd=tmp_path)
    assert run("./main", cwd=tmp_path).returncode == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", MOST)
def test_clang_cl_issues_no_warnings(name: str, tmp_path: Path) -> None:
    """Use clang as Visual C++ (command line and dialect), with ziglang's Windows headers."""
    ziglang = pytest.importorskip("ziglang", reason="ziglang is not installed")
    title, library = kit(name, tmp_path), Path(ziglang.__file__).parent / "lib"
    call = [sys.executable, "-m", "ziglang", "clang", "--driver-mode=cl"]
    call += ["--target=x86_64-pc-windows-msvc", "/Zs", "/W4", "/WX", "/I."]
    for place in (library / "include", library / "libc/include/any-windows-any"):
        call += ["-imsvc", str(place)]
    for file in (f"{title}.c", "main.c", "selftest.c"):
        compiled(*call, "/TC", file, cwd=tmp_path)
    # the guard of MinGW's float.h, a declaration of which is no C++ in this dialect
    compiled(*call, "/D_MINGW_FLOAT_H_", "/TP", f"{title}.c", cwd=tmp_path)
    (tmp_path / "bad.c").write_text("int f(void) { int y = 1; return 0; }\n", encoding="utf-8")
    assert "unused variable" in run(*call, "/TC", "bad.c", cwd=tmp_path).stderr


@pytest.mark.parametrize(
    ("form", "name"),
    [
        pytest.param(f, n, marks=() if (f, n) == ("plain", "cartpole") else pytest.mark.slow)
        for f, n in (*product(["plain"], MOST), *product(["fast"], ["cartpole", "verlet", "chain"]))
    ],
)
def test_sanitizers_report_no_errors(form: str, name: str, tmp_path: Path) -> None:
    title = kit(name, tmp_path)
    at = "." if form == "plain" else "fast"
    how = ["-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    how += ["-std=c99" if form == "plain" else "-std=gnu99", f"-I{at}"]
    for program in ("selftest", "main"):
        files = [f"{program}.c", f"{at}/{title}.c", "-lm", "-o", program]
        process = run(needs("gcc"), *how, *files, cwd=tmp_path)
        assert process.returncode == 0, process.stderr
        process = run(f"./{program}", cwd=tmp_path)
        assert (process.returncode, process.stderr) == (0, "")


STEPS = """
#include <NAME.h>
int main(void)
{
    double q[2] = { 0.1, 0.2 }, qd[2] = { 0, 0 };
    int k, status = 0;

    for (k = 0; k < 100; k++)
        status += (int)NAME_rk4_step(q, qd, 0.001, &NAME_defaults);
    return status;
}
"""


@pytest.mark.slow
@pytest.mark.parametrize("form", ["plain", "fast"])
def test_valgrind_reports_no_heap_use_and_no_errors(form: str, tmp_path: Path) -> None:
    valgrind, title = needs("valgrind"), kit("cartpole", tmp_path)
    at = "." if form == "plain" else "fast"
    (tmp_path / "steps.c").write_text(STEPS.replace("NAME", title), encoding="utf-8")
    for program, blocks in (("steps", "0 allocs"), ("selftest", "1 allocs")):  # allocated by stdio
        files = [f"{program}.c", f"{at}/{title}.c", "-lm", "-o", program]
        compiled("cc", "-std=gnu99", "-g", "-O2", f"-I{at}", *files, cwd=tmp_path)
        process = run(valgrind, "--error-exitcode=9", f"./{program}", cwd=tmp_path)
        assert process.returncode == 0, process.stderr
        assert f"total heap usage: {blocks}" in process.stderr


# --- object code ----------------------------------------------------------------------------------


@pytest.mark.parametrize("level", tiers(["-Os", "-O0", "-O2", "-O3"], "-Os"))
@pytest.mark.parametrize("name", tiers([*NAMES, *VARIANTS], "cartpole"))
def test_object_has_bounded_stack_and_no_writable_data(
    name: str, level: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also, no function is recursive, and only functions of <math.h> are called."""
    monkeypatch.setenv("EOMC_CFLAGS", level)
    gcc = compiler.Compiler((needs("gcc"),), "")
    title = assembled_system(name).name
    measurement = sizes.measure(generated(name), title, gcc)
    assert (measurement.faults, measurement.writable) == ((), 0)
    names = {f.name for f in measurement.functions}
    public = [f for f in measurement.functions if "." not in f.name]
    assert {
        f"{title}_acceleration",
        f"{title}_integrate",
    } <= names
    assert all(f.code > 0 and f.stack is not None and f.total_stack is not None for f in public)
    called = {x for f in measurement.functions for x in f.calls} - names
    assert called <= FUNCTIONS | {"memcpy", "memset", "memmove"}, called - FUNCTIONS
    run_of, step_of = (
        next(f for f in public if f.name == f"{title}_{what}")
        for what in ("integrate", f"{assembled_system(name).run.methods[0]}_step")
    )
    assert run_of.total_stack is not None and step_of.total_stack is not None
    if level == "-O0":  # without inlining
        assert run_of.total_stack > step_of.total_stack > (step_of.stack or 0)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("int x_f(int n) { return n > 1 ? n*x_f(n - 1) + x_f(n - 2) : 1; }", "x_f: calls itself"),
        ("int x_g(int); int x_f(int n) { return x_g(n) + 1; }\n"
         "int x_g(int n) { return n > 9 ? 1 : x_f(n + 1) + x_f(n + 2); }", "calls itself"),
        ("double use(double *);\ndouble x_f(int n) { double a[n]; return use(a); }",
         "x_f: its stack has no bound"),
    ],
)  # fmt: skip
def test_unbounded_stack_is_reported(
    text: str, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    gcc = compiler.Compiler((needs("gcc"),), "")
    measurement = sizes.measure({"x.h": "", "x.c": text}, "x", gcc)
    assert fault in "\n".join(measurement.faults)
    assert next(f for f in measurement.functions if f.name == "x_f").total_stack is None


def test_writable_data_and_constants_are_counted() -> None:
    text = (
        "int x_a; int x_b = 3; const double x_c[4] = { 1, 2, 3, 4 };\nint x_f(void) { return 7; }"
    )
    measurement = sizes.measure({"x.h": "", "x.c": text}, "x", compiler.find_compiler())
    assert (measurement.writable, measurement.constants) == (8, 32)
    assert measurement.code > 0 and [f.name for f in measurement.functions] == ["x_f"]


def test_sizes_need_a_compiler_that_produces_objects(tmp_path: Path) -> None:
    (tmp_path / "cc").write_text("#!/bin/sh\necho no object > x.o\n", encoding="utf-8")
    os.chmod(tmp_path / "cc", 0o755)
    for command, message in ((str(tmp_path / "cc"), "no ELF object"), ("false", "failed"),
                          ("true", "no ELF object"), ("/nowhere", "can't be run")):  # fmt: skip
        with pytest.raises(EomcError, match=message):
            sizes.measure({"x.h": "", "x.c": ""}, "x", compiler.Compiler((command,), ""))


# --- MISRA ----------------------------------------------------------------------------------------


EVENTFUL = """eomc = 1
name = "eventful"
[coordinates]
y = { start = 1.0 }
z = { start = 0.2 }
[parameters]
e = 0.8
[inputs]
force = { signal = "0.5*sin(2*t)", limits = [-2, 2] }
[energy]
kinetic = "y_dot**2/2 + z_dot**2/2"
potential = "9.81*y + z**2/2"
[forces]
z = "force"
[outputs]
height = "2*y + z_dot"
[[event]]
name = "impact"
when = "y"
direction = "falling"
action = "jump"
y_dot = "-e*y_dot"
[run]
tolerance = 1e-9
linearize = "products"
discretize = true
"""


BY_VERSION = (
    "2.4",
    "7.3",
    "12.2",
    "13.5",
    "14.1",
    "21.15",
)  # reported by some versions of cppcheck only


def eventful() -> dict[str, str]:
    """Return the C of a scene with limits, an output, a jump and adaptive steps."""
    return dict(eomc.sources(system.from_scene(scene.parse(EVENTFUL, "eventful.toml"))).files)


@pytest.mark.slow
def test_misra_deviations_are_documented(tmp_path: Path) -> None:
    """Compare cppcheck's findings over all scenes with the deviations listed in docs/c.md.

    Which deviations cppcheck reports depends on its version, but all are listed.
    """
    cppcheck, text = needs("cppcheck"), (ROOT / "docs" / "c.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([\d., ]+?)(?: ¹)? \| (?:required|advisory) \|", text, re.MULTILINE)
    documented = {rule for row in rows for rule in row.split(", ")}
    reported = set()
    for name in [*NAMES, *VARIANTS, "eventful"]:
        title = name if name == "eventful" else assembled_system(name).name
        files = eventful() if name == "eventful" else generated(name)
        for end in "hc":
            file = f"{title}.{end}"
            (tmp_path / file).write_text(files[file], encoding="utf-8")
        words = ["--addon=misra", "--enable=style", "--std=c99", "--suppress=misra-config"]
        process = run(cppcheck, *words, f"{title}.c", cwd=tmp_path)
        assert process.returncode == 0 and ": error:" not in process.stderr, process.stderr
        reported |= set(re.findall(r"\[misra-c2012-([\d.]+)\]", process.stderr))
    assert reported <= documented and documented - reported <= {*BY_VERSION}
