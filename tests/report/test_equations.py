"""Equations in textbook form: correct, in order, in lines of at most 100 columns."""

import json
import pickle
import re
import resource
import shutil
import subprocess
import sys
import unicodedata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy
from click.testing import CliRunner
from support.cases import SCENES
from sympy import Eq, cos, sin, symbols
from sympy.printing.pretty.stringpict import stringPict

import eomc
from eomc import pipeline
from eomc.cli.main import main
from eomc.model.symbols import symbol
from eomc.report.equations import derive
from eomc.report.equations_text import write_equations
from eomc.report.typeset import Typesetter
from eomc.runtime.plot import tex
from eomc.verify import symbolic

ALL = sorted(SCENES.glob("*.toml"))
SMALL = [f for f in ALL if f.stem != "bricard"]  # which fills many pages
QUICK = ("cartpole_tutorial", "spring_pendulum", "furuta_pendulum", "kapitza_pendulum")


def scenes(files: list[Path]) -> list[Any]:
    """Return them as parameters, most of them slow."""
    return [
        pytest.param(f, id=f.stem, marks=() if f.stem in QUICK else pytest.mark.slow) for f in files
    ]


def are_equal(equation: Eq, left: sympy.Expr, right: sympy.Expr = sympy.S.Zero) -> bool:
    return bool(sympy.simplify(equation.lhs - equation.rhs - left + right) == 0)


def test_cart_pole_of_the_tutorial() -> None:
    equations = eomc.equations(SCENES / "cartpole_tutorial.toml")
    q2, v2, a1, a2 = symbols("q2 q2_dot q1_ddot q2_ddot")
    mc, mp, r, g = symbols("mc mp l g")
    first, second = equations.scalar
    assert are_equal(
        first, (mc + mp) * a1 - mp * r * cos(q2) * a2 / 2 + mp * r * sin(q2) * v2**2 / 2
    )
    assert are_equal(second, -mp * r * cos(q2) * a1 / 2 + mp * r**2 * a2 / 3 - mp * g * r * sin(q2))
    assert first.rhs == second.rhs == 0
    assert sympy.expand(equations.L - equations.kinetic + equations.potential) == 0


def test_inputs_are_on_the_right_and_friction_on_the_left() -> None:
    system = eomc.System.make(
        "slider", ["x"], "m*x_dot**2/2", "k*x**2/2", dissipation="c*x_dot**2/2",
        forces={"x": "F - k_3*x**3"}, inputs={"F": 0},
        parameters=dict.fromkeys(("m", "k", "c", "k_3"), 1),
    )  # fmt: skip
    (equation,) = derive(system).scalar
    m, k, c, k_3, F = symbols("m k c k_3 F", real=True)
    x, v, a = symbols("x x_dot x_ddot", real=True)
    assert sympy.expand(equation.lhs - (m * a + c * v + k * x)) == 0
    assert sympy.expand(equation.rhs - (F - k_3 * x**3)) == 0
    assert r"& m \ddot{x} + c \dot{x} + k x = F - k_{3} x^{3}" in write_equations(system, "latex")
    text = unicodedata.normalize("NFC", str(derive(system)))
    assert unicodedata.normalize("NFC", "m⋅ẍ + c⋅ẋ + k⋅x = F - k₃⋅x") in text


def test_dots_follow_words() -> None:
    text = unicodedata.normalize("NFC", str(eomc.equations(SCENES / "furuta_pendulum.toml")))
    assert "⋅arm¨⋅cos(θ)" in text and "⋅arm˙⋅θ̇⋅" in unicodedata.normalize("NFD", text)
    assert not re.search(r"ar[\u0307\u0308]|aṙ|r̈", unicodedata.normalize("NFD", text))


def test_decimals_of_a_scene_are_printed_as_decimals() -> None:
    """0.028, not 7/250; a third and an eighth are printed as fractions."""
    potential = "0.0125*x**2/2 + 0.007*x*(1 + m) - m*sin(x)/400 + x**3/8"
    system = eomc.System.make("a", ["x"], "m*x_dot**2/6", potential, parameters={"m": 1})
    text, latex = (write_equations(system, form) for form in ("text", "latex"))
    assert "- 0.0025⋅m⋅cos(x) = 0" in text and "0.007 + 0.007⋅m + 0.0125⋅x" in text
    assert r"- 0.0025 m \cos {x} = 0" in latex and r"\frac{3 x^{2}}{8}" in latex
    match = re.search(r"P &= (.*) \\\\\n  L &= (.*)", latex)
    assert match and "- 0.0025 m \\sin {x}" in match[1] and "+ 0.0025 m \\sin {x}" in match[2]
    assert "000" not in text + latex
    assert not derive(system).g.atoms(sympy.Float)  # only the printed form has decimals


@pytest.mark.parametrize("file", scenes(SMALL))
def test_terms_sum_to_their_expression(file: Path) -> None:
    """The signs matter: a sum after a minus would lose all terms but the first."""
    equations = derive(pipeline.read(file))
    write = Typesetter(equations.system)
    rng = np.random.default_rng(3)
    names = sorted(equations.system.names | {"t"})
    at = {
        symbol(n): float(x) for n, x in zip(names, rng.uniform(0.2, 1.0, len(names)), strict=True)
    }
    at |= dict.fromkeys(equations.multipliers, 0.3)
    values = [
        equations.kinetic,
        equations.potential,
        equations.L,
        *equations.g,
        *equations.D,
        *equations.C,
        *equations.right,
    ]
    for value in values:
        terms = write.terms(value)
        assert len(terms) == 1 or not any(term.is_Add for _, term in terms)
        total = sum((-1 if minus else 1) * complex(term.subs(at).doit()) for minus, term in terms)
        assert np.isclose(total, complex(value.subs(at)), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("file", scenes(SMALL))
def test_scalar_equations_agree_with_reference(file: Path) -> None:
    system = pipeline.read(file)
    equations, reference = derive(system), symbolic.derive(system)
    rng = np.random.default_rng(1)
    values = [p.value for p in system.parameters]
    for _ in range(3):
        q, qd, qdd, u = (
            rng.uniform(0.2, 1.0, len(s)) for s in (system.q, *[system.q] * 2, system.u)
        )
        values_by_symbol = dict(zip((p.symbol for p in system.parameters), values, strict=True))
        for symbols_, x in ((system.q, q), (system.qd, qd), (system.qdd, qdd), (system.u, u)):
            values_by_symbol |= dict(zip(symbols_, x, strict=True))
        values_by_symbol[symbolic.t] = 0.7
        multipliers = rng.uniform(0.2, 1.0, len(system.constraints))
        values_by_symbol |= dict(zip(equations.multipliers, multipliers, strict=True))
        residuals = [
            float((e.lhs - e.rhs).subs(values_by_symbol).evalf()) for e in equations.scalar
        ]
        state = {"q": q, "qd": qd, "t": 0.7, "u": u}
        D, bias, tau = (reference.evaluate(name, **state) for name in ("D", "bias", "tau"))
        expected = D @ qdd + bias - tau
        if system.constraints:
            expected -= multipliers @ reference.evaluate("constraint_jacobian", **state)
        assert np.allclose(residuals, expected, rtol=1e-9, atol=1e-9 * abs(expected).max())


def test_terms_are_ordered_as_in_a_textbook() -> None:
    latex = write_equations(pipeline.read(SCENES / "spring_pendulum.toml"), "latex")
    assert (
        r"& m \ddot{r} - m r \dot{\theta}^{2} + k \left(r - l_{0}\right) - m g \cos {\theta} = 0"
        in latex
    )
    assert (
        r"& m r^{2} \ddot{\theta} + 2 m r \dot{r} \dot{\theta} + m g r \sin {\theta} = 0" in latex
    )


@pytest.mark.parametrize(
    ("name", "dots", "expected"),
    [
        ("theta_1", 0, r"\theta_{1}"),
        ("theta1", 1, r"\dot{\theta}_{1}"),
        ("arm", 2, r"\ddot{\mathrm{arm}}"),
        ("m_c", 0, r"m_{\mathrm{c}}"),
        ("m_pole", 0, r"m_{\mathrm{pole}}"),
        ("x_prime", 1, r"\dot{x}'"),
        ("x_prime_2", 0, "x'_{2}"),
        ("Omega", 0, r"\Omega"),
        ("Alpha", 0, r"\mathrm{Alpha}"),
        ("l_theta2", 0, r"l_{\theta2}"),
    ],
)
def test_names_are_typeset(name: str, dots: int, expected: str) -> None:
    assert tex(name, dots) == expected


QUAD = """
eomc = 1
name = "quad"
[coordinates]
a = { start = 0.5 }
b = { start = 0.5 }
c = { start = 0.5 }
d = { start = 0.5 }
[parameters]
mass = 1.0
length = 1.0
g = 9.81
[definitions]
x1 = "length*sin(a)"
y1 = "-length*cos(a)"
x2 = "x1 + length*sin(b)"
y2 = "y1 - length*cos(b)"
x3 = "x2 + length*sin(c)"
y3 = "y2 - length*cos(c)"
x4 = "x3 + length*sin(d)"
y4 = "y3 - length*cos(d)"
[energy]
kinetic = "mass*(dot(x1)**2 + dot(y1)**2 + dot(x2)**2 + dot(y2)**2 + dot(x3)**2 + dot(y3)**2 + \
dot(x4)**2 + dot(y4)**2)/2"
potential = "mass*g*(y1 + y2 + y3 + y4)"
[outputs]
tip = "dot(x4)*y4 + a_ddot"
"""


def test_matrix_entries_of_four_links_are_printed_one_by_one(tmp_path: Path) -> None:
    file = tmp_path / "quad.toml"
    file.write_text(QUAD, encoding="utf-8")
    equations = eomc.equations(file)
    text, latex = str(equations), equations._repr_latex_()
    assert "D₁₂ = 3⋅mass⋅length ⋅cos(a - b)" in text
    entry = r"D_{34} &= \mathrm{mass} \, \mathrm{length}^{2} \, \cos{\left(c - d \right)}"
    assert entry in latex
    entries = {(int(i), int(j)) for i, j in re.findall(r"^  D_{(.)(.)} &=", latex, re.MULTILINE)}
    assert entries == {(i, j) for i in range(1, 5) for j in range(i, 5)}
    assert r"\frac{d}{dt} \left(" in latex and "d/dt" in text
    assert max(stringPict(line).width() for line in text.splitlines()) <= 100
    assert max(map(len, re.sub(r"\\[a-z]+|[{}]", "", latex).splitlines())) <= 150


@pytest.mark.parametrize("file", scenes(ALL))
def test_text_has_at_most_100_columns(file: Path) -> None:
    text = write_equations(pipeline.read(file))
    assert not re.search(r"\*\*|;$|\bdouble\b|\bw\d+ =|\w\[", text, re.M), text
    assert max(stringPict(line).width() for line in text.splitlines()) <= 100


def test_long_lines_are_broken() -> None:
    system = eomc.System.make(
        "wide", ["x"], "m*x_dot**2/2", f"k*sqrt({' + '.join(f'(x - a_{i})**2' for i in range(9))})",
        parameters={"m": 1, "k": 1, **{f"a_{i}": 1 for i in range(9)}},
    )  # fmt: skip
    text = str(derive(system))
    assert max(stringPict(line).width() for line in text.splitlines()) <= 100
    write = Typesetter(system)
    terms = write.terms(sum(symbols("a:z")))
    assert len(write.rows(terms, 40)) > 2
    assert [t for row in write.rows(terms, 40) for t in row] == terms


@pytest.fixture
def scene_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copy(SCENES / "cartpole.toml", tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def show(*words: str) -> str:
    result = CliRunner().invoke(main, ["show", *words])
    assert result.exit_code == 0, result.output
    return result.output


def test_repr_of_equations_and_systems_is_one_line() -> None:
    system = eomc.read(SCENES / "cartpole_driven.toml")
    expected = "2 coordinates, 1 input, 4 parameters"
    assert repr(system) == f"<System cartpole_driven: {expected}>"
    assert repr(eomc.equations(system)) == (
        f"<Equations of cartpole_driven: {expected}; print() shows them>"
    )


def test_printed_equations_are_cached_until_the_scene_changes(
    scene_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = show("cartpole.toml")
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "read", lambda scene: pytest.fail("derived again"))
        assert show("cartpole.toml") == first
    text = (scene_folder / "cartpole.toml").read_text(encoding="utf-8")
    (scene_folder / "cartpole.toml").write_text(text.replace("m_c", "m_k"), encoding="utf-8")
    assert "m_k" not in first and "mₖ" in show("cartpole.toml")
    (cache_file,) = (scene_folder / "build" / ".shown").glob("*.json")
    cache_file.write_text(json.dumps({"key": 1}), encoding="utf-8")  # damaged
    assert "mₖ" in show("cartpole.toml")


def test_cached_equations_are_printed_without_sympy(scene_folder: Path) -> None:
    show("cartpole.toml")
    code = """
import sys
from eomc.cli.main import main
main(["show", "cartpole.toml"], standalone_mode=False)
assert "sympy" not in sys.modules and "numpy" not in sys.modules
"""
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert process.returncode == 0 and "mass matrix" in process.stdout, process.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", ["suspension", "quad"])
def test_four_coordinates_are_printed_in_seconds_and_again_faster(
    name: str, tmp_path: Path
) -> None:
    """CPU time from an empty folder, including the import of SymPy."""
    file = SCENES / f"{name}.toml"
    if name == "quad":
        file = tmp_path / "quad.toml"
        file.write_text(QUAD, encoding="utf-8")
    took = []
    for _ in range(2):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, "-m", "eomc", "show", str(file), "--build", str(tmp_path)]
        subprocess.run(command, check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        took.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    assert took[0] < 3.0 and took[1] < 0.3, took


def test_nothing_is_cached_in_an_unwritable_folder(scene_folder: Path) -> None:
    (scene_folder / "build").write_text("in the way")
    assert "mass matrix" in show("cartpole.toml")


PENDULUM = """eomc = 1
name = "pendulum"
[coordinates]
theta = { unit = "rad", start = 0.5 }
[parameters]
m = 1.0
l = 0.5
[energy]
kinetic = "m*l**2*theta_dot**2/2"
potential = "-m*9.81*l*cos(theta)"
"""


@pytest.fixture
def pendulum(tmp_path: Path) -> Path:
    (tmp_path / "pendulum.toml").write_text(PENDULUM, encoding="utf-8")
    return tmp_path / "pendulum.toml"


def test_equations_of_a_scene_have_plain_symbols(pendulum: Path) -> None:
    equations = eomc.equations(pendulum)
    m, r, theta, acceleration = symbols("m l theta theta_ddot")
    assert equations.D.subs({"m": 2, "l": 3})[0, 0] == equations.D.subs({m: 2, r: 3})[0, 0] == 18
    assert sympy.lambdify((m, r), equations.D)(2, 3) == 18
    g = sympy.Rational(981, 100)
    assert sympy.solve(equations.scalar[0], acceleration) == [-g * sin(theta) / r]
    assert equations.symbols["theta_ddot"] == acceleration and equations.symbols["m"] == m
    assert equations.set_out.D == equations.D and "θ̈" in str(equations)


@pytest.mark.parametrize("assumptions", [{}, {"real": True}, {"positive": True}])
def test_equations_of_a_system_have_the_symbols_of_the_user(assumptions: dict[str, bool]) -> None:
    from sympy.physics.mechanics import dynamicsymbols

    m, r = symbols("m l", **assumptions)
    theta = dynamicsymbols("theta")
    system = eomc.System.make(
        "pendulum", [theta], m * r**2 * theta.diff() ** 2 / 2, -m * r * cos(theta),
        parameters={m: 1, r: 1},
    )  # fmt: skip
    equations = eomc.equations(system)
    assert equations.D.subs({m: 2, r: 3})[0, 0] == 18
    assert equations.scalar[0].lhs.has(theta.diff(dynamicsymbols._t, 2))
    assert equations.symbols["theta"] == theta and equations.symbols["theta_dot"] == theta.diff()
    x, v = symbols("x x_dot", **assumptions)
    plain = eomc.System.make("mass", [x], m * v**2 / 2, m * x**2, parameters={m: 1})
    assert eomc.equations(plain).g[0] == 2 * m * x
    assert m * v**2 / 2 - m * x**2 == eomc.equations(plain).L


def test_velocities_of_positive_coordinates_may_be_negative() -> None:
    r = sympy.Symbol("r", positive=True)
    for v in (eomc.dot(r), sympy.Symbol("r_dot", real=True)):
        system = eomc.System.make("mass", [r], v**2 / 2, r**2, forces={r: -v * sympy.Abs(v)})
        equations = eomc.equations(system)
        assert equations.tau.subs({r: 1, equations.symbols["r_dot"]: -2})[0] == 4


def test_names_as_text_are_plain_symbols() -> None:
    system = eomc.System.make(
        "mass", ["x"], "m*x_dot**2/2", "k*x**2/2", parameters={"m": 1, "k": 1}
    )
    assert eomc.equations(system).g.subs({"k": 2, "x": 3})[0] == 6


def test_equations_accept_numbers_for_parameters(pendulum: Path) -> None:
    equations = eomc.equations(pendulum)
    changed = equations.with_values({"m": 2}, l=0.1)
    assert changed.D[0, 0] == sympy.Rational(1, 50)
    assert "0.02⋅θ̈" in unicodedata.normalize("NFC", str(changed))
    assert equations.with_values({equations.symbols["m"]: 3}).D.free_symbols == {sympy.Symbol("l")}
    with pytest.raises(eomc.EomcError, match="ll is not a parameter; did you mean 'l'"):
        equations.with_values(ll=1)
    for wrong in (float("nan"), "x", sympy.Symbol("y"), 1j):
        with pytest.raises(eomc.EomcError, match="m must be a finite real number"):
            equations.with_values(m=wrong)


def test_only_fractions_equal_to_the_double_are_printed() -> None:
    system = eomc.System.make("a", ["x"], f"{8 / 3!r}*x_dot**2/2", "0.3333333333333*x")
    text = str(derive(system))
    assert "2.6666" not in text and "[8/3]" in text
    assert "0.3333333333333" in text  # which is not a third


@pytest.mark.parametrize(
    ("form", "fraction"),
    [("text", "[8/3]"), ("latex", r"\frac{8}{3}"), ("python", "Rational(8, 3)")],
)
def test_all_forms_print_a_float_as_the_same_fraction(form: str, fraction: str) -> None:
    text = write_equations(eomc.System.make("a", ["x"], f"{8 / 3!r}*x_dot**2/2", "0"), form)
    assert fraction in text and "2.666" not in text


def test_floats_are_printed_as_the_fractions_that_round_to_them() -> None:
    x, v, m = symbols("x x_dot m")
    system = eomc.System.make(
        "a", [x], 8 / 3 * m * v**2 / 2, 0.3333333333333 * m * x + 0.7 * x**2, parameters={m: 1}
    )
    equations = eomc.equations(system)
    text = str(equations)
    assert "2.6666" not in text and "0.3333333333333" in text and "1.4⋅x" in text
    assert r"\frac{8 m \ddot{x}}{3}" in equations._repr_latex_()
    assert equations.D.atoms(sympy.Float)  # the expressions themselves are as they were
    assert equations.with_values(m=8 / 3).D[0] == pytest.approx(64 / 9, rel=1e-15)
    plain = eomc.System.make("b", ["x"], "m*x_dot**2/2", "0", parameters={"m": 1})
    assert eomc.equations(plain).with_values(m=8 / 3).D[0] == sympy.Rational(8, 3)
    assert eomc.equations(plain).with_values(m=0.3).D[0] == sympy.Rational(3, 10)


def test_each_equation_is_printed_and_typeset_by_itself() -> None:
    equations = eomc.equations(SCENES / "spring_pendulum.toml")
    first, second, kinetic, *_ = equations.equations
    assert (first.left - first.right).equals(equations.scalar[0].lhs)
    assert first.title == second.title == "equations of motion"
    latex = r"m \ddot{r} - m r \dot{\theta}^{2} + k \left(r - l_{0}\right) - m g \cos {\theta} = 0"
    assert first._repr_latex_() == "\\begin{align*}\n  & " + latex + "\n\\end{align*}"
    assert (kinetic.left, kinetic.right) == (sympy.Symbol("K"), equations.kinetic)
    assert str(kinetic).strip() in re.sub("^    ", "", str(equations), flags=re.MULTILINE)
    assert repr(kinetic).startswith("<Equation K = ") and len(repr(kinetic)) < 80
    (mass_matrix,) = (e for e in equations.equations if e.title == "mass matrix")
    assert repr(mass_matrix) == "<Equation D = a matrix (2, 2)>"
    assert equations.D._repr_latex_() == mass_matrix._repr_latex_()
    assert r"D &= \left[\begin{matrix}m & 0\\0 & m r^{2}" in equations.D._repr_latex_()
    assert (2 * equations.D)._repr_latex_().startswith("$")  # by SymPy, since it is no part
    assert pickle.loads(pickle.dumps(equations.D)) == equations.D


def test_rows_of_a_system_in_functions_of_time_are_typeset() -> None:
    from sympy.physics.mechanics import dynamicsymbols

    theta, m = dynamicsymbols("theta"), sympy.Symbol("m", positive=True)
    system = eomc.System.make(
        "a", [theta], m * theta.diff() ** 2 / 2, m * theta**2, parameters={m: 1}
    )
    (row, *_) = eomc.equations(system).equations
    assert row.left.has(theta.diff(dynamicsymbols._t, 2))
    assert r"m \ddot{\theta} + 2 m \theta = 0" in row._repr_latex_()
