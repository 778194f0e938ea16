"""Coefficients of the explicit methods, and the accuracy of dp8 where that of RK4 is limited."""

from __future__ import annotations

import dataclasses
import math
from fractions import Fraction
from itertools import pairwise, product
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support.cases import cases, scene_file, scene_text, variant
from support.session import tiers

import eomc
from eomc.emit.common import solver
from eomc.emit.common.c_expression import DOUBLE, FLOAT, Real
from eomc.integrators import tableaux
from eomc.integrators.tableaux import DP8, METHODS, Method
from eomc.verify import convergence, reference
from eomc.verify.comparison import Comparison, Measurement
from eomc.verify.convergence import Convergence

SCENES = Path(__file__).parents[2] / "scenes"
MODULES = Path("build/tests/modules")

pytestmark = pytest.mark.usefixtures("quickly_compiled")

# Runge-Kutta methods; those with an `end` of their own are Nystrom methods.
EXPLICIT = [m for m in METHODS.values() if not m.implicit and not m.end]


def dot(x: tableaux.Row, y: tableaux.Row) -> Fraction:
    return sum((a * b for a, b in zip(x, y, strict=False)), Fraction(0))


@pytest.mark.parametrize("method", EXPLICIT, ids=lambda m: m.name)
def test_order_conditions(method: Method) -> None:
    """Check conditions of quadrature, and of the trees with one branching: b A c^k =
    1/((k+1)(k+2)).
    """
    exact = Fraction(1, 10**25)
    powers = [tuple(c**k for c in method.c) for k in range(method.order)]
    for k, power in enumerate(powers):
        assert abs(dot(method.b, power) - Fraction(1, k + 1)) < exact
        if k + 2 <= method.order:
            inner = tuple(dot(row, power) for row in method.a)
            assert abs(dot(method.b, inner) - Fraction(1, (k + 1) * (k + 2))) < exact
            # the same with the matrices that the generated code uses
            assert abs(dot(method.b_a, power) - Fraction(1, (k + 1) * (k + 2))) < exact
    assert abs(dot(method.b, powers[-1]) - Fraction(1, method.order)) < exact
    next_one = tuple(c**method.order for c in method.c)
    assert abs(dot(method.b, next_one) - Fraction(1, method.order + 1)) > exact


@pytest.mark.parametrize("method", EXPLICIT, ids=lambda m: m.name)
def test_stability_limits(method: Method) -> None:
    """Check limits of an undamped oscillation and of a decay at the rate 1, to three digits."""
    undamped, decay = method.limits

    def growth(acceleration: reference.Acceleration, h: float) -> float:
        q, qd = np.eye(2)[:, :, None]
        ends = reference.runge_kutta_step(method, acceleration, q, qd, 0.0, h)[..., 0]
        return float(np.max(np.abs(np.linalg.eigvals(ends))))

    for limit, force in ((undamped, lambda q, qd, t: -q), (decay, lambda q, qd, t: -qd)):
        assert growth(force, limit) <= 1 + 1e-6 < growth(force, 1.005 * limit)  # rounded down


@pytest.mark.parametrize("real", [DOUBLE, FLOAT], ids=lambda real: real.name)
@pytest.mark.parametrize("method", METHODS.values(), ids=lambda m: m.name)
def test_rounded_weights_add_up_to_one(method: Method, real: Real) -> None:
    """Each weight is a number of C's type; its error is at most that of rounding them
    separately.
    """
    rounded = solver.round_weights(method.b, real)
    kind = np.dtype(real.dtype).type
    assert [Fraction(float(kind(float(x)))) for x in rounded] == list(rounded)
    assert sum(rounded) == 1
    assert [x == 0 for x in rounded] == [x == 0 for x in method.b]
    assert (rounded == rounded[::-1]) == (method.b == method.b[::-1])
    most = Fraction(real.epsilon) / 2 * sum(map(abs, method.b))
    assert all(abs(x - y) <= most for x, y in zip(rounded, method.b, strict=True))


def case_module(name: str) -> tuple[ModuleType, dict]:
    case = cases()[name]
    text = scene_text(name).replace("[run]", '[run]\nmethod = ["rk4", "dp8"]')
    path = scene_file(f"dp8_{name}", text.replace('name = "', 'name = "dp8_', 1))
    return eomc.load(path, MODULES), case


# Case: a step size at which the error of the method is below the rounding error.
REACHED = {
    "cartpole_drop_tutorialP": 0.01,
    "cartpole_torque_physicalP": 0.05,
    "double_pendulum_regular": 0.02,
    "henon_heiles": 0.1,
    "furuta_pendulum": 0.002,
    "lagrange_top_nutation": 0.005,
}


@pytest.mark.parametrize(("name", "h"), tiers(REACHED.items(), "cartpole_torque_physicalP"))
def test_dp8_reaches_the_rounding_floor(name: str, h: float) -> None:
    m, case = case_module(name)
    t_end = float(case["t_end"])
    steps = round(t_end / h)
    reference = np.array(case["q_ref"], float)
    scale = max(1.0, float(np.max(np.abs(reference))))
    error = {
        method: np.max(
            np.abs(m.simulate(h=t_end / steps, steps=steps, method=method).q[-1] - reference)
        )
        / scale
        for method in m.methods
    }
    # The rounding floor, plus one rounding error in each step, amplified to the end.
    floor = max(float(case["double_floor"]), case["amplification"] * 2e-16 * np.sqrt(steps))
    assert error["dp8"] < 20 * floor
    assert error["rk4"] > 100 * error["dp8"]


@pytest.mark.slow
@pytest.mark.usefixtures("quickly_compiled")
def test_check_detects_a_wrong_coefficient(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = list(DP8.a[7])
    row[3] += Fraction(1, 1000)
    broken = dataclasses.replace(DP8, a=(*DP8.a[:7], tuple(row), *DP8.a[8:]))
    monkeypatch.setitem(tableaux.METHODS, "dp8", broken)
    text = (SCENES / "cartpole.toml").read_text(encoding="utf-8")
    path = tmp_path / "cartpole.toml"
    path.write_text(text.replace("[run]", '[run]\nmethod = ["rk4", "dp8"]'), encoding="utf-8")
    # it would fail too
    monkeypatch.setattr(Convergence, "closing", lambda *_: Measurement(math.nan, "not looked at"))
    comparison = Comparison(eomc.read(path), eomc.load(path, tmp_path), np.random.default_rng(0), 4)
    results = comparison.report(convergence.checks)
    assert [row.name for row in results if not row.passed] == ["order of dp8"]


def test_unknown_method_is_refused_by_name(cartpole: ModuleType) -> None:
    assert cartpole.methods == ("rk4",)
    with pytest.raises(ValueError, match=r"method: 'dp8' is not in this module, which has rk4"):
        cartpole.simulate(method="dp8")
    source = (MODULES / "cartpole" / "cartpole.c").read_text(encoding="utf-8")
    assert "dp8" not in source


def test_each_method_evaluates_signals_and_holds_constant_inputs() -> None:
    path = variant("cartpole_driven", "driven_dp8", method='["dp8", "rk4"]')
    m = eomc.load(path, MODULES)
    assert m.methods == ("dp8", "rk4")
    followed = [m.simulate(h=h, duration=2.0).q[-1] for h in (0.1, 0.05)]
    assert np.max(np.abs(followed[0] - followed[1])) < 1e-11
    constant = [
        m.simulate(h=h, duration=2.0, u=[0.3], method="rk4").q[-1] for h in (0.02, 0.01, 0.005)
    ]
    exact = m.simulate(h=0.05, duration=2.0, u=[0.3]).q[-1]
    errors = [np.max(np.abs(q - exact)) for q in constant]
    assert all(12 < a / b < 20 for a, b in pairwise(errors))


def test_steps_at_any_angular_velocity(cartpole: ModuleType) -> None:
    """Stages rotate small angles by one series, larger ones by another, or evaluate sines again."""

    def slope(x: np.ndarray) -> np.ndarray:
        return np.concatenate([x[2:], cartpole.acceleration(x[:2], x[2:])])

    worst = 0.0
    for h, turned in product(np.geomspace(0.01, 0.4, 30), 1.3 * 2.0 ** np.arange(-9, 2)):
        run = cartpole.simulate(q0=[0.1, 0.7], qd0=[-0.2, turned / h], h=h, steps=5)
        for x, result in pairwise(np.hstack([run.q, run.qd])):
            k1 = slope(x)
            k2 = slope(x + h / 2 * k1)
            k3 = slope(x + h / 2 * k2)
            k4 = slope(x + h * k3)
            expected = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            scale = 1 + np.abs(x) + h * np.max(np.abs([k1, k2, k3, k4]), axis=0)
            worst = max(worst, float(np.max(np.abs(result - expected) / scale)))
    assert worst < 5e-15
