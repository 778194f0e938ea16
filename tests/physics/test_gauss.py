"""Implicit methods: order, stability, energy, evaluations, and how failures are reported."""

from __future__ import annotations

import re
import subprocess
import warnings
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy
from support.cases import cases, fast_kit, scene_file, scene_text, variant
from support.session import MODULES, Modules, tiers

import eomc
from eomc.integrators import tableaux
from eomc.integrators.tableaux import METHODS
from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.verify.check import check

pytestmark = pytest.mark.usefixtures("quickly_compiled")

GAUSS = ("gauss4", "gauss6", "gauss8")
ALL = '["gauss8", "gauss4", "gauss6", "rk4"]'

OSCILLATOR = """
eomc = 1
name = "{name}"
[coordinates]
x = {{ start = {start}, rate = {rate} }}
[parameters]
k = {k}
c = {c}
[energy]
kinetic = "x_dot**2/2"
potential = "k*x**2/2"
dissipation = "c*x_dot**2/2"
[run]
method = ["gauss8", "gauss4", "gauss6", "rk4"]
"""


def oscillator(name: str, k: float, c: float, start: float = 1.0, rate: float = 0.0) -> Path:
    text = OSCILLATOR.format(name=name, k=float(k), c=float(c), start=start, rate=rate)
    return scene_file(name, text)


def count_evaluations(
    path: Path, method: str, h: float, steps: int
) -> tuple[int, list[float], int]:
    """Run the generated C; return (accelerations evaluated, final q and qd, status)."""
    system = eomc.read(path)
    name, n = system.name, len(system.coordinates)
    files = fast_kit(eomc.sources(system))
    source = re.sub(
        rf"([A-Z_]+INLINE int {name}_accelerations\([^)]*\)\n{{)",
        r"long evaluations;\n\1\n    evaluations++;", files[f"{name}.c"], count=1,
    )  # fmt: skip
    assert "evaluations++" in source
    several = len(system.run.methods) > 1
    choice = f"    options.method = {name.upper()}_METHOD_{method.upper()};" if several else ""
    folder = Path("build/tests") / f"counted_{name}"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.h").write_text(files[f"{name}.h"], encoding="utf-8")
    (folder / f"{name}.c").write_text(source, encoding="utf-8")
    (folder / "main.c").write_text(
        f"""#include "{name}.h"
#include <stdio.h>
extern long evaluations;
int main(void)
{{
    double q[{n}], qd[{n}];
    {name}_options options = {{ .h = {h!r}, .steps = {steps} }};
    {name}_output output = {{ 0 }};
    {name}_status status;
    for (int i = 0; i < {n}; i++)
        q[i] = {name}_q0[i], qd[i] = {name}_qd0[i];
{choice}
    status = {name}_integrate(q, qd, &{name}_defaults, &options, &output);
    printf("%ld %d", evaluations, (int)status);
    for (int i = 0; i < {n}; i++)
        printf(" %.17g %.17g", q[i], qd[i]);
    return 0;
}}
""",
        encoding="utf-8",
    )
    program = folder / "program"
    subprocess.run(
        ["cc", "-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-Wconversion", "-o",
         str(program), str(folder / "main.c"), str(folder / f"{name}.c"), "-lm"], check=True,
    )  # fmt: skip
    numbers = subprocess.run([program.resolve()], capture_output=True, text=True, check=True)
    count, status, *state = numbers.stdout.split()
    return int(count), list(map(float, state)), int(status)


@pytest.mark.parametrize("name", GAUSS)
def test_coefficients_satisfy_the_order_conditions(name: str) -> None:
    """Check conditions of quadrature, C(s) and symmetry; compare the nodes with SymPy's."""
    m, exact = METHODS[name], Fraction(1, 10**40)
    x, s = sympy.Symbol("x"), m.stages
    roots = sorted(r.evalf(40) for r in sympy.Poly(sympy.legendre(s, 2 * x - 1)).nroots(n=45))
    assert max(abs(sympy.Rational(c) - r) for c, r in zip(m.c, roots, strict=True)) < 1e-38
    for k in range(2 * s):
        area = sum((b * c**k for b, c in zip(m.b, m.c, strict=True)), Fraction(0))
        assert abs(area - Fraction(1, k + 1)) < exact
    for c, row in zip(m.c, m.a, strict=True):
        for k in range(s):
            inner = sum((a * node**k for a, node in zip(row, m.c, strict=True)), Fraction(0))
            assert abs(inner - c ** (k + 1) / (k + 1)) < exact
    # symplectic: b_i a_ij + b_j a_ji = b_i b_j
    for i in range(s):
        for j in range(s):
            off = m.b[i] * m.a[i][j] + m.b[j] * m.a[j][i] - m.b[i] * m.b[j]
            assert abs(off) < exact
    for row, c in zip(
        m.extrapolation, m.c, strict=True
    ):  # a polynomial of degree s - 1 is extrapolated exactly
        extrapolated = sum(
            (e * node ** (s - 1) for e, node in zip(row, m.c, strict=True)), Fraction(0)
        )
        assert abs(extrapolated - (1 + c) ** (s - 1)) < exact


@pytest.mark.slow
def test_orders_by_check() -> None:
    for scene in ("cartpole_driven", "kapitza_pendulum"):  # inputs, explicit time
        path = variant(scene, f"gauss_{scene}", method=ALL)
        report = check(eomc.read(path), eomc.load(path, MODULES))
        assert [row for row in report.results if not row.passed] == []
        assert {f"order of {m}" for m in GAUSS} <= {row.name for row in report.results}


@pytest.mark.slow
def test_check_detects_a_wrong_coefficient(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import dataclasses

    m = METHODS["gauss6"]
    row = (m.a[1][0], m.a[1][1] + Fraction(1, 1000), m.a[1][2])
    broken = dataclasses.replace(m, a=(m.a[0], row, m.a[2]))
    monkeypatch.setitem(tableaux.METHODS, "gauss6", broken)
    path = variant("cartpole", "gauss_wrong", method='["rk4", "gauss6"]')
    report = check(eomc.read(path), eomc.load(path, tmp_path))
    assert {r.name for r in report.results if not r.passed} >= {"order of gauss6"}


@pytest.mark.parametrize("name", GAUSS)
def test_fast_decay_is_stable(name: str) -> None:
    """h lambda = -1e4: RK4 overflows, |R| < 1 here."""
    m = eomc.load(oscillator("gauss_decay", k=1.0, c=1e4, rate=1.0), MODULES)
    run = m.simulate(h=1.0, steps=200, method=name)
    assert run.status == "ok"
    assert np.max(np.abs(run.q)) < 1.1 and np.max(np.abs(run.qd)) < 1.1
    with pytest.warns(RuntimeWarning):
        assert m.simulate(h=1.0, steps=200, method="rk4").status != "ok"


def test_stiff_decay_needs_few_evaluations() -> None:
    """k = 1e6, c = 2e5, slow motion exp(-5 t): 9 digits at 10 s; RK4 needs 3,000,000
    evaluations.
    """
    k, c, steps = 1e6, 2e5, 60
    slow = -2 * k / (c + np.sqrt(c * c - 4 * k))
    path = oscillator("gauss_stiff", k, c, start=1.0, rate=slow)
    evaluations, (q, qd), status = count_evaluations(path, "gauss8", 2.0 / steps, steps)
    exact = np.exp(slow * 2.0)
    assert status == 0
    assert abs(q / exact - 1) < 1e-9 and abs(qd / (slow * exact) - 1) < 1e-9
    assert evaluations < 800


@pytest.mark.slow
def test_stiff_spring_pendulum_needs_few_evaluations() -> None:
    """k = 1e6 with damping over 10 s, against a 30-digit reference: 1e-9 with under 4,000
    evaluations.

    For stability RK4 needs 140,000 evaluations.
    """
    name = "spring_pendulum_stiff_damped"
    case = cases()[name]
    text = scene_text(name).replace("[run]", f"[run]\nmethod = {ALL}")
    path = Path("build/tests") / f"gauss_{name}.toml"
    path.write_text(text.replace('name = "', 'name = "gauss_', 1), encoding="utf-8")
    steps = 120
    evaluations, state, status = count_evaluations(
        path, "gauss8", float(case["t_end"]) / steps, steps
    )
    assert status == 0
    error = np.max(np.abs(np.array(state[::2]) - np.array(case["q_ref"], float)))
    assert error < 1e-9 * max(1.0, np.max(np.abs(np.array(case["q_ref"], float))))
    assert evaluations < 4000


def test_energy_of_a_pendulum_does_not_drift() -> None:
    """8,000 s with a coarse step: the error in the second half is as large as in the first."""
    m = eomc.load(variant("simple_pendulum", "gauss_pendulum", method=ALL), MODULES)
    run = m.simulate(h=0.2, duration=8000.0, method="gauss4")
    error = run.energy - run.energy[0]
    half = len(error) // 2
    assert run.status == "ok" and np.max(np.abs(error)) > 1e-8
    assert np.max(np.abs(error[half:])) < 1.05 * np.max(np.abs(error[:half]))
    assert abs(np.mean(error[half:]) - np.mean(error[:half])) < 0.01 * np.max(np.abs(error))


def test_no_convergence_is_reported_with_the_last_good_state() -> None:
    """The potential varies too fast for the step, so that the iteration does not converge."""
    text = (
        'eomc = 1\nname = "gauss_dive"\n[coordinates]\nx = { start = 1.0 }\n[parameters]\nm = 1.0\n'
        '[energy]\nkinetic = "m*x_dot**2/2"\npotential = "-m*1e6*cos(50*x)"\n'
        '[run]\nmethod = ["gauss4", "gauss8"]\n'
    )
    path = Path("build/tests/gauss_dive.toml")
    path.write_text(text, encoding="utf-8")
    evaluations, (q, qd), status = count_evaluations(path, "gauss8", 1.0, 20)
    assert status == 3
    assert np.isfinite([q, qd]).all() and evaluations < 20 * 4 * 200


@pytest.mark.parametrize(
    ("form", "method", "h"), tiers([("fast", "gauss8", 20.0), ("plain", "gauss6", 40.0)], "fast")
)
def test_newton_iteration_restarts_if_midpoint_derivatives_mislead_it(
    form: str, method: str, h: float
) -> None:
    """A quartic well with long steps: Newton's method converges with derivatives of each stage."""
    text = (
        'eomc = 1\nname = "quartic"\n[coordinates]\nx = { rate = 3e-5 }\n'
        '[energy]\nkinetic = "x_dot**2/2"\npotential = "0.05*x**2 + 2e3*x**4"\n'
        '[run]\nmethod = ["gauss8", "gauss6"]\n'
    )
    system = from_scene(parse(text, "quartic.toml"))
    with warnings.catch_warnings(action="ignore"):  # about an h that does not resolve the motion
        run = eomc.load(system, MODULES, form=form).simulate(h=h, steps=20, method=method)
    assert (run.status, run.steps) == ("ok", 20)
    assert np.ptp(run.energy) < 1e-2 * run.energy[0]


def test_run_in_pieces_equals_the_whole_run(modules: Modules) -> None:
    """Require equal bits, also if C is called for one step at a time."""
    text = Path("scenes/cartpole_driven.toml").read_text(encoding="utf-8")
    m = modules.unoptimised(text.replace("[run]\n", f"[run]\nmethod = {ALL}\n"))
    with warnings.catch_warnings(action="ignore"):
        for method in GAUSS:
            whole = m.simulate(h=0.02, steps=700, u=0.5, method=method)
            cut = m.simulate(h=0.02, steps=700, u=lambda t, q, qd: 0.5, method=method)
            assert np.array_equal(whole.q, cut.q) and np.array_equal(whole.qd, cut.qd)


@pytest.mark.slow
def test_single_precision() -> None:
    m = eomc.load(variant("cartpole", "gauss_float", method=ALL, real='"float"'), MODULES)
    exact = eomc.load(variant("cartpole", "gauss_double", method=ALL), MODULES).simulate(h=0.01)
    for name in GAUSS:
        run = m.simulate(h=0.01, method=name)
        assert run.status == "ok" and run.q.dtype == np.float32
        assert np.max(np.abs(run.q[-1] - exact.q[-1])) < 1e-3


@pytest.mark.slow
def test_stiff_scene_agrees_with_scipy() -> None:
    from scipy.integrate import solve_ivp

    m: Any = eomc.load(oscillator("gauss_scipy", k=1e4, c=300.0, rate=2.0), MODULES)
    q0, qd0 = m.start
    other = solve_ivp(m.rhs, (0, 1), [*q0, *qd0], method="Radau", rtol=1e-11, atol=1e-13).y[:, -1]
    run = m.simulate(h=1 / 400, duration=1.0)
    assert np.max(np.abs(np.array([*run.q[-1], *run.qd[-1]]) - other)) < 1e-9


def test_batches_are_refused_with_a_reason() -> None:
    path = variant("cartpole", "gauss_batch", method=ALL, batch="true")
    with pytest.raises(eomc.SceneError, match="is for one trajectory: leave out batch"):
        eomc.sources(eomc.read(path))


def test_orders_and_energy_of_verlet_and_euler() -> None:
    m = eomc.load(variant("mass_spring", "verlet_ms", method='["verlet", "euler"]'), MODULES)
    omega = 1.0
    runs = {name: m.simulate(h=0.05, duration=500.0, method=name) for name in m.methods}
    for run, bound in zip(runs.values(), (0.05**2, 0.05), strict=True):
        error = np.abs(run.energy / run.energy[0] - 1)
        assert 0.02 * bound < np.max(error) < 2 * omega * bound  # bounded: symplectic
    with pytest.raises(eomc.SceneError, match=r"inertial forces here depend on theta_dot"):
        eomc.sources(eomc.read(variant("cartpole", "verlet_no", method='"verlet"')))


@pytest.mark.slow
def test_feedback_in_a_signal_costs_as_much_as_in_a_force() -> None:
    """u = -1e6 x - 2e5 x_dot: the derivatives of Newton's corrections include those of the signals.

    The slow motion is exp(-5 t), with h lambda = -2,000 of the fast mode; without du/dx no stage
    converges.
    """
    text = """
eomc = 1
name = "gauss_signal"
[coordinates]
x = { start = 1.0, rate = -5.000125006250391 }
y = { start = 0.3 }
[parameters]
k = 1e6
c = 2e5
[inputs]
u = { signal = "-k*x - c*x_dot" }
[energy]
kinetic = "x_dot**2/2 + y_dot**2/2 + x_dot*y_dot*cos(y)/400"
potential = "(y - x)**2/2"
[forces]
x = "u"
[run]
method = ["gauss8", "gauss4"]
"""
    signal, force = Path("build/tests/gauss_signal.toml"), Path("build/tests/gauss_force.toml")
    signal.write_text(text, encoding="utf-8")
    section = '[inputs]\nu = { signal = "-k*x - c*x_dot" }\n'
    assert section in text
    text = text.replace(section, "").replace('x = "u"', 'x = "-k*x - c*x_dot"')
    force.write_text(text.replace("gauss_signal", "gauss_force"), encoding="utf-8")
    one, other = (
        eomc.load(path, MODULES).simulate(h=0.01, steps=200, method="gauss8")
        for path in (signal, force)
    )
    assert one.status == other.status == "ok"
    np.testing.assert_allclose(one.x[-1], other.x[-1], rtol=1e-9, atol=1e-12)
    assert one.evaluations < 1.1 * other.evaluations < 3000
