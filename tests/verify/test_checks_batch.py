"""Checks of batches compare all significant digits, and no more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.session import Modules, tiers
from support.template_checks.batches import STEPS, BatchChecks
from support.template_checks.runs import RunChecks, run_in_c

from eomc.model.system import from_scene
from eomc.scene.read import parse
from eomc.verify.comparison import Comparison

# forces that depend on a slide; with a cosine of it they have no digit at 1e304
SLIDE = """eomc = 1
name = "slide"
[coordinates]
x = { start = 0.1, rate = 0.2 }
[parameters]
k = 60.0
[energy]
kinetic = "x_dot**2/3"
potential = "k*x**2/2"
dissipation = "x_dot**2/6"
[forces]
x = "FORCE"
[run]
h = 0.02
batch = true
"""
NEARLY_OVERFLOWING = 5e305
OVERFLOWING = 8e306  # after a few steps

pytestmark = pytest.mark.usefixtures("quickly_compiled")


def batches(modules: Modules, force: str, text: str = SLIDE) -> BatchChecks:
    text = text.replace("FORCE", force)
    system = from_scene(parse(text, "slide.toml"))
    comparison = Comparison(system, modules.unoptimised(text), np.random.default_rng(0), 4)
    return BatchChecks(RunChecks(comparison), [])


@pytest.mark.parametrize(
    ("force", "digits"), tiers([("-x/7", True), ("-40*cos(x)*x", False)], "-40*cos(x)*x")
)
def test_rows_without_digits_are_compared_by_rounding(
    modules: Modules, force: str, digits: bool
) -> None:
    b = batches(modules, force)
    s = replace(b.instances[0], q=np.zeros(1), qd=np.array([NEARLY_OVERFLOWING]))
    single, perturbed = (
        run_in_c(b.model, "rk4", replace(s, qd=s.qd * by), b.h, STEPS) for by in (1, 1 + 1e-13)
    )
    rows = single.rows[:, :6]
    assert not b.differs_beyond_rounding("rk4", s, rows, single)
    assert not b.differs_beyond_rounding("rk4", s, perturbed.rows[:, :6], single)
    assert b.differs_beyond_rounding("rk4", s, rows * 1.01, single) == digits


def test_last_row_of_a_stopped_instance_equals_a_single_run(modules: Modules) -> None:
    """This includes a stop after the first step; a running instance has no digit left to
    compare.
    """
    b = batches(modules, "-x/7")
    s = replace(b.instances[0], q=np.zeros(1), qd=np.array([OVERFLOWING]), params=None)
    alone = run_in_c(b.model, "rk4", s, b.h, STEPS)
    assert 0 < alone.steps < STEPS and alone.status
    whole = b.simulate("rk4", [s] * len(b.instances), None)
    for steps in range(alone.steps, 0, -1):  # rounding may decide a step that nearly fails
        whole.steps[0] = steps
        whole.q[0, steps + 1 :] = whole.qd[0, steps + 1 :] = np.nan
        assert not b.fails_differently("rk4", whole, 0, s)
        whole.q[0, steps] *= 1.01
        assert b.fails_differently("rk4", whole, 0, s)
    whole = b.simulate("rk4", b.instances, None)
    whole.q[0, STEPS] *= 1.01
    assert not b.fails_differently("rk4", whole, 0, b.instances[0])


def test_own_and_shared_parameters_are_compared_by_rounding(modules: Modules) -> None:
    b = batches(modules, "-x/7")
    alike = [replace(s, params=b.instances[0].params) for s in b.instances]
    one, other = (b.simulate("rk4", alike, None, own=own) for own in (False, True))
    by = [b.simulate("rk4", b.with_rounding_errors(alike), None)]
    assert b.differ_by_rounding_only(one, other, by) and b.differ_by_rounding_only(by[0], other, by)
    one.q[3, 5] *= 1 + 1e-10
    assert not b.differ_by_rounding_only(one, other, by)


COUPLED = """eomc = 1
name = "coupled"
[coordinates]
x = { start = 0.5 }
y = { start = 0.5 }
[parameters]
k = 1e9
[energy]
kinetic = "x_dot**2/2 + y_dot**2/2"
potential = "k*(x - y)**2/2"
[run]
h = 0.02
batch = true
"""


def test_perturbation_of_single_coordinates_counts(modules: Modules) -> None:
    """Equal changes of both leave the spring between them unchanged; rounding errors do not."""
    b = batches(modules, "", COUPLED)
    s = replace(b.instances[0], q=np.array([0.5, 0.5]), qd=np.array([0.1, 0.1]), params=None)
    perturbed = run_in_c(b.model, "rk4", replace(s, q=np.array([0.5 + 1e-16, 0.5])), b.h, 1)
    assert (
        np.abs(perturbed.rows[:, 1] - run_in_c(b.model, "rk4", s, b.h, 1).rows[:, 1]).max() > 1e-8
    )
    off = b.step_error("rk4", s, perturbed.rows[:, 1])
    assert off is not None and off < 10
