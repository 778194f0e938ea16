"""Derivatives of runs through events, against differences of the same steps in 50 digits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy
from support.session import Modules, tiers
from test_adjoint import PreciseRun, precise

import eomc
from eomc.base import resources
from eomc.emit.common import amalgamate
from eomc.model.system import System, from_scene
from eomc.program import program
from eomc.scene.read import parse
from eomc.verify import runs
from eomc.verify.check import check

RUN = """[run]
h = 0.05
method = ["rk4", "dp8", "gauss8", "gauss16"]
linearize = "products"
discretize = true
tolerance = 1e-12
"""
# A ball on a table that swings, in a wind that swings too; an input pulls it.
TABLE_TENNIS = f"""eomc = 1
name = "swung"
[coordinates]
x = {{ rate = 2.0 }}
y = {{ start = 0.8, rate = 0.5 }}
[parameters]
e = 0.8
a = 0.04
w = 7.0
c = 0.1
[inputs]
pull = {{ signal = "cos(3*t) - x/5 + c*y_dot" }}
[energy]
kinetic = "(x_dot**2 + y_dot**2)/2 + y**2*x_dot**2/20"
potential = "9.81*y"
[forces]
x = "pull - c*x_dot*sqrt(x_dot**2 + y_dot**2)"
y = "sin(5*t) - c*y_dot + pull/9"
[[event]]
name = "impact"
when = "y - a*sin(w*t)"
direction = "falling"
action = "jump"
y_dot = "-e*(y_dot - a*w*cos(w*t)) + a*w*cos(w*t)"
x_dot = "x_dot*(1 - c) + t*y/50"
[[event]]
name = "apex"
when = "y_dot - c*x"
[[event]]
name = "net"
when = "x - 1.3 - a*t"
action = "stop"
{RUN}"""
# A block on a belt: `s` is the sign of its sliding velocity, 0 where it sticks.
BELT = f"""eomc = 1
name = "belt"
[coordinates]
x = {{ rate = 0.1 }}
[parameters]
m = 1.0
k = 10.0
v = 0.1
mu_s = 0.4
mu = 0.3
s = 0
[energy]
kinetic = "m*x_dot**2/2"
potential = "k*x**2/2"
[forces]
x = "-mu*m*9.81*s + k*x*(1 - s**2)"
[[event]]
name = "stops"
when = "(x_dot - v)*s"
direction = "falling"
action = "jump"
x_dot = "v"
s = "-sign(x)*heaviside(k*abs(x) - mu_s*m*9.81)"
[[event]]
name = "starts"
when = "(1 - s**2)*(k*abs(x) - mu_s*m*9.81) - s**2"
direction = "rising"
action = "jump"
s = "-sign(x)"
{RUN}"""
# Two balls that hit the floor at the same times, and a timer that a jump sets.
TWINS = f"""eomc = 1
name = "twins"
[coordinates]
y = {{ start = 1.0 }}
z = {{ start = 1.0 }}
[parameters]
e = 0.8
k = 0.3
until = 1e9
[energy]
kinetic = "y_dot**2*(1 + y**2/9)/2 + z_dot**2*(1 + z**2/9)/2"
potential = "9.81*(y + z) + k*(y**2 + z**2)"
[[event]]
name = "left"
when = "y"
direction = "falling"
action = "jump"
y_dot = "-e*y_dot"
until = "t + 0.17 + y_dot/100"
[[event]]
name = "right"
when = "z"
direction = "falling"
action = "jump"
z_dot = "-e*z_dot"
[[event]]
name = "bell"
when = "t - until"
action = "jump"
y_dot = "y_dot + z*k"
{RUN}"""


class PreciseEvents(PreciseRun):
    """The steps of a run, up to the same events, with mpmath."""

    def __init__(self, system: System, run: Any, steps: Any) -> None:
        super().__init__(system, run.method, 0.0, 1, 0.0)
        symbols = [*system.q, *system.qd, *system.u, *(p.symbol for p in system.parameters)]
        symbols.append(sympy.Symbol("t", real=True))
        state = {x.name: x for x in (*system.q, *system.qd)}
        heaviside = {"Heaviside": lambda x, *_: mpmath.mpf(int(x > 0))}

        def compiled(formula: Any) -> Callable[..., Any]:
            return sympy.lambdify(symbols, formula, [heaviside, "mpmath"])

        self.events = [compiled(e.when) for e in system.events]
        jumps = [dict(e.jump) for e in system.events]
        self.maps = [compiled([x.get(name, state[name]) for name in state]) for x in jumps]
        self.n, self.run, self.of = len(system.q), run, steps

    def inputs(self, x: Any, t: Any, p: Any) -> Any:
        own = self.u if self.u is not None else self.signal(x[: self.n], x[self.n :], p, t)
        return own + self.added

    def end(self, row: int, time: Any) -> Any:
        """Return the end of the step from a row of the path to a time."""
        start, x = self.path[row]
        self.set_inputs(row)
        self.h, self.t0 = time - start, start
        table = None if self.u is None else [self.u]
        return np.concatenate(self.rows(x[: self.n], x[self.n :], table, [self.added], self.p)[-1])

    def set_inputs(self, row: int) -> None:
        self.u = None if self.of.u is None else precise(self.of.u[row])
        self.added = self.table[self.of.period[row]]

    def event(self, k: int, row: int, near: float) -> tuple[Any, Any]:
        """Return time and state at an event near a time, at the end of the step from a row."""

        def value(time: Any) -> Any:
            x = self.end(row, time)
            return self.events[k](*x, *self.inputs(x, time, self.p), *self.p, time)

        start = mpmath.mpf(float(near))
        time = mpmath.findroot(value, (start, start + mpmath.mpf(10) ** -8), tol=1e-80)
        return time, self.end(row, time)

    def results(self, x: Any, table: Any, p: Any) -> Any:
        """Return the rows [q; qd] of the run and the occurrences [t; q; qd] as one array.

        table: is added to the inputs, a row for each step or for each control period.
        """
        of, last = self.of, len(self.of.t) - 1
        self.path, self.table, self.p = [(mpmath.mpf(float(of.t[0])), x)], table, p
        for i in range(last):
            if i in of.ends:
                (time, x), k = self.path[i], of.ends[i].event
                self.set_inputs(i - 1)
                x = np.array(self.maps[k](*x, *self.inputs(x, time, p), *p, time))
            elif i + 1 in of.ends:
                time, x = self.event(of.ends[i + 1].event, i, of.t[i + 1])
            else:
                time = mpmath.mpf(float(of.t[i + 1]))
                x = self.end(i, time)
            self.path.append((time, x))
        rows = []
        for k, place in enumerate(of.places):
            (time, x), at = self.path[place], of.point(k)
            if place < 0 and at.event >= 0:
                time, x = self.event(at.event, at.row, at.time)
            elif place < 0:
                x = self.end(at.row, mpmath.mpf(float(at.time)))
            rows.append(x if at.event < 0 else np.array([time, *x]))
        return np.concatenate(rows)


def own_module(m: Any) -> Any:
    """Return the module `sensitivity` of a built scene."""
    return import_module(f"{m.Trajectory.__module__.rpartition('.')[0]}.sensitivity")


CASES = {
    "bounce with signals": (TABLE_TENNIS, {"duration": 0.9}, {"impact", "apex", "net"}),
    "bounce with every": (TABLE_TENNIS, {"duration": 0.6, "every": 4}, {"impact", "apex"}),
    "bounce with times": (
        TABLE_TENNIS, {"times": [0.0, 0.13, 0.4, 0.47, 0.6, 0.63]}, {"impact", "apex"},
    ),
    "bounce with a table": (
        TABLE_TENNIS, {"duration": 0.6, "u": np.cos(np.arange(4.0))[:, None],
                       "control_period": 0.15}, {"impact", "apex"},
    ),
    "stick-slip": (BELT, {"duration": 9.0, "h": 0.1, "method": "dp8"}, {"stops", "starts"}),
    "simultaneous": (TWINS, {"duration": 1.3}, {"left", "right", "bell"}),
    "jump at the end": (TWINS, {"q0": {"until": 0.4 - 1e-15}, "duration": 0.4}, {"bell"}),
}  # fmt: skip


@pytest.mark.parametrize("case", tiers(CASES, "simultaneous"))
def test_derivatives_through_events_agree_with_differences_of_fifty_digits(
    modules: Modules, case: str
) -> None:
    """Along one direction in start, inputs and parameters, forwards and backwards."""
    text, arguments, expected = CASES[case]
    m, system, random = modules.unoptimised(text), from_scene(parse(text, "t.toml")), draws(case)
    run = m.simulate(**({"h": 0.05, "method": "rk4"} | arguments))
    assert run.status == "ok" and {name for name, log in run.events.items() if len(log)} == expected
    steps, (which, occurrences) = own_module(m)._Steps(run, "test"), run.event_data
    sizes = run.q.shape, run.qd.shape, (len(occurrences), 1 + 2 * m.nq)
    q_bar, qd_bar, event_bars = (random.standard_normal(size) for size in sizes)
    events = {
        name: np.split(event_bars[which == k], [1, 1 + m.nq], axis=1)
        for k, name in enumerate(run.events)
    }
    gradient = run.vjp(q_bar, qd_bar, events={k: (t[:, 0], *x) for k, (t, *x) in events.items()})
    shift = random.standard_normal(m.nu)
    directions = [random.standard_normal(x.shape) for x in (gradient.q, gradient.qd)]
    directions += [shift + np.zeros_like(gradient.u), random.standard_normal(gradient.p.shape)]
    with mpmath.workdps(50):
        reference, by = PreciseEvents(system, run, steps), mpmath.mpf(10) ** -20
        ends, p = [], precise(run.request.p)
        x, (dx, du, dp) = (
            precise(np.concatenate([run.q[0], run.qd[0]])),
            (by * precise(d) for d in (np.concatenate(directions[:2]), *directions[2:])),
        )
        ends = [reference.results(x + s * dx, s * du, p + s * dp) for s in (0, 1, -1)]
        exact = ((ends[1] - ends[2]) / (2 * by)).astype(float)
    values = ends[0].astype(float)
    np.testing.assert_allclose(
        values, np.concatenate([run.x.ravel(), occurrences.ravel()]), rtol=0, atol=1e-12
    )
    along = np.concatenate([*directions[:2], shift, directions[3]])
    rows = np.concatenate(run.sensitivity(), axis=-1) @ along
    logs = {k: np.concatenate(x, axis=-1) @ along for k, x in run.event_sensitivity().items()}
    of_events = np.zeros_like(occurrences)
    for k, name in enumerate(run.events):
        of_events[which == k] = logs[name]
    values, scale = np.concatenate([rows.ravel(), of_events.ravel()]), np.max(np.abs(exact))
    assert np.max(np.abs(values - exact)) < 1e-12 * scale
    bars = np.concatenate([np.hstack([q_bar, qd_bar]).ravel(), event_bars.ravel()])
    product = sum(np.sum(a * b) for a, b in zip(gradient, directions, strict=True))
    assert abs(product - bars @ exact) < 1e-12 * np.sum(np.abs(bars)) * scale


def draws(case: str) -> np.random.Generator:
    return np.random.default_rng([*case.encode()])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["gauss8", "gauss16", "adaptive"])
def test_gradients_of_implicit_and_adaptive_runs_agree_with_short_explicit_steps(
    modules: Modules, method: str
) -> None:
    """Of the landing point, its time and the end, with respect to start and parameters."""
    m = modules.unoptimised(TABLE_TENNIS)

    def gradient(**steps: Any) -> Any:
        run = m.simulate(times=[0.0, 0.35, 0.6], **steps)
        bars = [np.ones(3 * m.nq).reshape(3, -1) for _ in range(2)]
        landing = run.events["impact"]
        events = {"impact": (1 + landing.t, np.cos(landing.q), None)}
        result = run.vjp(*bars, events=events)
        return np.concatenate([result.q, result.qd, result.p])

    steps = {"tol": 1e-13} if method == "adaptive" else {"h": 0.01, "method": method}
    expected = gradient(h=0.001, method="dp8")
    np.testing.assert_allclose(gradient(**steps), expected, rtol=0, atol=1e-9 * abs(expected).max())


@pytest.mark.slow
def test_sensitivities_of_an_adaptive_run_pass_through_events(modules: Modules) -> None:
    m = modules.unoptimised(TABLE_TENNIS)
    runs = [m.simulate(duration=2.0, **steps) for steps in ({"tol": 1e-13}, {"h": 0.001})]
    assert all(run.stopped == "net" for run in runs)
    ends = [np.concatenate([x[-1] for x in run.sensitivity()], axis=-1) for run in runs]
    times = [run.event_sensitivity()["net"].start[0, 0] for run in runs]
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-9 * abs(ends[0]).max())
    np.testing.assert_allclose(*times, rtol=0, atol=1e-9)
    outputs = modules.unoptimised(TABLE_TENNIS.replace("[[event]]", OUTPUTS, 1))
    run = outputs.simulate(h=0.05, duration=0.9)
    exact = run.sensitivity()
    height = run.sensitivity(outputs=True).start[:, 0]
    np.testing.assert_allclose(height, 2 * run.q[:, 1:] * exact.start[:, 1], rtol=0, atol=1e-13)


BATCH = RUN.replace('["rk4", "dp8", "gauss8", "gauss16"]', '"rk4"\nbatch = true').replace(
    "tolerance = 1e-12\n", ""
)


@pytest.mark.slow
@pytest.mark.parametrize("duration", [0.9, 0.1])
def test_instances_of_batches_have_the_derivatives_of_single_runs(
    modules: Modules, duration: float
) -> None:
    """The first instance stops at the net, the second one does not reach it."""
    m = modules.unoptimised(TABLE_TENNIS.replace(RUN, BATCH).replace("swung", "swung_batch"))
    qd0 = np.array([[2.0, 0.5], [0.5, 0.4]])
    steps = {"h": 0.05, "duration": duration, "params": {"e": np.array([0.8, 0.7])}}
    batch = m.simulate_batch(np.array([[0.0, 0.8]] * 2), qd0, **steps)
    draw = np.random.default_rng(3).standard_normal
    q_bar, apex = draw(batch.q.shape), batch.events["apex"]
    t_bar, state_bar = draw(apex.t.shape), draw(apex.q.shape)
    gradient = batch.vjp(q_bar, events={"apex": (t_bar, None, state_bar)})
    sensitivity = batch.sensitivity()
    for k, e in enumerate((0.8, 0.7)):
        times = batch.t
        run = m.simulate([0.0, 0.8], qd0[k], h=0.05, times=times, params={"e": e})
        own = apex.instance == k
        one = run.vjp(q_bar[k, : len(run)], events={"apex": (t_bar[own], None, state_bar[own])})
        n = len(one.u)
        for a, b in zip(one, (x[k] for x in gradient), strict=True):
            np.testing.assert_allclose(b[:n] if a is one.u else b, a, rtol=1e-9, atol=1e-12)
        assert not gradient.u[k, n:].any()
        start = run.sensitivity().start
        np.testing.assert_allclose(sensitivity.start[k, : len(run)], start, rtol=1e-9, atol=1e-12)
        assert np.isnan(sensitivity.start[k, len(run) :]).all()
    assert (len(run) == len(batch.t)) and (batch.stopped[0] == "net") == (duration > 0.5)


OUTPUTS = '[outputs]\nheight = "y**2"\n[[event]]'
LOB = f"""eomc = 1
name = "lob"
[coordinates]
y = {{ rate = 9.81 }}
[parameters]
top = 4.905
[inputs]
lift = {{ signal = "0*y" }}
[energy]
kinetic = "y_dot**2/2"
potential = "9.81*y"
[forces]
y = "lift"
[[event]]
name = "ceiling"
when = "y - top"
action = "jump"
direction = "rising"
y_dot = "y_dot - 1"
[[event]]
name = "rests"
when = "y + 1 + lift*0.0001"
action = "jump"
direction = "falling"
y_dot = "-y_dot/2"
{RUN.replace("0.05", "0.01")}"""


@pytest.mark.slow
def test_grazing_events_are_reported(modules: Modules) -> None:
    """The depth below which the ceiling counts as grazed is some roundings of the height."""
    m = modules.unoptimised(LOB)
    for depth, is_grazed in ((1e-15, True), (1e-12, False)):
        run = m.simulate(h=0.01, duration=1.2, params={"top": 4.905 - depth})
        assert len(run.events["ceiling"]) == 1
        if is_grazed:
            for derivatives in (run.sensitivity, lambda run=run: run.vjp(run.q)):
                with pytest.raises(
                    m.MotionError, match=r"event 'ceiling' grazes zero at t = (0.99|1)"
                ):
                    derivatives()
        else:
            speed = np.sqrt(2 * 9.81 * depth)
            gradient = run.vjp(events={"ceiling": ([1.0], None, None)})
            assert gradient.p[0] == pytest.approx(1 / speed, rel=1e-3)


@pytest.mark.slow
def test_derivatives_through_events_that_do_not_exist_are_refused(modules: Modules) -> None:
    m, swung = modules.unoptimised(LOB), modules.unoptimised(TABLE_TENNIS)
    run = m.simulate(h=0.01, duration=2.2)
    assert len(run.events["rests"]) == 1
    for derivatives in (run.sensitivity, lambda: run.vjp(run.q)):
        with pytest.raises(ValueError, match=r"an input that follows a signal.*give u="):
            derivatives()
    given = m.simulate(h=0.01, duration=2.2, u=[0.0])
    assert given.vjp(given.q).u.shape == (1,) and given.sensitivity().start.shape[1:] == (2, 2)
    with pytest.warns(RuntimeWarning, match="ever sooner"):
        rests = m.simulate(h=0.01, duration=9.0, u=[0.0])
    with pytest.raises(ValueError, match="vjp: the run did not reach its end: jumps follow"):
        rests.vjp(rests.q)
    with pytest.raises(ValueError, match="sensitivity: the run did not reach its end"):
        rests.sensitivity()
    with pytest.raises(ValueError, match="h and method are those of the run"):
        given.sensitivity(h=0.001)
    run = swung.simulate(h=0.05, duration=0.9)
    for words, error, events in (
        ("events: 'bounce' is not one of", KeyError, {"bounce": (None, None, None)}),
        (r"events\['apex'\]: expected a tuple", ValueError, {"apex": [1.0]}),
        (r"events\['apex'\]\[0\]: shape \(2,\)", ValueError, {"apex": ([1, 2], None, None)}),
    ):
        with pytest.raises(error, match=words):
            run.vjp(events=events)
    plain = modules.unoptimised(TABLE_TENNIS.replace(', "gauss16"', "").replace("swung", "flung"))
    adaptive = plain.simulate(tol=1e-9, duration=0.5)
    with pytest.raises(ValueError, match=r'gauss16, which the module lacks.*"gauss16"\]'):
        adaptive.vjp(adaptive.q)


# beginnings of lines of csrc/solver/adjoint.c, and the same with another sign
WRONG_SIGNS = {
    "*by_time += PARTS": "*by_time -= PARTS",
    "t + OFFSETS[n]*h/PARTS": "t + OFFSETS[n]*h",
    "const real end_bar = 2*h": "const real end_bar = h",
    "r_rate = eom_method_c[i]*qd[k]": "r_rate = -eom_method_c[i]*qd[k]",
    "r_rate += 2*h*AA": "r_rate += h*AA",
    "v_rate += A": "v_rate -= A",
    "by_size += end_bar": "by_size -= end_bar",
    "qdd_bar[k] = h*eom_method_bA": "qdd_bar[k] = -h*eom_method_bA",
    "qdd_bar[k] += h": "qdd_bar[k] -= h",
    "by_size += eom_method_c[i]*by_time": "by_size -= eom_method_c[i]*by_time",
    "by_start += by_time": "by_start -= by_time",
    "by_size += q_bar[k]*qd[k]": "by_size -= q_bar[k]*qd[k]",
    "t_bar[0] += by_start - by_size": "t_bar[0] += by_start + by_size",
    "t_bar[1] += by_size": "t_bar[1] -= by_size",
    "starts = first + k == 0": "starts = first + k == 1",
}


@pytest.mark.slow
@pytest.mark.parametrize("right", WRONG_SIGNS)
def test_each_term_of_the_derivatives_by_times_counts(
    monkeypatch: pytest.MonkeyPatch, modules: Modules, tmp_path: Path, right: str
) -> None:
    """The gradient of the unchanged module is that of the differences above."""
    read, text = (
        resources.text,
        TABLE_TENNIS.replace('["rk4", "dp8", "gauss8", "gauss16"]', '"rk4"'),
    )
    assert read("csrc", "solver/adjoint.c").count(right) == 1

    def gradient(m: Any) -> Any:
        run = m.simulate(h=0.05, duration=0.9)
        return np.concatenate([x.ravel() for x in run.vjp(run.q, run.qd)])

    expected = gradient(modules.unoptimised(text))
    wrong = WRONG_SIGNS[right]
    monkeypatch.setattr(resources, "text", lambda *where: read(*where).replace(right, wrong))
    definitions: Any = amalgamate.definitions
    monkeypatch.setattr(amalgamate, "definitions", definitions.__wrapped__)
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    system = replace(from_scene(parse(text, "test.toml")), digest=wrong.encode().hex())
    values = gradient(eomc.load(system, tmp_path))
    assert np.max(np.abs(values - expected)) > 1e-7 * np.max(np.abs(expected))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["event_slopes", "jump_vjp"])
def test_check_detects_wrong_derivatives_of_events(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    text = TWINS.replace('["rk4", "dp8", "gauss8", "gauss16"]', '"rk4"')
    system = replace(from_scene(parse(text, "test.toml")), digest=name.encode().hex())
    right = program.lower

    def wrong(function: str, tape: Any, values: Any, *names: Any, **more: Any) -> Any:
        values = [-x if function == name else x for x in values]
        return right(function, tape, values, *names, **more)

    monkeypatch.setattr(program, "lower", wrong)
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    report = check(system, eomc.load(system, tmp_path), states=4, tables=[runs.event_checks])
    assert [row.name for row in report.results if not row.passed] == ["derivatives of events"]
