"""Adaptive steps: final state, rows at output times, refusals, agreement of both C forms."""

from __future__ import annotations

import math
import pickle
import warnings
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support import cases
from support.session import Modules, tiers

import eomc
from eomc.base.errors import SceneError
from eomc.model.system import System, from_scene
from eomc.runtime.package import model_of
from eomc.runtime.status import STATUS
from eomc.scene.read import parse
from eomc.verify.check import check

pytestmark = pytest.mark.usefixtures("unoptimised_file")
BUILDS = Path(__file__).parents[2] / "build" / "tests" / "adaptive"
PERIOD = 2 * math.pi
KEPLER = """eomc = 1
name = "eccentric"
[coordinates]
x = { unit = "m", start = 0.1 }
y = { unit = "m", rate = 4.358898943540674 }
[parameters]
mu = 1
[inputs]
push = { unit = "N" }
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2"
potential = "-mu/sqrt(x**2 + y**2)"
[forces]
x = "push"
[run]
tolerance = 1e-9
"""


SINGLE = """eomc = 1
name = "single"
[coordinates]
a = { start = 1.0 }
[energy]
kinetic = "a_dot**2/2"
potential = "-cos(a)"
[run]
real = "float"
tolerance = 1e-4
duration = 5
"""


@pytest.fixture(scope="module")
def single() -> ModuleType:
    """A pendulum in single precision."""
    return eomc.load(from_scene(parse(SINGLE, "single.toml")), BUILDS)


@pytest.fixture(scope="module")
def kepler() -> ModuleType:
    """An orbit of eccentricity 0.9 about the origin, from its pericentre, with period 2 pi."""
    return eomc.load(from_scene(parse(KEPLER, "eccentric.toml")), BUILDS)


def test_error_at_end_is_about_the_tolerance(kepler: ModuleType) -> None:
    errors = []
    for tol in (1e-5, 1e-7, 1e-9, 1e-11):
        run = kepler.simulate(tol=tol, duration=PERIOD)
        assert run.status == "ok" and run.t[-1] == PERIOD and run.tol == tol
        errors.append(math.hypot(run.q[-1, 0] - 0.1, run.q[-1, 1]))
        assert errors[-1] < 10 * tol
    assert errors[0] > 100 * errors[-1]


def test_steps_are_short_where_motion_is_fast(kepler: ModuleType) -> None:
    run = kepler.simulate(duration=PERIOD)
    assert run.tol == 1e-9 and len(run) == run.steps + 1 <= 40
    steps, distance = np.diff(run.t), np.hypot(*run.q.T)
    assert steps[distance[:-1] < 0.3].max() < steps[distance[:-1] > 1.5].min() / 5
    assert run.evaluations < 1500 and run.rejected < run.steps / 4


def test_rows_at_output_times_equal_ends_of_separate_runs(kepler: ModuleType) -> None:
    times = np.array([0.0, 0.01, 0.5, 3.3, 3.4, 6.0])
    run = kepler.simulate(tol=1e-12, times=times)
    full_run = kepler.simulate(tol=1e-12, duration=6.0)
    assert run.t.tolist() == times.tolist() and run.q.shape == (6, 2)
    assert run.steps == full_run.steps and np.array_equal(run.q[-1], full_run.q[-1])
    assert run.q[0].tolist() == [0.1, 0.0]
    for row, t in zip(run.q[1:], times[1:], strict=True):
        reference = kepler.simulate(tol=1e-12, duration=t)
        assert row == pytest.approx(reference.q[-1], abs=1e-11)


def test_run_split_into_several_calls_is_identical(
    kepler: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = kepler.simulate(duration=50.0)
    module = __import__(f"{kepler.__name__}._runtime.integration", fromlist=["integration"])
    monkeypatch.setattr(module, "FIRST_CALL_STEPS", 1)
    monkeypatch.setattr(module, "MAX_STEPS_PER_CALL", 3)
    monkeypatch.setattr(model_of(kepler).integrator, "room", 0)
    repeated = kepler.simulate(duration=50.0)
    assert repeated == run and np.array_equal(repeated.t, run.t) and repeated.steps == run.steps
    assert pickle.loads(pickle.dumps(run)) == run


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"q0": [0.2, 0.1]},
        {"qd0": (0.5, 3.0)},
        {"params": {"mu": 2.0}, "t0": 1.5},
        {"u": 0.01},
        {"u": np.array([0.01])},
    ],
    ids=["plain", "q0", "qd0", "params", "u", "array"],
)
def test_run_in_one_call_equals_run_with_progress(kepler: ModuleType, options: dict) -> None:
    """Compare the fast path of repeated short runs with the general path."""
    kepler.simulate(duration=PERIOD)  # stores the number of steps
    fast = kepler.simulate(duration=PERIOD, tol=1e-8, **options)
    assert 0 < fast.steps + 1 <= model_of(kepler).integrator.room
    general = kepler.simulate(
        duration=PERIOD, tol=1e-8, **options, progress=lambda finished, total: None
    )
    assert fast == general and fast.message == general.message
    assert fast.evaluations == general.evaluations and fast.h == general.h
    assert np.array_equal(fast(options.get("t0", 0.0) + 0.3), general(options.get("t0", 0.0) + 0.3))


@pytest.mark.parametrize("u", [np.array([1 + 2j]), np.array(["1"]), np.array([math.nan])])
def test_fast_path_refuses_invalid_inputs_like_general_path(
    kepler: ModuleType, u: np.ndarray
) -> None:
    kepler.simulate(duration=PERIOD)
    with pytest.raises(ValueError, match=r"^u: "):
        kepler.simulate(duration=PERIOD, u=u)


def test_first_step_respects_maximum_step_size(kepler: ModuleType) -> None:
    """Far away and at rest nothing else limits the first step."""
    options = {"q0": [1e3, 0.0], "qd0": [0.0, 0.0], "params": {"mu": 1e-12}}
    run = kepler.simulate(duration=100.0, max_step=0.01, **options)
    assert np.diff(run.t).max() <= 0.01 * (1 + 1e-9)
    assert np.diff(kepler.simulate(duration=100.0, **options).t)[0] > 0.05


@pytest.mark.parametrize("end", [1e10, 1e15, 1e300])
def test_distant_end_time_changes_no_step(kepler: ModuleType, end: float) -> None:
    def interrupt(finished: int, total: int) -> None:
        raise KeyboardInterrupt

    short_run = kepler.simulate(duration=1e3)
    with pytest.raises(kepler.Interrupted) as interruption:
        kepler.simulate(duration=end, progress=interrupt)
    run = interruption.value.run
    n_common = min(len(run), len(short_run)) - 2
    assert n_common > 20 and np.array_equal(run.t[:n_common], short_run.t[:n_common])
    assert np.array_equal(run.q[:n_common], short_run.q[:n_common])


def test_run_with_more_steps_than_previous_run_is_complete(kepler: ModuleType) -> None:
    kepler.simulate(duration=0.1)
    n_rows = model_of(kepler).integrator.room
    run = kepler.simulate(duration=20 * PERIOD)
    assert run.steps > n_rows and run.t[-1] == 20 * PERIOD
    assert run == kepler.simulate(duration=20 * PERIOD)


def test_run_in_one_call_is_unaffected_by_other_threads(
    kepler: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another thread whose run stops now shrinks the buffer of later runs, not of this one."""
    run, model = kepler.simulate(q0=[0.2, 0.0], duration=1.0), model_of(kepler)

    class Library:
        """The functions of C; while one runs, the other thread's run stops."""

        lib = model.c.lib

        def __getattr__(self, name: str) -> object:
            model.integrator.room = 0
            return getattr(self.lib, name)

    monkeypatch.setattr(model.c, "lib", Library())
    assert model.integrator.room and kepler.simulate(q0=[0.2, 0.0], duration=1.0) == run
    assert model.integrator.room == 0  # the general path would have set it again


def test_run_in_one_call_refuses_invalid_arguments(kepler: ModuleType) -> None:
    kepler.simulate(duration=1)
    for arguments, message in (
        ({"tol": 0.1}, "give one between"),
        ({"duration": -1.0}, "not a time"),
        ({"q0": [[0.1, 0.2]]}, "q0"),
        ({"qd0": [math.nan, 1.0]}, "qd0"),
        ({"t0": math.inf}, "t0"),
    ):
        with pytest.raises(ValueError, match=message):
            kepler.simulate(**arguments)
    with pytest.warns(RuntimeWarning, match="stopped at"):
        assert kepler.simulate(q0=[0.0, 0.0], qd0=[0.0, 0.0], duration=1).status != "ok"


def test_run_ends_at_time_rounded_to_single_precision(single: ModuleType) -> None:
    """0.7 s is later than the nearest float, 0.3 s is earlier."""
    for n_rows in (0, 48):
        for t0, duration in ((0.0, 0.7), (0.0, 0.3), (0.7, 0.0), (0.1, 0.6)):
            model_of(single).integrator.room = n_rows
            run = single.simulate(duration=duration, t0=t0)
            assert run.status == "ok" and run.t[-1] == np.float32(t0 + duration)


def test_interpolated_states_equal_ends_of_separate_runs(kepler: ModuleType) -> None:
    run = kepler.simulate(tol=1e-12, duration=PERIOD)
    times = np.array([[0.0, 3.0, 0.05], [PERIOD, 1.7, 3.0]])
    q, qd = run(times)
    assert q.shape == qd.shape == (2, 3, 2)
    for index in np.ndindex(2, 3):
        reference = kepler.simulate(tol=1e-13, duration=times[index])
        assert q[index] == pytest.approx(reference.q[-1], abs=2e-11)
        assert qd[index] == pytest.approx(reference.qd[-1], abs=2e-10)
    assert run(0.0)[0].tolist() == [0.1, 0.0] and run(3.0)[0].shape == (2,)
    with pytest.raises(ValueError, match=r"t: the run goes from 0 s to 6.28"):
        run(7.0)


def test_curves_and_sections_interpolate_within_long_steps(kepler: ModuleType) -> None:
    run = kepler.simulate(duration=3.0)
    n_rows, fine = len(run), run.curve_run
    assert n_rows < 100 and len(fine) >= 1000 and len(run) == n_rows
    assert np.isin(run.t, fine.t).all()
    assert np.allclose(fine["energy"], run.energy[0], rtol=1e-7)
    times = run.section("x")["t"]
    assert len(times) and np.abs(run(times)[0][:, 0]).max() < 1e-6
    dense_run = kepler.simulate(times=np.linspace(0, 3, 2000))
    assert dense_run.curve_run is dense_run


def test_section_is_as_accurate_as_the_steps(kepler: ModuleType) -> None:
    run = kepler.simulate(tol=1e-12, duration=3 * PERIOD)
    section = run.section("y", rising=False)  # at the apocentre, half a period later
    assert section["t"] == pytest.approx(PERIOD * np.array([0.5, 1.5, 2.5]), abs=1e-9)
    assert section["x"] == pytest.approx([-1.9] * 3, abs=1e-9)
    assert np.abs(section["y"]).max() < 1e-12
    assert [len(x) for x in run.section("x", 9.0).values()] == [0] * len(section)


@pytest.mark.parametrize("every", [1, 7])
def test_interpolation_of_fixed_steps_has_their_order(driven: ModuleType, every: int) -> None:
    times, errors = np.linspace(0.0, 1.0, 23), []
    exact = driven.simulate(h=1e-4, duration=1.0, u=[0.3])(times)
    for h in (0.02, 0.01):
        run = driven.simulate(h=h, duration=1.0, every=every, u=[0.3])
        errors.append(np.abs(np.array(run(times)) - exact).max())
    assert 1e-12 < errors[1] < errors[0] / 10


def test_saved_run_is_loaded_unchanged(kepler: ModuleType, tmp_path: Path) -> None:
    run = kepler.simulate(duration=2.0)
    run.save(tmp_path / "run.npz")
    loaded = kepler.load_run(tmp_path / "run.npz")
    assert (
        loaded == run and loaded.tol == run.tol and loaded(1.0)[0].tolist() == run(1.0)[0].tolist()
    )


def test_error_estimate_is_close_to_the_true_error(kepler: ModuleType) -> None:
    run = kepler.simulate(tol=1e-6, duration=5 * PERIOD, estimate=True)
    true_error = abs(run.q[-1] - [0.1, 0.0])
    assert run.error.resolved and run.error.order == 16
    assert np.all(run.error.q[-1] < 3 * true_error + 1e-12) and np.all(
        run.error.q[-1] > true_error / 3
    )
    assert run.error.amplification > 10


def test_error_is_estimated_at_the_smallest_tolerance(kepler: ModuleType) -> None:
    """No finer tolerance exists: the same steps differ by nothing, yet rounding is 1e-11."""
    run = kepler.simulate(tol=1e-15, duration=5 * PERIOD)
    true_error = abs(run.q[-1] - [0.1, 0.0]).max()
    assert true_error / 10 < max(run.estimate().end.values()) < 100 * true_error + 1e-13


def test_perturbed_start_near_a_centre_takes_few_steps(
    kepler: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: a perturbation beyond the centre led to an orbit of 1e7 revolutions."""
    q0, speed = 1e-6, math.sqrt((2 - 1e-6) / 1e-6)
    original, steps = kepler.simulate([q0, 0], [0, speed], duration=6.0, tol=1e-10), []

    integrate = model_of(kepler).integrator.integrate

    def record(*arguments: object) -> object:
        steps.append(integrate(*arguments))
        return steps[-1]

    monkeypatch.setattr(model_of(kepler).integrator, "integrate", record)
    original.estimate()
    assert max(run.steps for run in steps) < 1_000_000


def test_pulse_between_steps_is_reported_by_the_error_estimate(modules: Modules) -> None:
    text = SINGLE.replace("-cos(a)", "a**2/2").replace('real = "float"', "").replace("= 5", "= 60")
    text = text.replace("single", "pulsed").replace("a = { start = 1.0 }", "a = {}")
    text = text.replace("[run]", '[forces]\na = "exp(-((t - 50)/0.01)**2)/0.01"\n[run]')
    run = modules.unoptimised(text).simulate(tol=1e-9)
    assert abs(run.q[-1, 0]) == 0  # no node lies within the pulse
    with pytest.warns(RuntimeWarning, match="exceeds a tenth of the motion"):
        error = run.estimate().end["a"]
    assert error == pytest.approx(math.sqrt(math.pi) * abs(math.sin(10)), rel=1e-4)


def test_constant_inputs_act_in_adaptive_steps(kepler: ModuleType) -> None:
    without_input, with_input = (kepler.simulate(duration=1.0, u=[u]) for u in (0.0, 0.1))
    fixed = kepler.simulate(h=1e-4, duration=1.0, u=[0.1])
    assert with_input.q[-1] == pytest.approx(fixed.q[-1], abs=1e-8)
    assert abs(without_input.q[-1, 0] - with_input.q[-1, 0]) > 1e-3 and with_input.u[-1] == [0.1]


def test_steps_respect_maximum_step_size(kepler: ModuleType) -> None:
    run = kepler.simulate(duration=PERIOD, max_step=0.05)
    assert np.diff(run.t).max() <= 0.05 * (1 + 1e-12) and run.steps > 120


@pytest.mark.parametrize("tol", [1e-4, 1e-6, 1e-9, 1e-10, 1e-12, 1e-14])
def test_fall_into_a_centre_ends_at_the_singularity(kepler: ModuleType, tol: float) -> None:
    """Regression: below the resolution of time the fit of step sizes was 0/0; steps jumped over."""
    for transverse in (0.0, 1e-9):
        with pytest.warns(RuntimeWarning, match="forces grow without end"):
            run = kepler.simulate([1, 0], [0, transverse], duration=3, tol=tol)
        assert run.status == "no convergence"
        assert run.t[-1] == pytest.approx(math.pi / math.sqrt(8), rel=1e-6)
        assert abs(run.q[-1]).max() < 1e-4


def test_run_into_a_singularity_stops_and_reports_the_time(kepler: ModuleType) -> None:
    with pytest.warns(RuntimeWarning, match="stopped at t = 0.03"):
        run = kepler.simulate(q0=[0.1, 0], qd0=[0, 0], duration=1.0)  # straight into the centre
    assert run.status in ("not finite", "no convergence")
    assert run.t[-1] == pytest.approx(math.pi * math.sqrt(0.1**3 / 8), rel=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tol": 1e-16}, "tol: 1e-16: give one between 1e-15 and 0.01"),
        ({"tol": 1}, "tol: 1: give one between"),
        ({"tol": 1e-6, "q0": [1]}, "q0: shape (1,), expected (2,): x, y"),
        (
            {"qd0": [[0, 1]]},
            "qd0: shape (1, 2), expected one state, (2,): x, y; simulate_batch takes many",
        ),
        ({"tol": "x"}, "tol: 'x' is not a number"),
        ({"tol": 1e-6, "h": 0.1}, "h: belongs to fixed steps"),
        ({"tol": 1e-6, "every": 2}, "every: belongs to fixed steps; tol, max_step and stiff"),
        ({"every": 2}, "eccentric goes by its tolerance, 1e-09, where nothing is said: give h too"),
        ({"tol": 1e-6, "times": [1.0, 0.5]}, "times: expected ascending times from t0"),
        ({"tol": 1e-6, "times": [-1.0]}, "times: expected ascending times from t0 = 0 s"),
        ({"tol": 1e-6, "times": []}, "times: expected a row of finite numbers"),
        ({"tol": 1e-6, "times": [1.1], "duration": 1.0}, "times: 1.1 s is behind the end of"),
        ({"tol": 1e-6, "duration": -1.0}, "duration: -1 is not a time"),
        ({"tol": 1e-6, "max_step": 0}, "max_step: 0 is not a step size"),
    ],
)
def test_invalid_arguments_of_adaptive_runs_are_refused(
    kepler: ModuleType, options: dict, message: str
) -> None:
    with pytest.raises(ValueError) as error:
        kepler.simulate(**options)
    assert message in str(error.value)


def test_start_time_that_is_not_finite_is_refused(kepler: ModuleType) -> None:
    model = model_of(kepler)
    null, p, x = model.c.null, model.c.pointer(model.info.p0), np.array([0.1, 0, 0, 4.0])
    state = model.c.pointer(x[:2]), model.c.pointer(x[2:])
    for start in (math.nan, math.inf):
        options = model.c.ffi.new("run_options *", {"t0": start, "t_end": 1.0, "tol": 1e-9})
        options.steps, work = 10, model.c.ffi.new("run_work *")
        output = model.c.ffi.addressof(work, "output")
        status = model.c.lib.integrate(
            options, output, work, *state, null, 0, null, 0, p, null, null, null
        )
        assert (status, output.rows, output.steps) == (STATUS.index("not finite"), 0, 0)
        assert list(work.x) == x.tolist()


def test_method_auto_selects_adaptive_steps(kepler: ModuleType, cartpole: ModuleType) -> None:
    run, default = kepler.simulate(method="auto", duration=1.0), kepler.simulate(duration=1.0)
    assert run.tol == model_of(kepler).info.tolerance and np.array_equal(run.q, default.q)
    assert kepler.simulate(method="auto", tol=1e-6, duration=1.0).steps < run.steps
    with pytest.raises(ValueError, match="built without adaptive steps"):
        cartpole.simulate(method="auto")
    text = (cases.SCENES / "cartpole.toml").read_text(encoding="utf-8")
    for method, methods in (('"auto"', ("rk4",)), ('["auto", "dp8"]', ("dp8",))):
        settings = parse(text.replace("[run]", f"[run]\nmethod = {method}")).run
        assert (settings.methods, settings.tolerance) == (methods, 1e-9)
    settings = System.make("free", ["x"], "x_dot**2/2", methods="auto").run
    assert (settings.methods, settings.tolerance) == (("rk4",), 1e-9)


def test_tolerance_is_refused_where_scene_has_none(cartpole: ModuleType) -> None:
    with pytest.raises(
        ValueError,
        match=r"tol: cartpole was built without adaptive steps.* \[run\] tolerance = 1e-9",
    ):
        cartpole.simulate(tol=1e-9)
    assert not hasattr(model_of(cartpole).c.lib, "adaptive")


@pytest.mark.parametrize("value", ["0", "1", "1e-16", '"1e-9"', "true"])
def test_tolerance_outside_its_range_is_refused(value: str) -> None:
    with pytest.raises(SceneError, match="tolerance"):
        parse(KEPLER.replace("1e-9", value), "eccentric.toml")


NAMES = ("double_pendulum_regular", "cartpole_drop_tutorialP", "pleiades", "gimbal_near_lock_1e-3")


@pytest.mark.parametrize("name", tiers(NAMES, NAMES[0]))
def test_hard_cases_meet_the_reference(name: str) -> None:
    text = cases.scene_text(name).replace("[run]", "[run]\ntolerance = 1e-9")
    module = eomc.load(from_scene(parse(text, f"{name}.toml")), BUILDS)
    scale = max(1.0, *(abs(float(x)) for x in cases.cases()[name]["q_ref"]))
    for tol in (1e-6, 1e-9):
        assert cases.error_of(name, module.simulate(tol=tol).q[-1]) < 10 * tol * scale


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["double_pendulum", "heavy_top", "furuta_pendulum", "chain"])
@pytest.mark.parametrize("real", ["double", "float"])
def test_check_compares_both_c_forms_with_the_reference(scene: str, real: str) -> None:
    tol = {"double": "1e-9", "float": "1e-5"}[real]
    name = f"{scene}_{real}_fits"
    path = cases.variant(
        scene, name, tolerance=tol, **({"real": '"float"'} if real == "float" else {})
    )
    system = eomc.read(path)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        plain = eomc.load(system, BUILDS, form="plain")
        report = check(system, eomc.load(system, BUILDS), plain=plain, states=4)
    rows = [row for row in report.results if "adaptive" in row.name]
    assert len(rows) == 3 and all(row.passed for row in rows), rows  # each of both forms


def test_portable_form_has_adaptive_and_fixed_steps(tmp_path: Path) -> None:
    scene = tmp_path / "swing.toml"
    scene.write_text(
        'eomc = 1\nname = "swing"\n[coordinates]\na = { start = 1.0 }\n'
        '[energy]\nkinetic = "a_dot**2/2"\npotential = "-cos(a)"\n'
        '[run]\nmethod = ["gauss16", "gauss4"]\ntolerance = 1e-9\nh = 0.1\nduration = 2\n',
        encoding="utf-8",
    )
    plain = eomc.load(scene, tmp_path, form="plain")
    adaptive, fixed = plain.simulate(), plain.simulate(h=0.1)
    np.testing.assert_allclose(adaptive.q[-1], fixed.q[-1], atol=1e-8)


def test_error_of_run_in_single_precision_is_estimated(single: ModuleType) -> None:
    run, fine = single.simulate(), single.simulate(tol=1e-6)
    assert not run.estimate().verdict
    assert 1e-8 < run.estimate().end["a"] < 1e-3
    assert abs(run.q[-1, 0] - fine.q[-1, 0]) < 1e-3
