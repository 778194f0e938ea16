"""The library of numerical methods, csrc/solver, with the hand-written models of tests/c/solver.

Each C file test_*.c there includes files of the library directly, and the coefficients of one
method from tables.h, which this module writes. Its program reports failed checks.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest
from c_format import files, format_c
from support.compilation import STRICT, clang, compiled, run
from support.session import ROOT, needs, tiers

from eomc.derive import lagrange
from eomc.emit.common import adaptive, solver
from eomc.emit.common.amalgamate import COMMENT, paragraphs, select
from eomc.emit.common.c_expression import DOUBLE, FLOAT, Real
from eomc.emit.common.functions import SceneFunctions, portable_functions
from eomc.integrators.tableaux import METHODS, VERLET, Method
from eomc.model import system
from eomc.program import program
from eomc.scene import read as scene

LIBRARY, TESTS = ROOT / "csrc" / "solver", ROOT / "tests" / "c" / "solver"
BUILD = ROOT / "build" / "tests" / "solver"
SANITIZERS = "-O0 -fsanitize=address,undefined -fno-sanitize-recover=all".split()
FILES = list(files())
MAX_LINES = 60  # of a function


# Two coordinates, with the events of tests/c/solver/model.h
SCENE = """
eomc = 1
name = "two"
[coordinates]
x = { start = 1.0 }
y = { start = 1.0 }
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "10*x + y**2/2"
[[event]]
name = "impact"
when = "x"
direction = "falling"
action = "jump"
x_dot = "-x_dot"
[[event]]
name = "mark"
when = "y"
[[event]]
name = "end"
when = "t - 1"
action = "stop"
"""


@dataclass(frozen=True)
class Case:
    """A test in C: its file, the integration method, features of the library, and macros.

    method: None for adaptive steps.
    """

    file: str
    method: Method | None
    features: tuple[str, ...] = ()
    macros: tuple[str, ...] = ()

    def words(self, real: Real = DOUBLE) -> list[str]:
        """Return the words of a compiler's command for this test, after its tables are written."""
        is_adaptive = "ADAPTIVE" in self.features
        kind = self.method.name if self.method else "adaptive" if is_adaptive else "events"
        folder = BUILD / f"{kind}_{real.name}"
        folder.mkdir(parents=True, exist_ok=True)
        model = solver.portable_model(scene_functions(real, is_adaptive))
        if self.method:
            names = solver.library_names(model, self.method)
            tables = solver.tableau_tables(model.functions, self.method)
        else:
            names = adaptive.library_names(model)
            tables = solver.tableau_tables(model.functions, adaptive.METHOD)
            tables += adaptive.tables(model.functions)
        own = {"EOM_WIDTH", "EOM_LANES", "eom_output"}  # of model.h
        constants = [f"#define {k} {v}" for k, v in names.exact.items() if k not in own]
        write(folder / "tables.h", "\n\n".join(["\n".join(constants), *tables]) + "\n")
        macros = [f"EOM_{name}=1" for name in self.features] + ["SINGLE"] * (real is FLOAT)
        return [
            *(f"-I{f}" for f in (TESTS, LIBRARY, folder)),
            *(f"-D{name}" for name in (*self.macros, *macros)),
            str(TESTS / self.file),
        ]


@cache
def scene_functions(real: Real, is_adaptive: bool) -> SceneFunctions:
    """Return the C functions of the scene, with adaptive steps or without."""
    text = SCENE + "[run]\ntolerance = 1e-9\n" * is_adaptive
    two = system.from_scene(scene.parse(text, "two.toml"))
    return portable_functions(program.build(lagrange.derive(two)), real)


def write(path: Path, text: str) -> None:
    """Write a file, unless it has this text already, since another process may read it."""
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def fixed_steps(m: Method, *features: str) -> Case:
    """Return the test of a method with fixed steps, with these features of the library."""
    # Portable C iterates until the stages converge, so that no iteration limits the order.
    order = 2 * m.stages if m.implicit else m.order
    macros = (f"ORDER={order}", f"DAMPED={int(m is not VERLET)}")
    newton = ["NEWTON"] if m.newton else []
    file = "test_gauss_fixed.c" if m.implicit else "test_explicit.c"
    return Case(file, m, (*newton, *features), macros)


def derivative(name: str, *features: str) -> Case:
    """Return the test of the derivatives of a step of a method."""
    return Case("test_step_derivative.c", METHODS[name], features)


def projection(*features: str) -> Case:
    """Return the test of projections of states and of steps."""
    return Case("test_projection.c", METHODS["rk4"], ("HOLONOMIC", "RATE_TERMS", *features))


CASES = {
    "linear": Case("test_linear.c", METHODS["gauss4"]),
    **{name: fixed_steps(m) for name, m in METHODS.items()},
    "gauss6 with constraints": fixed_steps(METHODS["gauss6"], "CONSTRAINTS"),
    "gauss16 with constraints": fixed_steps(METHODS["gauss16"], "CONSTRAINTS", "PROJECTED_STAGES"),
    "projection": projection(),
    "dependent": projection("MULTIPLE", "SEARCH", "INCREMENTS"),
    "redundant": projection("MULTIPLE", "SUMS", "REDUNDANT"),
    "weights": projection("WEIGHTS"),
    **{f"derivative of {name}": derivative(name) for name in ("rk4", "gauss4", "gauss6")},
    "input of rk4": derivative("rk4", "INPUTS"),
    "input of gauss6": derivative("gauss6", "INPUTS", "NEWTON"),
    "derivative of rk4 with constraints": derivative("rk4", "CONSTRAINTS"),
    "derivative of gauss6 with constraints": derivative("gauss6", "CONSTRAINTS", "NEWTON"),
    "adjoint of rk4": Case("test_adjoint.c", METHODS["rk4"]),
    "adjoint of dp8 with inputs": Case("test_adjoint.c", METHODS["dp8"], ("INPUTS", "PARAMETERS")),
    "adjoint of gauss6": Case("test_adjoint.c", METHODS["gauss6"], ("IMPLICIT", "INPUTS")),
    "adaptive": Case("test_adaptive.c", None, ("ADAPTIVE",)),
    "kinks": Case("test_adaptive.c", None, ("ADAPTIVE", "KINKS")),
    "constraints": Case("test_adaptive.c", None, ("ADAPTIVE", "CONSTRAINTS")),
    "events": Case("test_events.c", None, ("ADAPTIVE", "EVENTS", "SEVERAL", "JUMPS", "RECORDS")),
    "fixed with events": Case("test_events.c", None, ("EVENTS", "SEVERAL", "JUMPS", "RECORDS")),
}


def check_program(call: Sequence[str], words: Sequence[str], folder: Path) -> None:
    """Compile a test without warnings, and run it."""
    unused = ("-Wno-unused-function", "-Wno-unused-const-variable")  # of the library and its tables
    compiled(*call, *unused, *words, "-o", "program", "-lm", cwd=folder)
    process = run("./program", cwd=folder)
    assert (process.returncode, process.stdout + process.stderr) == (0, "")


# Each C file, and each integration method once
QUICK = (
    "linear", "rk4", "gauss6 with constraints", "adjoint of dp8 with inputs", "projection",
    "derivative of gauss6 with constraints", "kinks", "events",
)  # fmt: skip


@pytest.mark.parametrize("name", tiers(CASES, *QUICK))
def test_methods_pass_their_tests_with_sanitizers(name: str, tmp_path: Path) -> None:
    check_program([needs("gcc"), *STRICT, *SANITIZERS], CASES[name].words(), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["gcc", "clang"])
@pytest.mark.parametrize("name", CASES)
def test_methods_pass_their_tests_with_every_compiler(
    name: str, which: str, tmp_path: Path
) -> None:
    call = clang() if which == "clang" else [needs("gcc")]
    for standard, level in (("c99", "-O2"), ("c17", "-O3")):
        flags = [f"-std={standard}", *STRICT[1:], level]
        check_program([*call, *flags], CASES[name].words(), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.method])
def test_methods_pass_their_tests_in_single_precision(name: str, tmp_path: Path) -> None:
    check_program([needs("gcc"), *STRICT, *SANITIZERS], CASES[name].words(FLOAT), tmp_path)


def included_files(path: Path) -> list[str]:
    """Return the names of the files of the library that a C file of the tests includes."""
    names = re.findall(r'#include "(\w+\.[ch])"', path.read_text(encoding="utf-8"))
    return [name for name in names if (LIBRARY / name).exists()]


def test_each_file_of_the_library_is_tested() -> None:
    assert {case.file for case in CASES.values()} == {file.name for file in TESTS.glob("test_*.c")}
    included = {name for file in TESTS.iterdir() for name in included_files(file)}
    assert included == {file.name for file in LIBRARY.iterdir()}


def test_files_of_adaptive_steps_are_those_of_a_model() -> None:
    assert included_files(TESTS / "adaptive.h") == list(adaptive.FILES)


@pytest.mark.parametrize(
    "file",
    [f for f in FILES if f.parent == LIBRARY],
    ids=lambda f: f.name,
)
def test_functions_are_short(file: Path) -> None:
    features: dict[str, bool] = defaultdict(lambda: True)
    for part in paragraphs(select(file.read_text(encoding="utf-8"), features)):
        code = COMMENT.sub("", part).strip()
        assert len(code.splitlines()) <= MAX_LINES, code[:200]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_files_have_the_format_of_the_project(file: Path) -> None:
    text = file.read_text(encoding="utf-8")
    assert format_c(text, needs("clang-format")) == text, "make format-c formats it"


# Loops over discrete coordinates, of which the models have none; comparisons that tell NaN; and
# pointers through which other features write.
SUPPRESSED = (
    "knownConditionTrueFalse",
    "incorrectLogicOperator",
    "oppositeExpression",
    "constVariablePointer",
)


@pytest.mark.parametrize(
    "name",
    tiers(
        ["linear", "gauss6 with constraints", "dependent", "input of gauss6", "events", "kinks"],
        "gauss6 with constraints",
        "dependent",
    ),
)
def test_cppcheck_finds_nothing(name: str) -> None:
    checks = "--enable=warning,style,performance,portability"
    words = ["--quiet", "--std=c99", checks, "--error-exitcode=1"]
    words += [f"--suppress={check}" for check in SUPPRESSED]
    process = run(needs("cppcheck"), *words, *CASES[name].words(), cwd=ROOT)
    assert (process.returncode, process.stdout + process.stderr) == (0, "")
