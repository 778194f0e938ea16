"""Simplified forms are equal, and those of textbooks where these exist."""

import random

import pytest
import sympy
from sympy import cos, sin, sqrt, symbols

from eomc.verify.symbolic import coefficients, simplify_trig

a, b, x, r, m, k = symbols("a b x r m k", real=True)
v, w = symbols("v w", real=True)


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        (m * r**2 * sin(a) ** 2 + m * r**2 * cos(a) ** 2, m * r**2),
        (r * cos(a) * cos(b) + r * sin(a) * sin(b), r * cos(a - b)),
        (sin(a) * cos(a + b) - cos(a) * sin(a + b), -sin(b)),
        (m + k * sin(a) ** 2 + r * sin(a) ** 2, m + (k + r) * sin(a) ** 2),
        (2 * k * sin(a) * cos(a), k * sin(2 * a)),
        (sqrt((r * sin(a)) ** 2 + (r * cos(a)) ** 2 + x), sqrt(r**2 + x)),
        ((m + k) * v**2 * cos(a) ** 2 + (m + k) * v**2 * sin(a) ** 2, (k + m) * v**2),
    ],
)
def test_textbook_forms(expression: sympy.Expr, expected: sympy.Expr) -> None:
    assert simplify_trig(expression, (v, w)) == expected


@pytest.mark.slow
def test_forms_are_equal_and_no_longer() -> None:
    pick = random.Random(1)
    parts = [
        sin(a),
        cos(a),
        sin(b),
        cos(b),
        cos(a + b),
        sin(2 * a - b),
        x,
        r,
        m,
        v,
        w,
        sqrt(1 + x**2),
    ]
    at = {s: sympy.Float(str(0.3 + 0.17 * i), 40) for i, s in enumerate((a, b, x, r, m, v, w))}
    for _ in range(25):
        terms = [sympy.Mul(*pick.choices(parts, k=pick.randint(1, 6))) for _ in range(6)]
        e = sympy.Add(*(pick.randint(-3, 3) * y for y in terms))
        simplified = simplify_trig(e, (v, w))
        assert abs((simplified - e).xreplace(at).evalf(40)) < 1e-30, e
        assert simplified.count_ops() <= e.count_ops()


def test_coefficients_of_rates() -> None:
    e = sympy.expand((r * v * cos(a) + w) ** 2) + k * x
    terms = coefficients(e, (v, w))
    assert terms == [(v**2, r**2 * cos(a) ** 2), (v * w, 2 * r * cos(a)), (w**2, 1), (1, k * x)]
    assert coefficients(sympy.tanh(v), (v, w)) is None
    assert coefficients(sympy.S.Zero, (v, w)) == []
