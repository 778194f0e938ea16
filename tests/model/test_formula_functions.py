"""Each row of the table of functions has the same meaning in all programs that it names."""

from __future__ import annotations

import re
from pathlib import Path

import mpmath
import numpy as np
import pytest
import sympy
from support.session import Modules

import eomc
from eomc.base.errors import EomcError
from eomc.model.algebra import ALGEBRA, CONSTRUCTORS, compile_function, mpmath_functions
from eomc.model.symbols import symbol
from eomc.model.system import System
from eomc.report.equations_text import write_equations
from eomc.runtime.mathematics import ANALYTIC, DOUBLES, FUNCTIONS, MathFunction, numpy_functions
from eomc.scene import formulas, hints
from eomc.scene.formulas import evaluate, parse
from eomc.scene.read import parse as parse_scene
from eomc.verify.check import check

SCENES = Path(__file__).parents[2] / "docs" / "scenes.md"
ARGUMENTS = {"x": 0.3, "y": -0.7}
ALL = """
eomc = 1
name = "functions"
[coordinates]
x = { start = 0.3 }
y = { start = 0.7, rate = 0.1 }
[parameters]
a = 1.5
b = 0.4
[definitions]
p = "asinh(x*a) + atanh(b*sin(y)) + 0.1*sinh(y/9)*cosh(x/9)"
q = "hypot(x + 2, y) + atan2(y, x + 9)/9 + acos(sin(y)/3)/9 + asin(cos(x)/3)/9"
[energy]
kinetic = "(1 + erf(b)**2/2)*x_dot**2/2 + (2 + erf(x))*y_dot**2/2 + dot(p)**2/2 + dot(q)**2/2"
potential = "a*acosh(2 + x**2) + log1p(y**2) - cbrt(x + 3)*b + erfc(x*y) + expm1(cos(x - y))"
dissipation = "b*log1p(x_dot**2)/2"
[forces]
x = "-b*cbrt(x_dot + 2) + asinh(x_dot) + exp(-x**2) + max(x, 0.1, y)"
y = "-erf(y_dot/b) + hypot(x_dot, 1) + sqrt(1 + x**2) + log(2 + y**2) + abs(x) + min(y, 1)"
[outputs]
o = "erfc(x) + log1p(x**2) + expm1(x) + hypot(x, y) + cbrt(y) + tanh(x)*atan(y) + tan(x/9)"
[run]
batch = true
linearize = true
"""


def arguments_of(f: MathFunction) -> dict[str, float]:
    """Return values of the arguments inside the domain."""
    return {x: ARGUMENTS[x] + (f.name == "acosh") for x in f.arguments}


@pytest.mark.parametrize("f", ANALYTIC, ids=lambda f: f.name)
def test_derivatives_of_the_table_are_those_of_the_functions(f: MathFunction) -> None:
    with mpmath.workdps(40):
        algebra = {**mpmath_functions(mpmath), "number": mpmath.mpf, "pi": mpmath.pi}
        values = {x: mpmath.mpf(value) for x, value in arguments_of(f).items()}
        for k, derivative in enumerate(f.derivatives):
            orders = tuple(int(j == k) for j in range(len(f.arguments)))
            expected = mpmath.diff(algebra[f.name], tuple(values.values()), orders)
            computed = evaluate(parse(derivative), algebra, values.__getitem__)
            assert abs(computed - expected) < mpmath.mpf(10) ** -15
            x = [symbol(name) for name in f.arguments]
            slope = CONSTRUCTORS[f.name](*x).diff(x[k])
            known = {s: sympy.Rational(arguments_of(f)[s.name]) for s in x}
            assert abs(slope.subs(known).evalf(30) - sympy.Float(str(expected), 30)) < 1e-15


@pytest.mark.parametrize("f", FUNCTIONS.values(), ids=lambda f: f.name)
def test_values_agree_in_all_programs(f: MathFunction) -> None:
    values = [*arguments_of(f).values()]
    expected = DOUBLES[f.name](*values)
    arrays = [np.array([x, x]) for x in values]
    assert numpy_functions()[f.name](*arrays) == pytest.approx([expected] * 2, rel=1e-15)
    assert float(mpmath_functions(mpmath)[f.name](*values)) == pytest.approx(expected, rel=1e-14)
    exact = ALGEBRA[f.name](*map(sympy.Rational, values))
    assert float(exact) == pytest.approx(expected, rel=1e-14)
    if f.exact:
        at = arguments_of(f).__getitem__
        assert evaluate(parse(f.exact), formulas.NUMERIC, at) == pytest.approx(expected)
    x = [symbol(name) for name in f.arguments]
    for module in ("numpy", "mpmath", "math"):
        if f in ANALYTIC:
            of = compile_function(x, CONSTRUCTORS[f.name](*x), module)
            assert float(of(*values)) == pytest.approx(expected, rel=1e-14)


def test_documentation_names_each_function_once() -> None:
    text = SCENES.read_text(encoding="utf-8").partition("## Formulas")[2].partition("## Bodies")[0]
    rows = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    names = [name for row in rows for name in re.findall(r"`(\w+)\(", row)]
    assert sorted(names) == sorted(formulas.FUNCTIONS)


def test_names_of_other_programs_are_explained() -> None:
    assert not {*hints.FUNCTION_ALIASES, *hints.FUNCTIONS} & {*formulas.FUNCTIONS}
    assert {*hints.FUNCTION_ALIASES.values()} <= {*formulas.FUNCTIONS}
    for written, meant in (
        ("arcsinh", "asinh"),
        ("artanh", "atanh"),
        ("ln", "log"),
        ("Erf", "erf"),
    ):
        with pytest.raises(formulas.FormulaError, match=f"did you mean '{meant}'"):
            parse(f"{written}(x)")
    with pytest.raises(formulas.FormulaError, match=r"write 1/cosh\(\.\.\.\)"):
        parse("sech(x)")


@pytest.mark.parametrize(
    ("formula", "domain"),
    [("acosh(1/2)", "x >= 1"), ("log1p(-1)", "x > -1"), ("atanh(1)", "-1 < x < 1"),
     ("2 + asin(exp(log(2)))", "-1 <= x <= 1"), ("sqrt(log(1/2))", "x >= 0")],
)  # fmt: skip
def test_values_outside_the_domain_name_it(formula: str, domain: str) -> None:
    with pytest.raises(formulas.FormulaError, match=f"is real where {domain}"):
        parse(formula)
    name = formula.replace("1/2", "half")
    if name != formula:
        text = ALL.replace("[definitions]", f'c = "{name}"\n[definitions]')
        with pytest.raises(EomcError, match=f"'c' .*|is real where {domain}"):
            parse_scene(text.replace("[parameters]", "[constants]\nhalf = 0.5\n[parameters]"))


def test_python_accepts_functions_of_code_generation() -> None:
    from sympy.codegen import cfunctions

    x = sympy.Symbol("x")
    force = cfunctions.log1p(x) + cfunctions.Cbrt(x) + cfunctions.hypot(x, 1) + sympy.erf(x)
    system = System.make("a", [x], "x_dot**2", forces={"x": force + cfunctions.log2(x)})
    same = System.make(
        "a",
        ["x"],
        "x_dot**2",
        forces={"x": "log1p(x) + cbrt(x) + hypot(x, 1) + erf(x) + log(x)/log(2)"},
    )
    assert system.forces == same.forces


def test_functions_are_printed_in_equations() -> None:
    system = System.make("a", ["x"], "x_dot**2/2", "cbrt(x) + log1p(x)")
    space: dict[str, object] = {}
    exec(write_equations(system, "python"), space)  # generated by eomc
    assert "cbrt" not in write_equations(system, "python")
    assert "cbrt" in write_equations(system, "latex")


@pytest.mark.slow
def test_check_passes_with_all_functions(
    modules: Modules, tmp_path: Path, quickly_compiled: None
) -> None:
    used = {name for name in formulas.FUNCTIONS if re.search(rf"\b{name}\(", ALL)}
    assert used == {*formulas.FUNCTIONS} - {"sign", "heaviside"}  # these have no derivative
    system = eomc.pipeline.assemble(eomc.model.system.from_scene(parse_scene(ALL)))
    plain = eomc.load(system, tmp_path, form="plain")
    report = check(system, modules.unoptimised(system), plain=plain)
    assert report.passed, report.table()
