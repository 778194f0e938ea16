"""Mutants of the generated C: each changed in one place, compiled, imported and checked.

    python tests/support/mutants.py                     the sample of the slow tests
    python tests/support/mutants.py --count 200 chain   a sample of one scene or of VARIANTS
    python tests/support/mutants.py --all --count 60

Changes concern signs, operators, comparisons, factors, constants and indices, one at a time. A
mutant is killed if it does not compile, crashes, hangs or fails a check, of `eomc check` or of
templates. Of the others, equivalent ones give the same bits as the original in RUNS random runs and
in all other results of `outcomes`, rounding ones the same values within ROUNDING; the rest have
survived, and are printed with their position.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from eomc.mechanism.assembly import assembled
from eomc.model.system import System, from_scene
from eomc.runtime.package import model_of
from eomc.scene.read import parse
from eomc.verify import comparison
from eomc.verify.comparison import Comparison
from eomc.verify.reference import Vector
from eomc.verify.sampling import State

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.cases import text_of
from support.compilation import Shipped
from support.forks import in_a_fork
from support.mutations import Mutant, of_c
from support.template_checks import check_all
from support.template_checks.runs import RunDivision, run_in_c

FLAGS = ("-O1", "-march=native", "-fno-math-errno", "-fno-trapping-math")
SECONDS = 60.0
RUNS = 60
ROUNDING = 1e-11  # amplification of rounding errors in random runs

# a scene, or one with other lines under [run]
VARIANTS: Mapping[str, tuple[str, str]] = {
    "pendulum_dp8_gauss8": ("double_pendulum", 'method = ["rk4", "dp8", "gauss8"]\n'),
    "cartpole_batch": ("cartpole", "batch = true\n"),
    "driven_batch": ("cartpole_driven", "batch = true\n"),
    "pendulum_gauss16": ("double_pendulum", 'method = ["rk4", "gauss16"]\n'),
    "chain_batch": ("chain", "batch = true\n"),
}
DIVERSE = (
    "cartpole", "pendulum_dp8_gauss8", "cartpole_batch", "chain", "tumbling_box", "cartpole_driven",
)  # fmt: skip


def variant(name: str) -> System:
    """Return a scene or one of VARIANTS as a system, with assembled initial state."""
    base, more = VARIANTS.get(name, (name, ""))
    return assembled(from_scene(parse(text_of(base, more), f"{name}.toml")))


# --- results of a module --------------------------------------------------------------------------


def outcomes(module: Any, check: Any) -> Vector:
    """Return the results of RUNS random runs, of functions at their states, and of a batch."""
    results: list[Vector] = []
    model = model_of(module)
    draw = np.random.default_rng(99)
    names = ("D", "C", "g", "bias", "tau", "kinetic_energy", "potential_energy", "energy", "jacobi",
             "power")  # fmt: skip
    states = check.expected
    for n in range(RUNS):
        s = states[n % len(states)].state
        near = 1 + 0.3 * draw.standard_normal((2, len(s.q)))
        at = State(s.q * near[0], s.qd * near[1], s.t, s.u, s.params)
        for name in names:
            results.append(check.module_value(name, at))
        for method in module.methods:
            h = check.system.run.h * float(np.exp(draw.uniform(-3, 2)))
            for cuts in ((3, 17), ()):
                division = RunDivision(cuts)
                run = run_in_c(model, method, at, h, 30, every=1 + n % 3, division=division)
                results += [run.rows, np.array([run.status, run.steps])]
    if hasattr(module, "simulate_batch"):
        q, qd = (np.array([getattr(e.state, x) for e in states] * 9) for x in ("q", "qd"))
        qd = qd * np.exp(draw.uniform(-2, 6, (len(q), 1)))
        for method in module.methods:
            runs = module.simulate_batch(q, qd, steps=30, every=7, method=method, threads=1)
            results += [runs.q, runs.qd, runs.status_codes]
    return np.concatenate([np.asarray(x, float).ravel() for x in results])


class Bench:
    """A scene whose reference is derived once; mutants are checked in forked processes."""

    def __init__(self, name: str, folder: Path, system: System | None = None) -> None:
        self.system = variant(name) if system is None else system
        self.shipped = Shipped(self.system, folder / name)
        self.reference = comparison.reference_for(self.system)
        comparison.reference_for = lambda system: self.reference
        self.mutants = of_c(self.shipped.source)
        # All forked processes then share what the reference has compiled for itself. The original
        # has its own folder, because a loaded library cannot be loaded again.
        own = Shipped(self.system, folder / f"{name}_original")
        assert own.compile(FLAGS) is None and self.shipped.compile(FLAGS) is None
        original = own.load()
        report = check_all(self.system, original)
        assert report.passed, report.table()
        self.states = Comparison(self.system, original, np.random.default_rng(5), None)
        self._right: Vector | None = None

    @property
    def right(self) -> Vector:
        """Return the results of the original."""
        if self._right is None:
            assert self.shipped.compile(FLAGS) is None
            self._right = self.outcome()
        return self._right

    def outcome(self) -> Vector:
        """Return the results of the compiled mutant; empty if it terminates."""
        file = self.shipped.folder / "outcome.npy"
        file.unlink(missing_ok=True)
        in_a_fork(lambda: np.save(file, self._outcome()), SECONDS)
        return np.load(file) if file.exists() else np.zeros(0)

    def _outcome(self) -> Vector:
        module = self.shipped.load()
        self.states.module = module
        return outcomes(module, self.states)

    def _passed(self) -> str:
        """Classify a mutant that passes the check."""
        result = self.outcome()
        right = self.right
        if np.array_equal(result, right, equal_nan=True):
            return "equivalent"
        if result.shape != right.shape:
            return "survived"
        with np.errstate(all="ignore"):
            same = (result == right) | (np.isnan(result) & np.isnan(right))
            near = np.abs(result - right) <= ROUNDING * (1 + np.abs(right))
        return "rounding" if np.all(same | near) else "survived"

    def _check(self) -> list[str]:
        report = check_all(self.system, self.shipped.load())
        return [row.name for row in report.results if not row.passed]

    def judge(self, mutant: Mutant) -> tuple[str, str]:
        """Return killed, survived or equivalent, and the cause."""
        message = self.shipped.compile(FLAGS, mutant.apply(self.shipped.source))
        if message is not None:
            return "no C", ""
        kind, value = in_a_fork(self._check, SECONDS)
        if kind != "done":
            return "killed", f"{kind}: {value}"
        if value:
            assert isinstance(value, list)
            return "killed", ", ".join(map(str, value))
        return self._passed(), ""

    def place(self, mutant: Mutant) -> str:
        """Return the position and the change."""
        source = self.shipped.source
        line = source.count("\n", 0, mutant.at) + 1
        start = source.rfind("\n", 0, mutant.at) + 1
        end = source.find("\n", mutant.at)
        old = source[mutant.at : mutant.end]
        text = mutant.apply(source)[start : end + len(mutant.new) - len(old)].strip()
        return f"{line}: {old!r} -> {mutant.new!r}: {text}"


def tried(
    name: str, count: int, seed: int, folder: Path, loud: bool = True
) -> tuple[dict[str, int], list[str]]:
    """Return the number of mutants by result in a sample, and the positions of survivors."""
    bench = Bench(name, folder)
    sample = random.Random(seed).sample(bench.mutants, min(count, len(bench.mutants)))
    counts = dict.fromkeys(("killed", "survived", "equivalent", "rounding", "no C"), 0)
    survived = []
    for mutant in sample:
        verdict, _ = bench.judge(mutant)
        counts[verdict] += 1
        if verdict not in ("killed", "no C") and loud:
            print(f"  {verdict} {bench.place(mutant)}", flush=True)
        if verdict == "survived":
            survived.append(bench.place(mutant))
    if loud:
        summary = ", ".join(f"{n} {what}" for what, n in counts.items())
        print(f"{name}: {len(bench.mutants)} mutants, of {len(sample)} {summary}", flush=True)
    return counts, survived


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description="Mutants of the generated C, checked.")
    parser.add_argument("scenes", nargs="*", help="of scenes/, or of VARIANTS")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--all", action="store_true", help=" ".join(DIVERSE))
    options = parser.parse_args(arguments)
    names = DIVERSE if options.all else options.scenes or ["cartpole", "chain"]
    total: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            # each in a process of its own: modules of one name, references of another
            one = partial(tried, name, options.count, options.seed, Path(folder))
            kind, value = in_a_fork(one, 36_000)
            if kind != "done":
                print(f"{name}: {kind}: {value}")
                return 2
            assert isinstance(value, list)
            for what, n in value[0].items():
                total[what] = total.get(what, 0) + n
    live = total["killed"] + total["survived"]
    print(f"in all {total}: {total['killed'] / max(1, live):.1%} of {live} that change a result")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
