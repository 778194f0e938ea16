"""Test that expressions on a tape are stored in a normal form."""

from __future__ import annotations

import pytest
from sympy import Expr, Integer, Max, S, Symbol, cosh, log, sinh, sqrt, symbols, tanh

from eomc.derive.tape import NotDifferentiableError, Stage, Tape

x, a = Symbol("x", real=True), Symbol("a", real=True)


def expand(tape: Tape, atom: Expr) -> Expr:
    """Expand an atom into an expression in the leaves of the tape."""
    while names := [s for s in atom.free_symbols if s not in tape.leaves]:
        atom = atom.xreplace({s: tape.rhs(s) for s in names})
    return atom


@pytest.mark.parametrize(
    "expression, expected",
    [
        (sinh(x) / cosh(x), tanh(x)),
        (a * sinh(x) ** 3 / cosh(x) ** 2, a * sinh(x) * tanh(x) ** 2),
        (sinh(-2 * x) * tanh(2 * x) / cosh(2 * x), -(tanh(2 * x) ** 2)),
        (sinh(x) / cosh(2 * x), sinh(x) / cosh(2 * x)),
        (sinh(x) * cosh(x), sinh(x) * cosh(x)),
        (sinh(x) / sqrt(cosh(x)), sinh(x) / sqrt(cosh(x))),
    ],
)
def test_sinh_over_cosh_becomes_tanh(expression: Expr, expected: Expr) -> None:
    """Both overflow for large x."""
    tape = Tape({x: Stage.POSITION, a: Stage.PARAMETER})
    assert expand(tape, tape.define(expression)) == expected


def test_derivative_of_log_cosh_is_tanh() -> None:
    tape = Tape({x: Stage.POSITION, a: Stage.PARAMETER})
    (slope,) = tape.gradient([(tape.define(a * log(cosh(x / 2))), x**0)], [x])
    assert expand(tape, slope) == a * tanh(x / 2) / 2


def test_sums_of_leaves_are_expanded_where_terms_cancel() -> None:
    """q1 + (q2 - q1) would leave rounding errors at large q; b1 + (b2 + b3) is no shorter."""
    b1, b2, b3 = (Symbol(f"b{k}", real=True) for k in (1, 2, 3))
    tape = Tape(dict.fromkeys((b1, b2, b3), Stage.POSITION))
    difference, total = tape.define(b2 - b1), tape.define(b2 + b3)
    assert tape.total([b1, difference]) == b2
    assert tape.total([2 * b1, tape.scaled(Integer(2), difference)]) == 2 * b2
    assert set(tape.rhs(tape.total([b1, total])).args) == {b1, total}
    assert tape.define(3 + b1 + difference - b2) == 3


def test_derivatives_along_constant_names_are_not_needed() -> None:
    """The derivative of max(a, b) jumps, which is irrelevant where a and b are constant."""
    a, b, v = symbols("a b v", real=True)
    tape = Tape(dict.fromkeys((a, b), Stage.POSITION) | {v: Stage.VELOCITY})
    slope = tape.forward([tape.define(Max(a, b) * v**2)], {a: S.One})[0]
    assert tape.forward([slope], {v: S.One})[0] != 0
    with pytest.raises(NotDifferentiableError):
        tape.forward([slope], {a: S.One})
