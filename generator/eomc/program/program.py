"""Everything that the generated code computes, each function by its cheapest route."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from sympy import Expr

from eomc.base.errors import Problem, SceneError
from eomc.derive import lagrange
from eomc.derive.lagrange import Equations
from eomc.derive.ldl import Solution, solve
from eomc.derive.tape import Stage, Tape
from eomc.integrators.tableaux import METHODS
from eomc.model.symbols import ALONG
from eomc.model.system import System, t
from eomc.program.ir import Call, Cost, Function, evaluator
from eomc.program.lower import lower
from eomc.program.polynomial import Expander

TIME = t.name
_READERS = {
    "signal": "and a signal reads",
    "tau": "and forces or the dissipation read",
    "bias": "and inertial forces here hang on",
    "acceleration": "and here they hang on",
}
MOST_IMPLICIT = 360  # accelerations of all stages: their matrix, on the stack, is a megabyte
LOST = 2  # times the rounding of another route: a route that has more is not taken


@dataclass(frozen=True)
class Program:
    """Everything that the generated code computes.

    order: in which the accelerations eliminate coordinates. passed_over: routes to them that were
    not tried, and why. notes: where unusual terms of K went.
    """

    system: System
    functions: Mapping[str, Function]
    notes: tuple[str, ...]
    order: tuple[int, ...]
    passed_over: Mapping[str, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Function:
        return self.functions[name]

    def __contains__(self, name: str) -> bool:
        return name in self.functions


# --- from equations to a program ------------------------------------------------------------------


def build(equations: Mapping[str, Equations]) -> Program:
    """The program of a system's equations, by route: each function by its cheapest route."""
    first = next(iter(equations.values()))
    names = [c.name for c in first.system.coordinates]
    expanders = {route: Expander(e.tape) for route, e in equations.items() if route == "program"}
    wanted = {route: _wanted(e) for route, e in equations.items()}
    functions: dict[str, Function] = {}
    for name in next(iter(wanted.values())):
        routes: dict[str, Route] = {}
        for route, e in equations.items():
            if name not in wanted[route]:  # D or C, by rows here and column by column there
                continue
            outputs = wanted[route][name]
            routes[route] = Route(e.tape, outputs)
            if route in expanders and (short := expanders[route].expand(outputs)) is not None:
                routes["expanded"] = Route(e.tape, short)
        functions[name] = _cheapest(name, first.system, routes)
    routes = {}
    for route, e in equations.items():
        for way, solution in e.solutions.items():
            routes[way] = _solving(solution, names)
        if route in expanders:
            routes |= _expanded_solutions(e, expanders[route], names)
    best = functions["acceleration"] = _cheapest("acceleration", first.system, routes)
    run = first.system.run
    if run.linearize or any(METHODS[name].newton for name in run.methods):
        made = _linearization(first.system, routes[best.route])
        functions[made.name] = replace(made, route=best.route)
    if run.linearize == "parameters" and first.system.parameters:
        taken = routes[best.route]
        rows = lagrange.sensitivity(first.system, taken.tape, taken.outputs)
        made = lower("sensitivity", taken.tape, [x for row in rows for x in row], (), ())
        functions["sensitivity"] = replace(made, route=best.route)
    if all(o.coefficient == 0 for o in functions["tau"].outputs):
        del functions["tau"]
    passed_over = {way: why for e in equations.values() for way, why in e.passed_over.items()}
    order = routes[best.route].order
    whole = Program(first.system, functions, first.notes, order, passed_over)
    if unsuited := _unsuited(whole):
        raise SceneError(unsuited)
    return whole


@dataclass(frozen=True)
class Route:
    """One way to a function: results and (pivot, diagonal) pairs on a tape, and their names."""

    tape: Tape
    outputs: Sequence[Expr]
    checks: Sequence[tuple[Expr, Expr]] = ()
    labels: Sequence[str] = ()
    order: tuple[int, ...] = ()


def _wanted(e: Equations) -> dict[str, list[Expr]]:
    by_rows = {"D": e.D, "C": e.C}
    wanted: dict[str, list[Expr]] = {
        **{
            name if len(rows) == len(e.g) else f"{name}_column": [x for row in rows for x in row]
            for name, rows in by_rows.items()
        },
        "g": list(e.g),
        "bias": list(e.bias),
        "tau": list(e.tau),
        "kinetic_energy": [e.kinetic],
        "potential_energy": [e.potential],
        "energy": [e.tape.define(e.kinetic + e.potential)],
    }
    if e.jacobi is not None:
        wanted["jacobi"] = [e.jacobi]
    if e.power != 0:
        wanted["power"] = [e.power]
    if e.signals:
        wanted["signal"] = list(e.signals)
    return wanted


def _solving(solution: Solution, names: Sequence[str]) -> Route:
    labels = [f"{name}_ddot" for name in names]
    pair = (solution.matrix.lower(), solution.matrix)
    labels += [f"{what}_{names[k]}" for k in solution.order for what in pair]
    return Route(solution.tape, solution.acceleration, solution.pivots, labels, solution.order)


def _unsuited(program: Program) -> list[Problem]:
    """What [run] asks for and this system can't have."""
    s, out = program.system, []
    implicit = [name for name in s.run.methods if METHODS[name].implicit]
    if implicit and s.run.batch:
        message = f"'{implicit[0]}' is for one trajectory: leave out batch = true, or that method"
        out.append(s.problem("run.batch", message))
    for name in (name for name in implicit if METHODS[name].newton):
        size = METHODS[name].stages * len(s.q)
        if size > MOST_IMPLICIT:
            message = (
                f"'{name}' would solve for {size} numbers at once, more than {MOST_IMPLICIT}: take "
                "an explicit method, or one with fewer stages"
            )
            out.append(s.problem("run.method", message))
    swept = [name for name in implicit if METHODS[name].sweeps]
    if swept and (jumps := _jumps(program)):
        message = (
            f"'{swept[0]}' needs smooth accelerations, and {jumps} of a coordinate or velocity "
            "jumps: make it smooth, say tanh(x/width), or take 'rk4' or 'dp8'"
        )
        out.append(s.problem("run.method", message))
    velocities = {x.name for x in s.qd}
    read = {
        name: sorted(program[name].uses & velocities)
        for name in ("signal", "tau", "bias", "acceleration")
        if name in program
    }
    if "verlet" in s.run.methods and (read["acceleration"] or read.get("signal")):
        name = next(name for name, names in read.items() if names)
        found = ", ".join(read[name])
        message = (
            f"'verlet' needs accelerations that hang on positions and time alone, "
            f"{_READERS[name]} {found}. "
            "Take 'rk4', 'dp8' or 'gauss4'"
        )
        out.append(s.problem("run.method", message))
    return out


def _jumps(program: Program) -> str:
    """A function in the accelerations that jumps on the way; the empty string where none does."""
    for name in ("acceleration", "signal"):
        for a in program[name].body if name in program else ():
            if isinstance(a.value, Call) and a.stage >= Stage.POSITION:
                if a.value.function in ("sign", "heaviside"):
                    return a.value.function
    return ""


def _linearization(system: System, way: Route) -> Function:
    """The derivatives of the accelerations by the route that these go."""
    rows = lagrange.linearization(system, way.tape, way.outputs)
    by_rows = len(rows) == len(system.q) and len(rows[0]) > len(rows)
    name = "linearization" if by_rows else "linearization_column"
    return lower(name, way.tape, [x for row in rows for x in row], way.checks, ())


def _expanded_solutions(e: Equations, expander: Expander, names: Sequence[str]) -> dict[str, Route]:
    n = len(e.bias)
    lower = [(i, j) for i in range(n) for j in range(i + 1)]
    both = expander.expand([*(e.D[i][j] for i, j in lower), *e.balance])
    if both is None:
        return {}
    entries = dict(zip(lower, both, strict=False))
    D = tuple(tuple(entries[max(i, j), min(i, j)] for j in range(n)) for i in range(n))
    routes = {}
    for route, short in (("expanded", lambda atom: atom), ("cancelled", expander.short)):
        order, acceleration, pivots = solve(e.tape, D, both[len(lower) :], short)
        routes[route] = _solving(Solution(e.tape, acceleration, order, pivots), names)
    return routes


def _cheapest(name: str, system: System, routes: Mapping[str, Route]) -> Function:
    """By the route with the fewest operations among those that lose no digits against another."""
    made = {way: lower(name, r.tape, r.outputs, r.checks, r.labels) for way, r in routes.items()}

    def rank(route: str) -> tuple[float, int]:  # D bears massless links: worth a fifth more
        weight = _weight(made[route].cost) * (1.25 if route == "tensions" else 1.0)
        return weight, len(made[route].early)

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

    Infinite where one fails and another does not: a massless link has no tension, but may have D.
    """
    states = range(5 if all(len(f.body) < 500 for f in made.values()) else 2)
    errors = {route: _errors(f, system, states) for route, f in made.items()}
    told = [k for k in states if any(math.isfinite(found[k]) for found in errors.values())]
    return {route: max((found[k] for k in told), default=0.0) for route, found in errors.items()}


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
        read = program["D" if "D" in program else "D_column"].uses
        if wrong := [
            f"{p.name} = {p.value:g}" for p in s.parameters if p.value <= 0 and p.name in read
        ]:
            message = (
                f"D is not positive definite, '{weak}' has no inertia, at {', '.join(wrong)}: "
                "masses and moments of inertia are positive"
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


def matrix(program: Program, name: str, values: Mapping[str, float]) -> list[list[float]]:
    """D or C at the given values by name, in Python floats, (nq, nq). Raises as `evaluate` does."""
    names = [c.name for c in program.system.coordinates]
    n = len(names)
    if name in program:
        flat, _ = evaluator(program[name])(values)
        return [flat[n * i : n * i + n] for i in range(n)]
    column, columns = evaluator(program[f"{name}_column"]), []
    for one in names:
        unit = {f"{other}{ALONG}": float(other == one) for other in names}
        columns.append(column({**values, **unit})[0])
    return [list(row) for row in zip(*columns, strict=True)]


def _without_inertia(program: Program, k: int) -> str | None:
    """The coordinate without a positive pivot in D at the k-th state; None where D is regular."""
    names = [c.name for c in program.system.coordinates]
    n = len(names)
    try:
        D = matrix(program, "D", nearby(program.system, k))
    except (ArithmeticError, ValueError):
        return names[0]
    A = [list(row) for row in D]
    for i in range(n):
        if not A[i][i] > 8 * n * 2.0**-52 * D[i][i]:
            return names[i]
        for j in range(i + 1, n):
            factor = A[j][i] / A[i][i]
            A[j] = [a - factor * b for a, b in zip(A[j], A[i], strict=True)]
    return None
