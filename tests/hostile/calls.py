"""Random calls of built modules from Python: most are well formed, some have hostile arguments.

    python tests/hostile/calls.py --count 100000 --seed 1     one process
    python tests/hostile/calls.py --threads 8                 eight threads, one module
    python tests/hostile/calls.py --only 4711                 one call again

A call must return, or raise ValueError, TypeError, MemoryError or the module's MotionError with a
message. Anything else is a finding: another exception, termination of the process, more than a
gigabyte of memory. A call that takes longer than STOP seconds receives Ctrl-C, and must then end
within PATIENCE. Some calls run in a forked process, some while timer signals arrive.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import mmap
import os
import random
import resource
import signal
import struct
import sys
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

import eomc
from eomc.model.system import from_scene
from eomc.scene.read import parse

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
BUILT = ROOT / "build" / "hostile" / "modules"
STOP, PATIENCE = 1.0, 0.2  # s
MEMORY = 2**30
SCENES = {
    "driven": ("scenes/cartpole_driven.toml", 'batch = true\nlinearize = "parameters"\n'),
    "bouncer": ("tests/hostile/corpus/scene/bouncer.toml", ""),
    "bar": ("scenes/four_bar.toml", "batch = true\ntolerance = 1e-9\ninverse_dynamics = true\n"),
    "arm": ("tests/hostile/corpus/scene/arm.toml", ""),
}


class Late(KeyboardInterrupt):
    """The Ctrl-C of a call that takes long."""


def module(name: str) -> ModuleType:
    """Build and load one of SCENES."""
    file, more = SCENES[name]
    text = (ROOT / file).read_text(encoding="utf-8").replace("[run]\n", "[run]\n" + more)
    os.environ.setdefault("EOMC_CFLAGS", "-O1")
    return eomc.load(from_scene(parse(text, file)), BUILT / name)


# --- arguments ------------------------------------------------------------------------------------


class LengthOnly:
    """An object with a length that is no array."""

    def __len__(self) -> int:
        return 2

    def __getitem__(self, k: int) -> float:
        raise ValueError("no entry")


def hostile(draw: random.Random, good: Any) -> Any:
    """Return an invalid value, often similar to the valid one."""
    size = np.size(good) if isinstance(good, np.ndarray) else 2
    shape = np.shape(good) if isinstance(good, np.ndarray) else (2,)
    zeros = np.zeros(shape)
    makes: list[Callable[[], Any]] = [
        lambda: None, lambda: "x", lambda: b"\x00\xff", lambda: float("nan"), lambda: -1.0,
        lambda: float("inf"), lambda: 10**400, lambda: 2**63, lambda: -(2**63), lambda: 1 + 2j,
        lambda: True, lambda: [], lambda: {}, lambda: {"x": 1.0}, lambda: (), lambda: object(),
        lambda: [[1, 2], [3]], lambda: np.zeros(0), lambda: np.zeros((2, 2, 2)), lambda: -7,
        lambda: Fraction(1, 3), lambda: np.full(shape, np.nan), lambda: np.full(shape, np.inf),
        lambda: np.full(shape, 1e308), lambda: np.full(shape, 5e-324), lambda: np.zeros(size + 1),
        lambda: zeros.astype(complex), lambda: zeros.astype(object), lambda: np.array(["a"] * size),
        lambda: zeros.astype(np.float32), lambda: zeros.astype(int), lambda: Decimal("1.5"),
        lambda: np.ma.masked_all(shape), lambda: np.zeros(shape, ">f8"), lambda: zeros.tolist(),
        lambda: iter([1.0, 2.0]), lambda: range(2), lambda: (x for x in (1.0,)), lambda: set(),
        lambda: np.datetime64("2020-01-01"), lambda: float, lambda: lambda *a: 1 / 0,
        lambda: lambda *a: np.full(9, np.nan), lambda: np.float16(0.5), lambda: np.int8(3),
        lambda: np.broadcast_to(0.5, shape), lambda: memoryview(bytes(8 * size)), lambda: 1e308,
        lambda: 10**12, lambda: 1e-300, lambda: -0.0, lambda: "\ud800", lambda: slice(3),
        lambda: np.zeros((10**3, size)), lambda: np.empty((0, size)), lambda: LengthOnly(),
        lambda: ...,
        lambda: np.zeros((size, 3))[:, 1],
    ]  # fmt: skip
    return draw.choice(makes)()


class Author:
    """Generates the calls of one module, reproducibly by number."""

    def __init__(self, m: ModuleType) -> None:
        self.m, self.n, self.nu = m, len(m.coordinates), len(m.inputs)
        self.names = [n for n in m.__all__ if callable(getattr(m, n)) and n not in OTHER]

    def call(self, draw: random.Random) -> tuple[str, dict[str, Any]]:
        """Return the function's name and its arguments by name."""
        import inspect

        name = draw.choice([*self.names, *["simulate"] * 4])
        if name == "simulate_batch" and draw.random() < 0.5:
            name = "simulate"
        signature = inspect.signature(getattr(self.m, name))
        many = name not in SINGLE and draw.random() < 0.2
        rows = draw.randint(1, 5)
        arguments: dict[str, Any] = {}
        for key, parameter in signature.parameters.items():
            if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
                continue
            if parameter.default is not parameter.empty and draw.random() < 0.6:
                continue
            value = self.good(key, name, draw, rows if many else 0)
            if value is not LEFT_OUT:
                arguments[key] = value
        if name in ("simulate", "simulate_batch") and not {"steps", "duration"} & set(arguments):
            arguments["steps"] = draw.randint(0, 30)
        if name == "simulate" and draw.random() < 0.002:
            arguments = {"steps": 10**12, "every": 10**12}  # until it is interrupted
        for key in list(arguments):
            if draw.random() < 0.08:
                arguments[key] = hostile(draw, arguments[key])
        if draw.random() < 0.02:
            arguments[draw.choice(["z", "q0", "steps", "x"])] = hostile(draw, 1.0)
        if draw.random() < 0.02 and arguments:
            del arguments[draw.choice(list(arguments))]
        return name, arguments

    def good(self, key: str, name: str, draw: random.Random, rows: int) -> Any:
        """Return a valid value, or LEFT_OUT."""
        n, real = self.n, np.random.default_rng(draw.getrandbits(32))
        shape = (rows, n) if rows or (name.endswith("_batch") and key in ("q0", "qd0")) else (n,)
        shape = (3, n) if shape == (0, n) else shape
        numbers: dict[str, Callable[[], Any]] = {
            **dict.fromkeys(("q", "qd", "qdd", "q0", "qd0"), lambda: real.normal(size=shape)),
            "x": lambda: real.normal(size=2 * n),
            "t": lambda: float(real.normal()), "t0": lambda: float(real.normal()),
            "h": lambda: float(10 ** real.uniform(-4, -1)),
            "duration": lambda: float(real.uniform(0, 0.05)), "steps": lambda: draw.randint(0, 30),
            "every": lambda: draw.randint(1, 7), "tol": lambda: float(10 ** real.uniform(-12, -3)),
            "max_step": lambda: float(real.uniform(0.01, 1)), "stiff": lambda: draw.random() < 0.5,
            "times": lambda: np.sort(real.uniform(0, 0.1, 4)),
            "estimate": lambda: draw.random() < 0.3,
            "method": lambda: draw.choice(self.m.methods), "threads": lambda: draw.randint(1, 3),
            "outputs": lambda: draw.random() < 0.5, "closed": lambda: draw.random() < 0.5,
            "control_period": lambda: 0.01,
        }  # fmt: skip
        if key == "params":
            return {
                p: float(real.uniform(0.5, 2)) for p in self.m.parameters if draw.random() < 0.5
            }
        if key == "u":
            if not self.nu:
                return LEFT_OUT
            law = draw.choice([0, 1, 2])
            values = real.normal(size=self.nu)
            return [values, None, lambda t, q, qd: values][law] if name == "simulate" else values
        if key == "values" or name == "Params":
            return LEFT_OUT
        return numbers[key]() if key in numbers else LEFT_OUT


SINGLE = {
    "simulate",
    "step",
    "rhs",
    "advice",
    "equilibrium",
    "discretize",
    "drive_forces",
    "Params",
}
OTHER = {
    "Trajectory", "Estimate", "Interrupted", "load_run", "defaults", "MotionError", "Batch", "dtype"
}  # fmt: skip
LEFT_OUT = object()


# --- a run ----------------------------------------------------------------------------------------


class Calls:
    """Makes calls, and stores the findings."""

    def __init__(self, names: Sequence[str], seed: int) -> None:
        self.authors = {name: Author(module(name)) for name in names}
        self.seed = seed
        self.outcomes: Counter[str] = Counter()
        self.found: dict[str, str] = {}
        self.latest = 0.0  # after a Ctrl-C
        self.memory = _peak()

    def draw_call(self, k: int) -> tuple[ModuleType, str, dict[str, Any], random.Random]:
        """Return call number k."""
        draw = random.Random(f"{self.seed} call {k}")
        author = self.authors[draw.choice(sorted(self.authors))]
        return author.m, *author.call(draw), draw

    def make(self, k: int, alone: bool = True) -> None:
        """Make call number k. alone: in the main thread, which receives signals."""
        m, name, arguments, draw = self.draw_call(k)
        if not alone and any(
            key in arguments and _long(arguments[key]) for key in ("steps", "duration")
        ):
            return  # Ctrl-C reaches the main thread only
        if alone and draw.random() < 0.002:
            self.in_a_fork(k, m, name, arguments)
            return
        every = 0.001 if draw.random() < 0.1 else 0.0  # signals during the whole call
        began = time.perf_counter()
        if alone:
            Interrupts.until = began + STOP
            signal.setitimer(signal.ITIMER_REAL, every or STOP, every or STOP)
        try:
            getattr(m, name)(**arguments)
            self.outcomes["result"] += 1
        except KeyboardInterrupt:  # an interrupted run has its own exception, with the rows so far
            self.latest = max(self.latest, time.perf_counter() - Interrupts.heard)
            self.outcomes["interrupted"] += 1
            if time.perf_counter() - Interrupts.heard > PATIENCE:
                self.keep(
                    k, f"{name}: {time.perf_counter() - Interrupts.heard:.2f} s after a Ctrl-C"
                )
        except (ValueError, TypeError, MemoryError, m.MotionError) as fault:
            self.outcomes[type(fault).__name__] += 1
            if len(str(fault).strip()) < 5:
                self.keep(k, f"{name}: {type(fault).__name__} without a word")
            if isinstance(fault, np.linalg.LinAlgError):
                self.keep(k, traceback.format_exc())
        except BaseException as fault:
            # raised by a function passed as argument
            if traceback.extract_tb(fault.__traceback__)[-1].filename != __file__:
                self.keep(k, traceback.format_exc())
        finally:
            if alone:
                signal.setitimer(signal.ITIMER_REAL, 0)
        if alone and time.perf_counter() - began > 10:
            self.keep(k, f"{name}: {time.perf_counter() - began:.1f} s")
        if _peak() - self.memory > MEMORY:
            self.memory = _peak()
            self.keep(k, f"{name}: {_peak() / 2**20:.0f} MB")

    def in_a_fork(self, k: int, m: ModuleType, name: str, arguments: dict[str, Any]) -> None:
        """Make the call in a child process, which must end by itself."""
        child = os.fork()
        if child == 0:
            signal.alarm(20)
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            with contextlib.suppress(Exception):
                getattr(m, name)(**{**arguments, **({"steps": 9} if "steps" in arguments else {})})
            os._exit(0)
        _, status = os.waitpid(child, 0)
        self.outcomes["in a fork"] += 1
        if status:
            self.keep(k, f"{name}: a fork ended with {status}")

    def keep(self, k: int, words: str) -> None:
        """Print a finding, once for each last line of its traceback."""
        key = words.strip().splitlines()[-1][:60]
        if key not in self.found:
            self.found[key] = words
            _, name, arguments, _ = self.draw_call(k)
            print(f"\n--- call {k} of seed {self.seed}: {name}({arguments})\n{words}", flush=True)


def _long(value: Any) -> bool:
    return not isinstance(value, (int, float)) or not abs(value) < 100


class Interrupts:
    """Handler of timer signals: it does nothing until a call has taken STOP seconds."""

    until = 0.0
    heard = 0.0

    @classmethod
    def ring(cls, *_: Any) -> None:
        """Handle a signal."""
        if time.perf_counter() >= cls.until:
            cls.heard = time.perf_counter()
            cls.until = cls.heard + 60
            raise Late


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def run(
    names: Sequence[str], first: int, count: int, seed: int, threads: int, shared: mmap.mmap
) -> int:
    """Make all calls; `shared` holds the current numbers. Return 1 if there are findings."""
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, Interrupts.ring)
    calls = Calls(names, seed)
    calls.memory = _peak()
    began = time.monotonic()

    def some(own: int) -> None:
        for k in range(first + own, first + count, threads):
            shared[8 * own : 8 * own + 8] = struct.pack("q", k)
            calls.make(k, threads == 1)

    if threads == 1:
        some(0)
    else:
        crowd = [threading.Thread(target=some, args=(own,)) for own in range(threads)]
        for thread in crowd:
            thread.start()
        for thread in crowd:
            thread.join()
    summary = ", ".join(f"{n} {what}" for what, n in calls.outcomes.most_common())
    print(
        f"{count} calls in {time.monotonic() - began:.0f} s by {threads} threads: {summary}; "
        f"{len(calls.found)} finds; {calls.latest:.3f} s after a Ctrl-C at most; "
        f"memory {_peak() / 2**20:.0f} MB"
    )
    return int(bool(calls.found))


def main(arguments: Sequence[str]) -> int:
    """Return 1 if there are findings, 2 if the process terminated."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("scenes", nargs="*", help=" ".join(SCENES))
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--only", type=int, metavar="N", help="that call alone")
    options = parser.parse_args(arguments)
    names = options.scenes or list(SCENES)
    first, count = (0, options.count) if options.only is None else (options.only, 1)
    for name in names:
        module(name)
    sys.stdout.flush()
    # In a child process, so that its termination and the calls in progress can be reported.
    with mmap.mmap(-1, 8 * max(options.threads, 1)) as shared:
        child = os.fork()
        if child == 0:
            status = 3
            # prints the traceback of a call that hangs
            faulthandler.dump_traceback_later(100 + options.count / 100, exit=True)
            try:
                status = run(names, first, count, options.seed, options.threads, shared)
            except BaseException:
                traceback.print_exc()
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
        _, status = os.waitpid(child, 0)
        if os.WIFSIGNALED(status):
            now = [struct.unpack("q", shared[8 * i : 8 * i + 8])[0] for i in range(options.threads)]
            which = f"in calls {now}, seed {options.seed}"
            print(f"the process ended by signal {os.WTERMSIG(status)} {which}")
            return 2
        return os.waitstatus_to_exitcode(status)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
