"""Selection of a route: the one with the fewest operations among those without loss of accuracy."""

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

MAX_ERROR_RATIO = 2  # a route with more than twice the rounding error of another is not used


@dataclass(frozen=True)
class Candidate:
    """One way to compute a function of the generated code, as derived by one route.

    A route is a method of derivation, such as Lagrange's or Newton and Euler's. All expressions are
    defined on the attribute `tape`, a list of elementary operations with named results.

    Attributes
    ----------
    outputs
        The results of the function.
    checks
        Pairs (pivot, diagonal entry) of a matrix factorization; every pivot must be positive.
    labels
        Names for the outputs, then for pivots and diagonal entries.
    order
        Indices of the coordinates in order of elimination.
    multipliers
        Lagrange multipliers of the constraints; for accelerations only.
    parts
        For each constraint that is active in some contact or friction modes only: the numerator and
        the denominator of its multiplier.
    """

    tape: Tape
    outputs: Sequence[Expr]
    checks: Sequence[tuple[Expr, Expr]] = ()
    labels: Sequence[str] = ()
    order: tuple[int, ...] = ()
    multipliers: Sequence[Expr] = ()
    parts: Mapping[int, Sequence[Expr]] = field(default_factory=dict)


def cheapest(name: str, system: System, routes: Mapping[str, Candidate]) -> Function:
    """Return the function with the given name, computed by the route with the fewest operations.

    A route is a method of derivation. `routes` maps the name of each route to the function that it
    gives. Routes with significantly larger rounding errors than another are excluded.
    """
    lowered = {
        way: lower(name, r.tape, r.outputs, system.names, checks=r.checks, labels=r.labels)
        for way, r in routes.items()
    }

    def rank(route: str) -> tuple[float, int]:
        return weight(lowered[route].cost) * ROUTES[route].penalty, len(lowered[route].early)

    by_weight = sorted(lowered, key=rank)
    best, first = by_weight[0], next(iter(lowered))
    if len(lowered) > 1 and lowered[best].body != lowered[first].body:
        errors = _roundings(lowered, system)
        least = min(errors.values())
        # Without cancellation, n rounding errors add up to about sqrt(n) units of rounding.
        usual = 2.0**-52 * max(4.0, math.sqrt(len(lowered[best].body)))
        best = next(r for r in by_weight if errors[r] <= MAX_ERROR_RATIO * max(least, usual))
    costs = tuple((route, f.cost) for route, f in lowered.items())
    return replace(lowered[best], route=best, routes=costs)


def _roundings(functions: Mapping[str, Function], system: System) -> dict[str, float]:
    """Return the largest relative error of each function in doubles, at some states around the
    start.

    The error is infinite where a function fails and another does not: without masses, link
    multipliers fail where D may still be regular.
    """
    states = range(5 if all(len(f.body) < 500 for f in functions.values()) else 2)
    errors = {route: _errors(f, system, states) for route, f in functions.items()}
    comparable = [k for k in states if any(math.isfinite(values[k]) for values in errors.values())]
    return {
        route: max((values[k] for k in comparable), default=0.0) for route, values in errors.items()
    }


def _errors(function: Function, system: System, states: Iterable[int]) -> list[float]:
    """Return the relative error of the results at each state; inf where there is no result."""
    in_doubles, exact, out = evaluator(function), evaluator(function, exact=True), []
    for k in states:
        values = nearby(system, k)
        values |= {f"{c.name}{ALONG}": 1.0 / (k + 1) for c in system.coordinates}
        values |= {i.name: 0.7 + 0.1 * n for n, i in enumerate(system.inputs)}
        try:
            (computed, regular), (true, _) = in_doubles(values), exact(values)
        except (ArithmeticError, ValueError):
            regular = False
        if not regular:
            out.append(math.inf)
            continue
        size = max(map(abs, true))
        difference = max(abs(a - b) for a, b in zip(computed, true, strict=True))
        out.append(difference / size if size else 0.0)
    return out


def weight(cost: Cost) -> int:
    """Return the cost of one call of a function, in units of the cost of one addition."""
    return cost.adds + cost.multiplications + 8 * cost.divisions + 25 * (cost.sincos + cost.calls)
