"""Compare RK4 steps with those of other programs; write RESULTS.md and RESULTS.svg.

    python benchmarks/peers.py [--rounds 25] [--only WORD]

All programs make steps of classical RK4 with the same fixed size on the same equations. Times are
measured only if the final states differ by at most 1e-9. Then all run in turns on one pinned core,
and the ratio of our time to theirs is computed within each round. Adaptive integrators are compared
at the same error. The programs are in `runners.py`, `simulators.py`, `solvers.py`, `xla.py`, and
hand-written kernels in `kernels.py`.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import calls
import figure
import kernels
import numpy as np
import physics
import runners
import simulators
import solvers
import work
import xla
from comparing import Peer, Row, compare, quartiles
from machine import CORES
from machine import machine as described
from runners import Array, Run, timed
from work import CASES, HERE, Case, load, write

import eomc
from eomc.derive import lagrange
from eomc.program import program

# ours over theirs at most, and behind it what is hoped for
BARS = {
    ("cart-pole", "numba"): (0.75,),
    ("cart-pole", "CasADi"): (0.70,),
    ("cart-pole", "NumPy"): (0.0015,),
    ("chain of 5", "CasADi"): (0.30, 0.20),
    ("chain of 10", "CasADi"): (0.25, 0.10),
    ("chain of 20", "numba"): (0.12, 0.04),
    ("Panda", "MuJoCo"): (0.13,),
    ("Panda", "Pinocchio"): (0.13,),
    ("cart-pole", "heyoka"): (0.40,),
    ("double pendulum", "heyoka"): (0.37, 0.33),
    ("chain of 5", "heyoka"): (0.48, 0.28),
    ("cart-pole", "alone"): (0.12,),
    ("Panda", "alone"): (0.17,),
    ("cart-pole", "threads"): (0.55,),
    ("cart-pole", "float"): (0.5,),
    ("double pendulum", "float"): (0.5,),
    ("chain of 5", "float"): (0.5,),
    ("cart-pole", "kernel"): (1.15,),
    ("4,096 times cart-pole", "kernel"): (1.15,),
    ("Panda", "kernel"): (1.15,),
}
KERNEL = "our kernel by hand"


def folder(root: Path) -> Path:
    return Path(tempfile.mkdtemp(dir=root))


def bars(name: str, peer: str) -> tuple[float, ...]:
    return BARS.get((name, peer), ())


# --- one trajectory ------------------------------------------------------------------------------


def single(name: str, root: Path, rounds: int) -> list[Row]:
    case, n = CASES[name], len(CASES[name].x0) // 2
    peers = [Peer("numba, by hand", runners.by_numba(case.matrices, n), bars(name, "numba"))]
    if n <= 10:
        by_hand = runners.by_casadi(case.matrices, case.x0, case.h, root)
        from_energies = physics.derived(eomc.read(write(case, root)))
        peers += [
            Peer("CasADi C, by hand", by_hand, bars(name, "CasADi")),
            Peer("numba, from SymPy", runners.by_numba(from_energies, n)),
            Peer("CasADi C, from SymPy", runners.by_casadi(from_energies, case.x0, case.h, root)),
        ]
    if n == 2:
        peers.append(Peer("JAX", xla.one(case.matrices)))
    if name == "cart-pole":
        peers.append(Peer("mechanicsdsl's C++", solvers.mechanicsdsl_cartpole(root)))
        peers.append(Peer("MuJoCo", simulators.mujoco_cartpole(), steps=2000))
        kernel = kernels.cartpole_run(case.x0, case.h, folder(root))
        peers.append(Peer(KERNEL, kernel, bars(name, "kernel")))

    def loop(x: Array, h: float, steps: int) -> Array:
        return physics.tutorial(case.matrices, x, h, steps)

    peers.append(Peer("NumPy loop", loop, bars(name, "NumPy"), steps=50))
    rows = compare(name, case, case.x0, runners.ours(load(case, root)), peers, rounds)
    if name.startswith("chain"):
        rivals = [replace(peer, bars=()) for peer in peers if peer.bars]
        relative = runners.relative(load(replace(case, scene=work.chain_of_bodies(n)), root))
        rows += compare(f"{name}, as bodies", case, case.x0, relative, rivals, rounds)
    return rows


def panda(_: str, root: Path, rounds: int) -> list[Row]:
    """The imported Panda alone, and 4,096 of it against one."""
    case = work.panda()
    one, module = runners.ours(load(case, root)), load(case, root, "batch = true\n")
    made = program.build(lagrange.derive(eomc.read(write(case, root))))["acceleration"]
    kernel = kernels.panda_run(made, case.x0, case.h, folder(root))
    peers = [
        Peer(KERNEL, kernel, bars("Panda", "kernel")),  # next to ours, so that both are as warm
        Peer("MuJoCo", simulators.mujoco_panda(), bars("Panda", "MuJoCo"), 200),
        Peer("Pinocchio, loop in C++", simulators.pinocchio_loop(root), bars("Panda", "Pinocchio")),
        Peer("Pinocchio, loop in Python", simulators.pinocchio_python(), steps=100),
    ]
    rows = compare("Panda", case, case.x0, one, peers, rounds)
    x = case.x0[:, None] + 0.1 * np.random.default_rng(1).standard_normal((len(case.x0), 4096))
    x[:, 0] = case.x0
    peer = Peer("ours, one trajectory", one, bars("Panda", "alone"), 20, case.x0)
    mine, few = runners.ours_batch(module), replace(case, steps=20)
    return rows + compare("4,096 times Panda", few, x, mine, [replace(peer, steps=1000)], rounds)


# --- many ----------------------------------------------------------------------------------------


def free_cores() -> float:
    """How many of our cores nobody else used over half a second; threads mean nothing otherwise."""

    def idle() -> int:
        lines = Path("/proc/stat").read_text(encoding="utf-8").splitlines()
        return sum(int(x.split()[4]) for x in lines if x.split()[0] in {f"cpu{k}" for k in CORES})

    before = idle()
    time.sleep(0.5)
    return (idle() - before) / 0.5 / os.sysconf("SC_CLK_TCK")


def batch(name: str, root: Path, rounds: int) -> list[Row]:
    case, n = CASES[name], len(CASES[name].x0) // 2
    case = replace(case, steps=200)
    spread = 0.1 * np.random.default_rng(1).standard_normal((2 * n, 65_536))
    spread[:, 0] = 0
    wide = case.x0[:, None] + spread
    x = np.ascontiguousarray(wide[:, :4096])
    module = load(case, root, "batch = true\n")
    short = runners.ours_batch(load(case, root, 'batch = true\nreal = "float"\n'))
    mine = runners.ours_batch(module)
    compiled = runners.by_heyoka(case.matrices, n, case.h, False)
    title = f"4,096 times {name}"
    peers = [
        Peer("heyoka cfunc", compiled, bars(name, "heyoka")),
        Peer("heyoka cfunc, fast_math", runners.by_heyoka(case.matrices, n, case.h, True)),
        Peer("numba, instance by instance", runners.numba_batch(case.matrices, n)),
        Peer("ours, one trajectory", runners.ours(module), bars(name, "alone"), 20_000, case.x0),
    ]
    if name == "cart-pole":
        peers.append(Peer("JAX", xla.batch(case.matrices, x, case.h)))
        kernel = kernels.cartpole_batch(x, case.h, folder(root))
        peers.append(Peer(KERNEL, kernel, bars(title, "kernel")))
    rows = compare(title, case, x, mine, peers, rounds)
    one = Peer("float64", mine, bars(name, "float"), agrees=1e-3)
    rows += compare(f"{title}, float32", case, x, short, [one], rounds)
    if (name, "threads") in BARS and free_cores() > 1.7:
        os.sched_setaffinity(0, CORES)
        case, two = replace(case, steps=100), runners.ours_batch(module, threads=2)
        both = runners.ours_in_processes(module, wide, sorted(CORES)[-2:])
        peers = [
            Peer("one thread", mine, bars(name, "threads"), agrees=0.0),
            Peer("two processes, half each", both, agrees=0.0),
        ]
        rows += compare(f"65,536 times {name}, two threads", case, wide, two, peers, rounds)
        os.sched_setaffinity(0, {max(CORES)})
    return rows


# --- at the same error ---------------------------------------------------------------------------


def loosest(make: solvers.Adaptive, case: Case, end: float, wanted: float) -> tuple[Run, str]:
    """The integrator at the loosest tolerance, in steps of 1.5, that ends within `wanted`."""
    tolerance, apart, whole = 1e-4, math.inf, replace(case, h=end)
    while not apart <= wanted:
        tolerance /= 1.5
        run = make(tolerance)
        apart = work.error(whole, case.x0, timed(run, case.x0, end, 1)[1], 1)
    return run, f"tolerance {tolerance:.1e} | {apart:.1e}"


def longest(run: Run, case: Case, end: float, wanted: float) -> tuple[Run, str]:
    """Ours at the longest step, within a twentieth, that ends within `wanted`."""
    many, apart = 100, math.inf
    while not apart <= wanted:
        many = math.ceil(many * 1.05)
        last = timed(run, case.x0, end / many, many)[1]
        apart = work.error(replace(case, h=end / many), case.x0, last, many)
    return lambda x, h, steps: run(x, h / many, many), f"{many} steps | {apart:.1e}"


def same_error(name: str, end: float, wanted: float, root: Path, rounds: int) -> str:
    """The table of integrators that choose their own steps, beside our fixed ones."""
    case, n = CASES[name], len(CASES[name].x0) // 2
    module = load(case, root, 'method = ["rk4", "dp8"]\n')
    ours = {m: partial(runners.ours, module, m) for m in ("rk4", "dp8")}
    found = {f"ours, {m}": longest(make(), case, end, wanted) for m, make in ours.items()}
    for title, make in (
        ("heyoka, Taylor", solvers.heyoka_taylor),
        ("JiTCODE, DOP853", solvers.jitcode_dop853),
        ("SciPy, DOP853, numba", solvers.scipy_dop853),
    ):
        found[title] = loosest(make(case.matrices, n), case, end, wanted)
    runs = [run for run, _ in found.values()]
    times = np.array([[timed(r, case.x0, end, 1)[0] for r in runs] for _ in range(rounds)])
    middle = np.median(times, axis=0)
    best = int(np.argmin(middle[: len(ours)]))
    lines = [
        f"The {name} over {end:g} s with an error of at most {wanted:g}. "
        f"*Ratio*: time of {list(found)[best]}, divided by that of the integrator.",
        "",
        "| integrator | us | ratio | quartiles | setting | error |",
        "|---|---|---|---|---|---|",
    ]
    for i, (title, (_, chosen)) in enumerate(found.items()):
        low, ratio, high = quartiles(times[:, best], times[:, i])
        lines.append(
            f"| {title} | {middle[i] * 1e6:.4g} | {ratio:.3g} | {low:.3g} – {high:.3g} | {chosen} |"
        )
    return "\n".join([*lines, ""])


# --- the page ------------------------------------------------------------------------------------

HEAD = """\
# Comparison with other programs

Written by `python benchmarks/peers.py`. Classical RK4 with the same fixed step on the same equations in all programs; times are
measured only if the final states agree to 1e-9 (float32: 1e-3).

- *ours*, *theirs*: time in ns per step and instance, median of {rounds} rounds in which all programs run in turns on one core.
- *Ratio*: ours/theirs, with median and quartiles of the ratios within the rounds. Below 1, eomc is faster.
- *Bar*: the required ratio, followed by the desired one if there is one.
- *Error*: the largest error of a component of the final state after that many steps, compared with DOP853 at rtol 1e-13 (of a batch: in its
  first four instances).

{machine}

![Each ratio with its quartiles and bar](RESULTS.svg)

| task | compared with | ours | theirs | ratio | quartiles | bar | our error | their error | steps |
|---|---|---|---|---|---|---|---|---|---|
"""  # noqa: E501
TAIL = """
Conditions:

- *By hand*: the right-hand side in `benchmarks/physics.py`, with one sine and cosine per angle, differences of angles by the addition theorem,
  straight-line LDL^T, and parameters as constants (those of eomc are variables): the most efficient form for the other programs. The scenes of
  the chains have absolute angles too, with positions as definitions; *as bodies*: joints and relative angles.
- *From SymPy*: D and the bias from the energies by SymPy, with common subexpressions eliminated, then the same LDL^T: the form of a user who
  starts from energies, as eomc does.
- numba: RK4 with scalars in one compiled loop, `fastmath={"contract"}`, which only allows FMA, as gcc does for eomc. The wheel of llvmlite
  has no SVML, so that its batch is not vectorised.
- CasADi: the whole step as one SX function; its C is compiled with the flags of eomc with and without `-fno-tree-slp-vectorize` (the faster one
  counts), and called from a loop in the same file.
- heyoka: the whole step as one compiled function, called on all 4,096 columns at once.
- JAX: double precision, all steps as one compiled `lax.scan` over a tuple of scalars; the batch by `vmap` or `lax.map`, the faster one. Chains
  are left out: XLA recomputes shared values for each use, some 2,500 ns per step for five links.
- MuJoCo: integrator RK4; contacts, constraints and sensors are disabled; the steps run in its own loop.
- mechanicsdsl: its generated C++ without output, with the flags of eomc or those of its own CMake file, the faster ones. Its step allocates
  vectors on the heap and uses powers and sines as written by SymPy.
- Panda: from the URDF of example-robot-data with locked fingers and joint friction. eomc uses the scene that `eomc import` writes, with its torque
  inputs (zero). Pinocchio: `aba` of the library in its wheel in a loop in C++, in the faster of its two conventions. Compiled from its
  headers with -O3 and -march=native, which takes minutes, `aba` was not faster.
- Our kernels by hand: `benchmarks/kernels/`, the same method with all known optimisations; by gcc or clang, the faster one.
- Ours: `simulate` and `simulate_batch` from Python, including all checks and copies.
- *Two processes, half each*: one process with a batch of half the size on each of two cores, the limit for two threads.
- At the same error: methods of eomc with the longest step, the others with the loosest tolerance, that end within 1e-9 of the solution. JiTCODE's
  right-hand side is C with the flags of eomc, SciPy's is numba's.
"""  # noqa: E501
PACKAGES = """eomc numba llvmlite casadi heyoka jax mujoco pin jitcode mechanicsdsl-core numpy scipy
sympy""".split()


def machine() -> str:
    """The machine in words, versions and flags."""
    return described(PACKAGES)


def findings(rows: list[Row]) -> str:
    """Return the summary: where another program is faster, and which bars are missed."""

    def told(row: Row) -> str:
        return f"{row.work}, compared with {row.peer.name} ({row.ratio[1]:.2g})"

    wins = [told(r) for r in rows if r.ratio[1] > 1]
    missed = [f"{told(r)[:-1]}, bar {r.peer.bars[0]:g})" for r in rows if r.missed]
    parts = (("Another program is faster", wins), ("Bars missed", missed))
    said = "".join(f"\n{title}: {'; '.join(lines) or 'none'}.\n" for title, lines in parts)
    if not any("two threads" in row.work for row in rows):
        said += "\nTwo threads compared with one: not measured, because no second core was free.\n"
    return said


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=25)
    parser.add_argument("--only", default="", help="a word in what is run; writes no page")
    options = parser.parse_args()
    os.sched_setaffinity(0, {max(CORES)})
    todo = [(single, name) for name in CASES]
    todo += [(batch, name) for name in ("cart-pole", "double pendulum", "chain of 5")]
    todo += [(panda, "Panda")]
    rows: list[Row] = []
    said = ""
    with tempfile.TemporaryDirectory() as root:
        for run, name in todo:
            if options.only in f"{run.__name__} {name}":
                rows += run(name, Path(root), options.rounds)
        if options.only in "same error":
            said += same_error("double pendulum", 20.0, 1e-9, Path(root), options.rounds)
        if options.only in "calls":
            said += "\n" + calls.table(Path(root), options.rounds)
    print(said, findings(rows), sep="")
    if not options.only:
        figure.draw([row.mark for row in rows], HERE / "RESULTS.svg")
        text = HEAD.format(rounds=options.rounds, machine=machine())
        text += "\n".join([*map(str, rows), "", said]) + findings(rows) + TAIL
        (HERE / "RESULTS.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
