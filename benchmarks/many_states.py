"""Time of functions of many states with inputs, times and parameters of their own.

    python benchmarks/many_states.py [--states 2048] [--rounds 9]

Prints for each function the time a state with one u, one t and one set of parameters for all
states, and how many times as long it takes with a u, a t, a parameter for each state; at most 3 is
right (`discretize` over a control period of ten steps: at most 30 times one step). Each ratio is
that of the shortest of `rounds` calls, which alternate.
"""

from __future__ import annotations

import argparse
import inspect
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import eomc

SCENES = Path(__file__).resolve().parents[1] / "scenes"
BAR, PERIOD_BAR = 3.0, 30.0
MORE = """
frames = true
inverse_dynamics = true
momentum = true
linearize = "parameters"
discretize = true
batch = true

[inputs]
push = { signal = "sin(2*t) - 0.1*FIRST_dot", limits = [-1, 1] }

[forces]
FIRST = "push - 0.1*FIRST_dot"

[outputs]
rate = "FIRST_ddot + push"
height = "sin(FIRST)*t"
"""
FUNCTIONS = (
    "D C g bias tau kinetic_energy potential_energy energy jacobi power signal applied output "
    "acceleration linearize sensitivity discretize pose frame_velocity frame_acceleration jacobian "
    "frame_forces inverse_dynamics momentum drive_forces constraints constraint_rates "
    "constraint_jacobian tangent multipliers reactions project"
).split()
COLUMNS = ("energy", "jacobi", "u", "saturated", "outputs", "multipliers", "reactions")


def shortest(calls: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """The shortest of so many calls of each, in turn, s."""
    found = dict.fromkeys(calls, np.inf)
    for _ in range(rounds + 1):
        for name, call in calls.items():
            begun = time.perf_counter()
            call()
            found[name] = min(found[name], time.perf_counter() - begun)
    return found


def load(name: str, first: str, root: Path) -> Any:
    path = root / f"{name}.toml"
    text = (SCENES / path.name).read_text(encoding="utf-8")
    path.write_text(text + MORE.replace("FIRST", first), encoding="utf-8")
    return eomc.load(path, root)


class Table:
    """Rows of times and ratios, printed as they are measured."""

    def __init__(self, rounds: int) -> None:
        self.rounds, self.slow = rounds, list[str]()
        print(f"{'function':44} {'ns/state':>9} {'u':>6} {'t':>6} {'param':>6} {'all':>6}")

    def row(self, name: str, count: int, calls: dict[str, Callable[[], Any]]) -> None:
        """One function; calls: "one", and "u", "t", "params", "all" where it takes them."""
        found = shortest(calls, self.rounds)
        texts, slow = [], ""
        for key in ("u", "t", "params", "all"):
            ratio = found[key] / found["one"] if key in found else np.nan
            texts.append(f"{ratio:6.2f}" if key in found else "     -")
            slow = "  slow" if ratio > BAR else slow
        print(f"{name:44} {found['one'] / count * 1e9:9.0f} {' '.join(texts)}{slow}")
        self.slow += [name] if slow else []


def functions(m: Any, states: int, table: Table) -> None:
    """All functions of states near the scene's start, on its constraints."""
    random = np.random.default_rng(3)
    q, qd = (x + 0.05 * random.standard_normal((states, m.nq)) for x in m.start)
    if getattr(m, "constraint_names", ()):
        q, qd = m.project(q, qd)
    qdd = m.acceleration(q, qd)
    name = m.parameters[0]
    one = {"u": np.full(m.nu, 0.3), "t": 0.2, "params": {name: m.defaults[name]}}
    each = {
        "u": random.standard_normal((states, m.nu)),
        "t": 0.2 * np.ones(states),
        "params": {name: m.defaults[name] * np.ones(states)},
    }
    wide = 3 if m._model.info.plane else 6
    extra: dict[str, dict[str, Any]] = {
        "wrenches": {"wrenches": np.ones((len(m.frames), wide))},
        "qdd": {"qdd": qdd},
    }
    for function in FUNCTIONS:
        if (call := getattr(m, function, None)) is None:
            continue
        takes = inspect.signature(call).parameters
        given = {"q": q} | ({"qd": qd} if "qd" in takes else {})
        for key, value in extra.items():
            given |= value if key in takes else {}
        given |= {key: value for key, value in one.items() if key in takes}
        own = {key: value for key, value in each.items() if key in takes}
        calls = {"one": partial(call, **given)}
        calls |= {key: partial(call, **given | {key: value}) for key, value in own.items()}
        calls["all"] = partial(call, **given | own)
        table.row(f"{m.title}: {function}", states, calls)


def control_period(m: Any, states: int, table: Table) -> None:
    """`discretize` over ten steps beside one step."""
    q, qd = (np.tile(x, (states, 1)) for x in m.start)
    u, h = np.random.default_rng(4).standard_normal((states, m.nu)), 1e-3
    calls = {
        "one": lambda: m.discretize(q, qd, h, u=u),
        "ten": lambda: m.discretize(q, qd, h, u=u, control_period=10 * h),
        "followed": lambda: m.discretize(q, qd, h, control_period=10 * h),
    }
    found = shortest(calls, table.rounds)
    for key, words in (("ten", "u held"), ("followed", "signals")):
        ratio = found[key] / found["one"]
        slow = "  slow" if ratio > PERIOD_BAR else ""
        print(f"{m.title}: discretize, ten steps, {words}: {ratio:.1f} times one step{slow}")
        table.slow += ["discretize, ten steps"] if slow else []


def runs(m: Any, states: int, table: Table) -> None:
    """What is computed from the rows of runs and of batches."""
    steps, batch = 64, max(states // 64, 2)
    random, name = np.random.default_rng(5), m.parameters[0]
    u = 0.1 * random.standard_normal((batch, steps, m.nu))
    values = m.defaults[name] * (1 + 0.01 * random.random(batch))
    how = {"h": 1e-3, "steps": steps}
    starts = tuple(np.tile(x, (batch, 1)) for x in m.start)
    batches = {
        "one": m.simulate_batch(*starts, u=u[0, 0], **how),
        "u": m.simulate_batch(*starts, u=u, **how),
        "params": m.simulate_batch(*starts, u=u[0, 0], params={name: values}, **how),
        "all": m.simulate_batch(*starts, u=u, params={name: values}, **how),
    }
    whole = states * 2
    single = {"h": 1e-4, "steps": whole}
    table_u = 0.1 * random.standard_normal((whole, m.nu))
    alone = {"one": m.simulate(u=u[0, 0], **single), "u": m.simulate(u=table_u, **single)}

    def column(run: Any, name: str) -> Any:
        for cached in ("outputs", "energy"):
            vars(run).pop(cached, None)
        return getattr(run, name)

    for what, made, count in (
        ("batch", batches, batch * (steps + 1)), ("run", alone, whole + 1)
    ):  # fmt: skip
        for name in COLUMNS:
            if name == "reactions" and not getattr(m, "loops", ()):
                continue
            if name == "multipliers" and not getattr(m, "constraint_names", ()):
                continue
            calls = {key: partial(column, run, name) for key, run in made.items()}
            table.row(f"{m.title}: {what}.{name}", count, calls)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--states", type=int, default=2048)
    parser.add_argument("--rounds", type=int, default=9)
    arguments = parser.parse_args()
    table = Table(arguments.rounds)
    with tempfile.TemporaryDirectory() as folder:
        for scene, first in (("cartpole_bodies", "x"), ("four_bar", "q1")):
            m = load(scene, first, Path(folder))
            functions(m, arguments.states, table)
            control_period(m, arguments.states, table)
            runs(m, arguments.states, table)
    print("slow: " + ", ".join(table.slow) if table.slow else "none is slow")
    return bool(table.slow)


if __name__ == "__main__":
    sys.exit(main())
