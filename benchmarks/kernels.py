"""Our generated steps against kernels written by hand.

    python benchmarks/kernels.py [--rounds 41]

The kernels lie in benchmarks/kernels/: the cart-pole alone and in a batch, and the Panda. Each is
compiled by gcc and by clang, where they are there, with our flags, and the faster is kept. Last
states are compared with ours first, to 1e-9; then both run in turns, five times in a row, and the
ratio of our time to the kernel's is taken within each round. The bar is 1.15.

cartpole_run, cartpole_batch and panda_run make the kernels as (x0, h, steps) -> last state, x0 =
[q; qd], (2 nq,), or (2 nq, batch). A batch of ours ends as q and qd, (batch, nq): a function puts
them so, which is not timed.
"""

from __future__ import annotations

import argparse
import ctypes
import math
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import work as cases
from sympy import S

import eomc
from eomc.derive import lagrange
from eomc.derive.tape import Stage
from eomc.emit.common import c_expression
from eomc.emit.common.c_expression import CContext
from eomc.program import program
from eomc.program.ir import Call, Function, Operand
from eomc.toolchain import compiler

HERE = Path(__file__).resolve().parent
BAR = 1.15
ROW = 5  # runs of one before it is the other's turn; the first finds nothing in the caches
AGREE = 1e-9  # how near last states must be to each other

Array = np.ndarray
Run = Callable[[Array, float, int], Array | Callable[[], Array]]


@dataclass(frozen=True)
class Work:
    """What both do: a start, steps of h, our run and the kernel's."""

    name: str
    x0: Array
    h: float
    steps: int
    ours: Run
    kernel: Run


# --- the kernels ----------------------------------------------------------------------------------


def libraries(source: str, folder: Path) -> list[ctypes.CDLL]:
    """A kernel by each compiler that is there; the cart-pole's has batches, as ours has."""
    made = []
    for name in ("gcc", "clang"):
        if shutil.which(name) is None:
            continue
        library = folder / f"{source}-{name}.so"
        includes = [f"-I{HERE.parent / 'csrc' / 'sincos'}", f"-I{folder}"]
        flags = [
            compiler.STANDARD,
            *compiler.flags(source == "cartpole"),
            "-ffp-contract=fast",
            "-shared",
            "-fPIC",
        ]
        file = str(HERE / "kernels" / f"{source}.c")
        subprocess.run([name, *flags, *includes, file, "-o", str(library), "-lm"], check=True)
        made.append(ctypes.CDLL(str(library)))
    if not made:
        raise SystemExit("no compiler for the kernels: install gcc or clang")
    return made


def faster(runs: Sequence[Run], x: Array, h: float, steps: int) -> Run:
    """The one that takes less time, all of them in turns; they differ by some 5 %."""
    times = np.array([[timed(run, x, h, steps)[0] for run in runs] for _ in range(41)])
    return runs[int(np.median(times, axis=0).argmin())]


def timed(run: Run, x: Array, h: float, steps: int) -> tuple[float, Array]:
    """Seconds, and the last state."""
    begun = time.perf_counter()
    last = run(x, h, steps)
    spent = time.perf_counter() - begun
    return spent, last() if callable(last) else last


def in_place(function: Any, *after: Callable[[Array], object]) -> Run:
    """A Run of a C function (x, h, steps, ...) that moves x; `after` gives what follows."""
    function.restype = None

    def run(x: Array, h: float, steps: int) -> Array:
        y = np.array(x, float, order="C")
        given = [make(y) for make in after]
        function(ctypes.c_void_p(y.ctypes.data), ctypes.c_double(h), ctypes.c_long(steps), *given)
        return y

    return run


def parameters(values: Sequence[float]) -> Callable[[Array], object]:
    held = (ctypes.c_double * len(values))(*values)
    return lambda _: held


CARTPOLE = (2.0, 2.0, 2.0, 9.8)  # m_c, m_p, l, g


def cartpole_run(x: Array, h: float, folder: Path) -> Run:
    made = [in_place(f.kernel_run, parameters(CARTPOLE)) for f in libraries("cartpole", folder)]
    return faster(made, x, h, 2000)


def cartpole_batch(x: Array, h: float, folder: Path) -> Run:
    def count(y: Array) -> object:
        return ctypes.c_long(y.shape[1])

    made = libraries("cartpole", folder)
    runs = [in_place(f.kernel_batch, count, parameters(CARTPOLE)) for f in made]
    return faster(runs, x, h, 20)


def panda_run(function: Function, x: Array, h: float, folder: Path) -> Run:
    """function: the generator's acceleration of the Panda."""
    (folder / "panda_body.h").write_text(panda_body(function), encoding="utf-8")
    return faster([in_place(f.kernel_run) for f in libraries("panda", folder)], x, h, 1000)


PAIR = replace(c_expression.DOUBLE, name="pair")


def panda_body(function: Function) -> str:
    """panda_body.h: the configuration's statements on pairs, and the velocities' on doubles.

    Sines and cosines come as sine[k], cosine[k] for joint k + 2.
    """
    turned, rest = [], []
    for a in function.body:
        is_sine = isinstance(a.value, Call) and a.value.function in ("sin", "cos")
        (turned if is_sine else rest).append(a)
    joints = {f"panda_joint{k}": k for k in range(1, 8)}
    where = {}
    for a in turned:
        assert isinstance(a.value, Call)
        (angle,) = a.value.args
        assert angle.coefficient == 1 and joints[angle.name] > 1
        array = "sine" if a.value.function == "sin" else "cosine"
        where[a.name] = f"{array}[{joints[angle.name] - 2}]"
    early = tuple(a for a in rest if a.stage is Stage.POSITION)
    late = tuple(a for a in rest if a.stage is Stage.VELOCITY)
    assert len(early) + len(late) == len(rest) and not function.early
    known = {*where, *(a.name for a in early)}
    kept = sorted({n for a in late for n in a.value.names} & known)
    ends = tuple(Operand(S.One, name) for name in kept)
    first = replace(function, body=early, outputs=ends, checks=())
    configuration = c_expression.body(first, CContext("panda", PAIR), where)
    outside = {name: f"kept[{2 * k}]" for k, name in enumerate(kept)}
    outside |= {f"{name}_dot": f"qd[{k - 1}]" for name, k in joints.items()}
    outside |= {f"{name}_torque": f"u[{k - 1}]" for name, k in joints.items()}
    final = replace(function, body=late, checks=())
    velocities = c_expression.body(final, CContext("panda"), outside)
    return "\n".join(
        [
            f"#define PANDA_KEPT {len(kept)}",
            "#define PANDA_CONFIGURATION \\",
            *(f"    {line} \\" for line in configuration.lines),
            *(f"    kept[{k}] = {text}; \\" for k, text in enumerate(configuration.results)),
            "",
            "#define PANDA_ACCELERATION \\",
            *(f"    {line} \\" for line in velocities.lines),
            *(f"    a[{k}] = {text}; \\" for k, text in enumerate(velocities.results)),
            "",
            "",
        ]
    )


# --- ours, and the comparison ---------------------------------------------------------------------


def alone(module: ModuleType, method: str = "rk4") -> Run:
    def run(x: Array, h: float, steps: int) -> Array:
        n = len(x) // 2
        done = module.simulate(x[:n], x[n:], h=h, steps=steps, every=steps, method=method)
        return np.concatenate([done.q[-1], done.qd[-1]])

    return run


def together(module: ModuleType, threads: int = 1) -> Run:
    def run(x: Array, h: float, steps: int) -> Callable[[], Array]:
        n = len(x) // 2
        done = module.simulate_batch(x[:n].T, x[n:].T, h, steps=steps, every=steps, threads=threads)
        return lambda: np.hstack([done.q[:, -1], done.qd[:, -1]]).T

    return run


def works(folder: Path) -> list[Work]:
    cartpole, panda = folder / "cartpole.toml", folder / "panda.toml"
    text = (HERE.parent / "scenes" / "cartpole.toml").read_text(encoding="utf-8")
    cartpole.write_text(text + "batch = true\n", encoding="utf-8")
    case = cases.panda()  # as in peers.py
    panda.write_text(case.scene, encoding="utf-8")
    ours, arm = eomc.load(cartpole, folder), eomc.load(panda, folder)
    function = program.build(lagrange.derive(eomc.read(panda)))["acceleration"]
    x = np.array([0.0, math.pi / 2, 0.0, 0.0])
    many = x[:, None] + 0.1 * np.random.default_rng(1).standard_normal((4, 4096))
    kernel = panda_run(function, case.x0, case.h, folder)
    h = 0.005
    return [
        Work("cart-pole", x, h, 20_000, alone(ours), cartpole_run(x, h, folder)),
        Work("4,096 cart-poles", many, h, 200, together(ours), cartpole_batch(many, h, folder)),
        Work("Panda", case.x0, case.h, case.steps, alone(arm), kernel),
    ]


def in_a_row(run: Run, work: Work) -> float:
    """Seconds of one of several runs: of a single one, Python's way in and out would be 4 %."""
    spent = [timed(run, work.x0, work.h, work.steps)[0] for _ in range(ROW)]
    return sum(spent[1:]) / (ROW - 1)


def compare(work: Work, rounds: int) -> str:
    """The line of the table: ns a step and instance, and quartiles of the ratio."""
    runs = (work.ours, work.kernel)
    ours, theirs = (timed(run, work.x0, work.h, work.steps)[1] for run in runs)
    apart = float(np.abs(ours - theirs).max())
    if not apart <= AGREE:
        raise SystemExit(f"{work.name}: the kernel ends {apart:.1e} away from us")
    times = np.array([[in_a_row(run, work) for run in runs] for _ in range(rounds)])
    each = np.median(times, axis=0) * 1e9 / work.steps / (work.x0.size // len(work.x0))
    low, middle, high = np.percentile(times[:, 0] / times[:, 1], [25, 50, 75])
    verdict = "met" if middle <= BAR else "**missed**"
    return (
        f"| {work.name} | {each[0]:.4g} | {each[1]:.4g} | {middle:.3g} | {low:.3g} – {high:.3g} "
        f"| {BAR} {verdict} | {apart:.1e} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=41)
    options = parser.parse_args()
    print("| work | ours, ns | kernel, ns | ratio | quartiles | bar | states apart |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for work in works(Path(folder)):
            print(compare(work, options.rounds), flush=True)


if __name__ == "__main__":
    main()
