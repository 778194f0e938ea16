"""Compare formulas of outputs on a tape with SymPy's derivatives, and outputs defined in Python."""

from __future__ import annotations

import pytest
import sympy
from sympy.physics.mechanics import dynamicsymbols

from eomc.base.errors import EomcError, SceneError
from eomc.derive import lagrange
from eomc.derive.outputs import outputs
from eomc.model.system import System, dot, from_scene, symbol, t
from eomc.program import ir, program
from eomc.scene.read import parse

X, V, A = (symbol(n) for n in ("x", "x_dot", "x_ddot"))
HEAD = """eomc = 1
name = "one"
[coordinates]
x = {}
[parameters]
k = 2.0
[energy]
kinetic = "k*x_dot**2/2"
[definitions]
y = "sin(k*x)*cos(t) + x**3"
[outputs]
"""


def value(text: str, **state: float) -> float:
    system = from_scene(parse(HEAD + f'a = "{text}"\n', "one.toml"))
    functions = program.build(lagrange.derive(system))
    (result,), _ = ir.evaluate(functions["outputs"], state)
    return result


@pytest.mark.parametrize("text", ["dot(y)", "dot(dot(y))", "dot(x_dot*y)", "x_ddot*y + dot(y)**2"])
def test_rates_follow_the_chain_rule(text: str) -> None:
    time = sympy.Symbol("time")
    x, k = sympy.Function("x")(time), sympy.Integer(2)
    y = sympy.sin(k * x) * sympy.cos(time) + x**3
    rules = {"dot": lambda e: sympy.diff(e, time), "y": y, "x_dot": x.diff(time)}
    exact = sympy.sympify(text, locals={**rules, "x_ddot": x.diff(time, 2)})
    state = {"x": 0.3, "x_dot": -0.7, "x_ddot": 1.1, "t": 0.4, "k": 2.0}
    for order in (2, 1, 0):
        exact = exact.subs(x.diff(time, order), state["x" + ("", "_dot", "_ddot")[order]])
    assert value(text, **state) == pytest.approx(float(exact.subs(time, 0.4)), rel=1e-13)


def test_derivatives_of_outputs_are_built_on_request() -> None:
    system = from_scene(parse(HEAD + 'a = "dot(y)*x_ddot"\n', "one.toml"))
    assert outputs(system, with_derivatives=False).slopes == ((),)
    assert "output_slopes" not in program.build(lagrange.derive(system))
    (row,) = outputs(system, with_derivatives=True).slopes
    assert len(row) == 3


def test_rate_of_a_discontinuous_output_is_refused() -> None:
    system = from_scene(parse(HEAD + 'a = "dot(sign(x))"\n', "one.toml"))
    with pytest.raises(SceneError, match="outputs: a derivative of something that jumps"):
        outputs(system, with_derivatives=False)


def test_outputs_from_symbols_and_from_dynamicsymbols() -> None:
    one = System.make("one", [X], V**2 / 2, X**2, outputs={"a": dot(X**2) + A, "b": t * X})
    x = dynamicsymbols("x")
    time = dynamicsymbols._t
    other = System.make(
        "one", [x], x.diff() ** 2 / 2, x**2,
        outputs={"a": 2 * x * x.diff() + x.diff(time, 2), "b": time * x},
    )  # fmt: skip
    state = {"x": 0.3, "x_dot": -0.7, "x_ddot": 1.1, "t": 0.4}
    for system in (one, other):
        functions = program.build(lagrange.derive(system))
        result, _ = ir.evaluate(functions["outputs"], state)
        assert result == pytest.approx([2 * 0.3 * -0.7 + 1.1, 0.12])
    for invalid in ({"for": X}, {"a": sympy.Symbol("z")}, [X]):
        with pytest.raises(EomcError, match=r"outputs|output a"):
            System.make("one", [X], V**2 / 2, outputs=invalid)
    with pytest.raises(EomcError, match="not declared"):
        System.make("one", [X], V**2 / 2, A * X)
