"""Portable C: compiler warnings, results, refusals, and how it is generated."""

from __future__ import annotations

import dataclasses
import re
import subprocess
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.cases import SCENES
from support.compilation import MATHEMATICS
from support.session import EVERYTHING, ROOT, needs, tiers

import eomc
from eomc.base import resources
from eomc.emit.common import c_function, templates
from eomc.emit.common.c_expression import Block
from eomc.emit.common.c_function import CArgument, CFunction
from eomc.mechanism.assembly import assembled
from eomc.model import system
from eomc.model.system import System
from eomc.program import outline
from eomc.scene import read as scene
from eomc.toolchain.files import write_files
from eomc.verify import equations, runs
from eomc.verify.comparison import CheckResult, Comparison

STRICT = """-std=c99 -pedantic -Wall -Wextra -Wconversion -Wdouble-promotion -Wshadow
-Werror""".split()
PLAIN = ROOT / "build" / "tests" / "plain"
STEPPERS = 'method = ["rk4", "dp8", "euler", "gauss4", "gauss6", "gauss8", "gauss16"]\n'
NAMES = sorted(path.stem for path in SCENES.glob("*.toml"))
# Constraints, time in the forces, an input.
ROD = """
eomc = 1
name = "rod"
[coordinates]
x = { start = 0.6 }
y = { start = -0.8 }
[parameters]
m = 1.0
l = 1.0
g = 9.81
[inputs]
f = { signal = "sin(t)" }
[energy]
kinetic = "m*(x_dot**2 + y_dot**2)/2"
potential = "m*g*y"
[forces]
x = "f"
[constraints]
rod = "x**2 + y**2 - l**2"
[run]
h = 0.005
duration = 1.0
"""
# By name: the scene, and lines added under [run].
VARIANTS = {
    "steppers": ("cartpole", STEPPERS + 'linearize = "parameters"\n'),
    "driven": ("cartpole_driven", STEPPERS + "linearize = true\ndiscretize = true\n"),
    "verlet": ("kepler_orbit", 'method = ["rk4", "euler", "verlet"]\nbatch = true\n'),
    "many": ("cartpole_driven", 'batch = true\nmethod = ["rk4", "dp8"]\n'),
    "single": ("suspension", 'real = "float"\ndiscretize = true\nmethod = ["rk4", "gauss4"]\n'),
    "slopes": ("cartpole", "linearize = true\n"),
    "everything": ("", 'method = ["rk4", "dp8", "euler"]\n'),
    "rod": ("rod", 'discretize = true\nmethod = ["rk4", "dp8", "gauss4"]\n'),
}

pytestmark = pytest.mark.usefixtures("quickly_compiled")


@cache
def assembled_system(name: str) -> System:
    """Return a scene of scenes/ or of VARIANTS, with its initial state assembled."""
    source, run = VARIANTS.get(name, (name, ""))
    own = {"": EVERYTHING, "rod": ROD}
    text = own.get(source) or (SCENES / f"{source}.toml").read_text(encoding="utf-8")
    text = text.replace("[run]\n", "[run]\n" + run)
    if name in VARIANTS:
        text = re.sub(r"^name *= .*", f'name = "plain_{name}"', text, count=1, flags=re.MULTILINE)
    return assembled(system.from_scene(scene.parse(text, f"{name}.toml")))


@cache
def generated(name: str) -> dict[str, str]:
    """Return the files of optimised and portable C of a build."""
    files = eomc.sources(assembled_system(name)).files
    return {file: text for file, text in files.items() if file.endswith((".c", ".h"))}


def load_both_forms(name: str) -> tuple[ModuleType, ModuleType]:
    """Return the modules of optimised and of portable C."""
    return eomc.load(assembled_system(name), PLAIN), eomc.load(
        assembled_system(name), PLAIN, form="plain"
    )


def kit(name: str, folder: Path) -> str:
    """Write the generated C as `eomc build` does; return its name."""
    (folder / "fast").mkdir()
    write_files(generated(name), folder)
    return assembled_system(name).name


def run(*command: str, cwd: Path) -> str:
    """Run a command that must succeed without warnings; return its output."""
    process = subprocess.run(command, cwd=cwd, capture_output=True, text=True)
    assert (process.returncode, process.stderr) == (0, "")
    return process.stdout


# --- compilers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", tiers([*NAMES, *VARIANTS], "everything"))
def test_strict_gcc_issues_no_warnings(name: str, tmp_path: Path) -> None:
    name = kit(name, tmp_path)
    (tmp_path / "twice.c").write_text(f'#include "{name}.h"\n#include "{name}.h"\n')
    files = [f"{name}.c", "main.c", "selftest.c", "twice.c"]
    run(needs("gcc"), *STRICT, "-O1", "-I.", "-c", *files, cwd=tmp_path)


@pytest.mark.parametrize("name", tiers([*NAMES, *VARIANTS], "single", "everything"))
def test_strict_clang_and_cpp_issue_no_warnings(name: str, tmp_path: Path) -> None:
    name = kit(name, tmp_path)
    run(needs("clang"), *STRICT, "-O1", "-c", f"{name}.c", cwd=tmp_path)
    cpp = ["-std=c++11", *STRICT[1:], "-fsyntax-only", "-x", "c++"]
    run(needs("g++"), *cpp, f"{name}.c", cwd=tmp_path)


@pytest.mark.parametrize("name", tiers([*NAMES, *VARIANTS], "everything"))
def test_both_forms_have_the_same_prototypes(name: str) -> None:
    def prototypes(header: str) -> set[str]:
        bare = re.sub(r"/\*.*?\*/", "", header, flags=re.DOTALL)
        declarations = re.findall(r"^\w[\w *]*\b\w+\([^;{]*\);", bare, re.MULTILINE)
        return {re.sub(r"\s+", "", p) for p in declarations}

    files, title = generated(name), assembled_system(name).name
    plain, fast = prototypes(files[f"{title}.h"]), prototypes(files[f"fast/{title}.h"])
    assert plain == {p for p in fast if "_block(" not in p}  # of states in vector registers
    assert len(plain) > 8


@pytest.mark.parametrize("name", tiers([*NAMES, *VARIANTS], "cartpole", "rod", "driven"))
def test_workspaces_have_only_members_that_the_portable_source_uses(name: str) -> None:
    files, title = generated(name), assembled_system(name).name
    header = re.sub(r"/\*.*?\*/", "", files[f"{title}.h"], flags=re.DOTALL)
    pattern = r"typedef struct \{([^}]*)\} \w+_(memory|options|output);"
    structs = {kind: text for text, kind in re.findall(pattern, header)}
    run = assembled_system(name).run
    assert {*structs} - {"memory"} == {"options", "output"}
    assert ("memory" in structs) == bool(run.tolerance or assembled_system(name).events)
    for member in set(re.findall(r"(\w+)(?:\[\d+\])?[,;]", "".join(structs.values()))):
        assert f"->{member}" in files[f"{title}.c"], member


@pytest.mark.parametrize("name", tiers(["cartpole", "driven", "everything"], "cartpole"))
def test_object_exports_the_public_names_only(name: str, tmp_path: Path) -> None:
    title = kit(name, tmp_path)
    run("cc", "-std=c99", "-O2", "-c", f"{title}.c", cwd=tmp_path)
    lines = run(needs("nm"), "-P", f"{title}.o", cwd=tmp_path).splitlines()
    symbols = [(line.split()[1], line.split()[0]) for line in lines]
    header = (tmp_path / f"{title}.h").read_text(encoding="utf-8")
    assert not [s for kind, s in symbols if kind == "U" and s not in MATHEMATICS]
    assert not [s for kind, s in symbols if kind in "BbDdCcSsGg"], "writable data"
    public = {s for kind, s in symbols if kind in "TR"}
    assert public == {s for s in public if re.search(rf"\b{s}[\[(;]|\b{s};", header)}
    assert all(s.startswith(f"{title}_") for s in public)
    assert {f"{title}_{what}" for what in ("D", "acceleration", "defaults", "q0", "qd0")} <= public


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cartpole", "chain", "driven"])
def test_portable_object_is_smaller_than_optimised_object(name: str, tmp_path: Path) -> None:
    title = kit(name, tmp_path)
    sizes = []
    for file in (f"{title}.c", f"fast/{title}.c"):
        run(needs("gcc"), "-std=c99", "-Os", "-c", file, "-o", "made.o", cwd=tmp_path)
        sizes.append(int(run(needs("size"), "made.o", cwd=tmp_path).splitlines()[1].split()[0]))
    assert sizes[0] < 0.7 * sizes[1]
    if name == "cartpole":
        assert sizes[0] < 3000


def test_header_and_source_of_different_forms_are_refused(tmp_path: Path) -> None:
    """The workspaces of the two forms differ."""
    title = kit("cartpole", tmp_path)
    (tmp_path / f"{title}.h").write_text(generated("cartpole")[f"fast/{title}.h"])
    for flags in ([], ["-ffast-math"]):
        command = ["cc", "-std=c99", *flags, "-c", f"{title}.c"]
        process = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert process.returncode != 0
        assert ("is of another build or form" in process.stderr) == (not flags or True)
    (tmp_path / f"{title}.h").write_text(generated("cartpole")[f"{title}.h"])
    process = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert process.returncode != 0 and "with -ffast-math" in process.stderr


@pytest.mark.parametrize("form", ["plain", "fast"])
@pytest.mark.parametrize("name", tiers(["gcc", "clang"], "gcc"))
def test_flags_that_ignore_nan_are_refused(name: str, form: str, tmp_path: Path) -> None:
    """-ffinite-math-only is the part of -ffast-math that removes the checks."""
    title, level = kit("cartpole", tmp_path), ["-std=gnu99", "-fsyntax-only"]
    source = f"{title}.c" if form == "plain" else f"fast/{title}.c"
    for flags, refused in (
        (["-ffast-math"], True), (["-Ofast"], True), (["-ffinite-math-only"], True),
        (["-O3", "-funroll-loops"], False), (["-fno-finite-math-only"], False),
        (["-fno-math-errno", "-fno-trapping-math"], False),
    ):  # fmt: skip
        process = subprocess.run(
            [needs(name), *level, *flags, source], cwd=tmp_path, capture_output=True, text=True
        )
        assert (process.returncode != 0) == refused, (flags, process.stderr)
        assert ("no NaN would be noticed" in process.stderr) == refused


# --- results --------------------------------------------------------------------------------------


def check_plain(name: str, fast: ModuleType, plain: ModuleType, states: int) -> list[CheckResult]:
    """Return the results of checks of values, runs and derivatives, of both forms of C."""
    comparison = Comparison(assembled_system(name), fast, np.random.default_rng(0), states, plain)
    tables = equations.checks, runs.checks, equations.derivative_checks
    return [row for table in tables for row in comparison.report(table)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", tiers([*NAMES, "steppers", "driven", "single", "everything"], "single")
)
def test_both_forms_of_c_agree_with_the_reference(name: str) -> None:
    fast, plain = load_both_forms(name)
    rows = check_plain(name, fast, plain, states=6)
    assert [row for row in rows if not row.passed] == []
    steps = {f"one step of {method}" for method in fast.methods if method != "rk4"}
    assert steps | {"D", "acceleration"} < {r.name for r in rows}


@pytest.mark.slow
def test_check_detects_a_wrong_weight(tmp_path: Path) -> None:
    right = resources.text

    def wrong(folder: str, name: str) -> str:
        return right(folder, name).replace("2*(a2[i] + a3[i])", "(a2[i] + 3*a3[i])")

    # The name differs because a process loads one module for each build.
    system_with_other_name = dataclasses.replace(assembled_system("cartpole"), name="plain_wrong")
    templates.environment.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resources, "text", wrong)
        plain = eomc.load(system_with_other_name, tmp_path, form="plain")
    templates.environment.cache_clear()
    rows = check_plain("cartpole", load_both_forms("cartpole")[0], plain, states=4)
    failed = {row.name for row in rows if not row.passed}
    assert failed == {"plain C: one step", "plain C: run"}


def test_documented_commands_compile_the_self_test(tmp_path: Path) -> None:
    title, page = kit("cartpole", tmp_path), (ROOT / "docs" / "c.md").read_text(encoding="utf-8")
    commands = re.findall(r"^cc .*selftest.*?(?= *#)", page, re.M)
    assert len(commands) == 2
    for command in commands:
        _, *arguments = command.replace("NAME", title).split()
        run(needs("cc"), *arguments, cwd=tmp_path)
        assert run("./a.out", cwd=tmp_path).startswith(f"{title}: right in ")


@pytest.mark.parametrize("name", tiers(["cartpole", "everything"], "cartpole"))
@pytest.mark.parametrize("form", ["plain", "fast"])
def test_example_and_self_test_work_with_both_forms(name: str, form: str, tmp_path: Path) -> None:
    title = kit(name, tmp_path)
    at = "." if form == "plain" else "fast"
    source = f"{at}/{title}.c"
    run("cc", "-std=c99", "-O0", f"-I{at}", "selftest.c", source, "-lm", cwd=tmp_path)
    assert re.fullmatch(rf"{title}: right in \d+ cases\n", run("./a.out", cwd=tmp_path))
    run("cc", "-std=c99", "-O0", f"-I{at}", "main.c", source, "-lm", "-o", "main", cwd=tmp_path)
    _, *rows = run("./main", cwd=tmp_path).splitlines()
    s, module = assembled_system(name).run, load_both_forms(name)[form == "plain"]
    steps = max(1, int(np.ceil(s.duration / s.h * (1 - 1e-12))))
    expected = module.simulate(steps=steps, every=max(1, steps // 200))
    values = np.array([[float(x) for x in row.split(",")] for row in rows])
    expected = np.column_stack(
        [expected.t, expected.q, expected.qd, *expected.outputs.values(), expected.energy]
    )
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-9 * np.max(np.abs(expected)))


def test_run_equals_its_steps_for_any_split() -> None:
    plain = eomc.load(assembled_system("driven"), PLAIN, form="plain")
    for method in plain.methods:
        whole = plain.simulate(steps=7, h=0.01, method=method)
        q, qd = plain.start
        for k in range(7):
            q, qd = plain.step(q, qd, 0.01, t=k * 0.01, method=method)
        assert np.array_equal(np.hstack([q, qd]), whole.x[-1]), method


@pytest.mark.parametrize("form", [0, 1])
def test_rows_at_steps_long_after_time_zero_are_those_of_the_steps(form: int) -> None:
    """The difference of two times has the rounding errors of the times."""
    module = load_both_forms("driven")[form]
    t0, h, steps = 1e5, 0.01, 20
    whole = module.simulate(t0=t0, h=h, steps=steps)
    rows = module.simulate(t0=t0, h=h, times=t0 + h * np.arange(steps + 1))
    assert rows.steps == steps and np.array_equal(rows.x, whole.x)
    assert rows.evaluations == whole.evaluations


@pytest.mark.parametrize(("method", "stages"), [("gauss4", 2), ("gauss6", 3), ("gauss8", 4)])
def test_each_iteration_evaluates_all_stages(method: str, stages: int) -> None:
    """A step begins with one evaluation; the contraction rate needs at least two iterations."""
    plain = eomc.load(assembled_system("driven"), PLAIN, form="plain")
    run = plain.simulate(steps=20, h=0.01, method=method)
    sweeps, rest = divmod(run.evaluations - 20, stages)
    assert rest == 0 and 2 * 20 <= sweeps <= 12 * 20


@pytest.mark.slow
@pytest.mark.parametrize("name", ["many", "verlet"])
def test_batch_equals_loop_over_instances(name: str) -> None:
    fast, plain = load_both_forms(name)
    random = np.random.default_rng(5)
    q0, qd0 = (x + 0.1 * random.standard_normal((9, 2)) for x in fast.start)
    qd0[4] = 1e300  # this instance fails and must not affect the others
    for method in fast.methods:
        options: dict[str, Any] = {"steps": 30, "every": 10, "method": method}
        one, other = (m.simulate_batch(q0, qd0, **options) for m in (fast, plain))
        good = np.arange(9) != 4
        np.testing.assert_allclose(other.q[good], one.q[good], rtol=1e-9, atol=1e-9)
        assert np.array_equal(one.status, other.status)
        single = plain.simulate(q0[0], qd0[0], steps=30, every=10, method=method)
        assert np.array_equal(single.q, other.q[0])


@pytest.mark.slow
def test_stiff_motion_with_long_steps() -> None:
    """A decay of 10,000 1/s with steps of 10 ms, and equally stiff feedback signals."""
    text = """
eomc = 1
name = "plain_stiff"
[coordinates]
x = { start = 1.0 }
[inputs]
F = { signal = "-1e8*x - 2e4*x_dot" }
[energy]
kinetic = "x_dot**2/2"
[forces]
x = "F"
[run]
h = 0.01
duration = 1.0
method = ["gauss4", "gauss6", "gauss8"]
"""
    stiff = system.from_scene(scene.parse(text, "plain_stiff.toml"))
    fast, plain = (eomc.load(stiff, PLAIN, form=form) for form in ("fast", "plain"))
    for method in plain.methods:
        one, other = (m.simulate(steps=100, method=method) for m in (fast, plain))
        assert str(other.status) == "ok"
        assert np.max(np.abs(other.x)) < 1e5
        np.testing.assert_allclose(other.q, one.q, rtol=1e-6, atol=1e-9)


# --- refusals -------------------------------------------------------------------------------------

REFUSED = """
#include <NAME.h>

#include <math.h>
#include <stdio.h>

static void tell(const char *what, int status, const double *x, int n)
{
    int i, same = 1;

    for (i = 0; i < n; i++)
        same = same && x[i] == 7;
    printf("%s %d %d\\n", what, status, same);
}

int main(void)
{
    const double far[2] = { 0.0, 1e300 }, still[2] = { 0.0, 0.0 }, fast[2] = { 0.0, 1e300 };
    NAME_params p = NAME_defaults;
    double qdd[2] = { 7, 7 }, A[8] = { 7, 7, 7, 7, 7, 7, 7, 7 };

    tell("speed", NAME_acceleration(qdd, still, fast, &p), qdd, 2);
    tell("slopes", NAME_linearization(A, A + 4, far, fast, &p), A, 8);
    p.m_c = -2.0;
    tell("mass", NAME_acceleration(qdd, still, still, &p), qdd, 2);
    tell("slopes", NAME_linearization(A, A + 4, still, still, &p), A, 8);
    p.m_c = NAN;
    tell("nan", NAME_acceleration(qdd, still, still, &p), qdd, 2);
STEPS
    return 0;
}
"""
STEP = """    {
        double x[4] = { 7, 7, 7, 7 }, rows[8] = { 7, 7, 7, 7, 7, 7, 7, 7 };
        NAME_options options = { .method = UPPER_METHOD_WHICH, .h = 0.01, .steps = 3 };
        NAME_output output = { .q_rows = rows, .qd_rows = rows + 4 };
        NAME_params bad = NAME_defaults;

        bad.m_c = -2.0;
        tell("METHOD", NAME_METHOD_step(x, x + 2, 0.01, &bad), x, 4);
        options.every = 1;
        options.rows = 2;
        output.rows = 1; /* the start is stored */
        tell("METHOD", (int)NAME_integrate(x, x + 2, &bad, &options, &output) - 1, rows, 8);
        bad.m_c = 2.0, bad.g = 1e308, bad.l = 1e-300;
        tell("METHOD", NAME_METHOD_step(x, x + 2, 0.01, &bad) != 0, x, 4);
    }
"""


def test_refused_calls_leave_the_arguments_unchanged(tmp_path: Path) -> None:
    """Status 1: D is not positive definite, 2: not finite; NULL comes from <stdio.h>."""
    title = kit("steppers", tmp_path)
    methods = assembled_system("steppers").run.methods
    steps = "".join(
        STEP.replace("WHICH", m.upper())
        .replace('"METHOD"', f'"{m}"')
        .replace("NAME_METHOD_step", f"NAME_{m}_step")
        .replace("UPPER", title.upper())
        for m in methods
    )
    text = REFUSED.replace("STEPS", steps).replace("NAME", title)
    (tmp_path / "refused.c").write_text(text, encoding="utf-8")
    for at in (".", "fast"):
        files = ["refused.c", f"{at}/{title}.c", "-lm", "-o", "refused"]
        run("cc", "-std=c99", "-O0", f"-I{at}", *files, cwd=tmp_path)
        lines = run("./refused", cwd=tmp_path).splitlines()
        assert lines[:5] == ["speed 2 1", "slopes 2 1", "mass 1 1", "slopes 1 1", "nan 2 1"], at
        expected = [line for m in methods for line in (f"{m} 1 1", f"{m} 0 1", f"{m} 1 1")]
        assert lines[5:] == expected, at


# --- large systems --------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["everything", "single", "driven", "slopes"])
def test_long_functions_are_outlined(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The static functions pass values in a struct; the self-test passes."""
    for size in ("LARGE", "PORTABLE_LARGE"):
        monkeypatch.setattr(outline, size, 5)
    for size in ("PIECE", "PORTABLE_PIECE"):
        monkeypatch.setattr(outline, size, 8)
    small = eomc.sources(assembled_system(name))
    title = small.name
    for file in (f"{title}.h", f"{title}.c", "selftest.c"):
        (tmp_path / file).write_text(small.files[file], encoding="utf-8")
    text = small.files[f"{title}.c"]
    assert f"{title}_acceleration_2(" in text
    assert (f"{title}_slopes_2(" in text) == assembled_system(name).run.needs_derivatives
    assert f"{title}_kinetic_energy_2(" in text
    run(needs("gcc"), *STRICT, "-O1", "-I.", "-c", f"{title}.c", cwd=tmp_path)
    run("cc", "-std=c99", "-I.", "selftest.c", f"{title}.c", "-lm", cwd=tmp_path)
    assert re.fullmatch(rf"{title}: right in \d+ cases\n", run("./a.out", cwd=tmp_path))
    fast, _ = load_both_forms(name)
    plain = eomc.load(assembled_system(name), tmp_path / "modules", form="plain")
    assert [row for row in check_plain(name, fast, plain, states=3) if not row.passed] == []


@pytest.mark.slow
def test_portable_functions_are_not_outlined_where_optimised_ones_are() -> None:
    files = generated("bricard")
    assert re.search(r"\bbricard_acceleration_\w*2\(", files["fast/bricard.c"])
    assert not re.search(r"\bbricard_\w+_2\(", files["bricard.c"])


@pytest.mark.slow
def test_chain_of_thirty_links_is_evaluated_by_columns(tmp_path: Path) -> None:
    text = (SCENES / "chain.toml").read_text(encoding="utf-8")
    text = text.replace("n = { value = 5,", "n = { value = 30,")
    text = re.sub(r"^name *= .*", 'name = "plain_links"', text, count=1, flags=re.MULTILINE)
    text = text.replace("[run]\n", "[run]\nlinearize = true\n")
    links = system.from_scene(scene.parse(text, "plain_links.toml"))
    fast, plain = (eomc.load(links, PLAIN, form=form) for form in ("fast", "plain"))
    source = eomc.sources(links).files["plain_links.c"]
    assert "plain_links_D_column(" in source
    q, qd = np.random.default_rng(3).standard_normal((2, len(links.q)))
    for name, arguments in (
        ("D", (q,)),
        ("C", (q, qd)),
        ("bias", (q, qd)),
        ("acceleration", (q, qd)),
    ):
        one, other = (getattr(m, name)(*arguments) for m in (fast, plain))
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-9 * np.max(np.abs(one)))
    one, other = (m.linearize(q, qd)[0] for m in (fast, plain))
    np.testing.assert_allclose(other, one, rtol=1e-7, atol=1e-9 * np.max(np.abs(one)))


# --- generation -----------------------------------------------------------------------------------


def test_text_of_a_function() -> None:
    arguments = (
        c_function.output_array("double", "x", "N"),
        c_function.input_array("double", "y"),
        CArgument("int", "n"),
    )
    f = CFunction(
        "f", "void", arguments, (Block("", ("x[0] = n;",)),), frozenset("xn"), "static", ("x = n.",)
    )
    assert f.prototype == "static void f(double x[N], const double *y, int n)"
    assert f.call(y="0", n="2*n") == "f(x, 0, 2*n)"
    assert f.unused == ("y",)
    assert f.definition == (
        "/* x = n. */\nstatic void f(double x[N], const double *y, int n)\n{\n"
        "    (void)y;\n\n    x[0] = n;\n}"
    )
    assert CFunction("g", "int", ()).prototype == "int g(void)"


def test_long_lines_are_wrapped() -> None:
    call = "    *status = " + "long_name(" + ", ".join(f"argument_{k}" for k in range(12)) + ");"
    text = c_function.break_long_lines(f"/* {'word ' * 30}*/\n{call}")
    first, second, *rest = text.split("\n")
    assert len(rest) == 2 and all(len(line) <= 100 for line in text.split("\n"))
    assert f"{first} {second.removeprefix(' * ')}" == f"/* {'word ' * 30}*/"
    assert rest[1].startswith("        argument_")


def test_portable_c_of_the_cart_pole_is_short() -> None:
    files = generated("cartpole")
    assert files["cartpole.c"].count("\n") <= 260
    assert files["cartpole.h"].count("\n") < 110
    assert "__attribute__" not in files["cartpole.c"] and "#define" not in files["cartpole.c"]
