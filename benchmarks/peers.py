"""Our steps against those of numba, CasADi, heyoka and a NumPy loop; writes RESULTS.md.

    python benchmarks/peers.py [--rounds 25] [--only WORD]

All do the same: classical RK4 at the same fixed step on the same equations. Final states are
compared first, and nothing is timed where they differ by more than 1e-9. Then all run in turns on
one pinned core, and the ratio of our time to theirs is taken within each round.
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import subprocess
import tempfile
import time
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

import numpy as np
import physics
import runners
from physics import Matrices
from runners import Array, Run, timed
from scipy.integrate import solve_ivp

import eomc
from eomc import compile as compiler

HERE = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Case:
    """Equations, a start x0 = [q; qd], and so many steps of h."""

    scene: str
    matrices: Matrices
    x0: Array
    h: float
    steps: int


@dataclass(frozen=True)
class Peer:
    """Whom we are compared with, the bar of the issue, and over how many steps if not the case's.

    x0: its start, if not the case's. agrees: how near its last state must be to ours.
    """

    name: str
    run: Run
    bar: float | None = None
    steps: int = 0
    x0: Array | None = None
    agrees: float = 1e-9


# --- scenes ------------------------------------------------------------------------------------


def chain_scene(n: int) -> str:
    """n point masses on massless links, absolute angles."""
    links = range(1, n + 1)
    squares = " + ".join(f"dot(x{i})**2 + dot(y{i})**2" for i in links)
    lines = ["eomc = 1", f'name = "chain{n}"', "[coordinates]"]
    lines += [f'a{i} = {{ unit = "rad" }}' for i in links]
    lines += ["[parameters]", 'm = { value = 1.0, unit = "kg" }', 'l = { value = 1.0, unit = "m" }']
    lines += ['g = { value = 9.81, unit = "m/s^2" }', "[definitions]"]
    for i in links:
        x, y = (f"x{i - 1} + ", f"y{i - 1} ") if i > 1 else ("", "")
        lines += [f'x{i} = "{x}l*sin(a{i})"', f'y{i} = "{y}- l*cos(a{i})"']
    lines += ["[energy]", f'kinetic = "m*({squares})/2"']
    lines += [f'potential = "m*g*({" + ".join(f"y{i}" for i in links)})"', "[run]", "h = 0.001"]
    return "\n".join([*lines, ""])


def scene(name: str) -> str:
    return (HERE.parent / "scenes" / f"{name}.toml").read_text(encoding="utf-8")


def start(*q: float) -> Array:
    return np.array([*q, *np.zeros(len(q))])


CASES = {
    "cart-pole": Case(scene("cartpole"), physics.cartpole, start(0.0, math.pi / 2), 0.005, 20_000),
    "double pendulum": Case(
        scene("double_pendulum"), physics.chain, start(0.5, 0.7), 0.005, 20_000
    ),
    **{
        f"chain of {n}": Case(chain_scene(n), physics.chain, start(*[0.3] * n), 0.001, steps)
        for n, steps in ((5, 10_000), (10, 5_000), (20, 1_000))
    },
}


def write(case: Case, root: Path, extra: str = "") -> Path:
    path = Path(tempfile.mkdtemp(dir=root)) / "scene.toml"
    path.write_text(case.scene + extra, encoding="utf-8")
    return path


def load(case: Case, root: Path, extra: str = "") -> ModuleType:
    path = write(case, root, extra)
    return eomc.load(path, path.parent)


# --- comparing -----------------------------------------------------------------------------------


def error(case: Case, x: Array, last: Array, steps: int) -> float:
    """The largest error in a component of the last state, against DOP853 at rtol 1e-13.

    Of a batch, in its first four instances.
    """
    n = len(x) // 2

    def rate(_: float, y: Array) -> Array:
        a = physics.acceleration(case.matrices, list(y), math.sin, math.cos)
        return np.concatenate([y[n:], a])

    columns = x.reshape(len(x), -1)[:, :4].T
    ends = [
        solve_ivp(rate, (0, case.h * steps), column, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
        for column in columns
    ]
    return float(np.abs(last[:, : len(columns)] - np.transpose(ends)).max())


@dataclass(frozen=True)
class Row:
    """A line of the table: times in ns a step and instance, the ratio's quartiles, errors."""

    work: str
    peer: Peer
    mine: float
    theirs: float
    ratio: Array
    errors: tuple[float, float]
    steps: int

    def __str__(self) -> str:
        low, middle, high = self.ratio
        bar = "" if self.peer.bar is None else f"{self.peer.bar:g} {self.verdict}"
        return (
            f"| {self.work} | {self.peer.name} | {self.mine:.4g} | {self.theirs:.4g} "
            f"| {middle:.3g} | {low:.3g} – {high:.3g} | {bar} "
            f"| {self.errors[0]:.1e} | {self.errors[1]:.1e} | {self.steps} |"
        )

    @property
    def verdict(self) -> str:
        assert self.peer.bar is not None
        return "met" if self.ratio[1] <= self.peer.bar else "**missed**"


def compare(
    work: str, case: Case, x: Array, mine: Run, peers: list[Peer], rounds: int
) -> list[Row]:
    """States first, then all in turns; the ratio is taken within each round."""
    many = x.size // len(x)
    errors = []
    for peer in peers:
        steps, begin = peer.steps or case.steps, x if peer.x0 is None else peer.x0
        (_, here), (_, there) = (
            timed(run, at, case.h, steps) for run, at in ((mine, x), (peer.run, begin))
        )
        width = min(here.shape[1], there.shape[1])
        apart = float(np.abs(here[:, :width] - there[:, :width]).max())
        if not apart <= peer.agrees:
            raise SystemExit(f"{work}: {peer.name} ends {apart:.1e} away from us: nothing is timed")
        errors.append((error(case, x, here, steps), error(case, begin, there, steps)))
    times = np.empty((rounds, 1 + len(peers)))
    for k in range(rounds):
        times[k, 0] = timed(mine, x, case.h, case.steps)[0] / case.steps / many
        for i, peer in enumerate(peers, 1):
            steps, begin = peer.steps or case.steps, x if peer.x0 is None else peer.x0
            spent = timed(peer.run, begin, case.h, steps)[0]
            times[k, i] = spent / steps / (begin.size // len(begin))
    rows = []
    middle = np.median(times, axis=0) * 1e9
    for i, peer in enumerate(peers, 1):
        ratio = np.percentile(times[:, 0] / times[:, i], [25, 50, 75])
        rows.append(
            Row(work, peer, middle[0], middle[i], ratio, errors[i - 1], peer.steps or case.steps)
        )
        print(rows[-1], flush=True)
    return rows


def single(name: str, root: Path, rounds: int) -> list[Row]:
    case, n = CASES[name], len(CASES[name].x0) // 2
    peers = [Peer("numba, by hand", runners.by_numba(case.matrices, n), BARS.get((name, "numba")))]
    if n <= 10:
        by_hand = runners.by_casadi(case.matrices, case.x0, case.h, root)
        from_energies = physics.derived(eomc.read(write(case, root)))
        peers += [
            Peer("CasADi C, by hand", by_hand, BARS.get((name, "CasADi"))),
            Peer("numba, from SymPy", runners.by_numba(from_energies, n)),
            Peer("CasADi C, from SymPy", runners.by_casadi(from_energies, case.x0, case.h, root)),
        ]

    def loop(x: Array, h: float, steps: int) -> Array:
        return physics.tutorial(case.matrices, x, h, steps)

    peers.append(Peer("NumPy loop", loop, BARS.get((name, "NumPy")), steps=50))
    return compare(name, case, case.x0, runners.ours(load(case, root)), peers, rounds)


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
    peers = [
        Peer("heyoka cfunc", compiled, BARS.get((name, "heyoka"))),
        Peer("heyoka cfunc, fast_math", runners.by_heyoka(case.matrices, n, case.h, True)),
        Peer("numba, instance by instance", runners.numba_batch(case.matrices, n)),
        Peer(
            "ours, one trajectory", runners.ours(module), BARS.get((name, "alone")), 20_000, case.x0
        ),
    ]
    work = f"4,096 times {name}"
    rows = compare(work, case, x, mine, peers, rounds)
    one = Peer("float64", mine, BARS.get((name, "float")), agrees=1e-3)
    rows += compare(f"{work}, float32", case, x, short, [one], rounds)
    if (name, "threads") in BARS and free_cores() > 1.7:
        os.sched_setaffinity(0, CORES)
        case, two = replace(case, steps=100), runners.ours_batch(module, threads=2)
        peer = Peer("one thread", mine, BARS[name, "threads"], agrees=0.0)
        rows += compare(f"65,536 times {name}, two threads", case, wide, two, [peer], rounds)
        os.sched_setaffinity(0, {max(CORES)})
    return rows


def to_accuracy(name: str, end: float, wanted: float, root: Path, rounds: int) -> str:
    """RK4 at the longest step, heyoka's Taylor at the loosest tolerance, that reach `wanted`."""
    case, n = CASES[name], len(CASES[name].x0) // 2
    rk4 = runners.ours(load(case, root))
    many, apart = 200, math.inf
    while apart > wanted:
        many = math.ceil(many * 1.1)
        h = end / many
        apart = error(replace(case, h=h), case.x0, timed(rk4, case.x0, h, many)[1], many)
    tolerance, far = 1e-6, math.inf
    while far > wanted:
        tolerance /= 2
        taylor = runners.taylor(case.matrices, n, tolerance)
        far = error(replace(case, h=end), case.x0, timed(taylor, case.x0, end, 1)[1], 1)
    times = np.array(
        [
            (timed(rk4, case.x0, h, many)[0], timed(taylor, case.x0, end, 1)[0])
            for _ in range(rounds)
        ]
    )
    low, middle, high = np.percentile(times[:, 0] / times[:, 1], [25, 50, 75])
    mine, theirs = np.median(times, axis=0) * 1e6
    return (
        f"\nTo an error of {wanted:g} over {end:g} s of the {name}: ours {mine:.4g} us "
        f"({many} steps, error {apart:.1e}), heyoka's adaptive Taylor {theirs:.4g} us "
        f"(tolerance {tolerance:.1e}, error {far:.1e}): "
        f"ratio {middle:.3g} ({low:.3g} – {high:.3g}).\n"
    )


# --- the page ------------------------------------------------------------------------------------

BARS = {
    ("cart-pole", "numba"): 0.75,
    ("cart-pole", "CasADi"): 0.70,
    ("cart-pole", "NumPy"): 0.0015,
    ("chain of 5", "CasADi"): 0.30,
    ("chain of 10", "CasADi"): 0.25,
    ("chain of 20", "numba"): 0.12,
    ("cart-pole", "heyoka"): 0.40,
    ("double pendulum", "heyoka"): 0.37,
    ("chain of 5", "heyoka"): 0.48,
    ("cart-pole", "alone"): 0.12,
    ("cart-pole", "threads"): 0.55,
    ("cart-pole", "float"): 0.5,
    ("double pendulum", "float"): 0.5,
}
CORES = os.sched_getaffinity(0)
HEAD = """\
# Against others

Written by `python benchmarks/peers.py`. Classical RK4 at the same fixed step and on the same
equations everywhere; the last states agree to 1e-9 (float32: 1e-3), or nothing would have been
timed. Times in ns a step and instance, medians of {rounds} rounds in which all run in turns on one
core; *ratio* is ours/theirs, the median and quartiles of the ratios within the rounds. Below 1 we
are faster. *Error*: the largest in a component of the last state after that many steps, against
DOP853 at rtol 1e-13 (of a batch: in its first four instances).

{machine}

| work | against | ours | theirs | ratio | quartiles | bar | our error | their error | steps |
|---|---|---|---|---|---|---|---|---|---|
"""
TAIL = """
- *By hand*: the right-hand side in `benchmarks/physics.py`, one sine and cosine an angle,
  differences of angles by the addition theorem, straight-line LDL^T, parameters folded in as
  numbers (ours are read at run time): the best form a peer can be given. The chains' scenes have
  absolute angles too, with positions as definitions.
- *From SymPy*: D and the bias from the energies by SymPy, common subexpressions taken out, then the
  same LDL^T: what a user of these has who writes energies, as ours do.
- numba: RK4 in scalars in one compiled loop, `fastmath={"contract"}`, which allows FMA as gcc does
  for us and nothing else. The wheel of llvmlite has no SVML, so its batch is not vectorised.
- CasADi: the whole step as one SX function, its C compiled with our flags with and without
  `-fno-tree-slp-vectorize` (the faster is kept), called from a loop in the same file.
- heyoka: the whole step as one compiled function called on all 4,096 columns at once.
- Ours: `simulate` and `simulate_batch` from Python, all checks and copies included.
- To an accuracy: the longest step of RK4, and heyoka's adaptive Taylor integrator at the loosest
  tolerance, that end within 1e-9 of the answer.
- Left out: JAX, MuJoCo, Pinocchio, JiTCODE, mechanicsdsl, and the Panda arm.
"""


def machine() -> str:
    """The machine in words, versions and flags."""
    info = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    name = next((x.split(":")[1].strip() for x in info.splitlines() if "model name" in x), "")
    width = "AVX-512" if "avx512f" in info else "AVX2, no AVX-512" if "avx2" in info else "no AVX2"
    compiled = subprocess.run(
        [*compiler.find_compiler().command, "--version"], capture_output=True, text=True, check=True
    ).stdout.splitlines()[0]
    packages = ("eomc", "numba", "llvmlite", "casadi", "heyoka", "numpy", "scipy", "sympy")
    versions = ", ".join(f"{p} {version(p)}" for p in packages)
    return (
        f"{name} ({width}), {len(CORES)} virtual cores shared with other work; "
        f"Python {platform.python_version()}, {versions}; {compiled}, "
        f"`{' '.join((compiler.STANDARD, *compiler.flags()))}`."
    )


def findings(rows: list[Row]) -> str:
    """Where a peer wins and which bars are missed, in words."""

    def told(row: Row) -> str:
        return f"{row.work} against {row.peer.name} ({row.ratio[1]:.2g})"

    wins = [told(r) for r in rows if r.ratio[1] > 1]
    missed = [
        f"{told(r)[:-1]}, bar {r.peer.bar:g})" for r in rows if r.peer.bar and r.verdict != "met"
    ]
    parts = (("A peer wins", wins), ("Bars missed", missed))
    said = "".join(f"\n{title}: {'; '.join(lines) or 'nowhere'}.\n" for title, lines in parts)
    if not any("two threads" in row.work for row in rows):
        said += "\nTwo threads against one: not measured, no second core was free.\n"
    return said


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=25)
    parser.add_argument("--only", default="", help="a word in what is run; writes no page")
    options = parser.parse_args()
    os.sched_setaffinity(0, {max(CORES)})
    work = [(single, name) for name in CASES]
    work += [(batch, name) for name in ("cart-pole", "double pendulum", "chain of 5")]
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as root:
        for run, name in work:
            if options.only in f"{run.__name__} {name}":
                rows += run(name, Path(root), options.rounds)
        said = to_accuracy("double pendulum", 20.0, 1e-9, Path(root), options.rounds)
    print(said, findings(rows), sep="")
    if not options.only:
        text = HEAD.format(rounds=options.rounds, machine=machine())
        text += "\n".join(map(str, rows)) + "\n" + said + findings(rows) + TAIL
        (HERE / "RESULTS.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
