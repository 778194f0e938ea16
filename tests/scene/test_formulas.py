"""Formulas have the same meaning in floats, in SymPy and in Python."""

import ast
import math
import random
import sys
from fractions import Fraction

import pytest
import sympy
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from eomc.model.algebra import ALGEBRA
from eomc.model.symbols import symbol
from eomc.scene.formulas import FUNCTIONS, NUMERIC, FormulaError, evaluate, parse, suggest

quick = settings(max_examples=150, deadline=None, derandomize=True, database=None)

NAMES = {"a": 0.75, "b": -1.3, "c_1": 2.0}
JITTER = 1e-15

leaves = st.one_of(
    st.sampled_from([*NAMES, "pi"]),
    st.integers(0, 20).map(str),
    st.tuples(st.integers(0, 9), st.integers(0, 999)).map(lambda d: f"{d[0]}.{d[1]:03}"),
    st.tuples(st.integers(1, 9), st.integers(-3, 3)).map(lambda d: f"{d[0]}e{d[1]}"),
)


def branches(inner):
    unary = [f for f, (least, _) in FUNCTIONS.items() if least == 1 and f != "dot"]
    return st.one_of(
        st.tuples(inner, st.sampled_from(["+", "-", "*", "/", " - "]), inner).map("".join),
        st.tuples(inner, st.sampled_from(["**2", "**3", "**-1", "**0.5"])).map("".join),
        inner.map("({})".format),
        inner.map("-{}".format),
        st.tuples(st.sampled_from(unary), inner).map(lambda p: f"{p[0]}({p[1]})"),
        st.tuples(st.sampled_from(["min", "max", "atan2"]), inner, inner).map(
            lambda p: f"{p[0]}({p[1]}, {p[2]})"
        ),
    )


formula_texts = st.recursive(leaves, branches, max_leaves=8)


def parsed(text):
    try:
        return parse(text)
    except FormulaError:
        assume(False)


def value(formula, seed=None):
    """Return the float of a formula; with a seed every leaf has an error of about one rounding."""
    draw = random.Random(seed)

    def with_rounding_error(x):
        return x if seed is None else x * (1 + draw.uniform(-JITTER, JITTER))

    algebra = {
        **NUMERIC,
        "pi": with_rounding_error(math.pi),
        "number": lambda text: with_rounding_error(NUMERIC["number"](text)),
    }
    return evaluate(formula, algebra, lambda name: with_rounding_error(NAMES[name]))


@quick
@given(formula_texts)
def test_formulas_in_floats_and_in_sympy_agree(text):
    formula = parsed(text)
    try:
        number = value(formula)
        spread = max(abs(value(formula, seed) - number) for seed in range(5))
    except (ArithmeticError, ValueError, TypeError):
        assume(False)
    assume(isinstance(number, float | int) and math.isfinite(number) and math.isfinite(spread))
    expr = sympy.sympify(evaluate(formula, ALGEBRA, symbol))
    exact = expr.xreplace({symbol(n): sympy.Rational(v) for n, v in NAMES.items()}).evalf(40)
    assume(exact.is_real and exact.is_finite)
    assume(exact == 0 or abs(exact) > sys.float_info.min)  # no underflow
    # the effect of rounding the leaves is no error of the algebra
    assert abs(number - exact) <= 1e-12 * abs(exact) + 20 * spread


@quick
@given(formula_texts)
def test_python_reads_formulas_alike(text):
    formula = parsed(text)
    builtins = {"abs": abs, "min": min, "max": max}
    names = {**NUMERIC, **NAMES, **builtins, "pi": math.pi}
    try:
        number = value(formula)
        python = eval(compile(ast.parse(text, mode="eval"), "formula", "eval"), names)
    except (ArithmeticError, ValueError, TypeError):
        assume(False)
    assert number == python or number != number or abs(number - python) <= 1e-12 * abs(python)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.1", Fraction(1, 10)),
        ("0.1 + 0.2", Fraction(3, 10)),
        ("1e-3", Fraction(1, 1000)),
        ("9.80665", Fraction(980665, 100000)),
        ("1_000.5", Fraction(2001, 2)),
        ("0x10", 16),
        ("1/3", Fraction(1, 3)),
        ("2**-2", Fraction(1, 4)),
    ],
)
def test_decimals_are_read_as_exact_rationals(text, expected):
    result = evaluate(parse(text), ALGEBRA, symbol)
    assert sympy.sympify(result) == sympy.Rational(expected.numerator, expected.denominator)
    assert evaluate(parse(text), NUMERIC, {}.get) == pytest.approx(float(expected), rel=1e-15)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("-2**2", -4),
        ("(-2)**2", 4),
        ("2**3**2", 512),
        ("2**-1", 0.5),
        ("-2**-2", -0.25),
        ("8/4/2", 1),
        ("2 - 3 - 4", -5),
        ("6/2*3", 9),
        ("--3", 3),
        ("+3", 3),
        ("max(1, 2, 3) - min(4, 5)", -1),
        ("sign(-2) + sign(0) + sign(3)", 0),
        ("heaviside(-1) + heaviside(0) + heaviside(2)", 1.5),
        ("atan2(1, -1)", 3 * math.pi / 4),
        ("abs(-2)*sqrt(16)", 8),
        ("log(exp(2))", 2),
        ("\n  2\n  + 3\t", 5),
    ],
)
def test_values_of_formulas(text, expected):
    assert evaluate(parse(text), NUMERIC, {}.get) == pytest.approx(expected, rel=1e-15)
    assert float(sympy.sympify(evaluate(parse(text), ALGEBRA, symbol))) == pytest.approx(expected)


def test_names_are_in_reading_order_without_functions_and_pi():
    formula = parse("sin(b) + a*dot(c)**2 + pi*b")
    assert [n.id for n in formula.names()] == ["b", "a", "c", "b"]
    assert [c.func.id for c in formula.calls("dot")] == ["dot"]


@pytest.mark.parametrize(
    ("text", "column", "width"),
    [
        ("a + b^2", 5, 1),
        ("  a + b^2", 5, 1),  # columns count without the surrounding blanks
        ("a + 2b", 4, 2),
        ("a*(b c)", 3, 3),
        ("a + sine(b)", 4, 4),
        ("1/(3 - 3)", 3, 5),
        ("a + 1e999", 4, 5),
        ("sqrt(2 - 3)", 0, 11),
        ("1/dot(3)", 2, 6),  # a derivative of numbers only is zero
        ("a\n + #b", 5, 1),
    ],
)
def test_errors_give_their_column(text, column, width):
    with pytest.raises(FormulaError) as error:
        parse(text)
    assert (error.value.column, error.value.width) == (column, width)


@pytest.mark.parametrize(
    "text",
    [
        "9**9**9**9",
        "0e999999999",
        "0e" + "9" * 5000,
        "1e-999999999",
        "((((a**60)**60)**60)**60)**60",
        "abs((2*a)**60)**60",
        "(2*((2*a)**60))**60",
        "9**60*9**60*9**60*9**60*9**60*9**60*9**60",
        "9" * 5000,
        "0x" + "f" * 5000,
        "-" * 5000 + "a",
        "(" * 5000 + "a" + ")" * 5000,
        "dot(" * 1000 + "a" + ")" * 1000,
        "a" + "+a" * 3000,
        "a**" * 3000 + "2",
    ],
)
def test_expensive_formulas_are_refused_quickly(text):
    with pytest.raises(FormulaError):
        parse(text)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os')", "a.b", "a[0]", "[a]", "{a}", "(a,)", "lambda: a", "(lambda: 0)()",
        "f'{a}'", "'a'", 'b"a"', "a if b else c", "a and b", "not a", "a < b", "a == b", "a := 1",
        "(a := 1)", "a @ b", "a // b", "a % b", "a | b", "a & b", "~a", "a << 1", "...", "None",
        "True", "1j", "[x for x in a]", "max(*a)", "max(a, **b)", "max(a, key=b)", "yield a",
        "await a", "a; b", "a\\\nb", "a #", "exec(a)", "eval(a)", "open(a)", "sin", "sin(a)(b)",
        "2(a)", "a!", "$a", "`a`", "a?", "\x00", "a\x0cb", "ａ", "", "  ",
    ],
)  # fmt: skip
def test_other_syntax_is_refused(text):
    with pytest.raises(FormulaError):
        parse(text)


def test_suggestions_for_misspelt_names():
    assert suggest("thata", ["theta", "g"]) == "; did you mean 'theta'?"
    assert suggest("M_C", ["m_c", "m_p"]) == "; did you mean 'm_c'?"
    assert suggest("zzz", ["theta", "g"]) == ""
    assert suggest("tol", ["tolerance", "h"]) == "; did you mean 'tolerance'?"
    assert suggest("the", ["theta_shoulder_1", "theta_shoulder_2"]) == ""  # both are equally near
