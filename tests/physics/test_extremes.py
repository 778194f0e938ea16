"""Long runs and a nearly singular D: how errors grow, and how many of sixteen digits remain.

Long runs are compared where the exact motion is back at its initial state. A coordinate that passes
zero there with velocity v has the value v lag, where lag is the time by which the run is early. A
method that loses or gains energy at a constant rate changes the frequency with it, and its lag
grows as t^2. Gauss-Legendre methods keep the energy up to a bounded error, as symplectic and
symmetric methods do, and their lag grows as t (Hairer, Lubich & Wanner, Geometric Numerical
Integration, ch. IX-XI).
"""

from __future__ import annotations

import math
from functools import cache
from types import ModuleType

import mpmath
import numpy as np
import pytest
from support.cases import SCENES, scene_text
from support.session import ROOT, Modules

from eomc.model.system import from_scene
from eomc.report import cost_of_digits, reference_solution
from eomc.scene.read import parse

BUILDS = ROOT / "build" / "tests" / "extremes"
ORBITS = 500

POLAR = """
eomc = 1
name = "kepler_polar"
[coordinates]
r = { start = 0.5 }
theta = { unit = "rad", rate = 3.4641016151377544 }
[parameters]
m = 1.0
mu = 1.0
[energy]
kinetic = "m*(r_dot**2 + r**2*theta_dot**2)/2"
potential = "-m*mu/r"
"""


@cache
def with_methods(text: str, *methods: str) -> ModuleType:
    module, skipped = cost_of_digits.build_variant(
        from_scene(parse(text, "extreme.toml")), methods, BUILDS
    )
    assert not skipped
    return module


def of_scene(name: str, *methods: str) -> ModuleType:
    return with_methods((SCENES / f"{name}.toml").read_text(encoding="utf-8"), *methods)


def lags_of_orbits(method: str, parts: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (lag, relative energy error) of an orbit with e = 0.5 after 50, 100, ... 500
    revolutions.
    """
    module = of_scene("kepler_orbit", "rk4", "dp8", "gauss4", "gauss6")
    v = math.sqrt(3)  # (1 + e)/(1 - e), at periapsis
    run = module.simulate(
        [0.5, 0], [0, v], h=2 * math.pi / parts, steps=ORBITS * parts, every=ORBITS * parts // 10,
        method=method,
    )  # fmt: skip
    assert run.status == "ok"
    return run.q[1:, 1] / v, (run.energy / run.energy[0] - 1)[1:]


def assert_linear(lag: np.ndarray) -> None:
    """Require equal increments within a hundredth, and a final lag far above rounding."""
    each = lag / np.arange(1, 11)
    assert abs(lag[-1]) > 1e-7
    np.testing.assert_allclose(each, each[-1], rtol=0.01)


def assert_quadratic(lag: np.ndarray) -> None:
    """Twice the time must give almost four times the lag; a part linear in t remains initially."""
    assert 3.7 < lag[9] / lag[4] < 4.1


@pytest.mark.slow
@pytest.mark.parametrize(("method", "parts"), [("gauss4", 256), ("gauss6", 128)])
def test_lag_of_500_orbits_grows_linearly(method: str, parts: int) -> None:
    """The energy error at periapsis stays below 1e-11; that of rk4 and dp8 is 1e-6 and 1e-9."""
    lag, energy = lags_of_orbits(method, parts)
    assert_linear(lag)
    assert np.max(np.abs(energy)) < 1e-11


@pytest.mark.slow
def test_energy_of_500_eccentric_orbits_is_bounded_while_periapsis_is_resolved() -> None:
    """e = 0.9: the planet turns by 43.6 rad/s at periapsis, by 0.44 rad in a step of h = 0.01.

    The energy error of gauss4 returns to the same value then and is at most 5e-4. With h = 0.02 it
    is not bounded: each passage adds an error of a hundredth, as in an independent implementation
    that is solved to rounding. A symplectic method conserves energy up to exp(-const/(h omega)).
    """
    module = of_scene("kepler_orbit", "rk4", "dp8", "gauss4", "gauss6")
    worst = {}
    for h in (0.01, 0.02):
        run = module.simulate(h=h, duration=ORBITS * 2 * math.pi, method="gauss4")
        assert run.status == "ok"
        error = np.abs(run.energy / run.energy[0] - 1)
        tenth = len(error) // 10
        worst[h] = [float(np.max(error[k * tenth : (k + 1) * tenth])) for k in range(10)]
    assert max(worst[0.01]) < 1e-3 and max(worst[0.01]) < 1.05 * min(worst[0.01])
    assert max(worst[0.02]) > 1.5 * min(worst[0.02])


@pytest.mark.slow
@pytest.mark.parametrize(("method", "parts"), [("rk4", 512), ("dp8", 128)])
def test_lag_of_500_orbits_grows_quadratically_if_energy_drifts(method: str, parts: int) -> None:
    lag, energy = lags_of_orbits(method, parts)
    assert_quadratic(lag)
    np.testing.assert_allclose(energy / np.arange(1, 11), energy[-1] / 10, rtol=0.02)


@pytest.mark.slow
def test_500_orbits_in_polar_coordinates() -> None:
    """D = m diag(1, r^2): gauss6 is symmetric there, though not symplectic in (q, qd)."""
    module = with_methods(POLAR, "gauss6", "dp8")
    lags = {}
    for method in module.methods:
        parts = 128
        run = module.simulate(
            h=2 * math.pi / parts, steps=ORBITS * parts, every=ORBITS * parts // 10, method=method
        )
        assert run.status == "ok"
        turned = 2 * math.pi * ORBITS / 10 * np.arange(1, 11)
        lags[method] = (run.q[1:, 1] - turned) / run.qd[0, 1]
    assert_linear(lags["gauss6"])
    assert_quadratic(lags["dp8"])


@pytest.mark.slow
def test_lag_of_a_pendulum_after_100_000_periods() -> None:
    """The amplitude is 79.4 degrees; the period is 4 K(k) sqrt(l/g), k = sin(79.4 deg/2).

    gauss6 with 32 steps a period loses 1e-9 s each period, thus 1e-4 s in 63 hours. The lag of dp8
    is 1e-13 s in the first period and grows as the square of their number.
    """
    module = of_scene("simple_pendulum", "gauss6", "dp8")
    v, w = 4.0, mpmath.sqrt(mpmath.mpf(module.defaults["g"]) / module.defaults["l"])
    period = float(4 * mpmath.ellipk((v / (2 * w)) ** 2) / w)
    lags = {}
    for method, parts, count in (("gauss6", 32, 100_000), ("dp8", 48, 20_000)):
        steps = parts * count
        run = module.simulate(
            [0.0], [v], h=period / parts, steps=steps, every=steps // 10, method=method
        )
        assert run.status == "ok"
        lags[method] = run.q[1:, 0] / v
        energy = np.abs(run.energy / run.energy[0] - 1)[1:]
        if method == "gauss6":
            assert np.max(energy) < 1e-10
    assert_linear(lags["gauss6"])
    assert_quadratic(lags["dp8"])


@pytest.mark.slow
def test_rk4_loses_energy_at_the_theoretical_rate(modules: Modules) -> None:
    """1e5 periods of x = cos t with h = 1/20: E decays as exp(-h^5 t/72), to 0.9973."""
    h = 0.05
    steps = round(1e5 * 2 * math.pi / h)
    run = modules("mass_spring").simulate(h=h, steps=steps, every=steps // 10)
    law = -(h**5) * run.t / 72
    np.testing.assert_allclose(np.log(run.energy / run.energy[0])[1:], law[1:], rtol=0.01)


# --- mass ratios ----------------------------------------------------------------------------------


def double_pendulum(m1: str, m2: str, duration: float) -> str:
    text = scene_text("double_pendulum_light_inner")
    for before, after in (
        ("m1 = 1e-06", f"m1 = {m1}"), ("m2 = 1.0", f"m2 = {m2}"),
        ("duration = 1.0", f"duration = {duration!r}"),
    ):  # fmt: skip
        assert text.count(before) == 1
        text = text.replace(before, after)
    return text


def exact_acceleration(p: dict[str, float], q: np.ndarray, qd: np.ndarray) -> list[mpmath.mpf]:
    """Return accelerations of the double pendulum in absolute angles, derived by hand, with 50
    digits.
    """
    with mpmath.workdps(50):
        m1, m2, l1, l2, g = (mpmath.mpf(p[name]) for name in ("m1", "m2", "l1", "l2", "g"))
        (a, b), (va, vb) = map(mpmath.mpf, q), map(mpmath.mpf, qd)
        coupling = m2 * l1 * l2 * mpmath.cos(a - b)
        swing = m2 * l1 * l2 * mpmath.sin(a - b)
        D = mpmath.matrix([[(m1 + m2) * l1**2, coupling], [coupling, m2 * l2**2]])
        tau = mpmath.matrix(
            [
                -swing * vb**2 - (m1 + m2) * g * l1 * mpmath.sin(a),
                swing * va**2 - m2 * g * l2 * mpmath.sin(b),
            ]
        )
        return list(mpmath.lu_solve(D, tau))


@pytest.mark.slow
@pytest.mark.parametrize(("m1", "m2"), [("1e-05", "1.0"), ("1e-09", "1.0"), ("1.0", "1e-09")])
def test_error_of_accelerations_is_bounded_by_the_condition_of_D(m1: str, m2: str) -> None:
    """The bound is 64 eps cond(D) with unit diagonal: up to 4e9 with the links in line."""
    module = with_methods(double_pendulum(m1, m2, 1.0), "rk4")
    random, conditions = np.random.default_rng(0), []
    for k in range(200):
        q, qd = random.uniform(-3, 3, (2, 2))
        if k % 3 == 0:
            q[1] = q[0] + random.uniform(-1e-3, 1e-3)
        D = module.D(q)
        size = np.sqrt(np.diag(D))
        conditions.append(np.linalg.cond(D / np.outer(size, size)))
        exact = exact_acceleration(module.defaults, q, qd)
        computed = module.acceleration(q, qd)
        off = max(abs(float(e - float(f))) for e, f in zip(exact, computed, strict=True))
        assert off < 64 * 2.0**-53 * conditions[-1] * max(abs(float(e)) for e in exact)
    if m2 == "1.0":
        assert max(conditions) > 0.1 / float(m1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("m1", "m2", "duration", "steps", "most"),
    [("1e-05", "1.0", 0.5, 2**18, 1e-9), ("1.0", "1e-08", 1.0, 2**14, 1e-12)],
    ids=["light inner", "light tip"],
)
def test_motion_at_extreme_mass_ratios(
    m1: str, m2: str, duration: float, steps: int, most: float
) -> None:
    """Compare with 25 digits all along. "Inner" has a transient mode of 1,000 rad/s; cond D =
    1e5.
    """
    text = double_pendulum(m1, m2, duration)
    exact = reference_solution.solve(from_scene(parse(text, "ratio.toml")), root=BUILDS)
    assert exact.digits[-1] > 25
    run = with_methods(text, "rk4", "gauss8").simulate(
        h=duration / steps, steps=steps, every=steps // 256, method="gauss8"
    )
    assert run.status == "ok"
    assert np.max(np.abs(exact.error_of(run.q, run.qd)) / exact.scale) < most
