"""gauss16, which needs few iterations: order, stability, cost, and how failures are reported."""

from __future__ import annotations

import dataclasses
import warnings
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.cases import cases, scene_file, scene_text, variant
from support.session import MODULES, tiers

import eomc
from eomc.integrators import tableaux
from eomc.integrators.tableaux import GAUSS16
from eomc.verify import convergence
from eomc.verify.check import check
from eomc.verify.comparison import Comparison

pytestmark = pytest.mark.usefixtures("quickly_compiled")

A_STEP = GAUSS16.sweeps * GAUSS16.stages  # accelerations of a step after a smooth one

SPRING = """
eomc = 1
name = "{name}"
[coordinates]
x = {{ start = 1.0 }}
[parameters]
k = 1.0
c = 0.0
[energy]
kinetic = "x_dot**2/2"
potential = "k*x**2/2"
dissipation = "c*x_dot**2/2"
[run]
method = ["gauss16"]
"""


ENDS = (
    SPRING.replace('"x_dot**2/2"', '"(1 + n*(x - 1.5))*x_dot**2/2"')
    .replace('"k*x**2/2"', '"k*x**2/2 - e*x**4/4"')
    .replace("c = 0.0", "c = 0.0\nn = 0.0\ne = 0.0")
)


def scene(name: str, text: str) -> ModuleType:
    return eomc.load(scene_file(name, text), MODULES)


def load_with_dp8(name: str, **run: str) -> ModuleType:
    return eomc.load(variant(name, f"g16_{name}", method='["gauss16", "dp8"]', **run), MODULES)


def driven() -> Path:
    return variant("cartpole_driven", "g16_driven", method='["gauss16", "dp8", "rk4"]')


def simulate_without_warnings(m: ModuleType, *state: Any, **how: Any) -> Any:
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        return m.simulate(*state, **how)


def test_extrapolation_sums_are_exact_for_polynomials() -> None:
    """A E and A A E integrate polynomials of the last step, of degree 7 and 6, over this one."""
    c, exact = GAUSS16.c, Fraction(1, 10**35)
    for j in range(8):
        power = [x**j for x in c]
        for at, once, twice in zip(
            c, GAUSS16.a_extrapolated, GAUSS16.a_squared_extrapolated, strict=True
        ):
            end = 1 + at
            integral = (end ** (j + 1) - 1) / (j + 1)
            again = (end ** (j + 2) - 1) / ((j + 1) * (j + 2)) - at / (j + 1)
            sums = [sum(w * p for w, p in zip(row, power, strict=True)) for row in (once, twice)]
            assert abs(sums[0] - integral) < exact
            assert j == 7 or abs(sums[1] - again) < exact


def test_five_iterations_are_stable_where_they_suffice() -> None:
    """Spectral radius of a step of q'' = -z^2 q, up to z = 3.8, and of q'' = -z qd, up to 1.9.

    Long before these limits the last iteration exceeds the tolerance, and further ones follow.
    """
    A, AA, E = (np.array(x, float) for x in (GAUSS16.a, GAUSS16.a_squared, GAUSS16.extrapolation))
    b, bA, c = (np.array(x, float) for x in (GAUSS16.b, GAUSS16.b_a, GAUSS16.c))

    def radius(of_q: float, of_qd: float) -> float:
        columns = []
        for unit in np.eye(10):
            q, v, a = unit[0], unit[1], E @ unit[2:]
            for _ in range(GAUSS16.sweeps):
                a = of_q * (q + c * v + AA @ a) + of_qd * (v + A @ a)
            columns.append([q + v + bA @ a, v + b @ a, *a])
        return float(np.max(np.abs(np.linalg.eigvals(np.transpose(columns)))))

    assert radius(-(3.8**2), 0) < 1 + 1e-3 < radius(-(4.0**2), 0)
    assert radius(0, -1.9) < 1 + 1e-6 < radius(0, -2.0)


def test_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """With an input and its signal."""
    monkeypatch.setattr(convergence, "advice_checks", lambda *_: ())
    path = driven()
    comparison = Comparison(eomc.read(path), eomc.load(path, MODULES), np.random.default_rng(0), 4)
    results = comparison.report(convergence.checks)
    assert [row for row in results if not row.passed] == []
    assert {"order of gauss16", "order of rk4"} <= {row.name for row in results}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cartpole_driven", "kapitza_pendulum"])
def test_order_by_check(name: str) -> None:
    """Cover inputs, signals and explicit time."""
    path = variant(name, f"g16_check_{name}", method='["rk4", "gauss16"]')
    report = check(eomc.read(path), eomc.load(path, MODULES))
    assert [row for row in report.results if not row.passed] == []
    assert {"order of gauss16", "run by gauss16"} <= {row.name for row in report.results}


@pytest.mark.slow
def test_check_detects_a_wrong_coefficient(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [list(row) for row in GAUSS16.a]
    rows[3][5] += Fraction(1, 1000)
    broken = dataclasses.replace(GAUSS16, a=tuple(map(tuple, rows)))
    monkeypatch.setitem(tableaux.METHODS, "gauss16", broken)
    path = tmp_path / "cartpole.toml"
    text = Path("scenes/cartpole.toml").read_text(encoding="utf-8")
    path.write_text(text.replace("[run]", '[run]\nmethod = ["gauss16"]'), encoding="utf-8")
    report = check(eomc.read(path), eomc.load(path, tmp_path))
    assert "order of gauss16" in {row.name for row in report.results if not row.passed}


# Case: a step size at which the error of the method is below the rounding error.
REACHED = {
    "cartpole_drop_tutorialP": 0.04,
    "cartpole_torque_physicalP": 0.1,
    "double_pendulum_regular": 0.1,
    "henon_heiles": 0.4,
    "furuta_pendulum": 0.01,
    "lagrange_top_nutation": 0.02,
}


@pytest.mark.parametrize(("name", "h"), tiers(REACHED.items(), "cartpole_torque_physicalP"))
def test_error_reaches_the_rounding_floor(name: str, h: float) -> None:
    case = cases()[name]
    text = scene_text(name).replace("[run]", '[run]\nmethod = ["gauss16"]')
    m = scene(f"g16_{name}", text.replace('name = "', 'name = "g16_', 1))
    t_end = float(case["t_end"])
    steps = round(t_end / h)
    reference = np.array(case["q_ref"], float)
    run = m.simulate(h=t_end / steps, steps=steps)
    error = np.max(np.abs(run.q[-1] - reference)) / max(1.0, float(np.max(np.abs(reference))))
    # The rounding floor, plus one rounding error in each step, amplified to the end.
    floor = max(float(case["double_floor"]), case["amplification"] * 2e-16 * np.sqrt(steps))
    assert error < 20 * floor
    assert 0.99 * steps * A_STEP < run.evaluations < 1.1 * steps * A_STEP + 200


def test_order_at_long_steps() -> None:
    """A spring, whose acceleration does not depend on velocities: order 16, from h = 2 to 1."""
    m = scene("g16_spring", SPRING.format(name="g16_spring"))
    error = []
    for steps in (200, 400):
        run = m.simulate(h=400.0 / steps, steps=steps)
        error.append(np.max(np.abs(run.q[:, 0] - np.cos(run.t))))
        assert run.evaluations < 1.2 * steps * A_STEP + 200
    assert error[0] > 1e-9 and np.log2(error[0] / error[1]) > 14


def test_long_steps_are_accurate_or_reported() -> None:
    """Beyond the stability limit of five iterations there are more; if they diverge, a status is
    set.
    """
    m = scene("g16_spring", SPRING.format(name="g16_spring"))
    statuses = {}
    for turn in (0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 10.0, 20.0, 50.0):
        run = simulate_without_warnings(m, h=turn, steps=100)
        statuses[turn] = run.status
        assert np.isfinite(run.x).all()
        assert np.max(np.abs(run.q[:, 0] - np.cos(run.t))) < 0.01
    for decay in (0.5, 1.0, 1.9, 2.5, 4.0, 6.0, 8.0, 15.0, 50.0):
        run = simulate_without_warnings(
            m, [1.0], [-1.0], h=decay, steps=30, params={"k": 0.0, "c": 1.0}
        )
        statuses[-decay] = run.status
        assert np.max(np.abs(run.qd[:, 0] + np.exp(-run.t))) < 1e-6
    undamped, decaying = GAUSS16.limits
    for x, status in statuses.items():
        within = x < undamped if x > 0 else -x < decaying
        assert status == ("ok" if within else "no convergence")


@pytest.mark.parametrize("turn", [2.5, 3.0])
def test_iterations_continue_while_the_last_change_exceeds_a_millionth(turn: float) -> None:
    """Five iterations alone leave as large an error; with more, a hundredth of the change
    remains.
    """
    m = scene("g16_spring", SPRING.format(name="g16_spring"))
    run = m.simulate(h=turn, steps=10)
    assert run.evaluations > 1.2 * run.steps * A_STEP
    assert np.max(np.abs(run.q[:, 0] - np.cos(run.t))) < 2e-8


@pytest.mark.slow
def test_energy_of_a_pendulum_does_not_drift() -> None:
    """1,000 periods in 40,000 steps: less than one rounding of the largest energy per step."""
    m = eomc.load(variant("simple_pendulum", "g16_pendulum", method='"gauss16"'), MODULES)
    run = m.simulate(h=0.05, duration=2000.0, every=10)
    error = np.abs(run.energy - run.energy[0]) / np.ptp(m.potential_energy(run.q))
    assert run.status == "ok" and np.max(error) < 1e-13
    assert run.evaluations < 1.001 * run.steps * A_STEP


def test_run_in_pieces_equals_the_whole_run() -> None:
    """Require equal bits, also if C is called for one step at a time and inputs jump."""
    m = eomc.load(driven(), MODULES)
    rng = np.random.default_rng(3)
    steps = 300
    jumping = np.repeat(rng.uniform(-1, 1, (steps // 20, 1)), 20, axis=0)
    for table in (np.full((steps, 1), 0.5), jumping):
        rows = iter(table)
        whole = m.simulate(h=0.02, steps=steps, u=table)
        cut = simulate_without_warnings(
            m, h=0.02, steps=steps, u=lambda t, q, qd, rows=rows: next(rows)
        )
        assert np.array_equal(whole.x, cut.x) and whole.evaluations == cut.evaluations
    constant = m.simulate(h=0.02, steps=steps, u=0.5)
    assert np.array_equal(constant.x, m.simulate(h=0.02, steps=steps, u=[[0.5]] * steps).x)


def test_zero_order_hold_inputs_cost_no_digits() -> None:
    """With a new value in every step, as accurate as dp8 with steps of a tenth."""
    m = eomc.load(driven(), MODULES)
    u = np.random.default_rng(1).uniform(-3, 3, (100, 1))
    run = m.simulate(h=0.05, u=u, steps=100)
    fine = m.simulate(h=0.005, u=np.repeat(u, 10, axis=0), steps=1000, every=10, method="dp8")
    assert np.max(np.abs(run.x - fine.x)) < 1e-11 * np.max(np.abs(fine.x))
    assert run.evaluations < 1.5 * 100 * A_STEP


def test_signals_are_evaluated_at_the_stages() -> None:
    """The scene's own signal is evaluated at the time of each stage."""
    m = eomc.load(driven(), MODULES)
    run = m.simulate(h=0.1, duration=5.0)
    fine = m.simulate(h=0.005, duration=5.0, every=20, method="dp8")
    assert np.max(np.abs(run.x - fine.x)) < 1e-12


@pytest.mark.slow
def test_explicit_time() -> None:
    m = load_with_dp8("kapitza_pendulum")
    run = m.simulate(h=0.002, duration=0.2)
    fine = m.simulate(h=0.0002, duration=0.2, every=10, method="dp8")
    assert np.max(np.abs(run.x - fine.x) / np.max(np.abs(fine.x), axis=0)) < 1e-11


def test_large_angles_fall_back_to_scalar_sines() -> None:
    """Beyond 2^20 rad each sine comes from libm: the same motion within the precision of the
    angle.
    """
    m = load_with_dp8("cartpole")
    q, qd = m.start
    turns = 400_000
    far = simulate_without_warnings(m, [q[0], q[1] + 2 * np.pi * turns], qd, h=0.02, duration=2.0)
    near = m.simulate(q, qd, h=0.02, duration=2.0)
    assert far.status == "ok" and far.q[0, 1] > 2**20
    off = far.q[:, 1] - 2 * np.pi * turns - near.q[:, 1]
    assert np.max(np.abs(off)) < 1e-7  # a rounding of the angle is 5e-10
    assert far.evaluations < 1.5 * far.steps * A_STEP
    # angles too large to change, and a motion under their sines: vector code would be meaningless
    for wide in np.linspace(2e16, 6e16, 9):
        how = {"h": 0.02, "steps": 50}
        runs = [
            simulate_without_warnings(m, [0.0, wide], [0.3, 0.5], **how, method=name)
            for name in m.methods
        ]
        np.testing.assert_allclose(runs[0].qd, runs[1].qd, rtol=1e-9)


def test_singular_mass_matrix_is_reported() -> None:
    """D vanishes on the way, at x = 0.5: the run ends before, at its last good state."""
    m, how = scene("g16_ends", ENDS.format(name="g16_ends")), {"params": {"n": 1.0}}
    run = simulate_without_warnings(m, [1.0], [-1.0], h=0.05, duration=5.0, **how)
    assert run.status in ("singular", "no convergence") and np.isfinite(run.x).all()
    assert run.q[-1, 0] > 0.4
    assert simulate_without_warnings(m, [0.5], [0.0], h=0.01, steps=3, **how).status == "singular"
    assert simulate_without_warnings(m, [0.4], [0.0], h=0.01, steps=3, **how).status == "singular"


def test_blow_up_is_reported() -> None:
    """x'' = x^3 from x = x' = 1 becomes infinite before t = 2."""
    m = scene("g16_ends", ENDS.format(name="g16_ends"))
    run = simulate_without_warnings(
        m, [1.0], [1.0], h=0.01, duration=5.0, params={"k": 0.0, "e": 1.0}
    )
    assert run.status in ("no convergence", "not finite") and np.isfinite(run.x).all()
    assert 1.0 < run.t[-1] < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("links", [5, 25])
def test_chains_agree_with_dp8(links: int) -> None:
    """Vector code, and outlined accelerations of 25 links evaluated one after the other."""
    text = Path("scenes/chain.toml").read_text(encoding="utf-8")
    text = text.replace('"chain"', f'"g16_chain{links}"').replace("value = 5,", f"value = {links},")
    text = text.replace("0.1*i", "0.02*i").replace(
        "[run]\n", '[run]\nmethod = ["gauss16", "dp8"]\n'
    )
    m = scene(f"g16_chain{links}", text)
    run = m.simulate(h=0.01, duration=0.5)
    fine = m.simulate(h=0.001, duration=0.5, every=10, method="dp8")
    assert np.max(np.abs(run.x - fine.x)) < 1e-9 * max(1.0, np.max(np.abs(fine.x)))


@pytest.mark.slow
def test_single_precision() -> None:
    m = load_with_dp8("cartpole", real='"float"')
    exact = eomc.load(variant("cartpole", "g16_double", method='"dp8"'), MODULES).simulate(h=0.01)
    run = m.simulate(h=0.05)
    assert run.status == "ok" and run.q.dtype == np.float32
    assert np.max(np.abs(run.q[-1] - exact.q[-1])) < 1e-3
    assert run.evaluations < 1.1 * run.steps * A_STEP + 200


def test_batches_and_discontinuous_accelerations_are_refused() -> None:
    """No derivatives are generated for such scenes."""
    with pytest.raises(eomc.SceneError, match="is for one trajectory: leave out batch"):
        eomc.sources(eomc.read(variant("cartpole", "g16_b", method='"gauss16"', batch="true")))
    text = SPRING.format(name="g16_jump") + '[forces]\nx = "-sign(x_dot)"\n'
    path = Path("build/tests/g16_jump.toml")
    path.write_text(text, encoding="utf-8")
    with pytest.raises(eomc.SceneError, match=r"'gauss16' needs smooth .* sign of a coordinate"):
        eomc.sources(eomc.read(path))
    source = eomc.sources(eomc.read(variant("cartpole", "g16_only", method='"gauss16"'))).files
    text = source["fast/g16_only.c"]
    assert "slopes" not in text and "rk4" not in text and "gauss16" in text
    plain = eomc.sources(eomc.read(variant("cartpole", "g16_none", method='"rk4"'))).files
    assert not any(
        "gauss16" in t or "_LANE" in t for f, t in plain.items() if f.endswith((".c", ".h"))
    )
