"""A parallelogram goes through the position where it lies flat and its rows fade."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

import eomc
from eomc.model.system import Constraint, System

pytestmark = pytest.mark.usefixtures("quickly_compiled")


def parallelogram() -> System:
    rows = {
        "along": "0.4*cos(a) + cos(b) - 0.4*cos(c) - 1",
        "across": "0.4*sin(a) + sin(b) - 0.4*sin(c)",
    }
    made = System.make(
        "flat_again", {"a": (0.05, -3.0), "b": (0.0, 0.0), "c": (0.05, -3.0)},
        "(a_dot**2 + b_dot**2 + c_dot**2)/2", "0", outputs=rows, h=0.005, duration=0.2,
    )  # fmt: skip
    constraints = tuple(Constraint(o.name, o.formula) for o in made.outputs)
    first, *rest = made.coordinates
    free = (first, *(replace(c, held=False, held_rate=False) for c in rest))
    return replace(made, outputs=(), constraints=constraints, coordinates=free)


@pytest.fixture(scope="module", params=["plain", "fast"])
def module(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, unoptimised_file: None
) -> ModuleType:
    return eomc.load(parallelogram(), tmp_path_factory.mktemp("flat"), form=request.param)


@pytest.mark.parametrize("start", [0.05, 0.0503, 0.0471, 0.05 + 1e-5])
def test_a_parallelogram_goes_on_through_the_flat_position(
    module: ModuleType, start: float
) -> None:
    """Rounding in a correction is more than that of a coordinate near zero there."""
    run = module.simulate(q0=[start, 0.0, start], qd0=[-3.0, 0.0, -3.0])
    assert run.status == "ok" and run.q[-1, 0] < -0.5
    np.testing.assert_allclose(run.q[:, 0], start - 3 * run.t, rtol=0, atol=1e-9)
    assert np.abs(run.q[:, 1]).max() < 1e-9
    assert np.ptp(run.energy) < 1e-9


@pytest.mark.parametrize("start", [0.3, 0.06, 0.0375])
def test_a_stage_where_rows_have_no_slope_throws_nothing_out(
    module: ModuleType, start: float
) -> None:
    """At 0 to a rounding, at a step's end or amid one: a row that is rounding holds nothing."""
    run = module.simulate(q0=[start, 0.0, start], qd0=[-3.0, 0.0, -3.0])
    assert run.status == "ok"
    np.testing.assert_allclose(run.q[:, 0], start - 3 * run.t, rtol=0, atol=1e-9)
    assert np.abs(run.qd[:, 0] + 3.0).max() < 1e-6
