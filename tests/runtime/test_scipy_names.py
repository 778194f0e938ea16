"""Runs and batches have the names of SciPy's solve_ivp, with its types and shapes."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.event_scenes import BALL
from support.session import Modules

from eomc.runtime.package import model_of

OPTIONS: dict[str, dict[str, Any]] = {
    "adaptive steps": {"duration": 1.0},
    "adaptive steps, times": {"times": np.linspace(0.0, 1.0, 6)},
    "fixed steps": {"h": 0.01, "duration": 1.0},
    "fixed steps, every": {"h": 0.01, "duration": 1.0, "every": 7},
    "fixed steps, times": {"h": 0.01, "times": np.linspace(0.0, 1.0, 6)},
}


@pytest.fixture(scope="module")
def ball(modules: Modules) -> ModuleType:
    return modules.unoptimised(BALL.replace("tolerance = 1e-9", "tolerance = 1e-10"))


def reference(ball: ModuleType) -> Any:
    """Fall to the first impact, by SciPy."""

    def impact(t: float, x: Any) -> float:
        return float(x[1])

    def top(t: float, x: Any) -> float:
        return float(x[3] - 100)  # never

    impact.terminal = True  # type: ignore[attr-defined]
    x0 = np.concatenate(ball.start)
    return solve_ivp(
        ball.rhs, (0, 1), x0, events=[impact, top], dense_output=True, rtol=1e-10, atol=1e-12
    )


@pytest.mark.parametrize("options", OPTIONS.values(), ids=list(OPTIONS))
@pytest.mark.parametrize("detects_events", [False, True], ids=["ignored", "events"])
def test_run_has_the_names_and_shapes_of_scipy(
    ball: ModuleType, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], detects_events: bool
) -> None:
    monkeypatch.setattr(model_of(ball).integrator, "ignores_events", not detects_events)
    ivp, run = reference(ball), ball.simulate(**options)
    assert type(run).__name__ == "Trajectory" and type(run.success) is type(ivp.success) is bool
    assert run.success and type(run.message) is type(ivp.message) is str
    assert type(run.nfev) is type(ivp.nfev) is int and run.nfev == run.evaluations > 0
    for t in (0.2, [0.1, 0.2, 0.3], np.array([0.2])):
        assert run.sol(t).shape == ivp.sol(t).shape
        np.testing.assert_allclose(run.sol(t), ivp.sol(t), atol=1e-7)
    names = model_of(ball).info.events if detects_events or run.tol else ()
    assert len(run.t_events) == len(run.y_events) == len(names)
    for t, y in zip(run.t_events, run.y_events, strict=True):
        assert t.ndim == ivp.t_events[0].ndim == 1
        assert y.shape == (len(t), 4) and ivp.y_events[0].shape == (1, 4)
    if names:
        assert run.t_events[0][0] == pytest.approx(ivp.t_events[0][0], abs=1e-9)
        np.testing.assert_allclose(run.y_events[0][0], ivp.y_events[0][0], atol=1e-7)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=list(OPTIONS))
def test_batch_has_the_names_of_scipy(ball: ModuleType, options: dict[str, Any]) -> None:
    runs = ball.simulate_batch(params={"e": [0.8, 0.7, 0.6]}, **options)
    assert type(runs).__name__ == "BatchTrajectory"
    assert runs.success.tolist() == [True] * 3 and isinstance(runs.message, str)
    assert np.array_equal(runs.nfev, runs.evaluations) and runs.nfev.shape == (3,)
    assert runs.sol(0.2).shape == (3, 4) and runs.sol([0.1, 0.2]).shape == (3, 4, 2)
    for k, e in enumerate([0.8, 0.7, 0.6]):
        run = ball.simulate(params={"e": e}, **options)
        np.testing.assert_allclose(runs.sol([0.1, 0.9])[k], run.sol([0.1, 0.9]), atol=1e-9)
        instance = runs.events["impact"].instance == k
        assert runs.t_events[0][instance] == pytest.approx(run.t_events[0], abs=1e-9)
        np.testing.assert_allclose(runs.y_events[0][instance], run.y_events[0], atol=1e-7)


def test_classes_have_the_same_attributes() -> None:
    from eomc.runtime.batch_trajectory import BatchTrajectory
    from eomc.runtime.trajectory import Trajectory

    own = {"error", "estimate", "balance", "section"}  # of one run
    fields = set(Trajectory.__dataclass_fields__)
    names = {x for x in dir(Trajectory) if not x.startswith("_")} | fields
    common = {x for x in dir(BatchTrajectory) if not x.startswith("_")}
    common |= set(BatchTrajectory.__dataclass_fields__)
    documented = {"t", "q", "qd", "u", "energy", "jacobi", "outputs", "constraints", "multipliers",
                  "reactions", "status", "success", "message", "sol", "nfev", "evaluations",
                  "t_events", "y_events", "events", "h", "method", "steps", "every", "tol", "t0",
                  "rejected", "stiff_steps", "reached", "stopped", "limit", "request", "params",
                  "saturated", "save", "to_dict", "to_pandas", "to_xarray", "plot",
                  "animate"}  # fmt: skip
    assert documented <= common and documented | own <= names


def test_failed_run_is_no_success(ball: ModuleType) -> None:
    with pytest.warns(RuntimeWarning, match="stopped"):
        assert not ball.simulate(qd0=[1e300, 0.0], h=1e10, steps=3).success


def test_selected_instances_are_those_of_the_batch(ball: ModuleType) -> None:
    runs = ball.simulate_batch(params={"e": [0.8, 0.7, 0.6]}, duration=1.0, times=[0.0, 0.5, 1.0])
    chosen = runs.select([2, 0])
    assert np.array_equal(chosen.q, runs.q[[2, 0]]) and chosen.params["e"].tolist() == [0.6, 0.8]
    assert np.array_equal(chosen.steps, runs.steps[[2, 0]])
    for k, original in enumerate([2, 0]):
        actual, expected = (
            r.events["impact"].for_instance(i) for r, i in ((chosen, k), (runs, original))
        )
        assert np.array_equal(actual.t, expected.t)
    assert np.array_equal(chosen(0.3)[0], runs(0.3)[0][[2, 0]])
