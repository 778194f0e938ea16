"""Runs that end early: singular mass matrix, numbers that are not finite."""

from __future__ import annotations

import re
from types import ModuleType

import numpy as np
import pytest
from support.session import MODULES, Modules
from support.trajectories import QD, Q

import eomc
from eomc.model.system import System, symbol
from eomc.runtime.package import model_of


def vanishing_mass() -> System:
    """K = x x'^2/2 under the force x'^2/2 moves uniformly, x'' = 0, until D = x is 0."""
    x, v = symbol("x"), symbol("x_dot")
    return System.make("fader", {x: 1.0}, x * v**2 / 2, forces={x: v**2 / 2}, h=1 / 8, duration=10)


def finite_time_escape() -> System:
    """x'' = 2 x^3 from x = 1, x' = 1 is x = 1/(1 - t): infinite at t = 1."""
    x, v = symbol("x"), symbol("x_dot")
    return System.make("escape", {x: (1.0, 1.0)}, v**2 / 2, -(x**4) / 2, h=0.01, duration=2)


def test_diverging_run_stores_its_finite_part() -> None:
    module = eomc.load(finite_time_escape(), MODULES)
    with pytest.warns(RuntimeWarning, match=r"escape: stopped at t = 1\.\d+ after 1\d\d steps"):
        run = module.simulate()
    assert run.status == "not finite"
    assert np.isfinite(run.q).all()
    assert np.isfinite(run.qd).all()
    assert len(run) == run.steps + 1
    assert run.t[-1] == run.steps * 0.01
    assert 1.0 <= run.t[-1] < 1.2
    for fragment in (f"t = {run.t[-1]:g}", "q = [", "qd = [", "no longer be finite"):
        assert fragment in run.message
    assert run.energy.shape == run.t.shape
    shorter = module.simulate(duration=0.9)  # the stored rows equal those of a shorter run
    assert np.array_equal(run.q[:91], shorter.q)


@pytest.mark.parametrize("every", [1, 4, 1000])
def test_singular_mass_matrix_ends_a_run(every: int) -> None:
    """The last valid state is stored, whatever the interval of rows is."""
    module = eomc.load(vanishing_mass(), MODULES)
    with pytest.raises(ArithmeticError, match="D is not positive") as error:
        module.acceleration([0.0], [1.0])
    assert error.value.status == "singular"
    with pytest.warns(RuntimeWarning, match=r"fader: stopped at t = 0\.75 .*D is not positive"):
        # the seventh step, from x = 1/8, would end at x = 0
        run = module.simulate([7 / 8], [-1.0], every=every)
    assert run.status == "singular"
    assert run.steps == 6
    assert run.t.tolist() == {1: [k / 8 for k in range(7)], 4: [0, 0.5, 0.75]}.get(every, [0, 0.75])
    assert np.array_equal(run.q[:, 0], 7 / 8 - run.t)


def test_fall_into_the_centre_ends_the_run(modules: Modules) -> None:
    """Kepler's orbit without a transverse velocity ends at r = 0."""
    kepler = modules("kepler_orbit")
    q, qd = kepler.start
    zero = np.zeros_like(q)
    with pytest.raises(ArithmeticError, match=r"at q = \[0\. 0\.\].*not finite") as error:
        kepler.acceleration(zero, qd)
    assert error.value.status == "not finite"
    with pytest.warns(RuntimeWarning, match=r"kepler_orbit: stopped at t = 0 "):
        run = kepler.simulate(zero, qd, steps=5)
    assert (run.status, run.steps, run.q.tolist()) == ("not finite", 0, [[0, 0]])


def test_singular_euler_angles_end_the_run(modules: Modules) -> None:
    """At theta = 0 the heavy top's D is singular: two of its angles turn about one axis."""
    top = modules("heavy_top")
    q, qd = (x.copy() for x in top.start)
    q[top.coordinates.index("theta")] = 0.0
    with pytest.raises(ArithmeticError, match="D is not positive definite") as error:
        top.acceleration(q, qd)
    assert error.value.status == "singular"
    with pytest.warns(RuntimeWarning, match="heavy_top: stopped at t = 0 .*D is not positive"):
        run = top.simulate(q, qd, steps=5)
    assert (run.status, run.steps, len(run)) == ("singular", 0, 1)
    with pytest.raises(ArithmeticError, match=r"no step from t = 1.5, q = \["):
        top.step(q, qd, t=1.5)


def test_failed_call_leaves_out_unchanged(modules: Modules) -> None:
    top = modules("heavy_top")
    q, qd = top.start
    singular = q * 0
    out = np.full((3, 3), 7.0)
    with pytest.raises(ArithmeticError, match=re.escape(np.array2string(singular))):
        top.acceleration([q, singular, q], [qd, qd, qd], out=out)
    assert np.all(out == 7)
    out_step = np.full(3, 7.0), np.full(3, 7.0)
    with pytest.raises(ArithmeticError):
        top.step(singular, qd, out=out_step)
    assert np.all(np.array(out_step) == 7)


def test_parameters_without_inertia_are_refused(cartpole: ModuleType) -> None:
    with pytest.raises(ArithmeticError, match="D is not positive definite"):
        cartpole.acceleration(Q, QD, params={"m_c": 0.0, "m_p": 0.0})
    with pytest.warns(RuntimeWarning, match="stopped at t = 0"):
        assert cartpole.simulate(steps=3, params={"m_p": -5.0}).steps == 0


def test_negative_step_in_c_goes_back(cartpole: ModuleType) -> None:
    """docs/c.md allows it; Python refuses it."""
    model = model_of(cartpole)
    step, pointer, null = model.integrator.step_functions["rk4"], model.c.pointer, model.c.tools[2]
    q, qd = np.array(Q[:2]), np.array(QD[:2])

    def step_in_place(h: float) -> int:
        q_new, qd_new = q.copy(), qd.copy()
        parts = pointer(q), pointer(qd), pointer(q_new), pointer(qd_new)
        return int(step(*parts, 0.0, h, null, model.arguments.default_pointers[2]))

    initial = np.hstack([q, qd])
    assert step_in_place(-0.01) == 0 and np.abs(np.hstack([q, qd]) - initial).max() > 1e-4
    assert step_in_place(0.01) == 0
    np.testing.assert_allclose(np.hstack([q, qd]), initial, atol=1e-9)
    returned = np.hstack([q, qd])
    assert (
        step_in_place(0.0) == 0 and step_in_place(float("nan")) == step_in_place(float("inf")) == 2
    )
    assert np.array_equal(np.hstack([q, qd]), returned)
    with pytest.raises(ValueError, match="h: -1 is not a step size"):
        cartpole.step(q, qd, -1.0)
