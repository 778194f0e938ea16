"""The reference solution compared with results of 30 digits, exact motions and its own promises."""

from __future__ import annotations

import shutil
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import mpmath
import numpy as np
import pytest
import sympy
from cases import case_system, cases
from conftest import ROOT, needs

import eomc
from eomc.base.errors import EomcError
from eomc.emit import c_expression
from eomc.model.nonsmooth import nonsmooth_functions
from eomc.model.system import System
from eomc.report import reference_solution

REFERENCES = ROOT / "build" / "tests" / "references"


@pytest.fixture(autouse=True)
def gcc() -> None:
    needs("gcc")


def oscillator(duration: float = 2.0) -> System:
    """x = cos(3 t), of one coordinate."""
    x, k = sympy.symbols("x k")
    v = sympy.Symbol("x_dot")
    return System.make("oscillator", {x: 1.0}, v**2 / 2, k * x**2 / 2, parameters={k: 9.0},
                       duration=duration)  # fmt: skip


def digits_right(name: str, made: reference_solution.ReferenceSolution) -> float:
    """Digits in common with the case's result, relative to the largest value on the way."""
    case = cases()[name]
    exact = [*case["q_ref"], *case["qd_ref"]]
    found = [*made.q[-1], *made.qd[-1]]
    off = [
        abs(float(Fraction(str(a)) - Fraction(b))) / s
        for a, b, s in zip(found, exact, made.scale, strict=True)
    ]
    return float(-np.log10(max(off)))


def agrees(name: str) -> None:
    made = reference_solution.solve(case_system(name), root=REFERENCES)
    assert made.digits[-1] >= 25
    # what it promises is right, as far as the case's 30 digits tell
    assert digits_right(name, made) > min(made.digits[-1], 29) - 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cartpole_drop_physicalP", "double_pendulum_regular"])
def test_a_case_has_25_digits(name: str) -> None:
    agrees(name)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "cartpole_torque_physicalP",
        "pendulum_large_swing",
        "kepler_e0.9_cartesian",
        "lagrange_top_nutation",
        "spring_pendulum_resonant",
        "henon_heiles",
        "kapitza_pendulum",
    ],
)
def test_more_cases_have_25_digits(name: str) -> None:
    agrees(name)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("oscillator")


@pytest.fixture(scope="module")
def made(folder: Path) -> reference_solution.ReferenceSolution:
    """That of the oscillator."""
    return reference_solution.solve(oscillator(), rows=8, root=folder)


def test_an_oscillator_is_cos_all_along(made: reference_solution.ReferenceSolution) -> None:
    with mpmath.workdps(40):
        for k, (q, qd) in enumerate(zip(made.q[:, 0], made.qd[:, 0], strict=True)):
            t = mpmath.mpf(2) * k / 8
            assert abs(mpmath.mpf(str(q)) - mpmath.cos(3 * t)) < 1e-31
            assert abs(mpmath.mpf(str(qd)) + 3 * mpmath.sin(3 * t)) < 3e-31
    assert made.digits[-1] > 30
    assert made.plain is not None and min(made.plain[:2]) > 30 and made.plain[2] > 0
    np.testing.assert_array_equal(made.t, np.arange(9) / 4)


def test_differences_are_right_below_double_precision(
    made: reference_solution.ReferenceSolution,
) -> None:
    nearest = made.q.astype(float)
    off = made.error_of(nearest, made.qd.astype(float))[:, 0]
    expected = [float(Fraction(float(x)) - Fraction(str(s))) for x, s in zip(
        nearest[:, 0], made.q[:, 0], strict=True)]  # fmt: skip
    np.testing.assert_allclose(off, expected, rtol=1e-9, atol=1e-33)
    assert np.max(np.abs(off)) > 1e-18  # doubles can't say it


def test_it_is_kept_until_start_or_parameters_change(
    made: reference_solution.ReferenceSolution, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = oscillator()
    with monkeypatch.context() as patch:
        patch.setattr(reference_solution, "_compute", lambda *a: pytest.fail("computed again"))
        again = reference_solution.solve(system, rows=8, root=folder)
    np.testing.assert_array_equal(made.q, again.q)
    np.testing.assert_array_equal(made.digits, again.digits)
    other = reference_solution.solve(system.with_parameters({"k": 4.0}), rows=8, root=folder)
    assert float(other.q[-1, 0]) == pytest.approx(np.cos(4.0), abs=1e-14)


def test_accelerations_that_are_not_the_plain_ones_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = reference_solution._compile
    monkeypatch.setattr(
        reference_solution, "_compile", lambda s, f: wrong(s.with_parameters({"k": 9.0}), f)
    )
    right = reference_solution._run
    monkeypatch.setattr(
        reference_solution,
        "_run",
        lambda e, s, *how: right(e, s.with_parameters({"k": 9.000000001}), *how),
    )
    with pytest.raises(EomcError, match="agree to 10 digits only"):
        reference_solution.solve(oscillator(), rows=4, root=tmp_path)


def test_what_it_can_not_do_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(EomcError, match="power of two"):
        reference_solution.solve(oscillator(), rows=100, root=tmp_path)
    with pytest.raises(EomcError, match="number of seconds"):
        reference_solution.solve(oscillator(), duration=-1.0, root=tmp_path)
    with monkeypatch.context() as patch, pytest.raises(EomcError, match="shorter duration"):
        patch.setattr(reference_solution, "MAX_SECONDS", 0.05)
        reference_solution.solve(oscillator(1e6), root=tmp_path)
    monkeypatch.setattr(shutil, "which", lambda name: None if name == "gcc" else f"/bin/{name}")
    monkeypatch.setattr(reference_solution.builds, "key", lambda *a: "another")
    with pytest.raises(EomcError, match="libquadmath"):
        reference_solution.solve(oscillator(), rows=4, root=tmp_path)


@pytest.mark.parametrize(("status", "words"), [(3, "got to t = 1 s of 2 s"), (1, "t = 1 s: D is")])
def test_how_far_it_came_is_said(tmp_path: Path, status: int, words: str) -> None:
    """Six rows of ten, the first of which is the start."""
    rows = "".join("0 0 0 ;\n" for _ in range(6))
    (tmp_path / "quad").write_text(f"#!/bin/sh\nprintf '{rows}'\nexit {status}\n")
    (tmp_path / "quad").chmod(0o700)
    with pytest.raises(EomcError, match=words):
        reference_solution._run(tmp_path / "quad", oscillator(), 2.0, 10, 4, 1e-25)


@pytest.mark.slow
def test_a_jump_costs_digits(tmp_path: Path) -> None:
    """sign(x_dot) is not smooth where the block turns: both ways must not claim 25 digits."""
    x, v = sympy.symbols("x x_dot")
    rubbed = System.make("rubbed", {x: (1.0, 0.0)}, v**2 / 2, 9 * x**2 / 2,
                         forces={x: -sympy.sign(v) / 2}, duration=2.0)  # fmt: skip
    made = reference_solution.solve(rubbed, rows=8, root=tmp_path)
    assert nonsmooth_functions(rubbed) == "sign"
    assert made.digits[-1] < 20
    # half a swing about x = 1/18 until pi/3, then about -1/18
    turned = -1 + 2 / 18
    exact = -1 / 18 + (turned + 1 / 18) * np.cos(3 * (2 - np.pi / 3))
    assert abs(float(made.q[-1, 0]) - exact) < 10.0 ** -min(made.digits[-1], 14.0)


def test_a_motion_that_sticks_at_a_jump_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EomcError, match=r"a force that jumps \(sign\) holds the motion there"):
        reference_solution.solve(case_system("coulomb_friction"), rows=4, root=tmp_path)


@pytest.mark.slow
def test_names_of_parameters_and_irrational_numbers_do_not_matter(tmp_path: Path) -> None:
    x, x_dot, e, mpf, size = sympy.symbols("x x_dot e mpf size")
    system = System.make(
        "named", {x: 0.1}, e * x_dot**2 / 2, sympy.E * x**2 / 2 + mpf * sympy.cos(sympy.pi * x),
        parameters={e: 2, mpf: 0.7}, inputs={size: sympy.exp(1) * e}, forces={x: size},
    )  # fmt: skip
    made = reference_solution.solve(system, 0.5, 16, tmp_path)
    assert made.plain is not None and min(made.plain[:2]) > 30


def test_quad_literals_hold_more_digits_than_a_double() -> None:
    assert c_expression.number(sympy.Rational(1, 10), c_expression.QUAD) == "(1.0q/10.0q)"
    assert c_expression.number(sympy.Integer(3), c_expression.QUAD) == "3.0q"
    assert c_expression.number(sympy.pi, c_expression.QUAD).startswith(
        "3.14159265358979323846264338327950288"
    )
    copy = replace(c_expression.QUAD)  # as plain functions have it
    assert c_expression.number(sympy.pi, copy) == c_expression.number(sympy.pi, c_expression.QUAD)
    text = c_expression.number(sympy.Float(0.1), c_expression.QUAD)  # the double that it is
    assert abs(Fraction(text[:-1]) - Fraction(0.1)) < Fraction(1, 10**38)


def test_gauss_coefficients_integrate_polynomials() -> None:
    """sum b c^k = 1/(k + 1) to order 2 s, sum_j a_ij c_j^k = c_i^(k+1)/(k + 1) to s."""
    with mpmath.workdps(50):
        s = 16
        x = [mpmath.mpf(text) for text in reference_solution.gauss_coefficients(s).split()]
        c, A = x[1 : 1 + s], x[1 + s : 1 + s + s * s]
        b = x[1 + s + 2 * s * s : 1 + 2 * s + 2 * s * s]
        for k in range(2 * s):
            assert abs(mpmath.fdot(b, [z**k for z in c]) - mpmath.mpf(1) / (k + 1)) < 1e-38
        for k in range(s):
            for i in range(s):
                row = A[i * s : (i + 1) * s]
                assert abs(mpmath.fdot(row, [z**k for z in c]) - c[i] ** (k + 1) / (k + 1)) < 1e-38


def test_the_scene_file_itself_will_do(tmp_path: Path) -> None:
    scene = ROOT / "scenes" / "mass_spring.toml"
    made = reference_solution.solve(scene, duration=1.0, rows=2, root=tmp_path)
    system = replace(eomc.read(scene))
    assert made.q.shape == (3, len(system.coordinates))
    assert (tmp_path / "mass_spring" / "reference_1.0_2.json").exists()
