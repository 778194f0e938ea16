"""Files that earlier versions saved are loaded; `python tests/runtime/test_earlier_files.py` in the
version that is to become an earlier one writes those in tests/runtime/earlier_files/.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.session import Modules

from eomc.runtime.package import model_of

FOLDER = Path(__file__).parent / "earlier_files"
SCENE = """eomc = 1
name = "earlier"
[coordinates]
y = { unit = "m", start = 1.0 }
[parameters]
m = { value = 1.0, unit = "kg" }
g = { value = 9.81, unit = "m/s^2" }
e = 0.9
[inputs]
f = { unit = "N", signal = "0.1*sin(t)" }
[energy]
kinetic = "m*y_dot**2/2"
potential = "m*g*y"
[forces]
y = "f - y_dot/10"
[[event]]
name = "impact"
when = "y"
direction = "falling"
action = "jump"
y_dot = "-e*y_dot"
[[event]]
name = "end"
when = "y_dot + 4"
action = "stop"
[run]
h = 0.01
duration = 0.2
batch = true
tolerance = 1e-9
"""
TIMES = np.array([0.0, 0.013, 0.1, 0.15])
TABLE = np.sin(np.arange(20.0))[:, None]
Q0 = np.array([[1.0], [0.5], [0.3]])


def law(t: float, q: Any, qd: Any) -> float:
    return float(-q[0] - qd[0] + t)


# name of the file, arguments, and whether events are ignored; with q0 of several instances a batch
CASES: dict[str, tuple[dict[str, Any], bool]] = {
    "run": ({"steps": 20, "every": 3}, True),
    "run_table": ({"steps": 20, "every": 3, "u": TABLE}, True),
    "run_function": ({"steps": 20, "u": law, "control_period": 0.04}, True),
    "run_function_between_rows": ({"steps": 20, "every": 3, "u": law}, True),
    "timed_run": ({"h": 0.01, "times": TIMES, "u": TABLE[:15]}, True),
    "timed_run_function": ({"h": 0.01, "times": TIMES, "u": law}, True),
    "adaptive_run": ({"u": law, "control_period": 0.05, "duration": 0.6}, False),
    "adaptive_run_table": ({"u": TABLE[:3], "control_period": 0.05, "times": TIMES}, False),
    "stepped_run": ({"h": 0.01, "duration": 0.5, "u": 0.5}, False),
    "batch_run": ({"q0": Q0, "steps": 20, "every": 3, "u": TABLE[None]}, True),
    "batch_run_signals": ({"q0": Q0, "steps": 20, "params": {"m": [1.0, 2.0, 3.0]}}, True),
    "timed_batch_run": ({"q0": Q0, "h": 0.01, "times": TIMES, "u": TABLE[None, :15]}, True),
    "adaptive_batch_run": ({"q0": Q0, "times": TIMES, "duration": 0.5}, False),
    "stepped_batch_run": ({"q0": Q0, "h": 0.01, "duration": 0.5, "u": 0.5}, False),
}


def simulate(module: Any, name: str) -> Any:
    arguments, ignores_events = CASES[name]
    call: Callable[..., Any] = module.simulate_batch if "q0" in arguments else module.simulate
    integrator = model_of(module).integrator
    integrator.ignores_events = ignores_events
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            return call(**arguments)
    finally:
        integrator.ignores_events = False


@pytest.fixture(scope="module")
def module(modules: Modules) -> ModuleType:
    return modules.unoptimised(SCENE)


@pytest.mark.parametrize("name", CASES)
def test_run_of_an_earlier_version_equals_the_same_run_of_this_version(
    module: ModuleType, name: str
) -> None:
    loaded, run = module.load_run(FOLDER / f"{name}.npz"), simulate(module, name)
    assert type(loaded) is type(run) and np.array_equal(loaded.status, run.status)
    for what in ("h", "every", "tol") if not run.tol else ("every", "tol"):
        assert getattr(loaded, what) == getattr(run, what), what
    assert loaded.method == run.method
    # this version may choose other adaptive steps
    tol = 1e-7 if run.tol else 1e-12
    if run.tol:
        np.testing.assert_allclose(loaded.q, run(loaded.t)[0], atol=tol)
        assert (
            loaded.u.shape == (*loaded.q.shape[:-1], 1)
            and loaded.energy.shape == loaded.u.shape[:-1]
        )
    else:
        assert loaded.message == run.message
        for what in ("t", "q", "qd", "u", "energy", "steps"):
            actual, expected = getattr(loaded, what), getattr(run, what)
            np.testing.assert_allclose(actual, expected, rtol=tol, atol=tol, err_msg=what)
    assert np.asarray(loaded.evaluations) == pytest.approx(np.asarray(run.evaluations), rel=0.3)
    for a, b in zip(loaded.t_events, run.t_events, strict=True):
        assert a == pytest.approx(b, abs=tol)
    at = np.linspace(run.t[0], run.t[-1], 7)
    if name == "run_function_between_rows":
        with pytest.raises(ValueError, match="values between rows are not stored"):
            loaded(at)
    else:
        np.testing.assert_allclose(loaded(at), run(at), rtol=tol, atol=tol)
        np.testing.assert_allclose(loaded.sol(at[3]), run.sol(at[3]), rtol=tol, atol=tol)


if __name__ == "__main__":
    import eomc

    FOLDER.mkdir(exist_ok=True)
    scene = Path(sys.argv[1]) / "earlier.toml"
    scene.write_text(SCENE, encoding="utf-8")
    built = eomc.load(scene, scene.parent)
    for each in CASES:
        simulate(built, each).save(FOLDER / f"{each}.npz")
        with np.load(FOLDER / f"{each}.npz") as arrays:
            np.savez_compressed(FOLDER / f"{each}.npz", **arrays)
