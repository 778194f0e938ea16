"""Gradients of runs, compared with differences of runs, in 50 digits and in doubles."""

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
from support.cases import text_of
from support.session import Modules, tiers

import eomc
from eomc.base import resources
from eomc.emit.common import amalgamate
from eomc.integrators.tableaux import METHODS
from eomc.model.system import System, from_scene
from eomc.scene.read import parse
from eomc.verify import equations, symbolic
from eomc.verify.check import check

LOOP = """eomc = 1
name = "steered"
[coordinates]
x = { start = 0.2 }
theta = { start = 0.3 }
[parameters]
k = 4.0
m = 1.5
[inputs]
force = { signal = "k*theta + 3*theta_dot - x_dot**2 + sin(t)" }
push = { signal = "cos(m*t)" }
[energy]
kinetic = "m*x_dot**2 + x_dot*theta_dot*cos(theta) + theta_dot**2"
potential = "9.81*cos(theta) + k*x**2"
[forces]
x = "force - 0.3*x_dot"
theta = "push*cos(x)"
[run]
method = ["rk4", "dp8", "euler", "gauss8", "gauss16"]
linearize = "products"
"""
RK4_LOOP = LOOP.replace('["rk4", "dp8", "euler", "gauss8", "gauss16"]', '"rk4"')
CHAIN = text_of("chain", 'linearize = "products"')
Function = Callable[..., Any]


def accelerations(system: System) -> tuple[Function, Function]:
    """Return functions for the accelerations and for the signals, with mpmath."""
    reference = symbolic.derive(system)
    n, t = len(system.q), sympy.Symbol("t", real=True)
    parameters = [p.symbol for p in system.parameters]
    symbols = (*system.q, *system.qd, *system.u, *parameters, t)
    motion, signals = (
        sympy.lambdify(symbols, list(x), "mpmath") for x in (reference.motion, reference.signals)
    )

    def acceleration(q: Any, qd: Any, u: Any, p: Any, t: Any) -> Any:
        values = motion(*q, *qd, *u, *p, t)
        D = mpmath.matrix(n, n)
        for k in range(n * n):
            D[k // n, k % n] = values[k]
        forces = [values[n * n + n + k] - values[n * n + k] for k in range(n)]
        return np.array(list(mpmath.lu_solve(D, mpmath.matrix(forces))))

    def signal(q: Any, qd: Any, p: Any, t: Any) -> Any:
        return np.array(signals(*q, *qd, *[mpmath.mpf(0)] * len(system.u), *p, t))

    return acceleration, signal


class PreciseRun:
    """Runs of an explicit method with mpmath, by the accelerations of the reference."""

    def __init__(self, system: System, method: str, h: float, steps: int, t0: float) -> None:
        self.acceleration, self.signal = accelerations(system)
        self.method, self.h, self.steps, self.t0 = METHODS[method], h, steps, t0

    def rows(self, q: Any, qd: Any, table: Any, added: Any, p: Any) -> Any:
        """Return the states after each step. table: a row of inputs for each; None: the signals.

        added: a row for each step, added to the inputs.
        """
        m, h, rows = self.method, mpmath.mpf(self.h), [(q, qd)]
        square = [[mpmath.mpf(x.numerator) / x.denominator for x in row] for row in m.a_squared]
        A = [[mpmath.mpf(x.numerator) / x.denominator for x in row] for row in m.a]
        b, bA, c = (
            [mpmath.mpf(x.numerator) / x.denominator for x in row] for row in (m.b, m.b_a, m.c)
        )
        for n in range(self.steps):
            a: list[Any] = []
            for i in range(m.stages):
                t = mpmath.mpf(self.t0) + n * h + c[i] * h
                r = (
                    q
                    + h * c[i] * qd
                    + h * h * sum(x * y for x, y in zip(square[i], a, strict=False))
                )
                v = qd + h * sum(x * y for x, y in zip(A[i], a, strict=False))
                u = self.signal(r, v, p, t) if table is None else table[n]
                a.append(self.acceleration(r, v, u + added[n], p, t))
            q = q + h * qd + h * h * sum(x * y for x, y in zip(bA, a, strict=True))
            qd = qd + h * sum(x * y for x, y in zip(b, a, strict=True))
            rows.append((q, qd))
        return rows


def precise(x: Any) -> Any:
    """Return an array of mpmath's numbers."""
    return np.vectorize(lambda number: mpmath.mpf(float(number)), otypes=[object])(x)


@pytest.mark.parametrize("with_table", [False, True])
@pytest.mark.parametrize("method", tiers(["rk4", "dp8", "euler"], "rk4"))
def test_gradients_agree_with_differences_of_fifty_digits(
    modules: Modules, method: str, with_table: bool
) -> None:
    """Along a direction in start, inputs and parameters; of signals, inputs are added to them."""
    m, system = modules.unoptimised(LOOP), from_scene(parse(LOOP, "test.toml"))
    random, h, steps, every = np.random.default_rng(1), 0.05, 8, 3
    q, qd, t0 = random.standard_normal(2), random.standard_normal(2), 0.25
    u = random.standard_normal((steps, 2)) if with_table else None
    p = np.array([3.0, 1.25])
    run = m.simulate(q, qd, h=h, steps=steps, every=every, t0=t0, u=u, params=p, method=method)
    q_bar, qd_bar = random.standard_normal((2, *run.q.shape))
    gradient = run.vjp(q_bar, qd_bar)
    directions = [random.standard_normal(x.shape) for x in gradient]
    with mpmath.workdps(50):
        reference, by = PreciseRun(system, method, h, steps, t0), mpmath.mpf(10) ** -20
        at = [0, 3, 6, 8]
        sums = []
        for sign in (1, -1):
            dq, dqd, du, dp = (sign * by * precise(x) for x in directions)
            table = None if u is None else precise(u)
            rows = reference.rows(precise(q) + dq, precise(qd) + dqd, table, du, precise(p) + dp)
            pairs = zip(at, precise(q_bar), precise(qd_bar), strict=True)
            sums.append(sum(np.sum(a * rows[k][0] + b * rows[k][1]) for k, a, b in pairs))
        exact = float((sums[0] - sums[1]) / (2 * by))
    value = sum(np.sum(x * y) for x, y in zip(gradient, directions, strict=True))
    assert value == pytest.approx(exact, rel=1e-12)


def difference(function: Callable[[float], float]) -> float:
    """Return the derivative at 0 by central differences of order 8, accurate to about 1e-11."""
    stencil, by = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280)), 2e-3
    return sum(w * (function(k * by) - function(-k * by)) for k, w in stencil) / by


@pytest.mark.parametrize("repeats", [True, False])
@pytest.mark.parametrize("every", [1, 7, 60, 1000])
@pytest.mark.parametrize("text", [LOOP, CHAIN])
def test_gradients_do_not_depend_on_the_rows_that_are_stored(
    modules: Modules, monkeypatch: pytest.MonkeyPatch, text: str, every: int, repeats: bool
) -> None:
    """Without repetition, steps between two rows are made again in parts."""
    m, random = modules.unoptimised(text), np.random.default_rng(2)
    if not repeats:
        own = import_module(f"{m.Trajectory.__module__.rpartition('.')[0]}.sensitivity")
        monkeypatch.setattr(own, "MAX_REPEATED_NUMBERS", 0)
    n, steps, h = m.nq, 120, 0.01
    q, qd, dq, dqd, last = random.standard_normal((5, n)) * 0.3
    u = random.standard_normal((30, m.nu)) if m.nu else None
    arguments = {"h": h, "steps": steps, "every": every}
    if m.nu:
        arguments["control_period"] = 4 * h
    run = m.simulate(q, qd, u=u, **arguments)
    bar = np.zeros_like(run.q)
    bar[-1] = last
    gradient = run.vjp(bar)
    assert gradient.u.shape == ((30, m.nu) if m.nu else (steps, 0))
    du = random.standard_normal(gradient.u.shape)

    def end(x: float) -> float:
        inputs = u + x * du if m.nu else None
        states = m.simulate(q + x * dq, qd + x * dqd, u=inputs, **arguments).q
        return float(last @ states[-1])

    value = gradient.q @ dq + gradient.qd @ dqd + np.sum(gradient.u * du)
    assert value == pytest.approx(difference(end), rel=1e-9)


@pytest.mark.parametrize("u", [[0.3, -0.4], None])
def test_gradients_by_parameters_and_constant_inputs(modules: Modules, u: Any) -> None:
    m = modules.unoptimised(LOOP)

    def run(x: float) -> Any:
        inputs = None if u is None else np.array(u) + x * np.array([1.0, 2.0])
        return m.simulate(h=0.02, steps=40, u=inputs, params={"k": 4.0 + x, "m": 1.5 - x})

    one = run(0.0)
    gradient = one.vjp(np.cos(one.q), one.qd)
    value = gradient.p @ [1, -1] + (gradient.u @ [1, 2] if u else 0)
    assert gradient.u.shape == ((2,) if u else (40, 2))

    def loss(x: float) -> float:
        states = run(x)
        return float(np.sum(np.sin(states.q)) + np.sum(states.qd**2) / 2)

    assert value == pytest.approx(difference(loss), rel=1e-9)
    assert all(np.all(x == 0) for x in one.vjp(None))
    start = m.simulate(h=0.02, steps=0).vjp([[1.0, 2.0]], [[3.0, 4.0]])
    assert [start.q.tolist(), start.qd.tolist(), start.u.shape] == [[1, 2], [3, 4], (0, 2)]


@pytest.mark.parametrize("method", ["gauss8", "gauss16"])
def test_gradients_of_implicit_methods(modules: Modules, method: str) -> None:
    m, random = modules.unoptimised(LOOP), np.random.default_rng(4)
    q, qd, dq, dqd, w = random.standard_normal((5, 2)) * 0.3
    how: dict[str, Any] = {"h": 0.05, "steps": 30, "every": 4, "method": method}

    def end(x: float) -> float:
        states = m.simulate(q + x * dq, qd + x * dqd, params={"m": 1.5 + x}, **how)
        return float(w @ states.q[-1])

    run = m.simulate(q, qd, **how)
    bar = np.zeros_like(run.q)
    bar[-1] = w
    gradient = run.vjp(bar)
    value = gradient.q @ dq + gradient.qd @ dqd + gradient.p[m.parameters.index("m")]
    assert value == pytest.approx(difference(end), rel=1e-9)


def test_gradients_of_stiff_motions_are_refused(modules: Modules) -> None:
    """Newton's method makes the steps; the adjoint has fixed-point iterations."""
    m = modules.unoptimised(LOOP)
    how = {"h": 0.05, "steps": 3, "method": "gauss8", "params": {"k": 1e5}, "u": [0.0, 0.0]}
    run = m.simulate([1e-4, 0.0], **how)
    assert run.status == "ok"
    with pytest.raises(m.MotionError, match="converge"):
        run.vjp(run.q)


@pytest.mark.usefixtures("quickly_compiled")
def test_both_forms_of_c_give_the_same_gradient() -> None:
    system = from_scene(parse(RK4_LOOP.replace('"steered"', '"steered_plain"'), "test.toml"))
    runs = [
        eomc.load(system, "build/tests", form=form).simulate(h=0.02, steps=40, every=6)
        for form in ("plain", "fast")
    ]
    one, other = (run.vjp(np.ones_like(run.q)) for run in runs)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11)


EVENT = """[[event]]
name = "ground"
when = "x - 0.25"
action = "jump"
x_dot = "-x_dot"
"""


@pytest.mark.slow
def test_runs_without_an_adjoint_are_refused(modules: Modules) -> None:
    m = modules.unoptimised(LOOP)
    steps = {"h": 0.02, "steps": 20}
    for words, run in (('linearize = "products"', modules("cartpole").simulate(**steps)),):
        with pytest.raises(ValueError, match=words):
            run.vjp(np.ones_like(run.q))
    run = m.simulate(**steps)
    for words, bar in ((r"q_bar: shape \(3,\), expected \(21, 2\)", np.ones(3)),
                       ("q_bar: not all", run.q * np.nan)):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            run.vjp(bar)
    jumps = modules.unoptimised(RK4_LOOP.replace("k*theta +", "sign(theta) +"))
    with pytest.raises(ValueError, match="a signal of the scene jumps"):
        jumps.simulate(**steps).vjp(run.q)
    assert jumps.simulate(u=[1.0, 2.0], **steps).vjp(run.q).u.shape == (2,)
    bounces = modules.unoptimised(RK4_LOOP.replace("[run]", f"{EVENT}[run]"))
    assert bounces.simulate(h=0.02, steps=1).vjp(np.ones((2, 2))).q.shape == (2,)
    constrained = modules.unoptimised(text_of("four_bar", 'linearize = "products"'))
    with pytest.raises(ValueError, match="runs with constraints have no adjoint"):
        constrained.simulate(**steps).vjp(np.ones((21, 3)))


# lines of csrc/solver/adjoint.c, and their beginnings with another sign
WRONG_SIGNS = {
    "a_bar[k] += h": "a_bar[k] -= h",
    "a_bars[NQ*i + k] = h": "a_bars[NQ*i + k] = -h",
    "to->qd[k] += bar[NQ + k]": "to->qd[k] -= bar[NQ + k]",
    "to->qd[k] += h": "to->qd[k] -= h",
    "to->u[k] += bar": "to->u[k] -= bar",
    "to->p[k] += bar": "to->p[k] -= bar",
    "bar[k] += of_signals": "bar[k] -= of_signals",
    "a_bar, r, v, t + eom": "a_bar, r, v, t - eom",
}


@pytest.mark.parametrize("right", tiers(WRONG_SIGNS, "to->p[k] += bar"))
def test_check_detects_a_wrong_adjoint(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, right: str
) -> None:
    read, wrong = resources.text, WRONG_SIGNS[right]
    assert read("csrc", "solver/adjoint.c").count(right) == 1
    monkeypatch.setattr(resources, "text", lambda *where: read(*where).replace(right, wrong))
    definitions: Any = amalgamate.definitions
    monkeypatch.setattr(amalgamate, "definitions", definitions.__wrapped__)
    monkeypatch.setenv("EOMC_CFLAGS", "-O0")
    system = replace(from_scene(parse(RK4_LOOP, "test.toml")), digest=wrong.encode().hex())
    module = eomc.load(system, tmp_path)
    report = check(system, module, states=4, tables=[equations.derivative_checks])
    assert [row.name for row in report.results if not row.passed] == ["adjoint by rk4"]


@pytest.mark.parametrize("inputs", ["table", "constant", "signals"])
def test_instances_of_batches_have_the_gradients_of_single_runs(
    modules: Modules, inputs: str
) -> None:
    """Tables differ from instance to instance; constant inputs are the same for all."""
    m = modules.unoptimised(RK4_LOOP + "batch = true\n")
    random = np.random.default_rng(5)
    q0, qd0 = random.standard_normal((2, 3, 2)) * 0.3
    tables = {"table": random.standard_normal((3, 5, 2)), "constant": np.ones(2)}
    u, steps = tables.get(inputs), {"h": 0.02, "steps": 20, "every": 3}
    steps |= {"control_period": 0.08} if inputs == "table" else {}
    batch = m.simulate_batch(q0, qd0, u=u, **steps)
    gradient = batch.vjp(batch.q, batch.qd)
    for k in range(3):
        own = u[k] if inputs == "table" else u
        run = m.simulate(q0[k], qd0[k], u=own, **steps)
        for one, of_batch in zip(run.vjp(run.q, run.qd), gradient, strict=True):
            np.testing.assert_allclose(of_batch[k], one, rtol=1e-9, atol=1e-12)
    with pytest.raises(ValueError, match=r"q_bar: shape \(2, 2\), expected \(3, 8, 2\)"):
        batch.vjp(np.ones((2, 2)))
