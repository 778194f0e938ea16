"""Values of a module can be pickled across processes, copied and compared."""

from __future__ import annotations

import copy
import json
import multiprocessing
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support import trajectories
from support.cases import SCENES
from support.session import MODULES, Modules

import eomc
from eomc.base.errors import Problem
from eomc.model.system import System
from eomc.runtime.package import model_of

COPIES: dict[str, Callable[[Any], Any]] = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda x: pickle.loads(pickle.dumps(x)),
    "pickle protocol 2": lambda x: pickle.loads(pickle.dumps(x, protocol=2)),
}


@pytest.fixture(params=COPIES.values(), ids=list(COPIES))
def copy_value(request: pytest.FixtureRequest) -> Callable[[Any], Any]:
    """A function that copies a value."""
    function: Callable[[Any], Any] = request.param
    return function


@pytest.fixture(scope="session")
def batch() -> ModuleType:
    """Cart-poles."""
    return trajectories.module("cartpole")


# --- copies ---------------------------------------------------------------------------------------


def test_params_are_copied_and_compared(
    cartpole: ModuleType, copy_value: Callable[[Any], Any], modules: Modules
) -> None:
    p = cartpole.Params(m_c=3.25)
    copied_params = copy_value(p)
    assert type(copied_params) is type(p) and copied_params == p and copied_params.m_c == 3.25
    copied_params.l = 7.0
    assert copied_params != p and p.l == 2.0
    assert p == cartpole.Params(m_c=3.25) and p != cartpole.Params() and p != 3
    assert p != modules("simple_pendulum").Params()
    with pytest.raises(TypeError, match="unhashable"):
        hash(p)


def test_run_is_copied_and_compared(driven: ModuleType, copy_value: Callable[[Any], Any]) -> None:
    options: dict[str, Any] = {"steps": 40, "every": 7, "params": {"m_c": 3.0}, "t0": 0.3}
    run = driven.simulate(u=np.full((40, 1), 0.25), **options)
    run.estimate()
    copied_run = copy_value(run)
    assert copied_run == run and type(copied_run) is type(run) and copied_run is not run
    assert (repr(copied_run), copied_run.message) == (repr(run), run.message)
    for name in ("t", "q", "qd", "energy", "jacobi", "x"):
        assert np.array_equal(getattr(copied_run, name), getattr(run, name)), name
    assert copied_run.error.end == run.error.end and np.array_equal(copied_run.error.q, run.error.q)
    repeated = copied_run.estimate()
    assert np.array_equal(repeated.q, run.error.q)
    assert run != driven.simulate(**options) and run != 3
    if copy_value is not copy.copy:
        copied_run.q[0] = 9.0
        assert run.q[0, 0] != 9.0 and copied_run != run


def test_run_under_a_function_is_copied_without_the_function(driven: ModuleType) -> None:
    with (
        pytest.warns(RuntimeWarning)
        if "u" not in model_of(driven).integrator.warned
        else memoryview(b"")
    ):
        run = driven.simulate(steps=10, u=lambda t, q, qd: [-qd[0]])
    copied_run = pickle.loads(pickle.dumps(run))
    assert copied_run == run and np.array_equal(copied_run.energy, run.energy)
    with pytest.raises(ValueError, match=r"^estimate: u was a function.*simulate again"):
        copied_run.estimate()
    estimate = copy.deepcopy(run).estimate()
    assert estimate.order == 4
    # it hangs at rest, where only rounding moves it: that is not chaos
    assert (
        not estimate.verdict and estimate.amplification < 10 and min(estimate.digits.values()) > 12
    )


def test_stopped_run_is_copied(cartpole: ModuleType, copy_value: Callable[[Any], Any]) -> None:
    with pytest.warns(RuntimeWarning):
        run = cartpole.simulate(h=3.0, duration=300.0)
    assert copy_value(run) == run and copy_value(run).status == "not finite"
    interruption = copy_value(cartpole.Interrupted(run))
    assert (
        type(interruption) is cartpole.Interrupted
        and interruption.run == run
        and str(interruption) == run.message
    )


def test_batch_is_copied_and_compared(batch: ModuleType, copy_value: Callable[[Any], Any]) -> None:
    q0 = np.array([[0.0, 0.1], [0.0, 1e300], [0.0, 0.4]])
    run = batch.simulate_batch(q0, h=0.01, steps=30, every=4, params={"m_c": [1.0, 2, 3]})
    copied_run = copy_value(run)
    assert copied_run == run and repr(copied_run) == repr(run) and copied_run is not run
    assert copied_run.status.tolist() == run.status.tolist()
    assert np.array_equal(copied_run.t, run.t) and np.array_equal(copied_run.steps, run.steps)
    assert run != batch.simulate_batch(q0, h=0.01, steps=30, every=5)


def test_motion_error_is_copied(cartpole: ModuleType, copy_value: Callable[[Any], Any]) -> None:
    with pytest.raises(cartpole.MotionError) as error:
        cartpole.step([0, 0.4], [0, 1e200], h=1.0)
    copied_error = copy_value(error.value)
    assert type(copied_error) is cartpole.MotionError
    assert (str(copied_error), copied_error.status) == (str(error.value), "not finite")


def test_modules_and_their_functions_are_pickled_by_reference(cartpole: ModuleType) -> None:
    classes = (cartpole.Params, cartpole.Trajectory, cartpole.MotionError)
    for value in (cartpole, model_of(cartpole), cartpole.D, cartpole.simulate, *classes):
        assert pickle.loads(pickle.dumps(value)) == value
        assert copy.deepcopy(value) == value
    assert pickle.loads(pickle.dumps(cartpole)) is cartpole


def test_errors_of_a_scene_are_pickled() -> None:
    error = eomc.SceneError([Problem("is wrong", "a", "x.toml", 2), Problem("too", "b")])
    loaded = pickle.loads(pickle.dumps(error))
    assert type(loaded) is eomc.SceneError
    assert loaded.problems == error.problems and str(loaded) == str(error)


# --- processes ------------------------------------------------------------------------------------

POOL = """
import multiprocessing, sys
import numpy as np
import eomc

def load():
    return eomc.load(*sys.argv[1:3])

def fails(k):
    load().step([0, 0.4], [0, 1e200], h=1.0)

def faulty(k):
    eomc.load(__file__)  # no scene

def runs(k):
    m = load()
    return m.simulate(steps=k), m.Params(m_c=k), m.simulate(steps=40).estimate()

if __name__ == "__main__":
    if sys.argv[4] == "loaded":
        m = load()
    with multiprocessing.get_context(sys.argv[3]).Pool(1) as pool:
        for call in (fails, faulty):
            try:
                pool.apply(call, (1,))
            except Exception as fault:
                print(type(fault).__name__, getattr(fault, "status", ""))
        run, p, error = pool.apply(runs, (5,))
        m = load()
        print(run, p.m_c, error.order, run.energy[0] == m.simulate(steps=1).energy[0])
        D = pool.apply(m.D, ([0.0, 0.5],), {"params": m.Params(m_c=5)})
        print(D[0, 0], pool.apply(len, (run,)))
"""


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.parametrize("loaded", ["loaded", "not loaded"])
def test_pool_of_processes(method: str, loaded: str, tmp_path: Path, cartpole: ModuleType) -> None:
    """An exception that cannot be unpickled would make it wait for ever."""
    script = tmp_path / "pool.py"
    script.write_text(POOL, encoding="utf-8")
    process = subprocess.run(
        [sys.executable, str(script), str(SCENES / "cartpole.toml"), str(MODULES), method, loaded],
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert process.stdout.splitlines() == [
        "MotionError not finite",
        "SceneError ",
        "<Trajectory of cartpole: 5 steps of 0.005 s> 5.0 4 True",
        "7.0 6",
    ], process.stderr


JOBS = """
import sys
import numpy as np
import eomc
from joblib import Parallel, delayed

m = eomc.load(*sys.argv[1:3])
many = eomc.load(*sys.argv[3:5])

def runs(k):
    p = m.Params(m_c=k)
    return m.simulate(steps=5, params=p), many.simulate_batch(params={"m_c": [1, k]}, steps=3), p, m

if __name__ == "__main__":
    for run, batch, p, module in Parallel(n_jobs=2)(delayed(runs)(k) for k in (2.0, 3.0)):
        mine = runs(p.m_c)
        assert (run, batch, p) == mine[:3] and module is m
        assert np.array_equal(batch.energy, mine[1].energy)
        print(p.m_c, run["theta"][-1] == mine[0]["theta"][-1])
    print(Parallel(n_jobs=2)(delayed(m.simulate)(steps=k) for k in (1, 2)))
"""


@pytest.mark.slow
def test_jobs_of_joblib(tmp_path: Path, cartpole: ModuleType, batch: ModuleType) -> None:
    """Functions of the script are sent by value, modules that they use by their path."""
    pytest.importorskip("joblib")
    script = tmp_path / "jobs.py"
    script.write_text(JOBS, encoding="utf-8")
    scenes = [str(SCENES / "cartpole.toml"), str(MODULES), "build/tests/many_cartpole.toml"]
    process = subprocess.run(
        [sys.executable, str(script), *scenes, "build/tests/modules"],
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert process.stdout.splitlines() == [
        "2.0 True",
        "3.0 True",
        "[<Trajectory of cartpole: 1 steps of 0.005 s>, "
        "<Trajectory of cartpole: 2 steps of 0.005 s>]",
    ], process.stderr


def test_module_imported_by_its_own_name_needs_no_eomc(cartpole: ModuleType) -> None:
    """Another process unpickles the values with NumPy and cffi alone."""
    write_code = (
        "import cartpole as m, pickle, sys\n"
        "try:\n    m.step([0, 0.4], [0, 1e200], h=1.0)\n"
        "except m.MotionError as error:\n    fault = error\n"
        "sys.stdout.buffer.write(pickle.dumps((m.simulate(steps=5), m.Params(m_c=3), fault, m.D)))"
    )
    read_code = (
        "import pickle, sys\n"
        "run, p, fault, D = pickle.loads(sys.stdin.buffer.read())\n"
        "assert 'eomc' not in sys.modules and fault.status == 'not finite'\n"
        "print(run, p, type(fault).__module__, D([0, 0.5])[0, 0], run.energy.shape)"
    )
    env = {**os.environ, "PYTHONPATH": str(MODULES)}
    writer = subprocess.run(
        [sys.executable, "-c", write_code], capture_output=True, env=env, check=True
    )
    reader = subprocess.run(
        [sys.executable, "-c", read_code], input=writer.stdout, capture_output=True, env=env
    )
    assert reader.returncode == 0, reader.stderr.decode()
    assert reader.stdout.decode().split(">")[0] == "<Trajectory of cartpole: 5 steps of 0.005 s"
    assert "cartpole._runtime.status 4.0 (6,)" in reader.stdout.decode()


@pytest.mark.slow
def test_forked_process_has_its_own_threads(batch: ModuleType) -> None:
    """The parent's threads do not exist there; a batch assigned to them would wait for ever."""
    q0 = np.tile(batch.start[0], (3000, 1))
    expected = batch.simulate_batch(q0, steps=100, every=100, threads=2)
    context = multiprocessing.get_context("fork")
    receive, send = context.Pipe(duplex=False)

    def child() -> None:
        send.send(batch.simulate_batch(q0, steps=100, every=100, threads=2) == expected)

    process = context.Process(target=child, daemon=True)
    process.start()
    try:
        assert receive.poll(20), "the child waits"
        assert receive.recv()
        process.join(20)
        assert process.exitcode == 0
    finally:
        process.kill()
        process.join()


# --- assignments ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("m_c", 50, r'cartpole_driven.simulate\(params={"m_c": 50}\), or eomc run --set m_c=50'),
        ("g", 3.7, r'params={"g": 3.7}'),
        ("h", 0.1, r"simulate\(h=0.1\), or eomc run --h 0.1"),
        ("duration", 3, r"simulate\(duration=3\)"),
        ("x", 1.0, r"a start .*simulate\(q0=..., qd0=...\)"),
        ("start", 1.0, r"a start "),
        ("theta_dot", 1.0, r"a start "),
        ("M_c", 50, r"is no name of the scene; did you mean 'm_c'\?; .*simulate\(params={...}\)"),
        ("thetadot", 1.0, r"is no name of the scene; did you mean 'theta_dot'"),
        ("D", None, "belongs to the module"),
        ("simulate", None, "belongs to the module"),
        ("defaults", {}, "belongs to the module"),
    ],
)
def test_assignment_to_a_module_is_refused_with_advice(
    driven: ModuleType, name: str, value: Any, message: str
) -> None:
    initial = dict(vars(driven))
    with pytest.raises(AttributeError, match=f"^{name}: .*{message}"):
        setattr(driven, name, value)
    assert vars(driven) == initial


def test_function_can_be_replaced_for_a_test(
    driven: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A deliberate replacement goes into the dictionary, or to the model."""
    monkeypatch.setitem(vars(driven), "simulate", lambda: "another")
    assert driven.simulate() == "another"
    monkeypatch.undo()
    assert driven.simulate(steps=1).steps == 1


def test_assignment_to_an_input_is_refused_with_advice(driven: ModuleType) -> None:
    with pytest.raises(AttributeError, match=r'an input .*simulate\(u={"force": 1.0}\)'):
        setattr(driven, driven.inputs[0], 1.0)


def test_assignment_to_a_parameter_named_like_a_function(cartpole: ModuleType) -> None:
    """g is both: the function stays, and the message names the parameter."""
    with pytest.raises(AttributeError, match="params="):
        cartpole.g = 3.7
    assert cartpole.g([0.0, 0.0]).shape == (2,)
    with pytest.raises(AttributeError, match=r"m_c: a parameter; .*defaults\['m_c'\]"):
        cartpole.m_c  # noqa: B018 - it raises


@pytest.mark.usefixtures("quickly_compiled")
def test_name_unknown_to_the_scene_can_be_assigned(tmp_path: Path) -> None:
    x = sympy_symbol("x")
    system = System.make("free", {x: 1.0}, sympy_symbol("x_dot") ** 2 / 2, x**2 / 2)
    module = eomc.load(system, MODULES)
    module.mine = 3  # type: ignore[attr-defined]
    assert module.mine == 3
    del module.mine  # type: ignore[attr-defined]


def sympy_symbol(name: str) -> Any:
    from eomc.model.symbols import symbol

    return symbol(name)


def test_defaults_are_read_only(cartpole: ModuleType) -> None:
    initial = json.dumps(cartpole.defaults)
    for change in (
        lambda d: d.__setitem__("m_c", 50), lambda d: d.update(m_c=50), lambda d: d.clear(),
        lambda d: d.pop("m_c"), lambda d: d.setdefault("m", 1),
    ):  # fmt: skip
        with pytest.raises(TypeError, match=r"params={...}"):
            change(cartpole.defaults)
    assert json.dumps(cartpole.defaults) == initial
    changed = cartpole.defaults | {"m_c": 50}
    assert changed["m_c"] == 50 and copy.deepcopy(cartpole.defaults) == cartpole.defaults
    assert pickle.loads(pickle.dumps(cartpole.defaults)) == cartpole.defaults
