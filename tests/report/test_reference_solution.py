"""Compare the reference solution with 30-digit results, exact motions and its own bounds."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import mpmath
import numpy as np
import pytest
import sympy
from support.builds import file_states
from support.cases import case_system, cases
from support.session import ROOT, needs

import eomc
from eomc.base.errors import EomcError
from eomc.emit.common import c_expression
from eomc.model.mechanics import nonsmooth_functions
from eomc.model.system import System
from eomc.program.program import Program
from eomc.report import reference_solution

REFERENCES = ROOT / "build" / "tests" / "references"


@pytest.fixture(autouse=True)
def gcc() -> None:
    needs("gcc")


def oscillator(duration: float = 2.0) -> System:
    """Return the oscillator with x = cos(3 t)."""
    x, k = sympy.symbols("x k")
    v = sympy.Symbol("x_dot")
    return System.make("oscillator", {x: 1.0}, v**2 / 2, k * x**2 / 2, parameters={k: 9.0},
                       duration=duration)  # fmt: skip


def correct_digits(name: str, solution: reference_solution.ReferenceSolution) -> float:
    """Return the digits in common with the case, relative to the largest value of the run."""
    case = cases()[name]
    exact = [*case["q_ref"], *case["qd_ref"]]
    result = [*solution.q[-1], *solution.qd[-1]]
    errors = [
        abs(float(Fraction(str(a)) - Fraction(b))) / s
        for a, b, s in zip(result, exact, solution.scale, strict=True)
    ]
    return float(-np.log10(max(errors)))


def assert_agrees_with_case(name: str) -> None:
    solution = reference_solution.solve(case_system(name), root=REFERENCES)
    assert solution.digits[-1] >= 25
    # its claimed digits are correct, as far as the case's 30 digits show
    assert correct_digits(name, solution) > min(solution.digits[-1], 29) - 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cartpole_drop_physicalP", "double_pendulum_regular"])
def test_case_has_25_correct_digits(name: str) -> None:
    assert_agrees_with_case(name)


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
def test_further_cases_have_25_correct_digits(name: str) -> None:
    assert_agrees_with_case(name)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("oscillator")


@pytest.fixture(scope="module")
def solution(folder: Path) -> reference_solution.ReferenceSolution:
    """Return the reference solution of the oscillator."""
    return reference_solution.solve(oscillator(), rows=8, root=folder)


def test_oscillator_agrees_with_cosine(solution: reference_solution.ReferenceSolution) -> None:
    with mpmath.workdps(40):
        for k, (q, qd) in enumerate(zip(solution.q[:, 0], solution.qd[:, 0], strict=True)):
            t = mpmath.mpf(2) * k / 8
            assert abs(mpmath.mpf(str(q)) - mpmath.cos(3 * t)) < 1e-31
            assert abs(mpmath.mpf(str(qd)) + 3 * mpmath.sin(3 * t)) < 3e-31
    assert solution.digits[-1] > 30
    assert solution.plain is not None and min(solution.plain[:2]) > 30 and solution.plain[2] > 0
    np.testing.assert_array_equal(solution.t, np.arange(9) / 4)


def test_differences_are_accurate_below_double_precision(
    solution: reference_solution.ReferenceSolution,
) -> None:
    nearest = solution.q.astype(float)
    errors = solution.error_of(nearest, solution.qd.astype(float))[:, 0]
    expected = [float(Fraction(float(x)) - Fraction(str(s))) for x, s in zip(
        nearest[:, 0], solution.q[:, 0], strict=True)]  # fmt: skip
    np.testing.assert_allclose(errors, expected, rtol=1e-9, atol=1e-33)
    assert np.max(np.abs(errors)) > 1e-18  # below the precision of doubles


def test_solution_is_cached_until_initial_values_or_parameters_change(
    solution: reference_solution.ReferenceSolution, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = oscillator()
    (files,) = folder.iterdir()
    before = file_states(files)
    again = reference_solution.solve(system, rows=8, root=folder)
    assert file_states(files) == before
    np.testing.assert_array_equal(solution.q, again.q)
    np.testing.assert_array_equal(solution.digits, again.digits)
    other = reference_solution.solve(system.with_parameters({"k": 4.0}), rows=8, root=folder)
    assert float(other.q[-1, 0]) == pytest.approx(np.cos(4.0), abs=1e-14)


def test_wrong_accelerations_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The executable computes with another stiffness than the plain equations."""
    right = reference_solution.rename_for_c

    def wrong(program: Program) -> tuple[Program, Mapping[str, str]]:
        renamed, names = right(program)
        function = renamed.functions["acceleration"]
        outputs = tuple(
            replace(o, coefficient=o.coefficient * (1 + sympy.Rational(1, 10**10)))
            for o in function.outputs
        )
        changed = replace(function, outputs=outputs)
        return replace(renamed, functions={**renamed.functions, "acceleration": changed}), names

    monkeypatch.setattr(reference_solution, "rename_for_c", wrong)
    with pytest.raises(EomcError, match="agree to 10 digits only"):
        reference_solution.solve(oscillator(), rows=4, root=tmp_path)


def test_unsupported_systems_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_failure_reports_the_time_reached(tmp_path: Path, status: int, words: str) -> None:
    """Six of ten rows, the first of which is the initial state."""
    rows = "".join("0 0 0 ;\n" for _ in range(6))
    (tmp_path / "quad").write_text(f"#!/bin/sh\nprintf '{rows}'\nexit {status}\n")
    (tmp_path / "quad").chmod(0o700)
    with pytest.raises(EomcError, match=words):
        reference_solution._run(tmp_path / "quad", oscillator(), 2.0, 10, 4, 1e-25)


@pytest.mark.slow
def test_discontinuity_reduces_the_claimed_digits(tmp_path: Path) -> None:
    """sign(x_dot) is not smooth where the block reverses; 25 digits must not be claimed."""
    x, v = sympy.symbols("x x_dot")
    rubbed = System.make("rubbed", {x: (1.0, 0.0)}, v**2 / 2, 9 * x**2 / 2,
                         forces={x: -sympy.sign(v) / 2}, duration=2.0)  # fmt: skip
    solution = reference_solution.solve(rubbed, rows=8, root=tmp_path)
    assert nonsmooth_functions(rubbed) == "sign"
    assert solution.digits[-1] < 20
    # half a swing about x = 1/18 until pi/3, then about -1/18
    turning_point = -1 + 2 / 18
    exact = -1 / 18 + (turning_point + 1 / 18) * np.cos(3 * (2 - np.pi / 3))
    assert abs(float(solution.q[-1, 0]) - exact) < 10.0 ** -min(solution.digits[-1], 14.0)


def test_motion_that_sticks_at_a_discontinuity_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EomcError, match=r"a force that jumps \(sign\) holds the motion there"):
        reference_solution.solve(case_system("coulomb_friction"), rows=4, root=tmp_path)


@pytest.mark.slow
def test_names_of_parameters_and_irrational_numbers_are_supported(tmp_path: Path) -> None:
    x, x_dot, e, mpf, size = sympy.symbols("x x_dot e mpf size")
    system = System.make(
        "named", {x: 0.1}, e * x_dot**2 / 2, sympy.E * x**2 / 2 + mpf * sympy.cos(sympy.pi * x),
        parameters={e: 2, mpf: 0.7}, inputs={size: sympy.exp(1) * e}, forces={x: size},
    )  # fmt: skip
    solution = reference_solution.solve(system, 0.5, 16, tmp_path)
    assert solution.plain is not None and min(solution.plain[:2]) > 30


def test_quad_literals_have_more_digits_than_a_double() -> None:
    assert c_expression.number(sympy.Rational(1, 10), c_expression.QUAD) == "(1.0q/10.0q)"
    assert c_expression.number(sympy.Integer(3), c_expression.QUAD) == "3.0q"
    assert c_expression.number(sympy.pi, c_expression.QUAD).startswith(
        "3.14159265358979323846264338327950288"
    )
    copy = replace(c_expression.QUAD)  # as in portable functions
    assert c_expression.number(sympy.pi, copy) == c_expression.number(sympy.pi, c_expression.QUAD)
    text = c_expression.number(sympy.Float(0.1), c_expression.QUAD)  # the double itself
    assert abs(Fraction(text[:-1]) - Fraction(0.1)) < Fraction(1, 10**38)


def test_gauss_coefficients_integrate_polynomials_exactly() -> None:
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


def test_scene_file_is_accepted(tmp_path: Path) -> None:
    scene = ROOT / "scenes" / "mass_spring.toml"
    solution = reference_solution.solve(scene, duration=1.0, rows=2, root=tmp_path)
    system = replace(eomc.read(scene))
    assert solution.q.shape == (3, len(system.coordinates))
    assert (tmp_path / "mass_spring" / "reference_1.0_2.json").exists()
