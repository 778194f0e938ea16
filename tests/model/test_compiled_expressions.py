"""Compiled expressions do not depend on what their symbols are called."""

from __future__ import annotations

import math
from typing import Any

import mpmath
import pytest
import sympy

from eomc.model.algebra import compile_function
from eomc.model.from_scene import from_scene
from eomc.model.symbols import symbol
from eomc.report.equations_text import write_equations
from eomc.scene.read import parse
from eomc.verify import symbolic
from eomc.verify.checks_inputs_outputs import Formulas
from eomc.verify.sampling import State

# of Python, NumPy, mpmath, SymPy, and of what expressions are compiled to
NAMES = (
    *("size", "e", "E", "Heaviside", "DiracDelta", "Max", "Min", "sum", "range", "len", "type"),
    *("math", "numpy", "mpmath", "mpf", "mpc", "inf", "x0", "x1", "self", "args", "print", "Dummy"),
    *("Matrix", "Eq", "Rational", "symbols", "Abs", "I", "S", "N"),
)


def named(*names: str) -> str:
    """A scene with parameters of those names beside exp(1) and functions that they may hide."""
    total = f"({' + '.join(names)})/{len(names)}"
    return f"""
eomc = 1
name = "named"
[coordinates]
x = {{ start = 0.1 }}
[parameters]
{"".join(f"{name} = 2.0" + chr(10) for name in names)}
[energy]
kinetic = "{total}*x_dot**2/2"
potential = "exp(1)*x**2/2 + {total}*x"
[forces]
x = "{total}*heaviside(x + 3) + max(x, {total}) + min(x, 1) + abs(x)"
[outputs]
y = "exp(1)*{total} + heaviside(x + 3) + max(x, {total}) + dot({total}*x)"
"""


def expected(x: float) -> float:
    """The acceleration of `named`."""
    return (2 + 2 + x + abs(x) - math.e * x - 2) / 2


def test_references_do_not_depend_on_names() -> None:
    system = from_scene(parse(named(*NAMES)))
    state = {"params": dict.fromkeys(NAMES, 2.0)}
    found = symbolic.derive(system).acceleration([0.3], [0.0], **state)
    assert found == pytest.approx([expected(0.3)])
    (output,) = Formulas(system).evaluate(State([0.3], [0.5], 0.0, None, None), [0.0])  # type: ignore[arg-type]
    assert output == pytest.approx(math.e * 2 + 1 + 2 + 2 * 0.5)


@pytest.mark.parametrize("modules", ["math", "numpy", "mpmath"])
@pytest.mark.parametrize("name", ["size", "e", "Abs", "mpf", "math", "x0"])
def test_arguments_and_definitions_hide_nothing(name: str, modules: Any) -> None:
    x, y = symbol("x"), symbol(name)
    e = [sympy.exp(1) * x + sympy.Abs(y), sympy.Abs(y) / x, sympy.pi]
    for given, definitions in (((x, y), ()), ((x,), ((y, x + 1),))):
        of = compile_function(given, e, modules, definitions)
        values = of(mpmath.mpf(2), mpmath.mpf(3)) if len(given) > 1 else of(mpmath.mpf(2))
        assert [*map(float, values)] == pytest.approx([2 * math.e + 3, 1.5, math.pi])


@pytest.mark.parametrize("name", ["E", "Max", "Matrix"])
def test_source_of_equations_runs_whatever_parameters_are_called(name: str) -> None:
    system, space = from_scene(parse(named(name))), dict[str, Any]()
    exec(write_equations(system, "python"), space)  # our own text
    found = space["g"][0] - space["tau"][0]
    values = {sympy.Symbol(name, real=True): 2, sympy.Symbol("x", real=True): sympy.Rational(3, 10)}
    assert -float(found.subs(values)) / 2 == pytest.approx(expected(0.3))
