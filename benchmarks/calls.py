"""Measure the overhead of a call and of the import of a built module.

    python benchmarks/calls.py [--rounds 25]

- A call of `simulate` or `simulate_batch`, compared with the C function with the same arguments and
  rows. Both are processor times of the thread, so that other processes on the core do not count,
  and the smallest of the rounds, which alternate. On a shared machine the times may differ by a
  factor of up to 1.8, depending on whether the other hardware thread of the core is in use.
- `step_batch` of eight instances, including all checks, as in a learning loop.
- The import of a built scene in a new process, with bytecode in place, after NumPy.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import work

import eomc

SCENES = Path(__file__).resolve().parents[1] / "scenes"
OVERHEAD_BAR, IMPORT_BAR = 2e-6, 50e-3  # s
MANY = 200  # calls in a row
H, STEPS, DURATION, TOL, COUNT = 0.005, 10, 0.5, 1e-9, 8
IMPORT = """
import sys, time, numpy
sys.path[:0] = [sys.argv[1]]
begun = time.perf_counter()
import cartpole
print(time.perf_counter() - begun)
"""


def loop_in_c(
    module: ModuleType, count: int, times: Any = None, u: Any = None, **options: Any
) -> Callable[[], object]:
    """Return the loop in C of a run with so many rows, after steps or at times.

    options: members of the C struct.
    """
    model = module._model
    (address, real, null), ffi, nq = model.c.tools, model.c.ffi, model.info.nq
    q, qd, p = model.arguments.default_pointers
    struct, output = ffi.new("run_options *", options), ffi.new("run_output *")
    rows, nothing = np.empty((1 + 2 * nq) * count), bytes(ffi.sizeof("run_output"))
    to, at_u = address(real, rows), null if u is None else address(real, u)
    stride = model.info.nu if u is not None and u.ndim == 2 else 0
    at_times = null if times is None else address(real, times)
    integrate, size = model.c.lib.integrate, len(nothing)

    def run() -> object:
        ffi.memmove(output, nothing, size)
        integrate(
            struct, output, null, q, qd, at_times, count, at_u, stride, p, to, to + count, null,
        )  # fmt: skip
        return rows, times, u

    return run


def fixed_loop(module: ModuleType, times: Any = None, u: Any = None) -> Callable[[], object]:
    """Return the loop in C of steps of equal size, with rows after each of them or at times."""
    count = 1 + STEPS if times is None else len(times)
    return loop_in_c(module, count, times, u, h=H, steps=STEPS, every=1)


def adaptive_loop(module: ModuleType, times: Any = None, u: Any = None) -> Callable[[], object]:
    """Return the loop in C of adaptive steps, with rows after each step or at times."""
    count = 200 if times is None else len(times)
    return loop_in_c(module, count, times, u, tol=TOL, t_end=DURATION, steps=199, every=1)


def batch_loop(module: ModuleType, u: Any = None) -> Callable[[], object]:
    """Return the loop in C of steps of equal size of eight instances."""
    model, count, n = module._model, COUNT, 1 + STEPS
    (address, real, null), ffi, nq = model.c.tools, model.c.ffi, model.info.nq
    start = np.tile(np.array(module.start)[:, None], (1, count, 1))
    state, rows = start.copy(), np.empty((2, count, n, nq))
    to, at = address(real, rows), address(real, state)
    options = ffi.new("run_options *", {"h": H, "steps": STEPS, "every": 1, "rows": n})
    options.u_instance = 0 if u is None else model.info.nu
    outputs, memory = ffi.new("run_output[]", count), ffi.new("run_memory[]", count)
    nothing, lib = bytes(ffi.sizeof(outputs)), model.c.lib
    at_u, p = null if u is None else address(real, u), model.arguments.default_pointers[2]

    def run() -> object:
        state[:] = start
        ffi.memmove(outputs, nothing, len(nothing))
        lib.begin_batch(count, to, to + count * n * nq, n, memory, outputs)
        lib.integrate_batch(options, count, at, at + count * nq, null, at_u, p, outputs)
        return rows, u

    return run


Calls = dict[str, tuple[Callable[[], object], Callable[[], object]]]


def calls(module: ModuleType) -> Calls:
    """Return for each title a call, and the loop in C that it makes."""
    u, table = np.array([0.5]), np.linspace(-1.0, 1.0, STEPS)[:, None]
    times, steps = np.linspace(0.0, DURATION, 11), H * np.arange(STEPS + 1)
    q, qd = (np.tile(x, (COUNT, 1)) for x in module.start)
    each, p, start = np.tile(u, (COUNT, 1)), {"m_c": 3.0}, module.start
    simulate: Callable[..., Any] = module.simulate
    batch: Callable[..., Any] = module.simulate_batch
    fixed, adaptive = fixed_loop(module), adaptive_loop(module)
    return {
        "`simulate(steps=10)`": (lambda: simulate(steps=STEPS), fixed),
        "`simulate(q0, qd0, steps=10)`": (lambda: simulate(*start, steps=STEPS), fixed),
        "`simulate(h=, duration=)`": (lambda: simulate(h=H, duration=H * STEPS), fixed),
        "`simulate(h=, u=, steps=10)`": (
            lambda: simulate(h=H, u=u, steps=STEPS), fixed_loop(module, u=u),
        ),
        "`simulate(u=TABLE, steps=10)`": (
            lambda: simulate(u=table, steps=STEPS), fixed_loop(module, u=table),
        ),
        "`simulate(params=, steps=10)`": (lambda: simulate(params=p, steps=STEPS), fixed),
        "`simulate(h=, times=)`": (
            lambda: simulate(h=H, times=steps), fixed_loop(module, steps),
        ),
        "`simulate(tol=)`": (lambda: simulate(tol=TOL, duration=DURATION), adaptive),
        "`simulate(tol=, u=)`": (
            lambda: simulate(tol=TOL, duration=DURATION, u=u), adaptive_loop(module, u=u),
        ),
        "`simulate(tol=, times=)`": (
            lambda: simulate(tol=TOL, times=times), adaptive_loop(module, times),
        ),
        "`simulate_batch(steps=10)` of eight": (
            lambda: batch(q, qd, steps=STEPS), batch_loop(module),
        ),
        "`simulate_batch(h=, u=, steps=10)` of eight": (
            lambda: batch(q, qd, h=H, u=each, steps=STEPS), batch_loop(module, each),
        ),
    }  # fmt: skip


def seconds(call: Callable[[], object]) -> float:
    """Return the mean over many calls in a row, processor time, s."""
    begun = time.thread_time()
    for _ in range(MANY):
        call()
    return (time.thread_time() - begun) / MANY


def overheads(root: Path, rounds: int) -> dict[str, tuple[float, float]]:
    """Return by title the least time of a call and of its loop in C, s."""
    text = (SCENES / "cartpole_driven.toml").read_text(encoding="utf-8")
    (root / "driven.toml").write_text(text + "tolerance = 1e-9\nbatch = true\n", encoding="utf-8")
    table = calls(eomc.load(root / "driven.toml", root))
    best = dict.fromkeys(table, (math.inf, math.inf))
    for _ in range(rounds + 1):
        for title, (call, loop) in table.items():
            whole, bare = best[title]
            best[title] = min(whole, seconds(call)), min(bare, seconds(loop))
    return best


def batch_step(root: Path, rounds: int) -> float:
    """Return the least time of a step of eight instances, s."""
    case = work.CASES["cart-pole"]
    module = work.load(case, root, "batch = true\n")
    q, qd = (np.tile(x, (COUNT, 1)) for x in case.x0.reshape(2, -1))
    return min(seconds(lambda: module.step_batch(q, qd, 1e-6)) for _ in range(rounds))


def import_time(root: Path, rounds: int) -> float:
    """Return the least time of a warm import beyond NumPy's own, s."""
    path = work.write(work.CASES["cart-pole"], root)
    eomc.load(path, path.parent)
    kept = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    command = [sys.executable, "-c", IMPORT, str(path.parent)]
    done = (
        subprocess.run(command, env=kept, capture_output=True, text=True, check=True)
        for _ in range(rounds + 1)  # the first may write the bytecode
    )
    return min(float(run.stdout) for run in done)


def table(root: Path, rounds: int) -> str:
    """Measure all calls and the import, and return the tables of the page."""
    lines = ["| call | whole, us | loop in C, us | overhead, us | bar |", "|---|---|---|---|---|"]
    for title, (whole, bare) in overheads(root, rounds).items():
        verdict = "met" if whole - bare <= OVERHEAD_BAR else "**missed**"
        numbers = " | ".join(f"{1e6 * x:.2f}" for x in (whole, bare, whole - bare))
        lines.append(f"| {title} | {numbers} | {1e6 * OVERHEAD_BAR:g} us {verdict} |")
    lines.append(f"| `step_batch` of eight | {1e6 * batch_step(root, rounds):.2f} | | | |")
    spent = import_time(root, min(rounds, 9))
    verdict = "met" if spent <= IMPORT_BAR else "**missed**"
    lines += [
        "",
        f"Warm import of a built module beyond NumPy's: {1e3 * spent:.3g} ms, "
        f"bar {1e3 * IMPORT_BAR:g} ms {verdict}.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=25)
    rounds = parser.parse_args().rounds
    with tempfile.TemporaryDirectory() as folder:
        print(table(Path(folder), rounds))


if __name__ == "__main__":
    main()
