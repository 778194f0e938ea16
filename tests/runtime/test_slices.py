"""Ctrl-C is handled soon in long calls of C; arrays of any alignment are read."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support.cases import SCENES
from support.session import Modules
from test_interrupts import ctrl_c_after

N_ROWS = 10_000_000  # rows
STIFF = 'method = "gauss8"\n'


def load_scene(name: str, run: str = "", repeat: int = 0) -> ModuleType:
    """Load a scene with more under [run] and `repeat` links."""
    text = (SCENES / f"{name}.toml").read_text(encoding="utf-8").replace("[run]\n", "[run]\n" + run)
    if repeat:
        text = text.replace("n = { value = 5,", f"n = {{ value = {repeat},")
    return Modules().of_text(text)


@pytest.fixture(scope="session")
def batch() -> ModuleType:
    return load_scene("cartpole", "batch = true\n")


def interrupt(work: Callable[[], Any], *, delay: float = 0.4, limit: float = 0.3) -> BaseException:
    """Return the exception that Ctrl-C raises in `work`; it must come within `limit` seconds.

    Both times are computing times, which do not depend on other programs.
    """
    with pytest.raises(KeyboardInterrupt) as interruption, ctrl_c_after(delay):
        start = time.process_time()
        work()
    latency = time.process_time() - start - delay
    assert latency < limit, f"{latency:.2f} s"
    return interruption.value


# --- Ctrl-C ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_ctrl_c_in_a_batch_of_one_after_a_fast_one(batch: ModuleType) -> None:
    """An instance of a large batch takes some ns per step; a single one as long as eight."""
    q0 = np.tile(batch.start[0], (4096, 1))
    batch.simulate_batch(q0, steps=2000, every=2000)
    interruption: Any = interrupt(
        lambda: batch.simulate_batch(q0[:1], steps=10**9, every=10**8), delay=0.1, limit=0.25
    )
    run = interruption.run
    assert run.status[0] == "interrupted" and 0 < run.steps[0] < 10**9
    steps = int(run.steps[0])
    # rows whose steps were not completed are NaN, the others equal those of the full run
    n_rows = steps // 10**8
    assert np.isnan(run.q[0, n_rows + 1 :]).all()
    expected = batch.simulate_batch(q0[:1], steps=1 + n_rows * 10**8, every=10**8)
    assert np.array_equal(run.q[0, : n_rows + 1], expected.q[0, : n_rows + 1])


@pytest.mark.slow
def test_ctrl_c_in_a_batch_whose_angles_become_wide(batch: ModuleType) -> None:
    """Angles too wide for vector code make an instance many times slower."""
    q0 = np.tile(batch.start[0], (512, 1))
    batch.simulate_batch(q0, steps=5000, every=5000)
    q0[:, 1] = 1e9
    interrupt(lambda: batch.simulate_batch(q0, steps=10**8, every=10**8, threads=1))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["D", "energy", "acceleration", "bias", "C"])
def test_ctrl_c_in_a_function_of_many_rows(name: str, batch: ModuleType) -> None:
    q = np.zeros((N_ROWS, 2))
    out = np.empty((N_ROWS, *np.shape(getattr(batch, name)(*(q[0],) * (1 if name == "D" else 2)))))
    state = (q,) if name == "D" else (q, q)

    def work() -> None:
        for _ in range(50):
            getattr(batch, name)(*state, out=out)

    interrupt(work)


@pytest.mark.slow
def test_ctrl_c_in_one_call_for_expensive_rows() -> None:
    """Rows of a chain of twenty links, tens of microseconds each."""
    m = load_scene("chain", repeat=20)
    rows = np.tile(m.start[0], (80_000, 1))
    out = np.empty((80_000, 20, 20))

    def work() -> None:
        for _ in range(50):
            m.C(rows, rows, out=out)

    interrupt(work, delay=0.1)


@pytest.mark.slow
def test_ctrl_c_in_an_implicit_method_and_in_its_error_estimate() -> None:
    """A step of gauss8 of a chain of twenty links may take milliseconds."""
    m = load_scene("chain", STIFF, repeat=20)
    interruption: Any = interrupt(
        lambda: m.simulate(h=0.01, steps=10**7, every=10**5, params={"b": 5.0}),
        delay=0.05, limit=0.2,
    )  # fmt: skip
    assert interruption.run.steps > 0
    run = m.simulate(h=0.005, steps=800, params={"b": 5.0})
    interrupt(lambda: run.estimate(), delay=0.05)


# --- slices change nothing ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["D", "C", "g", "bias", "energy", "potential_energy", "tau"])
def test_slices_give_the_values_of_single_rows(
    name: str, driven: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(3)
    q, qd = rng.standard_normal((2, 5003, 2))
    state = (q,) if name in ("D", "g", "potential_energy") else (q, qd)
    options = {"u": [0.3]} if name == "tau" else {}
    all_rows = getattr(driven, name)(*state, t=0.2, **options)
    rows = [
        getattr(driven, name)(*(x[k] for x in state), t=0.2, **options) for k in range(0, 5003, 7)
    ]
    assert np.array_equal(all_rows[::7], rows)
    monkeypatch.setattr(sys.modules[f"{driven.__name__}._runtime.functions"], "ROWS_PER_CALL", 100)
    assert np.array_equal(getattr(driven, name)(*state, t=0.2, **options), all_rows)


def test_accelerations_in_slices_equal_single_ones_and_name_the_invalid_row(
    cartpole: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    q, qd = np.random.default_rng(3).standard_normal((2, 5003, 2))
    all_rows = cartpole.acceleration(q, qd)
    monkeypatch.setattr(
        sys.modules[f"{cartpole.__name__}._runtime.functions"], "ROWS_PER_CALL", 100
    )
    assert np.array_equal(cartpole.acceleration(q, qd), all_rows)
    qd[3777] = [0, 1.25e200]
    with pytest.raises(cartpole.MotionError, match=r"1\.25e\+200"):
        cartpole.acceleration(q, qd)


# --- arrays that are not aligned ------------------------------------------------------------------


def unaligned(array: Any) -> Any:
    """Return the same numbers at an odd address, C-contiguous."""
    array = np.asarray(array, float)
    memory = bytearray(array.nbytes + 1)
    copy = np.frombuffer(memory, offset=1, dtype=float, count=array.size).reshape(array.shape)
    copy[...] = array
    assert copy.flags.c_contiguous and not copy.flags.aligned
    return copy


ENTRIES = """
import sys
import numpy as np
import eomc
sys.path[:0] = {tests!r}
from test_slices import unaligned
m = eomc.load({scene!r}, {root!r})

rng = np.random.default_rng(1)
n = {nq}
q, qd = rng.standard_normal((2, n)) / 9
Q, QD = rng.standard_normal((2, 40, n)) / 9
p, u = list(m.defaults.values()), [0.3]
U, P = rng.standard_normal((30, 1)), np.tile(p, (40, 1))
record = np.zeros(1, np.dtype([("tag", "u1"), ("q", float, n), ("Q", float, (40, n))]))
record["q"], record["Q"] = q, Q

def calls(f, g, G):
    "All entries; f makes an array of them, g is q and G is Q."
    for name in ("D", "g", "potential_energy"):
        yield getattr(m, name)(g), getattr(m, name)(G, params=f(p))
    for name in ("C", "bias", "energy", "jacobi", "kinetic_energy"):
        yield getattr(m, name)(g, f(qd), params=f(p)), getattr(m, name)(G, f(QD))
    for name in ("tau", "power", "acceleration"):
        yield getattr(m, name)(g, f(qd), u=f(u), params=f(p)), getattr(m, name)(G, f(QD), u=f(u))
    yield m.signal(g, f(qd)), m.rhs(0.0, f([*q, *qd]), f(u), f(p))
    yield m.linearize(g, f(qd), u=f(u), params=f(p))
    yield m.step(g, f(qd), u=f(u), params=f(p))
    yield (m.advice(g, f(qd), 5.0, f(u), f(p)),)
    for t in (f(U), f(u)):
        run = m.simulate(g, f(qd), steps=30, u=t, params=f(p))
        yield run.q, run.qd, run.energy
    law = m.simulate(g, f(qd), steps=30, u=lambda t, q, qd: f(u))
    yield law.q, law.qd
    if hasattr(m, "simulate_batch"):
        for table in (f(P), {{"m_c": f(P[:, 0])}}):
            for inputs in (f(np.ones((40, 1))), f(np.ones((40, 30, 1))), f(u)):
                run = m.simulate_batch(G, f(QD), steps=30, params=table, u=inputs)
                yield run.q, run.qd
            to = np.array(Q), np.array(QD)
            m.step_batch(G, f(QD), params=table, u=f(u), out=to)
            yield to

for name, bad in (("unaligned", (unaligned, unaligned(q), unaligned(Q))),
                  ("record", (unaligned, record[0]["q"], record[0]["Q"]))):
    for good, other in zip(calls(np.array, q, Q), calls(*bad), strict=True):
        for a, b in zip(good, other, strict=True):
            assert np.array_equal(a, b), name

wrong = [
    ("out: .*aligned", lambda: m.D(q, out=unaligned(np.zeros((n, n))))),
    ("out.0.: .*aligned", lambda: m.step(q, qd, out=(unaligned(q), unaligned(q)))),
    ("out.0.: .*aligned", lambda: m.simulate(q, qd, steps=0, out=(unaligned([q]), unaligned([q])))),
]
if hasattr(m, "simulate_batch"):
    wrong.append(("q: .*not aligned", lambda: m.step_batch(unaligned(Q), QD)))
import re
for words, call in wrong:
    try:
        call()
    except ValueError as fault:
        assert re.match(words, str(fault)), fault
    else:
        raise SystemExit("took an out= that is not aligned")
"""


@pytest.mark.slow
@pytest.mark.parametrize("case", ["cartpole_driven", "chain of 40"])
def test_unaligned_arrays_are_read(case: str, tmp_path: Path) -> None:
    """The C code is compiled to trap when a number is read from an odd address."""
    name = case.split()[0]
    text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
    if name == "chain":
        text = text.replace("n = { value = 5,", "n = { value = 40,")
        text += '\n[inputs]\npush = { unit = "N m" }\n[forces]\ntheta1 = "push"\n'
    run = "[run]\nlinearize = true\n" + ("batch = true\n" if name != "chain" else "")
    (tmp_path / "scene.toml").write_text(text.replace("[run]\n", run), encoding="utf-8")
    code = ENTRIES.format(
        tests=[str(p) for p in Path(__file__).parents[:2]], root=str(tmp_path),
        scene=str(tmp_path / "scene.toml"), nq=2 if name != "chain" else 40,
    )  # fmt: skip
    sanitizer = "-fsanitize=alignment -fsanitize-undefined-trap-on-error"
    process = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True,
        env={**os.environ, "CC": f"gcc {sanitizer}", "EOMC_CFLAGS": "-O1"},
    )  # fmt: skip
    assert process.returncode == 0, process.stderr or f"ended by signal {-process.returncode}"
