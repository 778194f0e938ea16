"""Everything that the generated code computes, each function by its cheapest route."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from sympy import Expr

from eomc import mechanics
from eomc.assignments import Cost, Function, evaluate
from eomc.expand import Expander
from eomc.lowering import lower
from eomc.mechanics import Equations
from eomc.problems import Problem, SceneError
from eomc.system import System, t
from eomc.tape import Tape

TIME = t.name
LOST = 2  # times the rounding of another route: a route that has more is not taken


@dataclass(frozen=True)
class Program:
    """Everything that the generated code computes."""

    system: System
    functions: Mapping[str, Function]
    notes: tuple[str, ...]
    order: tuple[int, ...]

    def __getitem__(self, name: str) -> Function:
        return self.functions[name]

    def __contains__(self, name: str) -> bool:
        return name in self.functions


# --- from equations to a program ------------------------------------------------------------------


def build(equations: Equations) -> Program:
    """The program of the equations: each function by its cheapest route."""
    e, tape = equations, equations.tape
    wanted: dict[str, list[Expr]] = {
        "D": [entry for row in e.D for entry in row],
        "C": [entry for row in e.C for entry in row],
        "g": list(e.g),
        "bias": list(e.bias),
        "tau": list(e.tau),
        "kinetic_energy": [e.kinetic],
        "potential_energy": [e.potential],
        "energy": [tape.define(e.kinetic + e.potential)],
    }
    if e.jacobi is not None:
        wanted["jacobi"] = [e.jacobi]
    if e.power != 0:
        wanted["power"] = [e.power]
    if e.signals:
        wanted["signal"] = list(e.signals)
    expander = Expander(tape)
    functions: dict[str, Function] = {}
    for name, outputs in wanted.items():
        routes: dict[str, Ends] = {"program": (outputs, ())}
        if (short := expander.expand(outputs)) is not None:
            routes["expanded"] = (short, ())
        functions[name] = _cheapest(name, e.system, tape, routes)
    labels = [f"{c.name}_ddot" for c in e.system.coordinates]
    labels += [f"{what}_{e.system.coordinates[k].name}" for k in e.order for what in ("d", "D")]
    routes = _acceleration_routes(e, expander)
    functions["acceleration"] = _cheapest("acceleration", e.system, tape, routes, labels)
    if all(o.coefficient == 0 for o in functions["tau"].outputs):
        del functions["tau"]
    return Program(e.system, functions, e.notes, e.order)


Ends = tuple[Sequence[Expr], Sequence[tuple[Expr, Expr]]]


def _acceleration_routes(e: Equations, expander: Expander) -> dict[str, Ends]:
    routes: dict[str, Ends] = {"program": (e.acceleration, e.pivots)}
    n = len(e.bias)
    lower = [(i, j) for i in range(n) for j in range(i + 1)]
    both = expander.expand([*(e.D[i][j] for i, j in lower), *e.balance])
    if both is not None:
        entries = dict(zip(lower, both, strict=False))
        D = tuple(tuple(entries[max(i, j), min(i, j)] for j in range(n)) for i in range(n))
        for route, short in (("expanded", lambda atom: atom), ("cancelled", expander.short)):
            _, acceleration, pivots = mechanics.solve(e.tape, D, both[len(lower) :], short)
            routes[route] = (acceleration, pivots)
    return routes


def _cheapest(
    name: str, system: System, tape: Tape, routes: Mapping[str, Ends], labels: Sequence[str] = ()
) -> Function:
    """By the route with the fewest operations among those that lose no digits against another."""
    made = {route: lower(name, tape, *ends, labels) for route, ends in routes.items()}
    by_weight = sorted(made, key=lambda route: (_weight(made[route].cost), len(made[route].early)))
    best = by_weight[0]
    if len(made) > 1 and made[best].body != made["program"].body:
        errors = {route: _rounding(function, system) for route, function in made.items()}
        least = min(errors.values())
        best = next(r for r in by_weight if errors[r] <= LOST * max(least, 2.0**-50))
    costs = tuple((route, f.cost) for route, f in made.items())
    return replace(made[best], route=best, routes=costs)


def _rounding(function: Function, system: System) -> float:
    """The largest relative error of the results, in doubles, over some states around the start."""
    worst = 0.0
    for k in range(5):
        values = nearby(system, k)
        values |= {i.name: 0.7 + 0.1 * n for n, i in enumerate(system.inputs)}
        try:
            found, _ = evaluate(function, values)
            exact, _ = evaluate(function, values, exact=True)
        except (ArithmeticError, ValueError):
            continue
        size = max(map(abs, exact))
        if size:
            off = max(abs(a - b) for a, b in zip(found, exact, strict=True))
            worst = max(worst, off / size)
    return worst


def _weight(cost: Cost) -> int:
    return cost.adds + cost.multiplications + 8 * cost.divisions + 25 * (cost.sincos + cost.calls)


def inertia(program: Program) -> list[Problem]:
    """A warning where D is not positive definite at the start.

    Raises SceneError where it is so at states around the start as well: no motion can be computed.
    """
    s = program.system
    weak = _without_inertia(program, 0)
    if weak is None:
        return []
    if all(_without_inertia(program, k) is not None for k in range(1, 6)):
        message = (
            f"D is not positive definite: '{weak}' has no inertia of its own. Give it a mass, "
            "or leave out a coordinate that others determine"
        )
        raise SceneError([s.problem("energy.kinetic", message)])
    message = (
        f"D is not positive definite at the start, '{weak}' has no inertia there: "
        "start elsewhere, or choose coordinates that are regular there"
    )
    return [s.problem("energy.kinetic", message, "warning")]


def nearby(system: System, k: int) -> dict[str, float]:
    """Values by name of the k-th of some states around the start (0: the start itself)."""
    out = {p.name: p.value for p in system.parameters} | {TIME: 0.0}
    for i, c in enumerate(system.coordinates):
        # steps in directions that have nothing to do with one another, short as they are printed
        out[c.name] = (
            float(f"{c.start + 0.37 * k * math.sin(1.0 + i + 2.3 * k):.6g}") if k else c.start
        )
        rate = c.rate + 0.53 * k * math.cos(0.7 + i + 1.9 * k)
        out[f"{c.name}_dot"] = float(f"{rate:.6g}") if k else c.rate
    return out


def _without_inertia(program: Program, k: int) -> str | None:
    """The coordinate without a positive pivot in D at the k-th state; None where D is regular."""
    names = [c.name for c in program.system.coordinates]
    n = len(names)
    try:
        flat, _ = evaluate(program["D"], nearby(program.system, k))
    except (ArithmeticError, ValueError):
        return names[0]
    A = [flat[n * i : n * i + n] for i in range(n)]
    for i in range(n):
        if not A[i][i] > 8 * n * 2.0**-52 * flat[n * i + i]:
            return names[i]
        for j in range(i + 1, n):
            factor = A[j][i] / A[i][i]
            A[j] = [a - factor * b for a, b in zip(A[j], A[i], strict=True)]
    return None
