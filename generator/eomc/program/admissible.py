"""The choice among routes: the fewest operations, of those that lose no digits."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from sympy import Expr

from eomc.derive.tape import Tape
from eomc.model.symbols import ALONG
from eomc.model.system import System
from eomc.program.interpret import evaluator, nearby
from eomc.program.ir import Cost, Function
from eomc.program.lower import lower
from eomc.program.routes import ROUTES

LOST = 2  # times the rounding of another route: a route that has more is not taken


@dataclass(frozen=True)
class Candidate:
    """A function by one route: results and (pivot, diagonal) pairs on a tape, and their names.

    order: in which coordinates are eliminated; multipliers: of constraints, beside accelerations;
    parts: what those are made of that modes switch.
    """

    tape: Tape
    outputs: Sequence[Expr]
    checks: Sequence[tuple[Expr, Expr]] = ()
    labels: Sequence[str] = ()
    order: tuple[int, ...] = ()
    multipliers: Sequence[Expr] = ()
    parts: Mapping[int, Sequence[Expr]] = field(default_factory=dict)


def cheapest(name: str, system: System, routes: Mapping[str, Candidate]) -> Function:
    """By the route with the fewest operations among those that lose no digits against another."""
    made = {
        way: lower(name, r.tape, r.outputs, system.names, checks=r.checks, labels=r.labels)
        for way, r in routes.items()
    }

    def rank(route: str) -> tuple[float, int]:
        return weight(made[route].cost) * ROUTES[route].penalty, len(made[route].early)

    by_weight = sorted(made, key=rank)
    best, first = by_weight[0], next(iter(made))
    if len(made) > 1 and made[best].body != made[first].body:
        errors = _roundings(made, system)
        least = min(errors.values())
        # so many roundings add up to their root, where nothing cancels
        usual = 2.0**-52 * max(4.0, math.sqrt(len(made[best].body)))
        best = next(r for r in by_weight if errors[r] <= LOST * max(least, usual))
    costs = tuple((route, f.cost) for route, f in made.items())
    return replace(made[best], route=best, routes=costs)


def _roundings(made: Mapping[str, Function], system: System) -> dict[str, float]:
    """The largest relative error of each, in doubles, over some states around the start.

    Infinite where one fails and another does not: without mass no multiplier, but perhaps D.
    """
    states = range(5 if all(len(f.body) < 500 for f in made.values()) else 2)
    errors = {route: _errors(f, system, states) for route, f in made.items()}
    some = [k for k in states if any(math.isfinite(found[k]) for found in errors.values())]
    return {route: max((found[k] for k in some), default=0.0) for route, found in errors.items()}


def _errors(function: Function, system: System, states: Iterable[int]) -> list[float]:
    """The relative errors of the results at those states around the start; inf where none are."""
    plain, exact, out = evaluator(function), evaluator(function, exact=True), []
    for k in states:
        values = nearby(system, k)
        values |= {f"{c.name}{ALONG}": 1.0 / (k + 1) for c in system.coordinates}
        values |= {i.name: 0.7 + 0.1 * n for n, i in enumerate(system.inputs)}
        try:
            (found, regular), (true, _) = plain(values), exact(values)
        except (ArithmeticError, ValueError):
            regular = False
        if not regular:
            out.append(math.inf)
            continue
        size = max(map(abs, true))
        off = max(abs(a - b) for a, b in zip(found, true, strict=True))
        out.append(off / size if size else 0.0)
    return out


def weight(cost: Cost) -> int:
    """What a call costs, in additions."""
    return cost.adds + cost.multiplications + 8 * cost.divisions + 25 * (cost.sincos + cost.calls)
