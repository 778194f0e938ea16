"""`eomc check` executes every line of the generated C, as counted by gcov."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.cases import RUN_VARIANTS, SCENES, text_of
from support.compilation import check_coverage, compiled, run, unexecuted
from support.session import needs

# b has no inertia if a is beyond 2 rad, which a run with b at rest reaches smoothly; z is free, so
# that it can overflow at the end of a step.
GENTLE = """eomc = 1
name = "gentle"
[coordinates]
z = { rate = 0.2 }
a = { unit = "rad", start = 0.3 }
b = { unit = "rad", start = 0.1 }
[parameters]
m = 1.2
k = 2.0
[energy]
kinetic = "m*(z_dot**2 + a_dot**2 + (1/2 + cos(a))*b_dot**2)/2 + m*sin(a)*a_dot*z_dot/3"
potential = "-k*cos(a)"
[run]
method = ["rk4", "gauss16"]
h = 0.1
"""

# lines that no check reaches, by scene, with the reason
UNREACHABLE = {
    "bricard": (
        r"return BRICARD_SINGULAR;",
        "of its parts the first one refuses where a bar has no mass, as all are alike",
    ),
    "andrews_squeezer": (
        r"return ANDREWS_SQUEEZER_SINGULAR;|\*status = ANDREWS_SQUEEZER_SINGULAR;|return 0;",
        "its masses are constants: nothing takes them away",
    ),
    "chain": (
        r"return CHAIN_SINGULAR;|\*status = CHAIN_SINGULAR;",
        "its pivots are positive multiples of what chain_compute_constants checks: equal rods",
    ),
}

# Lines of adaptive steps that are executed elsewhere: in stiff motion only, as in
# tests/runtime/test_adaptive_stiff.py; iterations and differences that fail where the accelerations
# do not; iterations that end by rounding errors, or whose last one changes the error estimate, as
# in tests/runtime/test_batch_adaptive.py; runs without a workspace, which only C programs start.
ADAPTIVE = re.compile(
    r"s->(stiff_votes|newton_steps) .*|\? \w+_NEWTON_STEPS : 0;|a->x\.newton = .*"
    r"|.*squared_change\(a, b, x->coarse\) < noise\*noise\);|return \w+_NO_CONVERGENCE;"
    r"|.*last_rough.*|beyond = \w+_select_wide\(again, next, beyond\);"
    r"|continue;|return 1;|return \w+_NOT_FINITE;|row\[k\] = k;|memset\(&own.*|memory = &own;"
    r"|.*>= options->max_evaluations;|.*_TOO_LONG;"  # tests/runtime/test_batch_adaptive.py
    r"|(return|output\[k\]\.status =) \w+_INVALID;"  # tests/c/test_event_calls.py
)


def unexplained(name: str, text: str, folder: Path) -> list[str]:
    """Return the lines that the check of a scene does not execute, without known unreachable
    ones.
    """
    needs("gcov")
    _, lines = check_coverage(text, folder)
    source = (folder / f"{name}.c").read_text(encoding="utf-8")
    excused, _ = UNREACHABLE.get(name, ("(?!)", ""))
    left = [(number, line) for number, line in lines if not re.fullmatch(excused, line)]
    left = [(n, line) for n, line in left if n not in lines_after_constrained_steps(name, source)]
    # A batch without instances, which only C programs run: tests/c/test_batch_source.py.
    empty = {n + 1 for n, line in enumerate(source.splitlines(), 1) if "if (count <= 0)" in line}
    left = [(n, line) for n, line in left if n not in empty]
    # Steps towards a singular position, and too long for the iteration:
    # tests/runtime/test_adaptive*.py.
    ends = ("if (!a.ends && 16*a.h <=", "fifth*fifth*change >", "if (options->max_evaluations &&")
    # The projection at a position where the same matrix has been regular before.
    ends += (f"if (!{name}_least_change(d, &x, fixed, ROWS))\n",)
    # The projection's iteration diverges and is kept: tests/emit/test_projection.py.
    ends += ("if (part < MIN_PART)",)
    # A state without derivatives in vector registers: tests/derive/test_linearize.py.
    ends += (f"if ({name}_fails(",)
    text = source.splitlines(keepends=True)
    refused = {n + 1 for n, x in enumerate(text, 1) if any(e in x for e in ends)}
    fallback = {n for n, x in enumerate(text, 1) if x.strip() == "at[i] = start[i];"}
    refused |= fallback | {n - 1 for n in fallback}
    # After the status of a limit of evaluations: tests/runtime/test_batch_adaptive.py.
    refused |= {n + 1 for n in refused if "TOO_LONG" in text[n - 1]}
    left = [(n, line) for n, line in left if n not in refused]
    if "_run_state;" in source:
        left = [(n, line) for n, line in left if not ADAPTIVE.fullmatch(line)]
    if never_singular(name, source):
        left = [(n, line) for n, line in left if n not in after_solve(name, source)]
    return [f"{number}: {line}" for number, line in left]


def lines_after_constrained_steps(name: str, source: str) -> set[int]:
    """Return lines that refuse the end of a constrained step, or count and judge singular
    positions.

    If a step or its derivatives fail, its stages nearly always fail earlier; these linkages have no
    singular positions on their way. Nor are they near zero, where positions are assembled to
    rounding. tests/runtime/test_constrained_runs.py has others that execute these lines.
    """
    numbers: set[int] = set()
    within = judges = rounds = False
    for number, line in enumerate(source.splitlines(), start=1):
        checks_rates = rf"\S.*\b{name}_(\w*rate_terms\w*|rates_contradict)\("
        judges |= bool(re.match(rf"{checks_rates}|\s+if \(!more && \*singular\)", line))
        if judges:
            numbers.add(number)
            judges = line not in ("}", " " * 8 + "}")
        rounds = (rounds or "if (pass && 2*change > last_change)" in line) and line != " " * 8 + "}"
        if rounds:
            numbers.add(number)
        within = (
            within
            or bool(
                re.match(
                    rf".*\b{name}_(project\w*|\w*derivative\w*|\w*differentiate\w*"
                    r"|\w*stage_equations)\(.*[^;]$",
                    line,
                )
            )
        ) and line != "}"
        refuses = within and re.search("return|break", line) and "OK" not in line
        if refuses or re.match(r"\s+output->first = options->t0 \+ \(\w+\)n\*h;", line):
            numbers.add(number)
    return numbers


def never_singular(name: str, source: str) -> bool:
    """Return True if D depends on parameters only: the function of a state returns 1."""
    solve = re.findall(rf"int {name}_solve(?:_at)?\([^;{{]*\)\n{{.*?\n}}", source, re.DOTALL)
    return bool(solve) and solve[0].rstrip().endswith("return 1;\n}")


def after_solve(name: str, source: str) -> set[int]:
    """Return the lines that follow a check whether that function returned 0."""
    numbers: set[int] = set()
    lines = source.splitlines()
    for number, line in enumerate(lines, start=1):
        if re.search(rf"if \(!{name}_(solve|rates|rk4)\w*\(", line):
            end = next(k for k in range(number, len(lines) + 1) if "SINGULAR" in lines[k - 1])
            numbers |= {end, end + 1} if "break;" in lines[end] else {end}
    return numbers


@pytest.mark.slow
@pytest.mark.parametrize("name", [p.stem for p in sorted(SCENES.glob("*.toml"))])
def test_every_line_of_every_scene_is_executed(name: str, tmp_path: Path) -> None:
    assert unexplained(name, text_of(name), tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize("what", RUN_VARIANTS)
def test_every_line_of_other_steppers_is_executed(what: str, tmp_path: Path) -> None:
    name, more = RUN_VARIANTS[what]
    assert unexplained(name, text_of(name, more), tmp_path) == []


@pytest.mark.slow
def test_every_refusal_of_gauss16_is_provoked(tmp_path: Path) -> None:
    assert unexplained("gentle", GENTLE, tmp_path) == []


PROGRAM = """int main(int count, char **words)
{
    if (count > 1)
        return words[1][0];
    return 0;
}
"""


def test_gcov_reports_lines_that_were_not_executed(tmp_path: Path) -> None:
    needs("gcov")
    (tmp_path / "scene.c").write_text(PROGRAM, encoding="utf-8")
    compiled("gcc", "-O0", "--coverage", "-c", "scene.c", "-o", "scene.o", cwd=tmp_path)
    compiled("gcc", "--coverage", "scene.o", "-o", "scene", cwd=tmp_path)
    assert run("./scene", cwd=tmp_path).returncode == 0
    assert list(unexecuted(tmp_path)) == [(4, "return words[1][0];")]


@pytest.mark.slow
def test_lines_that_were_not_executed_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the checks of templates, lines about refusals are not executed."""
    from support import compilation

    needs("gcov")
    own = compilation.CHECK.replace(
        "support.template_checks import check_all", "eomc.verify.check import check"
    )
    monkeypatch.setattr(compilation, "CHECK", own.replace("check_all(", "check("))
    left = unexplained("mass_spring", text_of("mass_spring"), tmp_path)
    assert any("MASS_SPRING_SINGULAR" in line for line in left)
