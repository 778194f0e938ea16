"""What counts as a mutant of C, a template, Python; a sample of the generator's is noticed."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from changes import Mutant, of_c, of_python, of_template
from conftest import ROOT

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


def found(source: str, mutants: list[Mutant]) -> set[tuple[str, str]]:
    return {(source[m.at : m.end].strip(), m.new.strip()) for m in mutants}


def test_of_c_the_code_alone() -> None:
    assert found(C, of_c(C)) == {
        ("<=", ">"), ("<=", "<"), ("0.5", "0.75"), ("*", "+"), ("*", "/"),
        ("-", "+"), ("1", "0"),
    }  # fmt: skip
    assert Mutant(0, 2, "x").of("abc") == "xc"


def test_of_templates_what_they_write_and_their_conditions() -> None:
    assert found(TEMPLATE, of_template(TEMPLATE)) == {
        ("one and two", "not (one and two)"), ("and", "or"), ("+=", "-="), ("+=", "="),
        ("*", "+"), ("*", "/"), ("q[{{ i + 1 }}] += h*v;", ""),
    }  # fmt: skip


def test_of_python_what_is_computed() -> None:
    assert found(PYTHON, of_python(PYTHON)) == {
        ("0.5", "0.75"), ("a", "list(a)[1:]"), ("a", "list(a)[:-1]"),
        ("x is None and not b", "not (x is None and not b)"), ("is", "is not"), ("and", "or"),
        ("not b", "(b)"), ('raise ValueError("3")', "pass"), ("b += 1", "pass"), ("+", "-"),
        ("1", "2"), (ast.unparse(ast.parse(PYTHON).body[2].body[-1]), "return None"),
        ("min", "max"), ("0", "1"), ("-", "+"), ("y < 4", "True"), ("<", "<="), ("<", ">"),
        ("4", "5"),
    }  # fmt: skip


def test_every_mutant_of_the_generator_is_python() -> None:
    for name in ("derive/tape.py", "runtime/integrator.py"):
        source = (ROOT / "generator" / "eomc" / name).read_text(encoding="utf-8")
        mutants = of_python(source)
        assert len(mutants) > 100
        for mutant in mutants[::10]:
            ast.parse(mutant.of(source))


@pytest.mark.slow
def test_a_sample_is_noticed(tmp_path: Path) -> None:
    """A third at least by four scenes alone; the whole tool asks forty, and the tests."""
    pytest.importorskip("coverage")
    tool = ROOT / "tests" / "generator_mutants.py"
    only = ["derive/ldl", "c/portable/rk4", "optimised/rk4", "lanes/rotate.h"]
    done = subprocess.run(
        [sys.executable, tool, "--brief", "--count", "6", "--seed", "4", "--only", *only],
        env=os.environ | {"EOMC_MUTANTS": str(tmp_path)}, capture_output=True, text=True,
    )  # fmt: skip
    told = re.search(r"^(\d+) of (\d+) caught", done.stdout, re.M)
    assert told, done.stdout + done.stderr
    caught, tried = map(int, told.groups())
    assert tried >= 5 and caught >= tried / 3, done.stdout
