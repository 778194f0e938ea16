"""Where a motion ends: D singular, numbers not finite."""

from __future__ import annotations

import re
from types import ModuleType

import numpy as np
import pytest
from conftest import MODULES, Modules
from states import QD, Q

import eomc
from eomc.model.system import System, symbol


def fader() -> System:
    """K = x x'^2/2 under the force x'^2/2 moves evenly, x'' = 0, until D = x is 0."""
    x, v = symbol("x"), symbol("x_dot")
    return System.make("fader", {x: 1.0}, x * v**2 / 2, forces={x: v**2 / 2}, h=1 / 8, duration=10)


def escape() -> System:
    """x'' = 2 x^3 from x = 1, x' = 1 is x = 1/(1 - t): infinite at t = 1."""
    x, v = symbol("x"), symbol("x_dot")
    return System.make("escape", {x: (1.0, 1.0)}, v**2 / 2, -(x**4) / 2, h=0.01, duration=2)


def test_a_motion_that_runs_away_keeps_what_it_had() -> None:
    module = eomc.load(escape(), MODULES)
    with pytest.warns(RuntimeWarning, match=r"escape: stopped at t = 1\.\d+ after 1\d\d steps"):
        run = module.simulate()
    assert run.status == "not finite"
    assert np.isfinite(run.q).all()
    assert np.isfinite(run.qd).all()
    assert len(run) == run.steps + 1
    assert run.t[-1] == run.steps * 0.01
    assert 1.0 <= run.t[-1] < 1.2
    for words in (f"t = {run.t[-1]:g}", "q = [", "qd = [", "no longer be finite"):
        assert words in run.message
    assert run.energy.shape == run.t.shape
    good = module.simulate(duration=0.9)  # what was kept is the motion up to there
    assert np.array_equal(run.q[:91], good.q)


@pytest.mark.parametrize("every", [1, 4, 1000])
def test_a_singular_mass_matrix_ends_a_run(every: int) -> None:
    """The last good state is kept, whatever rows were wanted."""
    module = eomc.load(fader(), MODULES)
    with pytest.raises(ArithmeticError, match="D is not positive") as fault:
        module.acceleration([0.0], [1.0])
    assert fault.value.status == "singular"
    with pytest.warns(RuntimeWarning, match=r"fader: stopped at t = 0\.75 .*D is not positive"):
        # the seventh step, from x = 1/8, would end at x = 0
        run = module.simulate([7 / 8], [-1.0], every=every)
    assert run.status == "singular"
    assert run.steps == 6
    assert run.t.tolist() == {1: [k / 8 for k in range(7)], 4: [0, 0.5, 0.75]}.get(every, [0, 0.75])
    assert np.array_equal(run.q[:, 0], 7 / 8 - run.t)


def test_a_fall_into_the_centre(modules: Modules) -> None:
    """Kepler's orbit without a sideways velocity ends at r = 0, or says that it can't go on."""
    kepler = modules("kepler_orbit")
    q, qd = kepler.start
    zero = np.zeros_like(q)
    with pytest.raises(ArithmeticError, match=r"at q = \[0\. 0\.\].*not finite") as fault:
        kepler.acceleration(zero, qd)
    assert fault.value.status == "not finite"
    with pytest.warns(RuntimeWarning, match=r"kepler_orbit: stopped at t = 0 "):
        run = kepler.simulate(zero, qd, steps=5)
    assert (run.status, run.steps, run.q.tolist()) == ("not finite", 0, [[0, 0]])


def test_the_pole_of_euler_angles(modules: Modules) -> None:
    """At theta = 0 the heavy top's D is singular: two of its angles turn about one axis."""
    top = modules("heavy_top")
    q, qd = (x.copy() for x in top.start)
    q[top.coordinates.index("theta")] = 0.0
    with pytest.raises(ArithmeticError, match="D is not positive definite") as fault:
        top.acceleration(q, qd)
    assert fault.value.status == "singular"
    with pytest.warns(RuntimeWarning, match="heavy_top: stopped at t = 0 .*D is not positive"):
        run = top.simulate(q, qd, steps=5)
    assert (run.status, run.steps, len(run)) == ("singular", 0, 1)
    with pytest.raises(ArithmeticError, match=r"no step from t = 1.5, q = \["):
        top.step(q, qd, t=1.5)


def test_a_failed_call_leaves_out_untouched(modules: Modules) -> None:
    top = modules("heavy_top")
    q, qd = top.start
    bad = q * 0
    out = np.full((3, 3), 7.0)
    with pytest.raises(ArithmeticError, match=re.escape(np.array2string(bad))):
        top.acceleration([q, bad, q], [qd, qd, qd], out=out)
    assert np.all(out == 7)
    ends = np.full(3, 7.0), np.full(3, 7.0)
    with pytest.raises(ArithmeticError):
        top.step(bad, qd, out=ends)
    assert np.all(np.array(ends) == 7)


def test_parameters_that_leave_no_inertia(cartpole: ModuleType) -> None:
    with pytest.raises(ArithmeticError, match="D is not positive definite"):
        cartpole.acceleration(Q, QD, params={"m_c": 0.0, "m_p": 0.0})
    with pytest.warns(RuntimeWarning, match="stopped at t = 0"):
        assert cartpole.simulate(steps=3, params={"m_p": -5.0}).steps == 0


def test_in_c_a_step_less_than_zero_goes_back(cartpole: ModuleType) -> None:
    """As docs/c.md says; Python refuses it."""
    model = cartpole._model
    step, pointer, null = model.integrator.loops["rk4"][0], model.c.pointer, model.c.tools[2]
    q, qd = np.array(Q[:2]), np.array(QD[:2])

    def stepped(h: float) -> int:
        at, moving = q.copy(), qd.copy()
        parts = pointer(q), pointer(qd), pointer(at), pointer(moving)
        return int(step(*parts, 0.0, h, null, model.arguments.default_pointers[2]))

    begun = np.hstack([q, qd])
    assert stepped(-0.01) == 0 and np.abs(np.hstack([q, qd]) - begun).max() > 1e-4
    assert stepped(0.01) == 0
    np.testing.assert_allclose(np.hstack([q, qd]), begun, atol=1e-9)
    there = np.hstack([q, qd])
    assert stepped(0.0) == 0 and stepped(float("nan")) == stepped(float("inf")) == 2
    assert np.array_equal(np.hstack([q, qd]), there)
    with pytest.raises(ValueError, match="h: -1 is not a step size"):
        cartpole.step(q, qd, -1.0)
