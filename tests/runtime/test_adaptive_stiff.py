"""Adaptive steps of stiff motion, by Newton's method, against closed forms and single runs."""

from __future__ import annotations

import warnings
from functools import cache
from pathlib import Path
from types import ModuleType

import mpmath
import numpy as np
import pytest
from support import cases
from support.session import Modules, tiers

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse

pytestmark = pytest.mark.usefixtures("unoptimised_file")
BUILDS = Path(__file__).parents[2] / "build" / "tests" / "adaptive"
TRAIN = """eomc = 1
name = "stiff_train"
[coordinates]
x = { unit = "m", start = 0.1, rate = 1 }
y = { unit = "m", start = 0.3 }
[parameters]
k = 1e8
c = 1e4
[energy]
kinetic = "(x_dot**2 + 2*y_dot**2)/2"
potential = "x**2/2 + k*(y - x)**2/2"
[forces]
x = "c*(y_dot - x_dot)"
y = "c*(x_dot - y_dot)"
[[event]]
name = "back"
when = "x + 2*y"
[run]
tolerance = 1e-9
batch = true
"""
START = (0.1, 0.3, 1.0, 0.0)


@pytest.fixture(scope="module")
def train() -> ModuleType:
    """Two masses, one on a soft spring, coupled so stiffly that they move as one after 1e-3 s."""
    return eomc.load(from_scene(parse(TRAIN, "stiff_train.toml")), BUILDS)


@cache
def exact_state(t: float) -> np.ndarray:
    """Return the state at t, (4,), from fifty digits."""
    k, c = 10**8, 10**4
    with mpmath.workdps(50):
        rates = mpmath.matrix(
            [
                [0, 0, 1, 0],
                [0, 0, 0, 1],
                [-1 - k, k, -c, c],
                [mpmath.mpf(k) / 2, -k / 2, c / 2, -c / 2],
            ]
        )
        values, vectors = mpmath.eig(rates)
        weights = mpmath.lu_solve(vectors, mpmath.matrix([mpmath.mpf(str(x)) for x in START]))
        modes = [weights[i] * mpmath.exp(values[i] * mpmath.mpf(t)) for i in range(4)]
        return np.array([float(mpmath.re(x)) for x in vectors * mpmath.matrix(modes)])


@pytest.mark.parametrize("tol", [1e-4, 1e-6, 1e-9, 1e-12])
def test_end_equals_the_closed_form(train: ModuleType, tol: float) -> None:
    with warnings.catch_warnings(action="error"):
        run = train.simulate(tol=tol, duration=20.0)
    assert run.status == "ok" and run.stiff_steps > run.steps / 3 and run.steps < 120
    assert np.abs(run.x[-1] - exact_state(20.0)).max() < 10 * tol
    assert "by Newton's method" in run.message


@pytest.mark.parametrize("tol", [1e-2, 1e-3, 1e-4])
def test_oscillation_limits_stiff_steps(train: ModuleType, tol: float) -> None:
    """Regression: steps grew to hundreds of periods; their scale was an extrapolated state."""
    options = {"duration": 300.0, "params": {"k": 10.0, "c": 0.0}}
    for stiff in (False, True):
        run = train.simulate(tol=tol, stiff=stiff, **options)
        assert np.abs(run.q[-1] - train.simulate(tol=1e-13, **options).q[-1]).max() < 30 * tol
        assert np.diff(run.t).max() < 3.0


def test_rows_within_stiff_steps_are_accurate(train: ModuleType) -> None:
    times = np.array([1e-4, 1e-3, 0.5, 3.0, 3.01, 17.7, 20.0])
    run = train.simulate(tol=1e-11, times=times)
    assert run.steps < 300
    for t, x in zip(times, run.x, strict=True):
        assert np.abs(x - exact_state(t)).max() < 1e-9, t
    repeated = train.simulate(tol=1e-11, duration=20.0)
    assert np.array_equal(np.concatenate(repeated(3.01)), run.x[4])


def test_events_in_stiff_steps_are_detected(train: ModuleType) -> None:
    times = train.simulate(tol=1e-12, duration=20.0).events["back"].t
    assert len(times) == 3 and np.diff(times) == pytest.approx(np.pi * np.sqrt(3), rel=1e-7)
    for t in times:
        x = exact_state(float(t))
        assert abs(x[0] + 2 * x[1]) < 1e-10


def test_run_can_start_with_newtons_method(train: ModuleType, tmp_path: Path) -> None:
    run = train.simulate(tol=1e-9, duration=20.0, stiff=True)
    default = train.simulate(tol=1e-9, duration=20.0)
    assert run.evaluations != default.evaluations
    assert np.abs(run.x[-1] - exact_state(20.0)).max() < 1e-8
    assert np.array_equal(run(3.3)[0], train.simulate(tol=1e-9, times=[3.3, 20], stiff=True).q[0])
    run.save(tmp_path / "run.npz")
    loaded = train.load_run(tmp_path / "run.npz")
    assert loaded.stiff_steps == run.stiff_steps and np.array_equal(loaded(3.3)[0], run(3.3)[0])
    assert max(run.estimate().end.values()) < 1e-8


def test_batch_takes_the_steps_of_single_runs(train: ModuleType) -> None:
    q0 = np.column_stack([np.linspace(0, 1, 9), np.linspace(0.3, 0.31, 9)])
    c = np.geomspace(1, 1e6, 9)
    runs = train.simulate_batch(q0, params={"c": c}, tol=1e-8, times=[0.0, 2.0, 5.0])
    for k in (0, 5, 8):
        single = train.simulate(q0[k], params={"c": c[k]}, tol=1e-8, times=[0.0, 2.0, 5.0])
        assert np.array_equal(runs.q[k], single.q) and runs.steps[k] == single.steps
        assert runs.stiff_steps[k] == single.stiff_steps
    assert (runs.stiff_steps > 0).any() and not (runs.stiff_steps > 0).all()
    stiff_batch = train.simulate_batch(q0, tol=1e-8, times=[0.0, 0.1], stiff=True)
    assert (stiff_batch.stiff_steps > 0).all() and set(stiff_batch.status) == {"ok"}
    single = train.simulate(q0[8], tol=1e-8, times=[0.0, 0.1], stiff=True)
    assert (
        np.array_equal(stiff_batch.q[8], single.q)
        and stiff_batch.stiff_steps[8] == single.stiff_steps
    )


def test_calm_motion_returns_to_fixed_point_iteration(train: ModuleType) -> None:
    run = train.simulate(params={"k": 1, "c": 0}, tol=1e-9, duration=200.0, stiff=True)
    assert run.stiff_steps == 32 and run.steps > 64
    assert train.simulate(params={"k": 1, "c": 0}, tol=1e-9, duration=200.0).stiff_steps == 0


@pytest.mark.slow
def test_single_precision() -> None:
    text = TRAIN.replace("stiff_train", "stiff_single").replace("1e4", "1e3").replace("1e8", "1e5")
    text = text.replace("batch = true\n", 'method = "gauss8"\nreal = "float"\n')
    text = text.replace("1e-9", "1e-5").replace('[[event]]\nname = "back"\nwhen = "x + 2*y"\n', "")
    module = eomc.load(from_scene(parse(text, "stiff_single.toml")), BUILDS)
    run, fine = module.simulate(duration=20.0), module.simulate(duration=20.0, h=0.05)
    # 4300 steps where fixed-point iteration converges
    assert run.stiff_steps > run.steps / 3 and run.steps < 100
    assert np.abs(run.x[-1] - fine.x[-1]).max() < 1e-4


@pytest.mark.slow
def test_constraints_hold_in_stiff_steps() -> None:
    text = """eomc = 1
name = "stiff_rod"
[coordinates]
x = { start = 0.6 }
y = { start = -0.8 }
z = { start = 0.1 }
[parameters]
k = 1e7
c = 1e4
[energy]
kinetic = "(x_dot**2 + y_dot**2 + z_dot**2/10)/2"
potential = "9.81*y + k*(z - x)**2/2"
[forces]
x = "c*(z_dot - x_dot)"
z = "c*(x_dot - z_dot)"
[constraints]
rod = "x**2 + y**2 - 1"
[run]
tolerance = 1e-10
method = "gauss8"
"""
    module = eomc.load(from_scene(parse(text, "stiff_rod.toml")), BUILDS)
    run = module.simulate(duration=3.0)
    assert run.status == "ok" and run.stiff_steps > run.steps / 2
    assert np.abs(run.constraints["rod"]).max() < 1e-13
    fine = module.simulate(duration=3.0, h=5e-5)
    assert np.abs(run.q[-1] - fine.q[-1]).max() < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("tol", [1e-6, 1e-9, 1e-12])
def test_stiff_governor_meets_its_reference(tol: float, modules: Modules) -> None:
    text = cases.scene_text("iftomm_A05_governor").replace("[run]", "[run]\ntolerance = 1e-9")
    module = modules.of_text(text)
    run = module.simulate(tol=tol)
    assert cases.error_of("iftomm_A05_governor", run.q[-1]) < 10 * tol
    assert run.stiff_steps > run.steps / 2 and run.steps < 400


def test_relaxation_oscillator_has_the_asymptotic_period() -> None:
    """Van der Pol's, mu = 1000; asymptotic period by Dorodnicyn."""
    text = """eomc = 1
name = "relaxation"
[coordinates]
x = { start = 2.0 }
[parameters]
mu = 1000.0
[energy]
kinetic = "x_dot**2/2"
potential = "x**2/2"
[forces]
x = "mu*(1 - x**2)*x_dot"
[[event]]
name = "up"
when = "x"
direction = "rising"
[run]
duration = 8000
tolerance = 1e-9
"""
    module = eomc.load(from_scene(parse(text, "relaxation.toml")), BUILDS)
    run = module.simulate()
    assert run.status == "ok" and run.steps < 2000 and run.stiff_steps > 400
    period = np.diff(run.events["up"].t)
    # 1.6137056 mu + 7.01432 mu^(-1/3) - (22/9) ln(mu)/mu + 0.0087/mu
    expected = (3 - 2 * np.log(2)) * 1000 + 7.01432 * 0.1 - 22 / 9 * np.log(1000) / 1000
    assert len(period) >= 3 and period == pytest.approx(expected, rel=1e-5)
    assert np.ptp(period) < 1e-5


FAR = """eomc = 1
name = "far"
[coordinates]
x = { unit = "m" }
y = { unit = "m" }
[parameters]
k = 1e6
c = 1e5
L = 1
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "k*L**2*exp((y - x)/L)"
[forces]
x = "c*(y_dot - x_dot)"
y = "c*(x_dot - y_dot) + 1e4*L*sin(t)"
[run]
tolerance = 1e-9
duration = 5
"""


@pytest.mark.parametrize(
    ("origin", "length", "steps"), [(0.0, 1e-3, 200), (6.4e6, 1e-3, 200), (0.0, 1e-9, 200)]
)
def test_units_and_origin_do_not_change_the_steps(origin: float, length: float, steps: int) -> None:
    """The contact is as steep as 1/L: difference quotients over a metre would miss it."""
    module = eomc.load(from_scene(parse(FAR, "far.toml")), BUILDS)
    expected = (29.79659887e-3, 29.79264387e-3)  # over 1000 L; from SciPy's Radau, to 1e-10
    for options in ({}, {"stiff": True}):
        run = module.simulate([origin, origin], params={"L": length}, **options)
        assert run.status == "ok" and run.steps < steps and run.stiff_steps > run.steps / 3
        scaled = (run.q[-1] - origin) / (1000 * length)
        assert scaled / 1000 == pytest.approx(expected, rel=1e-6 if origin else 1e-8)


RESTS = """eomc = 1
name = "{name}"
[coordinates]
x = {{ unit = "m", start = 0.5 }}
[energy]
kinetic = "x_dot**2/2"
potential = "{potential}"
[forces]
x = "{force}"
[run]
tolerance = 1e-9
duration = 300
"""


@pytest.mark.parametrize("options", [{"tol": 1e-4}, {}, {"tol": 1e-12}, {"stiff": True}])
@pytest.mark.parametrize(
    ("name", "potential", "force", "end", "steps"),
    tiers([
        ("sags", "9.81*x + 50*x**2", "-2*x_dot", -0.0981, 2500),
        # at 1e-4 rounding at rest decides: 230 to 760 steps from nine starts
        ("comes_to_rest", "-9.81*cos(x - 0.2)", "-x_dot/2", 0.2, 1000),
        ("lies", "9.81*x", "max(0, -1e6*x - 1e3*x_dot)", -9.81e-6, 500),
        ("lands", "9.81*x + exp(-x/5e-4)/1000", "-10*x_dot*exp(-x/5e-4)", None, 1000),
    ], "comes_to_rest"),
)  # fmt: skip
def test_motion_that_comes_to_rest_takes_few_steps(
    name: str, potential: str, force: str, end: float | None, steps: int, options: dict,
    modules: Modules,
) -> None:  # fmt: skip
    """Regression: at rest a velocity is rounding of the position; steps relative to it were 1e5."""
    text = RESTS.format(name=name, potential=potential, force=force)
    run = modules.unoptimised(text).simulate(**options)
    assert run.status == "ok" and run.steps + run.rejected < steps
    if end is None:  # where exp(-x/L) = 9.81 1000 L
        end = -5e-4 * np.log(9.81 * 0.5)
    assert run.q[-1, 0] == pytest.approx(end, rel=1e-12)


def test_stiff_controller_with_saturation_takes_stiff_steps() -> None:
    text = """eomc = 1
name = "stiffly_held"
[coordinates]
theta = { unit = "rad", start = 0.5 }
[inputs]
torque = { signal = "-1e6*(theta - 0.3*sin(t)) - 1e5*theta_dot", limits = [-1e4, 1e4] }
[energy]
kinetic = "theta_dot**2/2"
potential = "-cos(theta)"
[forces]
theta = "torque"
[run]
tolerance = 1e-6
duration = 10
"""
    module = eomc.load(from_scene(parse(text, "stiffly_held.toml")), BUILDS)
    run = module.simulate()
    assert run.status == "ok" and run.steps < 200 and run.stiff_steps > 10
    assert np.abs(run.x[-1] - module.simulate(tol=1e-9, stiff=True).x[-1]).max() < 1e-5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stiff": "no"}, "stiff: 'no' is not True or False"),
        ({"stiff": True, "h": 0.1}, "max_step and stiff to adaptive ones"),
    ],
)
def test_invalid_values_of_stiff_are_refused(
    train: ModuleType, options: dict, message: str
) -> None:
    for simulate in (train.simulate, train.simulate_batch):
        with pytest.raises(ValueError, match=message):
            simulate(**options)
