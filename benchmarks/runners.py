"""Who runs in benchmarks/peers.py: each is a function (x0, h, steps) -> last state.

x0 is [q; qd], (2 nq,), or (2 nq, batch). Who leaves the last state otherwise gives a function that
puts it so, which is not timed. Our own, `ours` and `ours_batch`, are those of kernels.py.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import math
import multiprocessing
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType
from typing import Any

import casadi
import heyoka
import kernels
import numba
import numpy as np
import physics
from kernels import Array, Run
from kernels import alone as ours
from kernels import together as ours_batch
from numba.np.unsafe.ndarray import to_fixed_tuple
from physics import Matrices

from eomc.toolchain import compiler


def timed(run: Run, x: Array, h: float, steps: int) -> tuple[float, Array]:
    """Seconds, and the last state as columns."""
    spent, last = kernels.timed(run, x, h, steps)
    return spent, last.reshape(len(last), -1)


def relative(module: ModuleType) -> Run:
    """Ours of a chain in relative angles; absolute ones come and go."""
    run = ours(module)

    def absolute(x: Array, h: float, steps: int) -> Array:
        last = run(np.diff(x.reshape(2, -1), prepend=0.0).ravel(), h, steps)
        return np.cumsum(last.reshape(2, -1), axis=1).ravel()

    return absolute


def ours_in_processes(module: ModuleType, x: Array, cores: Sequence[int]) -> Run:
    """Ours in a process for each of the cores at once, each with its share of x: what the machine
    has for threads to reach."""
    context = multiprocessing.get_context("spawn")
    n, pipes, lasts = len(x) // 2, [], []
    for core, share in zip(cores, np.split(x, len(cores), axis=1), strict=True):
        mine, other = context.Pipe()
        last = context.RawArray("d", share.size)
        given = str(module.__file__), share, core, other, last
        context.Process(target=_share, args=given, daemon=True).start()
        pipes.append(mine)
        lasts.append(np.frombuffer(last).reshape(2 * n, -1))

    def run(_: Array, h: float, steps: int) -> Array:
        for pipe in pipes:
            pipe.send((h, steps))
        for pipe in pipes:
            pipe.recv()
        return np.hstack(lasts)

    return run


def _share(file: str, x: Array, core: int, pipe: Connection, last: Any) -> None:
    """One of these processes: runs of its share, each when it is told to."""
    folder = Path(file).parent
    sys.path.insert(0, str(folder.parent))
    os.sched_setaffinity(0, {core})
    run = ours_batch(importlib.import_module(folder.name))
    out = np.frombuffer(last).reshape(x.shape)
    with contextlib.suppress(EOFError):  # nobody is there to tell any more
        while True:
            h, steps = pipe.recv()
            out[:] = run(x, h, steps)()
            pipe.send(None)


def numba_loop(matrices: Matrices, n: int) -> Callable[..., Any]:
    """run(x, h, steps): state and stages in scalars, the acceleration inlined four times.

    FMA contraction is allowed, as gcc does for us; the rest of fastmath would change meaning."""
    lines, results = physics.text(matrices, n)
    q, v = [f"x{i}" for i in range(n)], [f"x{n + i}" for i in range(n)]
    state, both = ", ".join(q + v), list(enumerate(zip(q, v, strict=True)))

    def stage(name: str, along: str, pull: str, back: str, by: str) -> str:
        at = [f"{a} + {along} * {b}" for a, b in zip(q, v, strict=True)]
        at = [f"{a} + {pull} * {back}{i}" if pull else a for i, a in enumerate(at)]
        moving = [f"{b} + {along} * {by}{i}" for i, b in enumerate(v)]
        return f"{', '.join(f'{name}{i}' for i in range(n))}, = acc({', '.join(at + moving)})"

    step = [
        f"{', '.join(f'a{i}' for i in range(n))}, = acc({state})",
        stage("b", "h_2", "", "", "a"),
        stage("c", "h_2", "hh_4", "a", "b"),
        stage("d", "h", "hh_2", "b", "c"),
        *(f"{x} += h * {y} + hh_6 * (a{i} + b{i} + c{i})" for i, (x, y) in both),
        *(f"{y} += h_6 * (a{i} + 2.0 * (b{i} + c{i}) + d{i})" for i, (_, y) in both),
    ]
    before = f"{state} = x\n h_2, h_6, hh_2, hh_4, hh_6 = h / 2, h / 6, h*h / 2, h*h / 4, h*h / 6"
    code = "\n ".join([f"def acc({state}):", *lines, f"return ({', '.join(results)},)"])
    code += f"\ndef run(x, h, steps):\n {before}\n for _ in range(steps):\n  " + "\n  ".join(step)
    names: dict[str, Any] = {"sin": math.sin, "cos": math.cos}
    exec(code + f"\n return ({state})", names)  # text of our own making
    names["acc"] = numba.njit(fastmath={"contract"})(names["acc"])
    return numba.njit(fastmath={"contract"})(names["run"])


def by_numba(matrices: Matrices, n: int) -> Run:
    loop = numba_loop(matrices, n)
    return lambda x, h, steps: np.array(loop(tuple(x), h, steps))


def numba_batch(matrices: Matrices, n: int) -> Run:
    """A loop over the instances, each taken through all its steps in registers."""
    loop, width = numba_loop(matrices, n), 2 * n

    @numba.njit
    def all_of(x: Array, h: float, steps: int) -> Array:
        y = np.empty_like(x)
        for k in range(x.shape[0]):
            row = loop(to_fixed_tuple(x[k], width), h, steps)
            for i in range(width):
                y[k, i] = row[i]
        return y

    return lambda x, h, steps: all_of(np.ascontiguousarray(x.T), h, steps).T


CASADI_DRIVER = """
void run(double *x, double h, long steps)
{
    double other[%(nx)d], w[%(w)d];
    casadi_int iw[%(iw)d];
    double *from = x, *to = other, *swap;
    for (long k = 0; k < steps; ++k) {
        const double *arg[%(arg)d] = {from, &h};
        double *res[%(res)d] = {to};
        step(arg, res, iw, w, 0);
        swap = from, from = to, to = swap;
    }
    for (int i = 0; from != x && i < %(nx)d; ++i)
        x[i] = from[i];
}
"""


def by_casadi(matrices: Matrices, x0: Array, h: float, root: Path) -> Run:
    """C generated from the whole step as one SX function, called in a loop in the same file.

    Compiled with our flags and without the one that suits our code; the faster is kept."""
    x, size = casadi.SX.sym("x", len(x0)), casadi.SX.sym("h")
    after = physics.rk4(matrices, [x[i] for i in range(len(x0))], size, casadi.sin, casadi.cos)
    step = casadi.Function("step", [x, size], [casadi.vertcat(*after)])
    generated = casadi.CodeGenerator("step.c")
    generated.add(step)
    sizes = {name: getattr(step, f"sz_{name}")() + 1 for name in ("w", "iw", "arg", "res")}
    folder = Path(tempfile.mkdtemp(dir=root))
    file = folder / "step.c"
    code = generated.dump().replace("CASADI_SYMBOL_EXPORT int step(", "static int step(")
    file.write_text(code + CASADI_DRIVER % {"nx": len(x0), **sizes})
    runs = []
    without = tuple(flag for flag in compiler.flags() if "slp" not in flag)
    for k, flags in enumerate((compiler.flags(), without)):
        library = folder / f"step{k}.so"
        command = [*compiler.find_compiler().command, compiler.STANDARD, *flags, "-fPIC", "-shared"]
        subprocess.run([*command, str(file), "-o", str(library), "-lm"], check=True)
        function = ctypes.CDLL(str(library)).run
        function.argtypes = [ctypes.c_void_p, ctypes.c_double, ctypes.c_long]

        def run(x: Array, h: float, steps: int, function: Any = function) -> Array:
            y = np.array(x, float)
            function(y.ctypes.data, h, steps)
            return y

        runs.append(run)
    return min(runs, key=lambda run: min(timed(run, x0, h, 1000)[0] for _ in range(9)))


def by_heyoka(matrices: Matrices, n: int, h: float, fast: bool) -> Run:
    """The whole step as one compiled function, its SIMD batch over all columns at once."""
    x = heyoka.make_vars(*[f"x{i}" for i in range(2 * n)])
    after = physics.rk4(matrices, list(x), heyoka.expression(h), heyoka.sin, heyoka.cos)
    function = heyoka.cfunc(after, x, fast_math=fast)

    def run(x: Array, h: float, steps: int) -> Array:
        now, then = x.copy(), np.empty_like(x)
        for _ in range(steps):
            function(now, outputs=then)
            now, then = then, now
        return now

    return run
