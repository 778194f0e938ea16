"""Adaptive steps: their end, rows at times, what they refuse, and that both forms of C agree."""

from __future__ import annotations

import math
import pickle
import warnings
from pathlib import Path
from types import ModuleType

import cases
import numpy as np
import pytest
from conftest import Modules, tiers

import eomc
from eomc.base.errors import SceneError
from eomc.model.from_scene import from_scene
from eomc.model.system import System
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
    """An orbit of eccentricity 0.9 about the origin, from its nearest point, period 2 pi."""
    return eomc.load(from_scene(parse(KEPLER, "eccentric.toml")), BUILDS)


def test_the_end_errs_by_about_the_tolerance(kepler: ModuleType) -> None:
    errors = []
    for tol in (1e-5, 1e-7, 1e-9, 1e-11):
        run = kepler.simulate(tol=tol, duration=PERIOD)
        assert run.status == "ok" and run.t[-1] == PERIOD and run.tol == tol
        errors.append(math.hypot(run.q[-1, 0] - 0.1, run.q[-1, 1]))
        assert errors[-1] < 10 * tol
    assert errors[0] > 100 * errors[-1]


def test_steps_are_short_where_the_motion_is_fast(kepler: ModuleType) -> None:
    run = kepler.simulate(duration=PERIOD)
    assert run.tol == 1e-9 and len(run) == run.steps + 1 <= 40
    steps, far = np.diff(run.t), np.hypot(*run.q.T)
    assert steps[far[:-1] < 0.3].max() < steps[far[:-1] > 1.5].min() / 5
    assert run.evaluations < 1500 and run.rejected < run.steps / 4


def test_rows_at_times_are_those_of_runs_that_end_there(kepler: ModuleType) -> None:
    times = np.array([0.0, 0.01, 0.5, 3.3, 3.4, 6.0])
    run = kepler.simulate(tol=1e-12, times=times)
    whole = kepler.simulate(tol=1e-12, duration=6.0)
    assert run.t.tolist() == times.tolist() and run.q.shape == (6, 2)
    assert run.steps == whole.steps and np.array_equal(run.q[-1], whole.q[-1])
    assert run.q[0].tolist() == [0.1, 0.0]
    for row, t in zip(run.q[1:], times[1:], strict=True):
        ended = kepler.simulate(tol=1e-12, duration=t)
        assert row == pytest.approx(ended.q[-1], abs=1e-11)


def test_a_run_is_the_same_in_pieces(kepler: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    run = kepler.simulate(duration=50.0)
    module = __import__(f"{kepler.__name__}._runtime.adaptive", fromlist=["adaptive"])
    monkeypatch.setattr(module, "_FIRST_CALL_STEPS", 1)
    monkeypatch.setattr(module, "_MAX_STEPS_PER_CALL", 3)
    monkeypatch.setattr(kepler._model.integrator, "room", 0)
    again = kepler.simulate(duration=50.0)
    assert again == run and np.array_equal(again.t, run.t) and again.steps == run.steps
    assert pickle.loads(pickle.dumps(run)) == run


@pytest.mark.parametrize(
    "how",
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
def test_a_run_in_one_call_is_the_same(kepler: ModuleType, how: dict) -> None:
    """The way of what is asked again and again, beside the one that takes all questions."""
    kepler.simulate(duration=PERIOD)  # how many steps there are
    quick = kepler.simulate(duration=PERIOD, tol=1e-8, **how)
    assert 0 < quick.steps + 1 <= kepler._model.integrator.room
    long = kepler.simulate(duration=PERIOD, tol=1e-8, **how, progress=lambda done, of: None)
    assert quick == long and quick.message == long.message
    assert quick.evaluations == long.evaluations and quick.h == long.h
    assert np.array_equal(quick(how.get("t0", 0.0) + 0.3), long(how.get("t0", 0.0) + 0.3))


@pytest.mark.parametrize("u", [np.array([1 + 2j]), np.array(["1"]), np.array([math.nan])])
def test_the_short_way_refuses_what_the_long_one_does(kepler: ModuleType, u: np.ndarray) -> None:
    kepler.simulate(duration=PERIOD)
    with pytest.raises(ValueError, match=r"^u: "):
        kepler.simulate(duration=PERIOD, u=u)


def test_the_first_step_is_no_longer_than_asked(kepler: ModuleType) -> None:
    """Far away and at rest nothing else bounds it."""
    far = {"q0": [1e3, 0.0], "qd0": [0.0, 0.0], "params": {"mu": 1e-12}}
    run = kepler.simulate(duration=100.0, h_most=0.01, **far)
    assert np.diff(run.t).max() <= 0.01 * (1 + 1e-9)
    assert np.diff(kepler.simulate(duration=100.0, **far).t)[0] > 0.05


@pytest.mark.parametrize("end", [1e10, 1e15, 1e300])
def test_a_distant_end_changes_no_step(kepler: ModuleType, end: float) -> None:
    def enough(done: int, whole: int) -> None:
        raise KeyboardInterrupt

    near = kepler.simulate(duration=1e3)
    with pytest.raises(kepler.Interrupted) as stopped:
        kepler.simulate(duration=end, progress=enough)
    run = stopped.value.run
    both = min(len(run), len(near)) - 2
    assert both > 20 and np.array_equal(run.t[:both], near.t[:both])
    assert np.array_equal(run.q[:both], near.q[:both])


def test_a_run_of_more_steps_than_the_last_is_whole(kepler: ModuleType) -> None:
    kepler.simulate(duration=0.1)
    room = kepler._model.integrator.room
    run = kepler.simulate(duration=20 * PERIOD)
    assert run.steps > room and run.t[-1] == 20 * PERIOD
    assert run == kepler.simulate(duration=20 * PERIOD)


def test_a_run_in_one_call_has_its_room_whatever_others_do(
    kepler: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thread whose run stops meanwhile takes the room of the next ones away, not of this one."""
    run, model = kepler.simulate(q0=[0.2, 0.0], duration=1.0), kepler._model

    def meanwhile(x0: object, name: str) -> object:
        model.integrator.room = 0
        return type(model.arguments).initial_half(model.arguments, x0, name)

    monkeypatch.setattr(model.arguments, "initial_half", meanwhile, raising=False)
    assert model.integrator.room and kepler.simulate(q0=[0.2, 0.0], duration=1.0) == run
    assert model.integrator.room == 0  # the long way would have found it anew


def test_a_run_in_one_call_refuses_the_same(kepler: ModuleType) -> None:
    kepler.simulate(duration=1)
    for wrong, words in (
        ({"tol": 0.1}, "give one between"),
        ({"duration": -1.0}, "not a time"),
        ({"q0": [[0.1, 0.2]]}, "q0"),
        ({"qd0": [math.nan, 1.0]}, "qd0"),
        ({"t0": math.inf}, "t0"),
    ):
        with pytest.raises(ValueError, match=words):
            kepler.simulate(**wrong)
    with pytest.warns(RuntimeWarning, match="stopped at"):
        assert kepler.simulate(q0=[0.0, 0.0], qd0=[0.0, 0.0], duration=1).status != "ok"


def test_a_run_ends_at_a_time_that_single_precision_rounds(single: ModuleType) -> None:
    """0.7 s is later than the float next to it, 0.3 s earlier."""
    for room in (0, 48):
        for t0, duration in ((0.0, 0.7), (0.0, 0.3), (0.7, 0.0), (0.1, 0.6)):
            single._model.integrator.room = room
            run = single.simulate(duration=duration, t0=t0)
            assert run.status == "ok" and run.t[-1] == np.float32(t0 + duration)


def test_a_run_tells_the_state_at_any_time(kepler: ModuleType) -> None:
    run = kepler.simulate(tol=1e-12, duration=PERIOD)
    times = np.array([[0.0, 3.0, 0.05], [PERIOD, 1.7, 3.0]])
    q, qd = run(times)
    assert q.shape == qd.shape == (2, 3, 2)
    for at in np.ndindex(2, 3):
        ended = kepler.simulate(tol=1e-13, duration=times[at])
        assert q[at] == pytest.approx(ended.q[-1], abs=2e-11)
        assert qd[at] == pytest.approx(ended.qd[-1], abs=2e-10)
    assert run(0.0)[0].tolist() == [0.1, 0.0] and run(3.0)[0].shape == (2,)
    with pytest.raises(ValueError, match=r"t: the run goes from 0 s to 6.28"):
        run(7.0)


def test_curves_and_sections_have_states_between_long_steps(kepler: ModuleType) -> None:
    run = kepler.simulate(duration=3.0)
    coarse, fine = len(run), run.curve_run
    assert coarse < 100 and len(fine) >= 1000 and len(run) == coarse
    assert np.isin(run.t, fine.t).all()
    assert np.allclose(fine["energy"], run.energy[0], rtol=1e-7)
    at = run.section("x")["t"]
    assert len(at) and np.abs(run(at)[0][:, 0]).max() < 1e-6
    held = kepler.simulate(times=np.linspace(0, 3, 2000))
    assert held.curve_run is held


def test_a_section_is_as_exact_as_the_steps(kepler: ModuleType) -> None:
    run = kepler.simulate(tol=1e-12, duration=3 * PERIOD)
    found = run.section("y", rising=False)  # at the farthest point, half a period on
    assert found["t"] == pytest.approx(PERIOD * np.array([0.5, 1.5, 2.5]), abs=1e-9)
    assert found["x"] == pytest.approx([-1.9] * 3, abs=1e-9)
    assert np.abs(found["y"]).max() < 1e-12
    assert [len(x) for x in run.section("x", 9.0).values()] == [0] * len(found)


@pytest.mark.parametrize("every", [1, 7])
def test_fixed_steps_tell_it_to_their_order(driven: ModuleType, every: int) -> None:
    times, errors = np.linspace(0.0, 1.0, 23), []
    exact = driven.simulate(h=1e-4, duration=1.0, u=[0.3])(times)
    for h in (0.02, 0.01):
        run = driven.simulate(h=h, duration=1.0, every=every, u=[0.3])
        errors.append(np.abs(np.array(run(times)) - exact).max())
    assert 1e-12 < errors[1] < errors[0] / 10


def test_a_saved_run_is_read_again(kepler: ModuleType, tmp_path: Path) -> None:
    run = kepler.simulate(duration=2.0)
    run.save(tmp_path / "run.npz")
    again = kepler.load_run(tmp_path / "run.npz")
    assert again == run and again.tol == run.tol and again(1.0)[0].tolist() == run(1.0)[0].tolist()


def test_its_error_is_found(kepler: ModuleType) -> None:
    run = kepler.simulate(tol=1e-6, duration=5 * PERIOD, estimate=True)
    true = abs(run.q[-1] - [0.1, 0.0])
    assert run.error.resolved and run.error.order == 16
    assert np.all(run.error.q[-1] < 3 * true + 1e-12) and np.all(run.error.q[-1] > true / 3)
    assert run.error.amplification > 10


def test_the_error_at_the_least_tolerance_is_found(kepler: ModuleType) -> None:
    """No finer run is there: beside the same steps none was seen, where rounding is 1e-11."""
    run = kepler.simulate(tol=1e-15, duration=5 * PERIOD)
    true = abs(run.q[-1] - [0.1, 0.0]).max()
    assert true / 10 < max(run.estimate().end.values()) < 100 * true + 1e-13


def test_a_moved_start_may_be_another_motion(kepler: ModuleType) -> None:
    """Moved by more than it is away from the centre: it went round there 1e7 times."""
    made = __import__(f"{kepler.__name__}._runtime.adaptive_error", fromlist=["adaptive_error"])
    q0, speed = 1e-6, math.sqrt((2 - 1e-6) / 1e-6)
    own, steps = kepler.simulate([q0, 0], [0, speed], duration=6.0, tol=1e-10), []

    def counted(*given: object) -> object:
        steps.append(run(*given))
        return steps[-1]

    run = __import__(f"{kepler.__name__}._runtime.adaptive", fromlist=["adaptive"]).run
    made.error_by_tighter_tolerance(own, counted, None)
    assert max(run.steps for run in steps) < 1_000_000


def test_a_pulse_that_steps_miss_is_told(modules: Modules) -> None:
    text = SINGLE.replace("-cos(a)", "a**2/2").replace('real = "float"', "").replace("= 5", "= 60")
    text = text.replace("single", "pulsed").replace("a = { start = 1.0 }", "a = {}")
    text = text.replace("[run]", '[forces]\na = "exp(-((t - 50)/0.01)**2)/0.01"\n[run]')
    run = modules.unoptimised(text).simulate(tol=1e-9)
    assert abs(run.q[-1, 0]) == 0  # what comes and goes between two nodes is not seen
    with pytest.warns(RuntimeWarning, match="exceeds a tenth of the motion"):
        error = run.estimate().end["a"]
    assert error == pytest.approx(math.sqrt(math.pi) * abs(math.sin(10)), rel=1e-4)


def test_held_inputs_act(kepler: ModuleType) -> None:
    one, other = (kepler.simulate(duration=1.0, u=[u]) for u in (0.0, 0.1))
    fixed = kepler.simulate(h=1e-4, duration=1.0, u=[0.1])
    assert other.q[-1] == pytest.approx(fixed.q[-1], abs=1e-8)
    assert abs(one.q[-1, 0] - other.q[-1, 0]) > 1e-3 and other.u[-1] == [0.1]


def test_no_step_is_longer_than_asked(kepler: ModuleType) -> None:
    run = kepler.simulate(duration=PERIOD, h_most=0.05)
    assert np.diff(run.t).max() <= 0.05 * (1 + 1e-12) and run.steps > 120


@pytest.mark.parametrize("tol", [1e-4, 1e-6, 1e-9, 1e-10, 1e-12, 1e-14])
def test_a_fall_into_a_centre_ends_there(kepler: ModuleType, tol: float) -> None:
    """Steps shrink below what time resolves: their line of sizes was 0/0, the next to the end."""
    for sideways in (0.0, 1e-9):
        with pytest.warns(RuntimeWarning, match="forces grow without end"):
            run = kepler.simulate([1, 0], [0, sideways], duration=3, tol=tol)
        assert run.status == "no convergence"
        assert run.t[-1] == pytest.approx(math.pi / math.sqrt(8), rel=1e-6)
        assert abs(run.q[-1]).max() < 1e-4


def test_a_motion_into_a_singularity_stops_and_says_where(kepler: ModuleType) -> None:
    with pytest.warns(RuntimeWarning, match="stopped at t = 0.03"):
        run = kepler.simulate(q0=[0.1, 0], qd0=[0, 0], duration=1.0)  # straight into the centre
    assert run.status in ("not finite", "no convergence")
    assert run.t[-1] == pytest.approx(math.pi * math.sqrt(0.1**3 / 8), rel=1e-3)


@pytest.mark.parametrize(
    ("how", "words"),
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
        ({"tol": 1e-6, "every": 2}, "every: belongs to fixed steps; tol, h_most and stiff"),
        ({"every": 2}, "eccentric goes by its tolerance, 1e-09, where nothing is said: give h too"),
        ({"tol": 1e-6, "times": [1.0, 0.5]}, "times: expected ascending times from t0"),
        ({"tol": 1e-6, "times": [-1.0]}, "times: expected ascending times from t0 = 0 s"),
        ({"tol": 1e-6, "times": []}, "times: expected a row of finite numbers"),
        ({"tol": 1e-6, "times": [1.1], "duration": 1.0}, "times: 1.1 s is behind the end of"),
        ({"tol": 1e-6, "duration": -1.0}, "duration: -1 is not a time"),
        ({"tol": 1e-6, "h_most": 0}, "h_most: 0 is not a step size"),
    ],
)
def test_what_makes_no_sense_is_refused(kepler: ModuleType, how: dict, words: str) -> None:
    with pytest.raises(ValueError) as fault:
        kepler.simulate(**how)
    assert words in str(fault.value)


def test_a_time_that_is_none_is_refused(kepler: ModuleType) -> None:
    model = kepler._model
    null = model.c.tools[2]
    for wrong in (math.nan, math.inf):
        work, x = model.c.ffi.new("adaptive_work *"), np.array([0.1, 0, 0, 4.0])
        t = np.array([wrong])
        status = model.c.lib.adaptive(
            model.c.pointer(x), model.c.pointer(t), 1.0, 1e-9, 0.0, null, 10, null, 0, null, null,
            null, model.c.pointer(model.info.p0), work,
        )  # fmt: skip
        assert (status, work.rows, work.steps) == (STATUS.index("not finite"), 0, 0)
        assert x.tolist() == [0.1, 0, 0, 4.0]


def test_auto_is_by_a_tolerance(kepler: ModuleType, cartpole: ModuleType) -> None:
    run, same = kepler.simulate(method="auto", duration=1.0), kepler.simulate(duration=1.0)
    assert run.tol == kepler._model.info.tolerance and np.array_equal(run.q, same.q)
    assert kepler.simulate(method="auto", tol=1e-6, duration=1.0).steps < run.steps
    with pytest.raises(ValueError, match="built without adaptive steps"):
        cartpole.simulate(method="auto")
    text = (cases.SCENES / "cartpole.toml").read_text(encoding="utf-8")
    for method, methods in (('"auto"', ("rk4",)), ('["auto", "dp8"]', ("dp8",))):
        made = parse(text.replace("[run]", f"[run]\nmethod = {method}")).run
        assert (made.methods, made.tolerance) == (methods, 1e-9)
    made = System.make("free", ["x"], "x_dot**2/2", methods="auto").run
    assert (made.methods, made.tolerance) == (("rk4",), 1e-9)


def test_without_tolerance_nothing_is_built(cartpole: ModuleType) -> None:
    with pytest.raises(
        ValueError,
        match=r"tol: cartpole was built without adaptive steps.* \[run\] tolerance = 1e-9",
    ):
        cartpole.simulate(tol=1e-9)
    assert not hasattr(cartpole._model.c.lib, "adaptive")


@pytest.mark.parametrize("given", ["0", "1", "1e-16", '"1e-9"', "true"])
def test_a_tolerance_is_a_small_number(given: str) -> None:
    with pytest.raises(SceneError, match="tolerance"):
        parse(KEPLER.replace("1e-9", given), "eccentric.toml")


NAMES = ("double_pendulum_regular", "cartpole_drop_tutorialP", "pleiades", "gimbal_near_lock_1e-3")


@pytest.mark.parametrize("name", tiers(NAMES, NAMES[0]))
def test_hard_cases_end_as_they_should(name: str) -> None:
    text = cases.scene_text(name).replace("[run]", "[run]\ntolerance = 1e-9")
    module = eomc.load(from_scene(parse(text, f"{name}.toml")), BUILDS)
    size = max(1.0, *(abs(float(x)) for x in cases.cases()[name]["q_ref"]))
    for tol in (1e-6, 1e-9):
        assert cases.error_of(name, module.simulate(tol=tol).q[-1]) < 10 * tol * size


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["double_pendulum", "heavy_top", "furuta_pendulum", "chain"])
@pytest.mark.parametrize("real", ["double", "float"])
def test_check_compares_both_forms_with_the_reference(scene: str, real: str) -> None:
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
    assert len(rows) == 8 and all(row.passed for row in rows), rows


def test_the_plain_form_has_the_method_by_fixed_steps_beside(tmp_path: Path) -> None:
    scene = tmp_path / "swing.toml"
    scene.write_text(
        'eomc = 1\nname = "swing"\n[coordinates]\na = { start = 1.0 }\n'
        '[energy]\nkinetic = "a_dot**2/2"\npotential = "-cos(a)"\n'
        '[run]\nmethod = ["gauss16", "gauss4"]\ntolerance = 1e-9\nh = 0.1\nduration = 2\n',
        encoding="utf-8",
    )
    plain = eomc.load(scene, tmp_path, form="plain")
    fitted, fixed = plain.simulate(), plain.simulate(h=0.1)
    np.testing.assert_allclose(fitted.q[-1], fixed.q[-1], atol=1e-8)


def test_the_error_of_a_run_in_single_precision_is_found(single: ModuleType) -> None:
    run, finer = single.simulate(), single.simulate(tol=1e-6)
    assert not run.estimate().verdict
    assert 1e-8 < run.estimate().end["a"] < 1e-3
    assert abs(run.q[-1, 0] - finer.q[-1, 0]) < 1e-3
