"""Mutants of C, templates and Python; a sample of mutants of the generator is detected."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.mutations import Mutant, of_c, of_python, of_template
from support.session import ROOT

C = """/* a + b */
int f(double a, double b);
#ifdef __GNUC__
#define F 1.0 + 2
#else
int g(int a)
{
    return a + 1;
}
#endif

int f(double a, double b)
{
    /* a * b */
    if (a <= b)
        return 0.5*a - x[1];
}
"""
TEMPLATE = """{# 1 + 2 #}
{% if one and two %}
    q[{{ i + 1 }}] += h*v;   /* a < b */
{% endif %}
"""
PYTHON = '''
"""Not 1."""
Kind = int | None
def f(a: tuple[int, 3], b: float = 0.5) -> "int | 2":
    """Not 2."""
    for x in a:
        if x is None and not b:
            raise ValueError("3")
    b += 1
    return min(a[0] - b, [y for y in zip(a, a, strict=True) if y < 4])
'''


def replacements(source: str, mutants: list[Mutant]) -> set[tuple[str, str]]:
    return {(source[m.at : m.end].strip(), m.new.strip()) for m in mutants}


def test_mutants_of_c_change_code_only() -> None:
    assert replacements(C, of_c(C)) == {
        ("<=", ">"), ("<=", "<"), ("0.5", "0.75"), ("*", "+"), ("*", "/"),
        ("-", "+"), ("1", "0"),
    }  # fmt: skip
    assert Mutant(0, 2, "x").apply("abc") == "xc"


def test_mutants_of_templates_change_output_and_conditions() -> None:
    assert replacements(TEMPLATE, of_template(TEMPLATE)) == {
        ("one and two", "not (one and two)"), ("and", "or"), ("+=", "-="), ("+=", "="),
        ("*", "+"), ("*", "/"), ("q[{{ i + 1 }}] += h*v;", ""),
    }  # fmt: skip


def test_mutants_of_python_change_computations() -> None:
    assert replacements(PYTHON, of_python(PYTHON)) == {
        ("0.5", "0.75"), ("a", "list(a)[1:]"), ("a", "list(a)[:-1]"),
        ("x is None and not b", "not (x is None and not b)"), ("is", "is not"), ("and", "or"),
        ("not b", "(b)"), ('raise ValueError("3")', "pass"), ("b += 1", "pass"), ("+", "-"),
        ("1", "2"), (ast.unparse(ast.parse(PYTHON).body[2].body[-1]), "return None"),
        ("min", "max"), ("0", "1"), ("-", "+"), ("y < 4", "True"), ("<", "<="), ("<", ">"),
        ("4", "5"),
    }  # fmt: skip


def test_every_mutant_of_the_generator_can_be_parsed() -> None:
    for name in ("derive/tape.py", "runtime/integrator.py"):
        source = (ROOT / "generator" / "eomc" / name).read_text(encoding="utf-8")
        mutants = of_python(source)
        assert len(mutants) > 100
        for mutant in mutants[::10]:
            ast.parse(mutant.apply(source))


@pytest.mark.slow
def test_sample_of_mutants_is_detected(tmp_path: Path) -> None:
    """Four scenes detect at least a third; the whole tool uses forty scenes, and the tests."""
    pytest.importorskip("coverage")
    tool = ROOT / "tests" / "support" / "generator_mutants.py"
    only = ["derive/ldl", "c/portable/rk4", "optimised/rk4", "lanes/rotate.h"]
    process = subprocess.run(
        [sys.executable, tool, "--brief", "--count", "10", "--seed", "4", "--only", *only],
        env=os.environ | {"EOMC_MUTANTS": str(tmp_path)}, capture_output=True, text=True,
    )  # fmt: skip
    match = re.search(r"^(\d+) of (\d+) caught", process.stdout, re.M)
    assert match, process.stdout + process.stderr
    caught, tried = map(int, match.groups())
    assert tried >= 5 and caught >= tried / 3, process.stdout
