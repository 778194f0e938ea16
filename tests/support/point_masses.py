"""Links and point masses: scenes, systems in SymPy, their accelerations by multipliers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import sympy

from eomc.derive import lagrange, link_multipliers
from eomc.model.system import System, dot, from_scene, symbol
from eomc.program import program
from eomc.program.ir import Function
from eomc.program.lower import lower
from eomc.program.routes import RouteInputs
from eomc.scene.read import parse
from eomc.verify.taylor import TaylorReference

sin, cos = sympy.sin, sympy.cos


def read_system(text: str) -> System:
    return from_scene(parse(text, "links.toml"))


def by_multipliers(system: System) -> Function:
    """Return the acceleration by this route, even if another one is cheaper."""
    solution = link_multipliers.solution(system)
    return lower("acceleration", solution.tape, solution.acceleration, checks=solution.pivots)


def cheapest(system: System) -> tuple[Function, Mapping[str, str]]:
    """Return the acceleration by the selected route, and why other routes were not tried."""
    best, _, passed_over = program.accelerations(RouteInputs(lagrange.derive(system)))
    return best, passed_over


def states(
    system: System, count: int = 3, seed: int = 11, reach: float = 1.5
) -> list[dict[str, float]]:
    """Return random coordinates, velocities, parameters, inputs and time by name."""
    random = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        state = {x.name: random.uniform(-reach, reach) for x in system.q}
        state |= {x.name: random.uniform(-2, 2) for x in system.qd}
        state |= {p.name: p.value * random.uniform(0.7, 1.5) for p in system.parameters}
        state |= {x.name: random.uniform(-1, 1) for x in system.u}
        out.append({**state, "t": random.uniform(0, 3)})
    return out


def independent(system: System, state: Mapping[str, float]) -> tuple[np.ndarray, float]:
    """Return the acceleration from the Taylor series of the energies, and the condition of D."""
    q, qd, u = ([state[x.name] for x in xs] for xs in (system.q, system.qd, system.u))
    params = {p.name: state[p.name] for p in system.parameters}
    answer = TaylorReference(system)
    D = answer.evaluate("D", q, qd, state["t"], u, params)
    return answer.acceleration(q, qd, state["t"], u, params), float(np.linalg.cond(D))


CHAIN = [-1, 0, 1, 2, 3]


def links(
    parents: list[int], equal: bool = True, relative: bool = False, written: bool = False,
    pivot: str = "", more: str = "",
) -> str:  # fmt: skip
    """Return point masses on massless links; link k hangs on parents[k] < k, or -1: the pivot.

    equal: one mass and one length for all. relative: angles relative to the parent link. written:
    positions without the names of parents. pivot: its position, a function of t.
    """
    n = len(parents)
    names = [""] if equal else [str(k) for k in range(n)]
    lines = ["eomc = 1", 'name = "links"', "[coordinates]"]
    lines += [f"q{k} = {{ start = {0.3 + 0.1 * k:.1f} }}" for k in range(n)]
    lines += ["[parameters]", "g = 9.81", "b = 0.3", "s = 4.0"]
    lines += [
        f"m{x} = {1.0 + 0.25 * k}\nl{x} = {1.0 - 0.125 * (k % 4)}" for k, x in enumerate(names)
    ]
    lines += ["[inputs]", 'u = { signal = "sin(t)" }', "[definitions]"]
    x, y, a = ([""] * n for _ in range(3))
    for k, p in enumerate(parents):
        size = "l" if equal else f"l{k}"
        a[k] = f"{a[p]} + q{k}" if relative and p >= 0 else f"q{k}"
        before = (f"x{p} + ", f"y{p} ") if p >= 0 else (pivot and f"{pivot} + ", "")
        if written:
            before = (f"{x[p]} + ", f"{y[p]} ") if p >= 0 else (pivot and f"{pivot} + ", "")
        x[k], y[k] = f"{before[0]}{size}*sin({a[k]})", f"{before[1]}- {size}*cos({a[k]})"
        lines += [f'x{k} = "{x[k]}"', f'y{k} = "{y[k]}"']
    masses = ["m" if equal else f"m{k}" for k in range(n)]
    kinetic = " + ".join(f"{m}*(dot(x{k})**2 + dot(y{k})**2)/2" for k, m in enumerate(masses))
    heights = " + ".join(f"{m}*g*y{k}" for k, m in enumerate(masses))
    lines += ["[energy]", f'kinetic = "{kinetic}"', more or f'potential = "{heights}"']
    return "\n".join(lines)


a, b, c, x, y = (symbol(name) for name in "abcxy")
m, L, R, k = (symbol(name) for name in "mlrk")
A_DOT, B_DOT, C_DOT = (symbol(f"{name}_dot") for name in "abc")
PARAMETERS = {m: 1.3, L: 0.6, R: 0.4, k: 2.0}


def link_end(from_: tuple[Any, Any], size: Any, angle: Any) -> tuple[Any, Any]:
    """Return the position of the end of a link."""
    return from_[0] + size * sin(angle), from_[1] - size * cos(angle)


def moving(points: list[tuple[Any, ...]], q: list[Any], more: Any = 0, **others: Any) -> System:
    """Return masses m, 2m, ... with these positions; more: additional kinetic energy."""
    kinetic = sum((j + 1) * m * sum(dot(e) ** 2 for e in p) / 2 for j, p in enumerate(points))
    potential = others.pop("potential", m * k * sum(p[-1] for p in points))
    return System.make("points", q, kinetic + more, potential, parameters=PARAMETERS, **others)
