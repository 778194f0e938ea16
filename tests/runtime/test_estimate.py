"""Error estimates of runs, their verdicts, and the step size against the stability limits."""

from __future__ import annotations

import math
import warnings
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.cases import SCENES, case_system, cases, error_of
from support.session import ROOT, Modules, tiers

import eomc
from eomc.model.system import System
from eomc.runtime import estimate
from eomc.runtime.package import model_of

SPRING = """
eomc = 1
name = "spring"
[coordinates]
x = { start = 1.0 }
[parameters]
k = 1e4
c = 0
[energy]
kinetic = "x_dot**2/2"
potential = "k*x**2/2"
dissipation = "c*x_dot**2"
[run]
h = 0.01
duration = 10.0
"""
JUMPING = """
eomc = 1
name = "jumping"
[coordinates]
x = { start = 1.0 }
[energy]
kinetic = "x_dot**2/2"
potential = "x**2/2"
[forces]
x = "-0.2*sign(x_dot)"
[run]
h = 0.01
duration = 10.0
"""


def build_quickly(system: System, flags: str) -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EOMC_CFLAGS", flags)  # compilation dominates the time here
        return eomc.load(system, ROOT / "build" / "tests" / "cases")


@cache
def load_case(name: str) -> ModuleType:
    return build_quickly(case_system(name), "-O1")


@pytest.fixture
def spring(modules: Modules) -> Any:
    """A module that has not issued warnings yet."""
    module = modules.unoptimised(SPRING)
    model_of(module).integrator.warned.clear()
    return module


def simulate_quietly(module: Any, **options: Any) -> Any:
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        return module.simulate(**options)


# --- the size of the error ------------------------------------------------------------------------


@pytest.mark.parametrize("every", [1, 7, 2000])
def test_error_estimate_at_all_rows_is_accurate(modules: Modules, every: int) -> None:
    """x = cos t, v = -sin t: the estimate equals the error to a hundredth, at every row."""
    run = modules("mass_spring").simulate(h=0.01, steps=2000, every=every, estimate=True)
    error = run.error
    assert error.q.shape == run.q.shape and error.qd.shape == run.qd.shape
    assert error.q[0] == error.qd[0] == 0
    exact_error = np.abs(run.q[:, 0] - np.cos(run.t)), np.abs(run.qd[:, 0] + np.sin(run.t))
    # h/4 itself errs by 1/256, rounding by about 1e-15 times the root of the number of steps
    np.testing.assert_allclose(error.q[:, 0], exact_error[0], rtol=0.01, atol=1e-13)
    np.testing.assert_allclose(error.qd[:, 0], exact_error[1], rtol=0.01, atol=1e-13)
    assert error.end == {"x": error.q[-1, 0], "x_dot": error.qd[-1, 0]}
    assert error.digits["x"] == pytest.approx(-math.log10(error.end["x"]), abs=0.01)
    assert error.order == 4 and error.observed == pytest.approx(4, abs=0.05)
    assert error.amplification == pytest.approx(1, abs=0.1)
    assert error.resolved and error.verdict == ""


def test_rounding_error_is_not_estimated_as_zero(modules: Modules) -> None:
    """The method's error is ten digits below: rounding is reported, neither more nor less."""
    run = modules("mass_spring").simulate(h=1e-4, steps=100_000, every=10_000, estimate=True)
    assert run.error.resolved and math.isnan(run.error.observed)
    exact_error = np.abs(run.q[1:, 0] - np.cos(run.t[1:]))
    assert np.all(run.error.q[1:] > 0) and np.all(run.error.q < 1e-11)
    assert np.max(exact_error) < 10 * np.max(run.error.q)


def test_text_of_an_estimate_is_one_line(cartpole: ModuleType) -> None:
    estimate = cartpole.simulate(duration=1.0).estimate()
    assert str(estimate).startswith(f"estimated error at the end: x {estimate.end['x']:.1g} (")
    assert f", theta {estimate.end['theta']:.1g} ({estimate.digits['theta']:.0f} digits)," in str(
        estimate
    )
    assert str(estimate).endswith(f" by a factor of {estimate.amplification:.2g}")


def test_run_without_steps_has_no_error(cartpole: ModuleType) -> None:
    error = cartpole.simulate(steps=0, estimate=True).error
    assert not error.q.any() and error.resolved


LINEAR = """
eomc = 1
name = "linear"
[coordinates]
x = { start = "place + 1e-3", rate = 1e-3 }
y = { start = "-place" }
[parameters]
place = 0
k = 1.0
[energy]
kinetic = "x_dot**2/2 + 500*y_dot**2"
potential = "k*(x - place)**2/2 + 5e6*(y + place)**2"
[run]
h = 0.005
duration = 10.0
tolerance = 1e-9
"""


@pytest.fixture(scope="module")
def linear(modules: Modules) -> ModuleType:
    """x with 1 rad/s where k is 1, and y at rest with 100 rad/s; parameters set their positions."""
    return modules.unoptimised(LINEAR)


@pytest.mark.parametrize("place", [0.0, 1.0, -1e3])
@pytest.mark.parametrize("options", [{"h": 0.005}, {"tol": 1e-9}, {"tol": 1e-9, "times": [4.0]}])
def test_perturbation_of_oscillators_does_not_grow(
    linear: ModuleType, place: float, options: dict[str, Any]
) -> None:
    """The flow of oscillators is a rotation, for any origin and any of them in motion."""
    error = simulate_quietly(linear, params={"place": place}, **options).estimate()
    assert error.amplification == pytest.approx(1, abs=0.3)


@pytest.mark.parametrize("options", [{"h": 0.005}, {"tol": 1e-9}])
def test_perturbation_near_a_saddle_grows_in_any_direction(
    linear: ModuleType, options: dict[str, Any]
) -> None:
    """x'' = x: by e^10 along (1, 1), by e^-10 along (1, -1), and x itself grows as fast."""
    for rate in (1e-3, -1e-3):
        params = {"place": 5.0, "k": -1.0}
        error = simulate_quietly(linear, qd0=[rate, 0.0], params=params, **options).estimate()
        assert error.amplification == pytest.approx(math.exp(10), rel=0.1)
        assert "chaotic" not in error.verdict


def test_rounding_of_a_small_motion_far_from_the_origin_is_not_chaotic(linear: ModuleType) -> None:
    """1e-9 m about 1e6 m is seven roundings of x; the verdict does not mention growth."""
    run = simulate_quietly(linear, q0=[1e6 + 1e-9, -1e6], h=0.005, params={"place": 1e6})
    assert run.estimate().amplification < 100 and "chaotic" not in run.error.verdict


def test_amplification_is_that_of_the_linear_motion() -> None:
    """The largest factor over all directions at the start, in the norm of D and T = 1/omega."""
    omega, D = 7.0, np.array([[3.0]])
    t = np.linspace(0, 5, 400)[:, None]
    c, s = np.cos(omega * t), np.sin(omega * t)
    by_position, by_velocity = np.hstack([c, -omega * s]), np.hstack([s / omega, c])
    root = estimate.norm_root(D, [by_position, by_velocity], 5.0)
    np.testing.assert_allclose(root, np.sqrt(3) * np.diag([omega, 1.0]), rtol=0.05)
    ends = (np.stack([x[k] for x in (by_position, by_velocity)], axis=1) for k in (0, 333))
    assert estimate.growth(root, *ends) == pytest.approx(1, rel=0.05)
    first, last = np.eye(2), np.diag([1e200, 1.0])
    assert estimate.growth(np.eye(2), first, last) == pytest.approx(1e200)
    assert estimate.growth(np.eye(2), first, np.diag([np.inf, 1.0])) == math.inf


QUICK = (
    "pendulum_large_swing",
    "double_pendulum_light_tip",
    "spring_pendulum_stiff_1e6",
    "cartpole_torque_physicalP",
    "coulomb_friction",
    "slider_crank_near_changepoint",
)
FIRST = ("pendulum_large_swing",)


def compare_estimates(name: str, max_steps: int) -> list[tuple[float, bool]]:
    """Return (estimate / error, whether an error of a tenth went unreported), per step size."""
    pairs = []
    for measured in cases()[name]["rk4_measured"]:
        if (steps := measured["steps"]) > max_steps:
            continue
        run = simulate_quietly(
            load_case(name), h=measured["h"], steps=steps, every=max(1, steps // 400)
        )
        if run.status == "ok":
            run.estimate()
            true_error = np.abs(run.q[-1] - np.array(cases()[name]["q_ref"], float))
            scale = np.maximum(np.max(np.abs(run.q), axis=0), 1e-6 * np.max(np.abs(run.q)))
            wrong = bool((true_error / scale > 0.1).any())
            ratio = float(run.error.q[-1].max()) / error_of(name, run.q[-1])
            pairs.append((ratio, wrong and run.error.resolved))
    return pairs


@pytest.mark.parametrize("name", tiers(QUICK, *FIRST))
def test_estimate_is_within_a_factor_of_ten(name: str) -> None:
    pairs = compare_estimates(name, 100_000)
    assert len(pairs) >= 3
    assert all(0.1 <= ratio <= 10 for ratio, _ in pairs)
    assert not any(silent for _, silent in pairs)


@pytest.mark.slow
def test_estimates_of_all_cases() -> None:
    """Nine of ten are within a factor of ten; no error of a tenth goes unreported."""
    unconstrained = [name for name, case in cases().items() if not case["constraints"]]
    pairs = [pair for name in unconstrained for pair in compare_estimates(name, 2_000_000)]
    assert len(pairs) > 100
    assert sum(0.1 <= ratio <= 10 for ratio, _ in pairs) >= 0.9 * len(pairs)
    assert not any(silent for _, silent in pairs)


# --- runs that are not resolved -------------------------------------------------------------------


TWO_BODIES = """
eomc = 1
name = "beside"
[coordinates]
x = { start = 0.0 }
y = { start = 1.0 }
[inputs]
u = {}
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "2*y**2"
[forces]
x = "u"
"""


@pytest.mark.parametrize(
    "options", [{}, {"control_period": 0.1}, {"control_period": 0.1, "pushed": 1}]
)
def test_discontinuous_law_at_rest_is_not_called_chaotic(modules: Modules, options: dict) -> None:
    """x is exactly at rest; perturbed by a rounding it would chatter, a million times its scale."""
    options, q = dict(options), [0.0, 1.0]
    qd = [0.5, 0.0] if options.pop("pushed", 0) else [0.0, 0.0]
    run = simulate_quietly(
        modules.unoptimised(TWO_BODIES),
        q0=q,
        qd0=qd,
        h=0.01,
        steps=1000,
        u=lambda t, q, qd: -np.sign(qd[0]),
        **options,
    )
    with warnings.catch_warnings(action="error"):
        error = run.estimate()
    assert error.resolved and error.amplification > 1e9
    exact = abs(run.q[-1, 1] - math.cos(2 * run.t[-1]))
    assert error.q[-1, 1] == pytest.approx(exact, rel=0.3)


def test_unstable_equilibrium_is_called_chaotic(modules: Modules) -> None:
    """An inverted pendulum that rounding does not move: perturbations grow smoothly."""
    text = TWO_BODIES.replace("2*y**2", "2*y**2 - 8*x**2")
    run = simulate_quietly(modules.unoptimised(text), h=0.01, steps=1000, u=[0.0])
    with pytest.warns(RuntimeWarning, match="chaotic: a difference at the start grows"):
        assert not run.estimate().resolved


@pytest.mark.slow
def test_motion_beyond_the_precision_of_doubles_is_reported() -> None:
    """Errors grow by 1.7e11 in 15 s."""
    message = (
        "^double_pendulum_chaotic: this motion is not resolved: the error of .* exceeds a tenth"
    )
    with pytest.warns(RuntimeWarning, match=message) as warnings_:
        run = load_case("double_pendulum_chaotic").simulate(h=0.005, steps=3000, estimate=True)
    assert warnings_[-1].filename == __file__
    with pytest.warns(RuntimeWarning, match=message) as warnings_:
        run.estimate()
    assert warnings_[-1].filename == __file__
    assert not run.error.resolved and "exceeds a tenth" in run.error.verdict
    assert run.error.amplification > 1e9
    assert min(run.error.digits.values()) == 0
    run = simulate_quietly(
        load_case("double_pendulum_chaotic"), h=1e-3, steps=25_000, estimate=True
    )
    assert "chaotic" in run.error.verdict and "no run in float64" in run.error.verdict


def test_force_jumps_lower_the_observed_order(modules: Modules) -> None:
    run = simulate_quietly(modules.unoptimised(JUMPING), estimate=True)
    assert run.error.observed < 3 and "forces jump" in run.error.verdict


def test_numerical_damping_of_a_fast_mode_is_detected(spring: Any) -> None:
    """h omega = 2: the oscillation is damped alike with h and h/2, and both are wrong."""
    run = simulate_quietly(spring, h=2e-3, duration=10.0, every=50, params={"k": 1e6})
    assert np.abs(run.q[-1, 0]) < 1e-6  # the exact amplitude stays 1
    assert run.estimate().q[-1, 0] == pytest.approx(abs(math.cos(1e4) - run.q[-1, 0]), rel=0.2)
    assert not run.error.resolved


def test_stopped_run_has_an_error_up_to_its_end(spring: Any) -> None:
    run = simulate_quietly(spring, h=0.01, duration=10.0, params={"k": 1e6})
    assert run.status == "not finite"
    error = run.estimate()
    assert len(error.q) == len(run) and "the run stopped" in error.verdict


def test_stopped_run_is_estimated_with_the_inputs_that_it_used(driven: ModuleType) -> None:
    """Shorter steps hold each input row as long as the run did, up to where it ended."""
    u = np.full((60, 1), 0.3)
    u[33] = 1e300  # too large for the square of the resulting theta_dot
    run = simulate_quietly(driven, steps=60, u=u, estimate=True)
    assert run.status == "not finite" and 33 <= run.steps < 60
    shorter = simulate_quietly(driven, steps=run.steps, u=u[: run.steps], estimate=True)
    assert np.array_equal(run.error.q, shorter.error.q)


def test_failed_convergence_is_reported(modules: Modules) -> None:
    """x'' = -4e4 x^3 in steps of 800 radians: no iteration for the stages converges."""
    text = SPRING.replace("k*x**2/2", "k*x**4") + 'method = ["gauss4"]\n'
    module: Any = modules.unoptimised(text)
    with pytest.warns(RuntimeWarning, match="does not converge: take a smaller h"):
        run = module.simulate(h=5.0, steps=10)
    assert run.status == "no convergence" and run.q.tolist() == [[1.0]]
    assert "t = 0 after 0 steps" in run.message and "q = [1.]" in run.message
    with pytest.raises(module.MotionError, match="does not converge") as error:
        module.step([1.0], [0.0], h=5.0)
    assert error.value.status == "no convergence"
    assert module.simulate(h=1e-3, steps=100, estimate=True).error.resolved
    assert module.advice(h=5.0) is None  # no step is too long for stability


def test_inputs_are_constant_over_the_same_intervals_in_shorter_steps(driven: ModuleType) -> None:
    """A table or function defines u between two of the run's own steps."""
    table = np.sin(np.arange(100) * 0.7)[:, None]
    run = driven.simulate(h=0.02, steps=100, u=table, estimate=True)
    assert run.error.resolved and run.error.q.max() < 1e-4
    times: list[float] = []

    def law(t: float, q: Any, qd: Any) -> list[float]:
        times.append(t)
        return [float(table[round(t / 0.02), 0])]

    by_law = simulate_quietly(driven, h=0.02, steps=100, u=law)
    assert np.array_equal(by_law.q, run.q)
    assert np.array_equal(by_law.estimate().q, run.error.q)
    assert np.allclose(np.array(sorted(set(times))) / 0.02, np.arange(100))


# --- the stability limit --------------------------------------------------------------------------


def test_step_beyond_the_stability_limit_is_reported_once(spring: Any) -> None:
    """RK4 of an undamped spring is stable up to h omega = 2.82; verify both sides of the limit."""
    module = spring
    message = r"h = 0.03 s is beyond rk4's stability limit of about 0.028 s here \(fastest mode 100"
    with pytest.warns(RuntimeWarning, match=message):
        run = module.simulate(h=0.03, steps=1000)
    assert abs(run.q[-1, 0]) > 1e3
    with warnings.catch_warnings(action="error"):
        module.simulate(h=0.03, steps=1000)  # already reported
        module.simulate(h=0.031, steps=19)  # too few steps
        run = module.simulate(h=0.028, steps=1000)
    assert abs(run.q[-1, 0]) < 1
    assert "0.031 s" in module.advice(h=0.031) and module.advice(h=0.028) is None
    assert module.advice(h=0.031, params={"k": 5e3}) is None


def test_fast_decay_has_a_stability_limit_too(spring: Any) -> None:
    """x'' = -k x - 1000 x': the fast eigenvalue is -1000 1/s, RK4's limit 2.78."""
    options = {"params": {"k": 1.0, "c": 500.0}}
    assert "limit of about 0.0028 s here (fastest decay 1e+03 1/s" in spring.advice(
        h=0.003, **options
    )
    assert spring.advice(h=0.0027, **options) is None
    assert abs(simulate_quietly(spring, h=0.003, qd0=[1.0], steps=1000, **options).q[-1, 0]) > 10
    assert abs(simulate_quietly(spring, h=0.0027, qd0=[1.0], steps=1000, **options).q[-1, 0]) < 2


def test_stability_limit_is_reported_by_every_kind_of_run(spring: Any) -> None:
    """Short runs in a single call of C, long runs, and runs by duration."""
    message = r"^spring: h = 0.0\d+ s is beyond rk4's stability limit"
    for k, options in enumerate(({"steps": 20}, {"steps": 3000}, {"duration": 3.0})):
        with pytest.warns(RuntimeWarning, match=message) as warnings_:
            spring.simulate(h=0.04 + k / 1000, **options)
        assert warnings_[0].filename == __file__


def test_step_longer_than_the_run_is_reported(cartpole: ModuleType) -> None:
    message = (
        "^cartpole: h = 0.5 s is longer than the duration, 0.2 s: the run is one step of 0.5 s$"
    )
    with pytest.warns(RuntimeWarning, match=message) as warnings_:
        run = cartpole.simulate(h=0.5, duration=0.2)
    assert run.steps == 1 and warnings_[0].filename == __file__
    with warnings.catch_warnings(action="error"):
        cartpole.simulate(h=0.5, duration=0.5)
        cartpole.simulate(h=0.5, duration=0)
        cartpole.simulate(h=0.5, steps=1)


def test_force_jump_is_not_taken_for_a_fast_mode(modules: Modules) -> None:
    """sign(x_dot) at rest has a difference quotient as steep as its width is small."""
    assert modules.unoptimised(JUMPING).advice(h=0.01) is None


def test_example_scene_starts_within_its_stability_limit() -> None:
    path = SCENES / "cartpole.toml"
    assert eomc.load(path, ROOT / "build" / "tests" / "modules").advice() is None


# --- derivatives ----------------------------------------------------------------------------------


def test_linearize_without_its_code_is_refused_with_advice(cartpole: ModuleType) -> None:
    with pytest.raises(ValueError, match=r"build it with \[run\] linearize = true"):
        cartpole.linearize([0, 1], [0, 0])


@pytest.mark.parametrize(
    ("ends", "expected"),
    [
        ([2.0, 0.0, -1e76, 3.0], [2.0, 2e-6, 1e76, 1e70]),
        ([0.0, 0.0, 4.0, 0.0], [4e-6, 4e-6, 4.0, 4e-6]),
        ([0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]),
        ([0.0, 4.0, 1e-17, 2e-17], [4e-6, 4.0, 2.0, 2.0]),
    ],
)
def test_diverging_velocities_do_not_set_the_scale_of_positions(
    ends: list[float], expected: list[float]
) -> None:
    """Errors of positions that are 1e40 times smaller would seem negligible."""
    scales = estimate.scales(np.array([[0.0, 0.0, 0.0, 0.0], ends]), 2.0, 2.0**-53)
    np.testing.assert_allclose(scales, expected, rtol=1e-15)
