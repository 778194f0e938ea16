"""The registry of routes: the methods by which the functions of the equations of motion are
derived.

To add a route, write a function of `RouteInputs` here or in derive/ and an entry of `ROUTES`.
`cheapest` selects the route of each function: the one with the fewest operations among those
without loss of accuracy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from sympy import Expr

from eomc.derive.constraints import constrained_accelerations
from eomc.derive.lagrange import Derivation, EquationsOfMotion
from eomc.derive.ldl import Rows, SolveResult, solve
from eomc.derive.link_multipliers import prefer_short_chains
from eomc.derive.tape import Tape
from eomc.model.symbols import ALONG
from eomc.model.system import System
from eomc.program.ir import Cost, Function, evaluator, nearby
from eomc.program.lower import lower
from eomc.program.polynomial import Expander

MAX_EXPANDED_DEFINITIONS = 120  # definitions that C depends on, up to which it is expanded


class RouteInputs:
    """The inputs of all routes: a derivation, and Lagrange's equations expanded to polynomials.

    A route is a method by which a function is derived.
    """

    def __init__(self, derived: Derivation) -> None:
        self.derived = derived
        self.lagrange = derived.lagrange
        self.expander = Expander(derived.lagrange.tape) if derived.lagrange else None

    @cached_property
    def expanded(self) -> tuple[Tape, Rows, Sequence[Expr]] | None:
        """The tuple (tape, D by rows, b) of the equations D qdd = b by Lagrange's method.

        D and b are expanded to polynomials. None if the polynomials become too large.
        """
        if self.lagrange is None or self.expander is None:
            return None
        D, n = self.lagrange.D, len(self.lagrange.bias)
        triangle = [(i, j) for i in range(n) for j in range(i + 1)]
        entries_and_forces = self.expander.expand(
            [*(D[i][j] for i, j in triangle), *self.lagrange.balance]
        )
        if entries_and_forces is None:
            return None
        entries = dict(zip(triangle, entries_and_forces, strict=False))
        rows = tuple(tuple(entries[max(i, j), min(i, j)] for j in range(n)) for i in range(n))
        return self.lagrange.tape, rows, entries_and_forces[len(triangle) :]


@dataclass(frozen=True)
class RouteFunctions:
    """Functions of the equations of motion by one route, as atoms of `tape`.

    A tape is a list of elementary operations, each with a named result. An atom is a number, a name
    on the tape, or a number times a name.

    Attributes
    ----------
    outputs
        The results of each function, by its name.
    notes
        Sentences that say where unusual terms of the kinetic energy appear.
    """

    tape: Tape
    outputs: Mapping[str, Sequence[Expr]]
    notes: tuple[str, ...]


def _by_ldl(system: System, order: str) -> str:
    """Describe elimination by L D L^T."""
    if system.constraints:
        return (
            "a = qdd by L diag(d) L^T of the KKT matrix [[D, A^T], [A, 0]], eliminated in the "
            f"order {order}, each row of A as soon as the coordinates that it reads are gone."
        )
    return f"a = qdd by D = L diag(d) L^T, eliminated in the order {order}."


@dataclass(frozen=True)
class Route:
    """A method to derive the accelerations, the other functions of the motion, or both.

    Attributes
    ----------
    sentence
        A description for users.
    accelerations
        Function that returns the solution for qdd, a str with the reason why the route is not used,
        or None if the route does not apply.
    functions
        Function that returns the other functions of the motion, or None if the route does not
        apply.
    solved
        Returns a sentence for a comment that says how D qdd = tau - bias is solved, from the system
        and the names of the coordinates in order of elimination.
    penalty
        A factor on the operation count, for disadvantages that the count does not include.
    """

    name: str
    sentence: str
    accelerations: Callable[[RouteInputs], SolveResult] = lambda _: None
    functions: Callable[[RouteInputs], RouteFunctions | None] = lambda _: None
    solved: Callable[[System, str], str] = _by_ldl
    penalty: float = 1.0


def _power(e: EquationsOfMotion) -> Expr:
    """Return the power supplied to the system, including that of moving constraints, lambda . A
    qd.
    """
    if e.rows is None or not any(e.rows.drift):
        return e.power
    multipliers = constrained_accelerations(e.tape, e.D, e.balance, e.rows).multipliers
    powers = [e.tape.times(x, v) for x, v in zip(multipliers, e.rows.drift, strict=True)]
    return e.tape.total([e.power, *powers])


def _functions(e: EquationsOfMotion | None) -> RouteFunctions | None:
    """Return all functions of the equations of motion other than the accelerations."""
    if e is None:
        return None
    outputs: dict[str, Sequence[Expr]] = {
        name if len(rows) == len(e.g) else f"{name}_column": [x for row in rows for x in row]
        for name, rows in (("D", e.D), ("C", e.C))
    }
    outputs |= {"g": e.g, "bias": e.bias, "tau": e.tau}
    outputs |= {"kinetic_energy": [e.kinetic], "potential_energy": [e.potential]}
    outputs["energy"] = [e.tape.define(e.kinetic + e.potential)]
    if e.jacobi is not None:
        outputs["jacobi"] = [e.jacobi]
    if (power := _power(e)) != 0:
        outputs["power"] = [power]
    if e.signals:
        outputs["signal"] = e.signals
    return RouteFunctions(e.tape, outputs, e.notes)


def _expanded_functions(material: RouteInputs) -> RouteFunctions | None:
    """Return the functions by Lagrange, expanded."""
    plain = _functions(material.lagrange)
    if plain is None or material.expander is None:
        return None
    expand = material.expander.expand
    expanded = {name: expand(outputs) for name, outputs in plain.outputs.items()}
    outputs = {
        name: polynomials for name, polynomials in expanded.items() if polynomials is not None
    }
    return replace(plain, outputs=outputs)


def _rotated(material: RouteInputs) -> RouteFunctions | None:
    """Return C of a short tree, expanded: rotations that cancel are removed by sin^2 + cos^2 =
    1.
    """
    plain = _functions(material.derived.newton_euler)
    if plain is None or "C" not in plain.outputs:
        return None
    C, tape = plain.outputs["C"], plain.tape
    names = [x for entry in C for x in entry.free_symbols]
    expanded_C = (
        Expander(tape).expand(C) if len(tape.live(names)) <= MAX_EXPANDED_DEFINITIONS else None
    )
    return None if expanded_C is None else replace(plain, outputs={"C": expanded_C})


def _expanded(material: RouteInputs) -> SolveResult:
    """Return the accelerations by elimination in the expanded equations."""
    if material.expanded is None:
        return None
    rows = material.lagrange.rows if material.lagrange else None
    return (
        constrained_accelerations(*material.expanded, rows) if rows else solve(*material.expanded)
    )


def _cancelled(material: RouteInputs) -> SolveResult:
    """Return the accelerations, expanded again after each step of the elimination."""
    if material.expander is None or material.expanded is None:
        return None
    rows = material.lagrange.rows if material.lagrange else None
    short = material.expander.short
    if rows:
        return constrained_accelerations(*material.expanded, rows, short)
    return solve(*material.expanded, short)


def _constrained(e: EquationsOfMotion | None) -> SolveResult:
    """Return the constrained accelerations from equations that are not expanded."""
    return constrained_accelerations(e.tape, e.D, e.balance, e.rows) if e and e.rows else None


def _by_articulated_bodies(_: System, order: str) -> str:
    """Describe the articulated-body algorithm."""
    return (
        "a = qdd by articulated bodies (Featherstone), the pivots d being those of "
        f"D = L diag(d) L^T, eliminated in the order {order}."
    )


def _by_multipliers(system: System, order: str) -> str:
    """Describe elimination by link multipliers."""
    fractions = "Along a chain s = N/M: s_k is N there, and S_k is M times the entry it was. "
    return (
        "a = qdd by link multipliers (tensions), S = N T N^T = L diag(s) L^T, eliminated in the "
        f"order of the links of {order}. {fractions if prefer_short_chains(system) else ''}"
        "Every mass must be positive."
    )


ROUTES: Mapping[str, Route] = {
    r.name: r
    for r in (
        Route(
            "lagrange",
            "Lagrange over the program of K and P",
            lambda m: m.derived.ldl or _constrained(m.lagrange),
            lambda m: _functions(m.lagrange),
        ),
        Route("expanded", "the same, multiplied out", _expanded, _expanded_functions),
        Route("cancelled", "multiplied out again during elimination", _cancelled),
        Route(
            "articulated",
            "Newton and Euler, articulated bodies",
            lambda m: m.derived.articulated,
            solved=_by_articulated_bodies,
        ),
        Route(
            "composite",
            "Newton and Euler, D of composite bodies, L D L^T",
            lambda m: m.derived.composite or _constrained(m.derived.newton_euler),
        ),
        Route(
            "newton-euler",
            "Newton and Euler along the tree",
            functions=lambda m: _functions(m.derived.newton_euler),
        ),
        Route("rotated", "the same, multiplied out", functions=_rotated),
        Route(
            "multipliers",
            "link multipliers: the tensions of links between point masses",
            lambda m: m.derived.multipliers,
            solved=_by_multipliers,
            penalty=1.25,  # D allows massless links, which justifies 25 % more operations
        ),
    )
}


# --- selection ------------------------------------------------------------------------------------

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
    return largest_errors({route: _errors(f, system, states) for route, f in functions.items()})


def largest_errors(errors: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Return the largest error of each route at the states at which a route has a result."""
    comparable = [
        column for column in zip(*errors.values(), strict=True) if any(map(math.isfinite, column))
    ]
    return {route: max((c[k] for c in comparable), default=0.0) for k, route in enumerate(errors)}


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
