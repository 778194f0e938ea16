"""What a module makes goes to other processes and comes back, and can be copied and compared."""

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

import batches
import numpy as np
import pytest
from cases import SCENES
from conftest import MODULES, Modules

import eomc
from eomc.base.errors import Problem
from eomc.model.system import System

COPIES: dict[str, Callable[[Any], Any]] = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda x: pickle.loads(pickle.dumps(x)),
    "pickle protocol 2": lambda x: pickle.loads(pickle.dumps(x, protocol=2)),
}


@pytest.fixture(params=COPIES.values(), ids=list(COPIES))
def copied(request: pytest.FixtureRequest) -> Callable[[Any], Any]:
    """A way to copy a value."""
    way: Callable[[Any], Any] = request.param
    return way


@pytest.fixture(scope="session")
def batch() -> ModuleType:
    """Many cart-poles."""
    return batches.module("cartpole")


# --- copies ---------------------------------------------------------------------------------------


def test_params_are_copied_and_compared(
    cartpole: ModuleType, copied: Callable[[Any], Any], modules: Modules
) -> None:
    p = cartpole.Params(m_c=3.25)
    other = copied(p)
    assert type(other) is type(p) and other == p and other.m_c == 3.25
    other.l = 7.0
    assert other != p and p.l == 2.0
    assert p == cartpole.Params(m_c=3.25) and p != cartpole.Params() and p != 3
    assert p != modules("simple_pendulum").Params()
    with pytest.raises(TypeError, match="unhashable"):
        hash(p)


def test_a_run_is_copied_and_compared(driven: ModuleType, copied: Callable[[Any], Any]) -> None:
    how: dict[str, Any] = {"steps": 40, "every": 7, "params": {"m_c": 3.0}, "t0": 0.3}
    run = driven.simulate(u=np.full((40, 1), 0.25), **how)
    run.estimate()
    other = copied(run)
    assert other == run and type(other) is type(run) and other is not run
    assert (repr(other), other.message) == (repr(run), run.message)
    for name in ("t", "q", "qd", "energy", "jacobi", "x"):
        assert np.array_equal(getattr(other, name), getattr(run, name)), name
    assert other.error.end == run.error.end and np.array_equal(other.error.q, run.error.q)
    again = other.estimate()
    assert np.array_equal(again.q, run.error.q)
    assert run != driven.simulate(**how) and run != 3
    if copied is not copy.copy:
        other.q[0] = 9.0
        assert run.q[0, 0] != 9.0 and other != run


def test_a_run_under_a_function_keeps_all_but_the_function(driven: ModuleType) -> None:
    with (
        pytest.warns(RuntimeWarning)
        if "u" not in driven._model.integrator.warned
        else memoryview(b"")
    ):
        run = driven.simulate(steps=10, u=lambda t, q, qd: [-qd[0]])
    other = pickle.loads(pickle.dumps(run))
    assert other == run and np.array_equal(other.energy, run.energy)
    with pytest.raises(ValueError, match=r"^estimate: u was a function.*simulate again"):
        other.estimate()
    found = copy.deepcopy(run).estimate()
    assert found.order == 4
    # it hangs at rest, where rounding alone moves it: that is not chaos
    assert not found.verdict and found.amplification < 10 and min(found.digits.values()) > 12


def test_a_run_that_stopped_is_copied(cartpole: ModuleType, copied: Callable[[Any], Any]) -> None:
    with pytest.warns(RuntimeWarning):
        run = cartpole.simulate(h=3.0, duration=300.0)
    assert copied(run) == run and copied(run).status == "not finite"
    stop = copied(cartpole.Interrupted(run))
    assert type(stop) is cartpole.Interrupted and stop.run == run and str(stop) == run.message


def test_a_batch_is_copied_and_compared(batch: ModuleType, copied: Callable[[Any], Any]) -> None:
    q0 = np.array([[0.0, 0.1], [0.0, 1e300], [0.0, 0.4]])
    run = batch.simulate_batch(q0, h=0.01, steps=30, every=4, params={"m_c": [1.0, 2, 3]})
    other = copied(run)
    assert other == run and repr(other) == repr(run) and other is not run
    assert other.status.tolist() == run.status.tolist()
    assert np.array_equal(other.t, run.t) and np.array_equal(other.steps, run.steps)
    assert run != batch.simulate_batch(q0, h=0.01, steps=30, every=5)


def test_a_motion_error_is_copied(cartpole: ModuleType, copied: Callable[[Any], Any]) -> None:
    with pytest.raises(cartpole.MotionError) as fault:
        cartpole.step([0, 0.4], [0, 1e200], h=1.0)
    other = copied(fault.value)
    assert type(other) is cartpole.MotionError
    assert (str(other), other.status) == (str(fault.value), "not finite")


def test_modules_and_their_functions_are_pickled_as_themselves(cartpole: ModuleType) -> None:
    classes = (cartpole.Params, cartpole.Run, cartpole.MotionError)
    for value in (cartpole, cartpole._model, cartpole.D, cartpole.simulate, *classes):
        assert pickle.loads(pickle.dumps(value)) == value
        assert copy.deepcopy(value) == value
    assert pickle.loads(pickle.dumps(cartpole)) is cartpole


def test_faults_of_a_scene_are_pickled() -> None:
    fault = eomc.SceneError([Problem("is wrong", "a", "x.toml", 2), Problem("too", "b")])
    other = pickle.loads(pickle.dumps(fault))
    assert type(other) is eomc.SceneError
    assert other.problems == fault.problems and str(other) == str(fault)


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
@pytest.mark.parametrize("how", ["fork", "spawn"])
@pytest.mark.parametrize("loaded", ["loaded", "not loaded"])
def test_a_pool_of_processes(how: str, loaded: str, tmp_path: Path, cartpole: ModuleType) -> None:
    """It would wait for ever for an exception that can't be read."""
    script = tmp_path / "pool.py"
    script.write_text(POOL, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, str(script), str(SCENES / "cartpole.toml"), str(MODULES), how, loaded],
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.stdout.splitlines() == [
        "MotionError not finite",
        "SceneError ",
        "<Run of cartpole: 5 steps of 0.005 s> 5.0 4 True",
        "7.0 6",
    ], done.stderr


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
    """Functions of the script go by value, what they use of a module by where it lies."""
    pytest.importorskip("joblib")
    script = tmp_path / "jobs.py"
    script.write_text(JOBS, encoding="utf-8")
    scenes = [str(SCENES / "cartpole.toml"), str(MODULES), "build/tests/many_cartpole.toml"]
    done = subprocess.run(
        [sys.executable, str(script), *scenes, "build/tests/modules"],
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.stdout.splitlines() == [
        "2.0 True",
        "3.0 True",
        "[<Run of cartpole: 1 steps of 0.005 s>, <Run of cartpole: 2 steps of 0.005 s>]",
    ], done.stderr


def test_a_module_imported_by_its_own_name_needs_no_eomc(cartpole: ModuleType) -> None:
    """What one process pickles another reads, by NumPy and cffi alone."""
    write = (
        "import cartpole as m, pickle, sys\n"
        "try:\n    m.step([0, 0.4], [0, 1e200], h=1.0)\n"
        "except m.MotionError as error:\n    fault = error\n"
        "sys.stdout.buffer.write(pickle.dumps((m.simulate(steps=5), m.Params(m_c=3), fault, m.D)))"
    )
    read = (
        "import pickle, sys\n"
        "run, p, fault, D = pickle.loads(sys.stdin.buffer.read())\n"
        "assert 'eomc' not in sys.modules and fault.status == 'not finite'\n"
        "print(run, p, type(fault).__module__, D([0, 0.5])[0, 0], run.energy.shape)"
    )
    env = {**os.environ, "PYTHONPATH": str(MODULES)}
    made = subprocess.run([sys.executable, "-c", write], capture_output=True, env=env, check=True)
    done = subprocess.run(
        [sys.executable, "-c", read], input=made.stdout, capture_output=True, env=env
    )
    assert done.returncode == 0, done.stderr.decode()
    assert done.stdout.decode().split(">")[0] == "<Run of cartpole: 5 steps of 0.005 s"
    assert "cartpole._runtime.status 4.0 (6,)" in done.stdout.decode()


@pytest.mark.slow
def test_a_fork_has_threads_of_its_own(batch: ModuleType) -> None:
    """Those of the parent are not there, and a batch given to them would wait for ever."""
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
    ("name", "value", "words"),
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
def test_a_module_is_not_assigned_to(driven: ModuleType, name: str, value: Any, words: str) -> None:
    before = dict(vars(driven))
    with pytest.raises(AttributeError, match=f"^{name}: .*{words}"):
        setattr(driven, name, value)
    assert vars(driven) == before


def test_a_test_may_replace_a_function(driven: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is meant goes into the dictionary, or to the model."""
    monkeypatch.setitem(vars(driven), "simulate", lambda: "another")
    assert driven.simulate() == "another"
    monkeypatch.undo()
    assert driven.simulate(steps=1).steps == 1


def test_an_input_is_not_assigned_to(driven: ModuleType) -> None:
    with pytest.raises(AttributeError, match=r'an input .*simulate\(u={"force": 1.0}\)'):
        setattr(driven, driven.inputs[0], 1.0)


def test_a_parameter_called_like_a_function(cartpole: ModuleType) -> None:
    """g is both: the function stays, and the message names the parameter."""
    with pytest.raises(AttributeError, match="params="):
        cartpole.g = 3.7
    assert cartpole.g([0.0, 0.0]).shape == (2,)
    with pytest.raises(AttributeError, match=r"m_c: a parameter; .*defaults\['m_c'\]"):
        cartpole.m_c  # noqa: B018 - it raises


@pytest.mark.usefixtures("quickly_compiled")
def test_what_is_no_name_of_the_scene_may_be_assigned(tmp_path: Path) -> None:
    x = sympy_symbol("x")
    made = System.make("free", {x: 1.0}, sympy_symbol("x_dot") ** 2 / 2, x**2 / 2)
    module = eomc.load(made, MODULES)
    module._mine = module.mine = 3  # type: ignore[attr-defined]
    assert module.mine == 3
    del module.mine, module._mine  # type: ignore[attr-defined]


def sympy_symbol(name: str) -> Any:
    from eomc.model.symbols import symbol

    return symbol(name)


def test_defaults_are_read_only(cartpole: ModuleType) -> None:
    before = json.dumps(cartpole.defaults)
    for change in (
        lambda d: d.__setitem__("m_c", 50), lambda d: d.update(m_c=50), lambda d: d.clear(),
        lambda d: d.pop("m_c"), lambda d: d.setdefault("m", 1),
    ):  # fmt: skip
        with pytest.raises(TypeError, match=r"params={...}"):
            change(cartpole.defaults)
    assert json.dumps(cartpole.defaults) == before
    mine = cartpole.defaults | {"m_c": 50}
    assert mine["m_c"] == 50 and copy.deepcopy(cartpole.defaults) == cartpole.defaults
    assert pickle.loads(pickle.dumps(cartpole.defaults)) == cartpole.defaults
