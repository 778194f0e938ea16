"""The energy balance of a run, against exact integrals; coarse rows leave it unresolved."""

from __future__ import annotations

import math
import pickle
from itertools import pairwise
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp, trapezoid
from support.session import Modules

from eomc.runtime.balance import _work as work
from eomc.runtime.package import model_of

FALLING = """
eomc = 1
name = "falling_down"
[coordinates]
y = { unit = "m", start = 1.0 }
[parameters]
e = 0.8
g = 9.81
c = 0.0
m = 1.0
at = 1e9
[inputs]
F = { unit = "N" }
[energy]
kinetic     = "m*y_dot**2/2"
potential   = "m*g*y"
dissipation = "c*y_dot**2/2"
[forces]
y = "F"
[[event]]
name      = "impact"
when      = "y"
direction = "falling"
action    = "jump"
y_dot     = "-e*y_dot"
[[event]]
name   = "sheds"
when   = "t - at"
action = "jump"
m      = "m/2"
[run]
duration = 2.0
tolerance = 1e-11
"""
STICKS = """
eomc = 1
name = "stopped_block"
[coordinates]
x = { start = 1.0, friction = "F" }
[parameters]
F = 1.0
[energy]
kinetic   = "x_dot**2/2"
potential = "5*x**2"
[run]
friction  = "stick"
tolerance = 1e-11
duration  = 5.0
"""
SPRING = """
eomc = 1
name = "pushed"
[coordinates]
x = { unit = "m", start = 1.0 }
[parameters]
c = 0.4
a = 0.0
[inputs]
u = { unit = "N" }
[energy]
kinetic     = "x_dot**2/2"
potential   = "2*x**2"
dissipation = "c*x_dot**2/2"
[forces]
x = "u + a*cos(t)"
[run]
h        = 0.02
duration = 10.0
"""
EXACT = {"h": 0.0005, "duration": 10.0}


@pytest.fixture
def pushed(modules: Modules) -> ModuleType:
    """A mass on a damped spring, with an input and a time-dependent force."""
    return modules.unoptimised(SPRING)


@pytest.mark.slow
def test_dissipation_of_a_damped_spring_is_exact(pushed: ModuleType) -> None:
    """x = e^(-d t) (cos w t + d/w sin w t), d = c/2: what is dissipated is the energy's fall."""
    d, T = 0.2, 10.0
    w = math.sqrt(4 - d**2)
    x = math.exp(-d * T) * (math.cos(w * T) + d / w * math.sin(w * T))
    v = -math.exp(-d * T) * 4 / w * math.sin(w * T)
    dissipated = 2 - (v**2 / 2 + 2 * x**2)
    balance = pushed.simulate().balance()
    assert balance.is_resolved and balance.inputs == balance.forces == 0
    assert abs(balance.dissipated - dissipated) < 1e-6
    assert abs(pushed.simulate(**EXACT).balance().dissipated - dissipated) < 1e-12
    assert balance.words.startswith(f"dissipated {dissipated:.3g} J; numerical error 1")


def test_work_of_inputs_and_of_forces_are_separate(pushed: ModuleType) -> None:
    """The work of a constant force u is u (x(T) - x(0)); the default signal does none."""
    without_input = pushed.simulate(params={"a": 0.7}).balance()
    run = pushed.simulate(params={"a": 0.7}, u=[3.0])
    balance = run.balance()
    fine = pushed.simulate(**EXACT, params={"a": 0.7})
    assert without_input.inputs == 0
    assert without_input.forces == pytest.approx(
        trapezoid(0.7 * np.cos(fine.t) * fine.qd[:, 0], fine.t), rel=1e-5
    )
    assert balance.inputs == pytest.approx(3 * (run.q[-1, 0] - run.q[0, 0]), rel=1e-6)
    change = run.energy[-1] - run.energy[0]
    work = balance.inputs + balance.forces - balance.dissipated
    assert abs(work - change) <= balance.error + 1e-14
    assert "work of inputs -1.38 J, work of forces 0.0673 J, dissipated 0.101 J; " in balance.words


@pytest.mark.parametrize("params", [{}, {"c": 2.0, "a": 5.0}])
def test_balance_error_is_the_error_of_the_method(
    pushed: ModuleType, params: dict[str, float]
) -> None:
    """The balance error falls by 16 or more if h is halved, and equals the error of the energy."""
    balances = [
        pushed.simulate(h=h, duration=8.0, params=params).balance() for h in (0.04, 0.02, 0.01)
    ]
    assert all(b.error > 10 * b.uncertainty for b in balances)
    for coarse, fine in pairwise(balances):
        assert 14 < coarse.error / fine.error < 40


@pytest.mark.parametrize("rows", [20, 33, 60, 100, 200, 500, 3000])
@pytest.mark.parametrize("sharpness", [1.0, 10.0, 300.0])
def test_quadrature_error_is_bounded_by_the_uncertainty(rows: int, sharpness: float) -> None:
    """Integrate cos t tanh(sharpness sin t) over 10 s: friction that is resolved or unresolved."""

    def integral(t: np.ndarray) -> np.ndarray:
        return np.log(np.cosh(sharpness * np.sin(t))) / sharpness

    t = np.minimum(np.arange(rows + 1) * 10 / (rows - 0.6), 10.0)  # the last step is shorter
    sums, uncertainty = work(t, np.cos(t) * np.tanh(sharpness * np.sin(t)))
    assert np.max(np.abs(sums - integral(t))) <= uncertainty + 1e-15  # rounding
    assert uncertainty < 1e-7 or sharpness > 1 or rows < 200


def test_balance_of_too_few_steps_is_unresolved(pushed: ModuleType) -> None:
    balance = pushed.simulate(h=0.9, steps=12).balance()
    assert not balance.is_resolved
    assert balance.words == "the steps are too long to determine the energy balance"


def test_rows_that_were_not_stored_are_recomputed(pushed: ModuleType) -> None:
    assert pushed.simulate(every=50).balance() == pushed.simulate().balance()


def test_balance_of_a_conservative_run_is_its_energy_error(cartpole: ModuleType) -> None:
    run = cartpole.simulate()
    balance = run.balance()
    assert (balance.inputs, balance.forces, balance.dissipated) == (0, 0, 0)
    assert balance.error == np.max(np.abs(run.energy - run.energy[0])) > 1e-9
    assert balance.is_resolved and balance.words.startswith(
        "no work or dissipation; numerical error"
    )
    assert not model_of(cartpole).functions.has_power


def test_balance_of_jacobis_integral_is_reported(modules: Modules) -> None:
    run = modules("kapitza_pendulum").simulate(duration=2.0)
    balance = run.balance()
    assert balance.forces == pytest.approx(run.jacobi[-1] - run.jacobi[0], abs=2 * balance.error)
    assert balance.is_resolved and balance.error < 1e-7 and balance.dissipated == 0


def test_time_dependent_potential_does_work(modules: Modules) -> None:
    """x'' = -cos(t): Jacobi's integral equals the energy, which nevertheless varies with time."""
    scene = """
eomc = 1
name = "swayed"
[coordinates]
x = {}
[energy]
kinetic   = "x_dot**2/2"
potential = "x*cos(t)"
[run]
h = 0.01
duration = 2.0
batch = true
"""
    module = modules.unoptimised(scene)
    run = module.simulate()
    assert np.array_equal(run.jacobi, run.energy) and abs(run.energy[-1]) > 0.1
    runs = module.simulate_batch([[0.0], [0.5]])
    assert np.array_equal(runs.jacobi, runs.energy)
    balance = run.balance()
    assert balance.is_resolved and balance.error < 1e-9
    assert balance.forces == pytest.approx(run.energy[-1] - run.energy[0], abs=1e-9)


def law(t: float, q: np.ndarray, qd: np.ndarray) -> list[float]:
    return [2.0 - q[0] - math.copysign(0.3, qd[0])]


@pytest.mark.filterwarnings("ignore:.*a Python function")
@pytest.mark.parametrize(
    "options",
    [
        {"u": np.sin(np.arange(20.0) ** 2)[:, None]},
        {"u": np.sin(np.arange(20.0) ** 2)[:, None], "times": np.linspace(0, 0.4, 11)},
        {"u": np.cos(np.arange(4.0))[:, None], "control_period": 0.1, "every": 3},
        {"u": law},
        {"u": law, "control_period": 0.06},
        {"u": law, "control_period": 0.06, "times": np.linspace(0, 0.4, 8)},
    ],
)
def test_work_of_constant_inputs_is_reported(pushed: ModuleType, options: dict[str, Any]) -> None:
    """Over a step the work of an input is u (x' - x), up to the method's error in x."""
    run = pushed.simulate(**{"steps": 20} if "times" not in options else {"h": 0.02}, **options)
    balance, ends = run.balance(), run(0.02 * np.arange(21))[0][:, 0]
    u = (
        np.repeat(options["u"], 20 // len(options["u"]))
        if options["u"] is not law
        else run.u[:-1, 0]
    )
    if options["u"] is law and "times" in options:
        u = pushed.simulate(steps=20, **options | {"times": None}).u[:-1, 0]
    assert balance.is_resolved and balance.error < 1e-7
    assert balance.inputs == pytest.approx(np.sum(u * np.diff(ends)), abs=2 * balance.error)
    assert 0 < balance.dissipated < 1 and balance.uncertainty < 1e-3 * balance.error


def test_work_of_zero_order_hold_inputs_in_adaptive_runs(falling: ModuleType) -> None:
    periods = np.array([0.0, 0.15, 0.3, 0.4])
    for options in ({"duration": 0.4}, {"times": periods}):
        run = falling.simulate(u=law, control_period=0.15, params={"c": 0.2}, **options)
        u = run.u[np.searchsorted(run.t, periods[:-1]), 0]
        work = np.sum(u * np.diff(run(periods)[0][:, 0]))
        balance, change = run.balance(), run.energy[-1] - run.energy[0]
        assert balance.is_resolved and balance.inputs == pytest.approx(work, abs=1e-11)
        assert balance.inputs - balance.dissipated == pytest.approx(change, abs=1e-11)


@pytest.mark.parametrize("times", [None, [0.0, 0.3, 1.5]])
def test_impacts_within_control_periods_are_balanced(
    falling: ModuleType, times: list[float] | None
) -> None:
    """A constant force does F (y' - y) across impacts too; impacts dissipate their part of K."""
    run = falling.simulate(u=law, control_period=0.15, duration=1.5, times=times)
    balance, impacts = run.balance(), run.events["impact"]
    periods = np.array([*(0.15 * np.arange(10)), 1.5])
    u = np.array([law(t, q, qd)[0] for t, q, qd in zip(periods, *run(periods), strict=True)])
    jumps = np.sum((0.8**2 - 1) * impacts.qd[:, 0] ** 2 / 2)
    assert len(impacts.t) > 1 and balance.is_resolved and balance.error < 1e-9
    assert balance.inputs == pytest.approx(np.sum(u[:-1] * np.diff(run(periods)[0][:, 0])))
    assert balance.jumps == pytest.approx(jumps, abs=1e-11)


def test_balance_of_an_interrupted_run_ends_at_its_last_row(falling: ModuleType) -> None:
    def interrupting_law(t: float, q: np.ndarray, qd: np.ndarray) -> list[float]:
        if t > 1.0:
            raise KeyboardInterrupt
        return law(t, q, qd)

    times = np.linspace(0, 1.5, 16)
    with pytest.raises(falling.Interrupted) as interruption:
        falling.simulate(u=interrupting_law, control_period=0.15, times=times)
    run = interruption.value.run
    full_run = falling.simulate(u=law, control_period=0.15, duration=float(run.t[-1]))
    assert run.t[-1] < 1.1 and len(run.events["impact"].t) > 0
    assert run.balance().inputs == pytest.approx(full_run.balance().inputs, abs=1e-9)
    assert run.balance().jumps == pytest.approx(full_run.balance().jumps, abs=1e-9)


@pytest.mark.filterwarnings("ignore:.*ever sooner")
@pytest.mark.parametrize(
    ("options", "status"),
    [
        ({"params": {"at": 0.3}, "duration": 0.4}, "ok"),  # at the end of a period
        ({"params": {"e": 0.5, "at": 1.0}, "duration": 3.0}, "accumulated"),  # and of the run
    ],
)
def test_jumps_at_the_end_of_a_period_or_run_are_balanced(
    falling: ModuleType, options: dict[str, Any], status: str
) -> None:
    run = falling.simulate(u=law, control_period=0.15, **options)
    balance, change = run.balance(), run.energy[-1] - run.energy[0]
    assert run.status == status and len(run.events["sheds"].t) == 1 and run["m"][-1] == 0.5
    assert balance.inputs + balance.jumps == pytest.approx(change, abs=1e-11)
    assert balance.is_resolved and balance.error < 1e-11 and balance.jumps < -1


@pytest.mark.filterwarnings("ignore:.*a Python function")
def test_balance_takes_the_inputs_of_steps_between_rows(pushed: ModuleType) -> None:
    balance, expected = (pushed.simulate(steps=20, u=law, every=k).balance() for k in (2, 1))
    assert balance.inputs == pytest.approx(expected.inputs, rel=1e-12)


@pytest.mark.parametrize("steps", [0, 1, 2, 3, 9])
def test_short_runs_have_a_balance(pushed: ModuleType, steps: int) -> None:
    balance = pushed.simulate(steps=steps, every=2).balance()
    assert math.isfinite(balance.error) and math.isfinite(balance.uncertainty)


def test_balance_can_be_pickled(pushed: ModuleType) -> None:
    balance = pushed.simulate(steps=30).balance()
    assert pickle.loads(pickle.dumps(balance)) == balance


@pytest.fixture
def falling(modules: Modules) -> ModuleType:
    """A bouncing ball with drag and a force, which sheds half of its mass at a given time."""
    return modules.unoptimised(FALLING)


@pytest.mark.parametrize("times", [None, np.linspace(0.0, 2.0, 21)])
def test_energy_dissipated_in_each_impact_is_exact(
    falling: ModuleType, times: np.ndarray | None
) -> None:
    """An impact takes (1 - e^2) of the kinetic energy, g e^2k before impact k, in any rows."""
    run = falling.simulate() if times is None else falling.simulate(times=times)
    count = len(run.events["impact"])
    balance = run.balance()
    assert count == 3 and balance.inputs == balance.forces == balance.dissipated == 0
    assert balance.jumps == pytest.approx(-9.81 * (1 - 0.8 ** (2 * count)), rel=1e-12)
    assert balance.is_resolved and balance.error < 1e-9
    assert balance.words.startswith("added by jumps -7.24 J; numerical error")
    assert pickle.loads(pickle.dumps(balance)) == balance


def test_work_between_jumps_is_separate_from_jumps(falling: ModuleType) -> None:
    """With drag and a force F, against SciPy's solution of each fall; F does F (y(T) - y(0))."""
    run = falling.simulate(u=[1.5], params={"c": 0.3, "e": 0.7})
    balance, y, dissipated, jumps = run.balance(), [1.0, 0.0, 0.0], 0.0, 0.0
    times = [0.0, *run.events["impact"].t, 2.0]
    for start, end in pairwise(times):
        y[2] = 0.0
        y = solve_ivp(
            lambda _, s: [s[1], -9.81 + 1.5 - 0.3 * s[1], 0.3 * s[1] ** 2], (start, end), y,
            method="DOP853", rtol=1e-12, atol=1e-13,
        ).y[:, -1].tolist()  # fmt: skip
        dissipated += y[2]
        if end < 2.0:
            jumps -= (1 - 0.7**2) * y[1] ** 2 / 2
            y[1] *= -0.7
    assert len(times) > 4 and balance.is_resolved
    assert balance.dissipated == pytest.approx(dissipated, rel=1e-9)
    assert balance.jumps == pytest.approx(jumps, rel=1e-9)
    assert balance.inputs == pytest.approx(1.5 * (run.q[-1, 0] - 1.0), rel=1e-9)
    assert balance.forces == pytest.approx(0, abs=1e-9)
    change = run.energy[-1] - run.energy[0]
    assert (
        abs(balance.inputs - balance.dissipated + balance.jumps - change) <= balance.error + 1e-12
    )
    assert " J, added by jumps -" in balance.words


def test_jump_that_sheds_mass_takes_its_energy(falling: ModuleType) -> None:
    """At 0.2 s half of the mass is shed, and with it half of K + P = m g."""
    balance = falling.simulate(duration=0.4, params={"at": 0.2}).balance()
    assert balance.jumps == pytest.approx(-9.81 / 2, rel=1e-12) and balance.is_resolved
    with pytest.warns(RuntimeWarning, match="ever sooner"):
        resting = falling.simulate(duration=9.0, params={"c": 0.2}).balance()
    assert resting.is_resolved and resting.dissipated - resting.jumps == pytest.approx(
        9.81, rel=1e-9
    )
    assert resting.error < 1e-8


@pytest.mark.slow
def test_stick_slip_friction_dissipates_all_and_its_jumps_take_nothing(modules: Modules) -> None:
    """Amplitudes fall by 2 F/k = 0.2 each half swing, so F acts all the way: 1, 0.8, ..., 0."""
    run = modules.unoptimised(STICKS).simulate()
    balance = run.balance()
    dissipated = 5 * (1 - run.q[-1, 0] ** 2)
    assert (
        balance.is_resolved
        and abs(balance.jumps) < 1e-12
        and balance.forces == pytest.approx(0, abs=1e-9)
    )
    assert balance.dissipated == pytest.approx(dissipated, rel=1e-10) and run.qd[-1, 0] == 0
    assert balance.words.startswith(f"dissipated {dissipated:.3g} J; numerical error")


def test_balance_of_many_jumps_needs_few_rows(falling: ModuleType) -> None:
    """Thousands of elastic impacts take nothing, and nothing is dissipated."""
    run = falling.simulate(duration=2500.0, params={"e": 1.0})
    balance = run.balance()
    assert len(run.events["impact"]) > 2500 and balance.is_resolved
    assert abs(balance.jumps) < 1e-9 and balance.error < 1e-6


STOP = """
eomc = 1
name = "meets_a_stop"
[coordinates]
x = { rate = 1.0 }
[energy]
kinetic = "x_dot**2/2"
potential = "x**2/2"
dissipation = "0.01*x_dot**2/2"
[forces]
x = "-1e7*max(0, x - 0.9)*max(0, 1 + x_dot)"
[run]
duration = 20.0
tolerance = 1e-9
"""


@pytest.mark.parametrize("times", [None, np.linspace(0.0, 20.0, 41)])
def test_short_contacts_are_resolved(modules: Modules, times: np.ndarray | None) -> None:
    """Regression: equidistant rows missed them, which gave an error of 8 % for an accurate run."""
    run = modules.of_text(STOP).simulate(times=times)
    balance = run.balance()
    assert balance is not None and balance.is_resolved
    assert max(balance.error, balance.uncertainty) < 1e-8
    assert balance.dissipated == pytest.approx(run.energy[0] - run.energy[-1], abs=1e-8)


@pytest.mark.parametrize("roundings", [-2, 0, 1, 5])
def test_jumps_within_roundings_of_an_end_are_balanced(falling: ModuleType, roundings: int) -> None:
    """Regression: rows between the ends of steps of a few roundings fell on the jump's time."""
    impact = float(falling.simulate(duration=1.0).events["impact"].t[0])
    shedding_time = 0.3 - roundings * np.spacing(0.3)
    for run in (
        falling.simulate(duration=impact + roundings * np.spacing(impact)),
        falling.simulate(duration=0.3, params={"at": shedding_time}),
        falling.simulate(duration=0.3, params={"at": max(0.0, -roundings)}),
    ):
        balance = run.balance()
        assert balance is not None and balance.is_resolved and balance.error < 1e-13
        assert balance.jumps == pytest.approx(run.energy[-1] - run.energy[0], abs=1e-12)
