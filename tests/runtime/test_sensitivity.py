"""Sensitivities of runs, against differences of 55 digits and differences of runs."""

from __future__ import annotations

from typing import Any

import mpmath
import numpy as np
import pytest
from support.session import Modules, tiers
from test_constrained_discretize import WINCH, difference_quotients
from test_discretize import EXPLICIT, INPUTS, LOOP, QD, Q, exact_stepper

OUTPUTS = '[outputs]\nspring = "k*x + lean"\npull = "theta_ddot*k + force"\n'
OBSERVED = EXPLICIT.replace("[run]\n", OUTPUTS + "[run]\ntolerance = 1e-9\n")
TABLE = [[0.6, -0.4], [-2.0, 0.1], [40.0, 0.3]]
K = 4.0


def exact_sensitivity(u: Any, hold: int, steps: int, h: float) -> list[Any]:
    """Return d[q; qd]/d[q0, qd0, u, p] after each step of RK4, accurate to all digits."""
    stepper = exact_stepper(EXPLICIT)
    rows = [] if u is None else np.broadcast_to(u, (3, 2))

    def states(z: Any) -> Any:
        x, result = z[:4], []
        for k in range(steps):
            now = None if u is None else [mpmath.mpf(a) for a in rows[k // hold].tolist()]
            x = stepper.step(
                "rk4", np.concatenate([x, z[4:]]), mpmath.mpf(h), k * mpmath.mpf(h), now
            )
            result.append(x)
        return np.array(result)

    with mpmath.workdps(55):
        z = np.array([mpmath.mpf(float(x)) for x in [*Q, *QD, 0, 0, K]])
        width, columns = mpmath.mpf(10) ** -18, []
        for k in range(len(z)):
            ends = [states(z + sign * width * (np.arange(len(z)) == k)) for sign in (1, -1)]
            columns.append(((ends[0] - ends[1]) / (2 * width)).astype(float))
    return [*np.moveaxis(columns, 0, -1)]


@pytest.mark.parametrize("inputs", tiers(["signals", "held", "table"], "table"))
@pytest.mark.parametrize("every", tiers([1, 3], 3))
def test_sensitivities_equal_differences_in_many_digits(
    modules: Modules, inputs: str, every: int
) -> None:
    """With a row after every third step, inputs change between the rows."""
    m, h = modules.unoptimised(OBSERVED), 0.03
    u: Any = TABLE if inputs == "table" else INPUTS[inputs]
    period = 2 * h if inputs == "table" else None
    run = m.simulate(Q, QD, h, steps=6, every=every, u=u, control_period=period)
    result = run.sensitivity()
    assert result._fields == ("start", "inputs", "parameters")
    J = np.concatenate(result, axis=-1)
    assert np.array_equal(J[0], np.eye(4, 7))
    expected = exact_sensitivity(u, 2 if period else 6, 6, h)[every - 1 :: every]
    for a, b in zip(J[1:], expected, strict=True):
        assert np.max(np.abs(a - b)) < 1e-14 * np.max(np.abs(b))


@pytest.mark.parametrize("inputs", ["signals", "held"])
@pytest.mark.parametrize("is_adaptive", [False, True])
def test_derivatives_of_outputs_equal_differences_of_runs(
    modules: Modules, inputs: str, is_adaptive: bool
) -> None:
    """Adaptive runs with short steps between their rows; inputs follow the rows of `OBSERVED`."""
    m, u = modules.unoptimised(OBSERVED), INPUTS[inputs]
    steps: dict[str, Any] = {"h": 0.02, "steps": 20, "every": 5}
    if is_adaptive:
        steps = {"tol": 1e-13, "times": [0.0, 0.1, 0.35]}
    options = {"h": 0.005, "method": "dp8"} if is_adaptive else {}

    def outputs(z: Any) -> Any:
        now, params = None if u is None else u + z[4:6], {"k": z[6]}
        run = m.simulate(z[:2], z[2:4], u=now, params=params, **steps)
        return m.output(run.q, run.qd, run.t, now, params).ravel()

    run = m.simulate(Q, QD, u=u, **steps)
    J = np.concatenate(run.sensitivity(outputs=True, **options), axis=-1)
    expected = difference_quotients(outputs, np.array([*Q, *QD, 0, 0, K])).reshape(J.shape)
    columns = [0, 1, 2, 3, 4, 5, 6] if u else [0, 1, 2, 3, 6]
    error = np.max(np.abs(J - expected)[..., columns])
    assert error < 1e-9 * np.max(np.abs(expected))


@pytest.mark.slow
def test_sensitivities_of_a_constrained_run_equal_differences(modules: Modules) -> None:
    m = modules.unoptimised(WINCH)
    q, qd = m.project(*m.start)
    run = m.simulate(q, qd, steps=20, every=4)

    def end(z: Any) -> Any:
        """Steps from any state, which a run would project first."""
        x = z[:2], z[2:4]
        for k in range(20):
            x = m.step(*x, t=0.02 * k, params=z[4:])
        return np.hstack(x)

    result = run.sensitivity()
    J = np.hstack([result.start[-1], result.parameters[-1]])
    expected = difference_quotients(end, np.hstack([q, qd, 1.3, 0.2]))
    np.testing.assert_allclose(J, expected, rtol=0, atol=1e-9)


def test_scene_without_derivatives_by_parameters_has_those_of_the_state(modules: Modules) -> None:
    m = modules.unoptimised(LOOP + "discretize = true\n")
    result = m.simulate(Q, QD, steps=3).sensitivity()
    assert [x.shape for x in result] == [(4, 4, 4), (4, 4, 2), (4, 4, 0)]
    Phi, _ = m.discretize(Q, QD)
    assert np.array_equal(result.start[1], Phi)


BALL = """eomc = 1
name = "bounced"
[coordinates]
y = { start = 1.0 }
[energy]
kinetic = "y_dot**2/2"
potential = "9.81*y"
[[event]]
name = "impact"
when = "y"
direction = "falling"
action = "jump"
y_dot = "-0.8*y_dot"
[run]
h = 0.01
discretize = true
"""


def test_runs_without_sensitivities_are_refused(modules: Modules, cartpole: Any) -> None:
    m, ball = modules.unoptimised(OBSERVED), modules.unoptimised(BALL)
    with pytest.raises(ValueError, match=r"u is a function.*give the table"):
        m.simulate(Q, QD, steps=3, u=lambda t, q, qd: [0.0, 0.0]).sensitivity()
    with pytest.raises(ValueError, match=r'sensitivity: bounced was built.*linearize = "products"'):
        ball.simulate(duration=1.0, every=7).sensitivity()
    assert ball.simulate(duration=0.4).sensitivity().start[-1] == pytest.approx(
        np.array([[1, 0.4], [0, 1]]), abs=1e-14
    )
    with pytest.raises(
        ValueError, match=r"sensitivity: cartpole was built without.*discretize = t"
    ):
        cartpole.simulate(steps=3).sensitivity()
    with pytest.raises(ValueError, match="sensitivity: bounced has no outputs"):
        ball.simulate(duration=0.1).sensitivity(outputs=True)
    run = m.simulate(Q, QD, steps=3, u=[0.0, 0.0])
    run.rows[0][1] = 1e200
    with pytest.raises(m.MotionError, match=r"no derivative of a step from t = 0.02"):
        run.sensitivity()
