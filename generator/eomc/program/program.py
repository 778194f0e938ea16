"""All functions of the generated code, each by its cheapest route."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

from sympy import Add, Expr, S, Symbol, expand

from eomc.base.errors import Problem, SceneError
from eomc.base.texts import listed
from eomc.derive import outputs
from eomc.derive.constraints import projection, rate_terms
from eomc.derive.frames import momentum, motions
from eomc.derive.lagrange import MASSLESS, Derivation, EquationsOfMotion, inverse_dynamics
from eomc.derive.ldl import Pairs, Solution, Vector
from eomc.derive.outputs import (
    STICKS,
    directional_derivatives,
    jacobian_products,
    sensitivity,
    signal_vjp,
)
from eomc.derive.tape import NotDifferentiableError, Stage, Tape
from eomc.integrators.tableaux import METHODS
from eomc.model.symbols import ALONG, Output, dot, needed_definitions, symbol
from eomc.model.system import System, t
from eomc.program.ir import Call, Function, evaluator, nearby
from eomc.program.lower import lower
from eomc.program.routes import ROUTES, Candidate, RouteInputs, cheapest, weight
from eomc.scene.scene import Scene

TIME = t.name
_READERS = {
    "signal": "and a signal reads",
    "tau": "and forces or the dissipation read",
    "bias": "and inertial forces here depend on",
    "acceleration": "and here they depend on",
}
MAX_IMPLICIT_UNKNOWNS = 360  # of all stages; their matrix takes a megabyte of stack


@dataclass(frozen=True)
class Program:
    """All functions of the generated code of a system.

    Attributes
    ----------
    functions
        The functions by name.
    notes
        Sentences that say where unusual terms of the kinetic energy appear in the equations.
    order
        Indices of the coordinates in order of elimination.
    passed_over
        Methods of derivation (routes) that were not used for the accelerations, with the reason.
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

    @property
    def solved(self) -> str:
        """A sentence that says how D qdd = tau - bias is solved."""
        names = ", ".join(self.system.coordinates[k].name for k in self.order)
        if "D" in self and not self.system.constraints:
            entries, period = enumerate(self["D"].outputs), len(self.order) + 1
            if not any(x.coefficient for k, x in entries if k % period):
                return "a = qdd = (tau - bias)/D: D is diagonal."
        return ROUTES[self["acceleration"].route].solved(self.system, names)


def build(derived: Derivation) -> Program:
    """Return the program of a system's equations: each function by its cheapest route.

    A route is a method of derivation, see routes.py.

    Raises
    ------
    SceneError
        If the table [run] of the scene requests something that is not possible for this system.
    """
    system, material = derived.system, RouteInputs(derived)
    by_route = {r.name: f for r in ROUTES.values() if (f := r.functions(material))}
    functions = {
        name: cheapest(
            name,
            system,
            {
                r: Candidate(f.tape, f.outputs[name])
                for r, f in by_route.items()
                if name in f.outputs
            },
        )
        for name in next(iter(by_route.values())).outputs
    }
    if derived.articulated == MASSLESS:  # D is singular everywhere: accelerations have no formula
        inertia(Program(system, functions, (), ()))
    best, taken, passed_over = accelerations(material)
    functions["acceleration"] = best
    additional = (
        *_derivatives(material, taken),
        *_constrained_functions(derived, taken),
        *_outputs(system, taken),
        *_events(system, taken),
        *_applied(system),
        *_signal_slopes(system, functions),
    )
    functions |= {function.name: function for function in (*additional, *_requested(system))}
    if all(o.coefficient == 0 for o in functions["tau"].outputs):
        del functions["tau"]
    notes = next(f.notes for f in by_route.values())
    program = Program(system, functions, notes, taken.order, passed_over)
    if unsuited := _unsuited(program):
        raise SceneError(unsuited)
    return program


def accelerations(material: RouteInputs) -> tuple[Function, Candidate, dict[str, str]]:
    """Return the function that computes the accelerations with the fewest operations.

    It is selected from the routes, the methods of derivation.

    Returns
    -------
    function
        The function "acceleration".
    candidate
        The same computation as expressions on a tape, from which other functions are derived.
    passed_over
        For each route that was not used, the reason.
    """
    solutions = {r.name: r.accelerations(material) for r in ROUTES.values()}
    system = material.derived.system
    candidates = {
        r: _solving(way, system) for r, way in solutions.items() if isinstance(way, Solution)
    }
    best = cheapest("acceleration", system, candidates)
    passed_over = {route: reason for route, reason in solutions.items() if isinstance(reason, str)}
    return best, candidates[best.route], passed_over


def _solving(solution: Solution, system: System) -> Candidate:
    """Return the candidate of a solution, with names for accelerations and pivots."""
    names = [c.name for c in system.coordinates]
    labels = [f"{name}_ddot" for name in names]
    matrix_names = (solution.matrix.lower(), solution.matrix)
    labels += [f"{matrix_name}_{names[k]}" for k in solution.order for matrix_name in matrix_names]
    values = (solution.acceleration, solution.pivots, labels, solution.order, solution.multipliers)
    return Candidate(solution.tape, *values, solution.parts)


def _derivatives(material: RouteInputs, taken: Candidate) -> Iterator[Function]:
    """Yield the derivatives of the accelerations that [run] or a method needs."""
    system = material.derived.system
    run, names = system.run, system.names
    if run.needs_derivatives or any(METHODS[name].newton for name in run.methods):
        candidates = {
            r.name: derived
            for r in ROUTES.values()
            if (derived := r.linearization(material, taken))
        }
        best = cheapest("linearization", system, candidates)
        by_columns = candidates[best.route].calls > 1
        yield replace(best, name="linearization_column") if by_columns else best
    if run.by_parameters and system.parameters:
        rows = sensitivity(system, taken.tape, taken.outputs)
        yield lower("sensitivity", taken.tape, [x for row in rows for x in row], names)
    if run.linearize == "products":
        products = jacobian_products(system, taken.tape, taken.outputs)
        for name, values in zip(("acceleration_jvp", "acceleration_vjp"), products, strict=True):
            yield lower(name, taken.tape, values, names, checks=taken.checks)
    if run.linearize == "products" and system.inputs:
        with suppress(NotDifferentiableError):
            tape, values = signal_vjp(system)
            yield lower("signal_vjp", tape, values, names)


def _outputs(system: System, taken: Candidate) -> Iterator[Function]:
    """Yield the outputs, and their derivatives where those of the accelerations are requested.

    taken: the accelerations. Their tape has the multipliers that outputs may contain; accelerations
    in outputs remain arguments.
    """
    if not system.outputs:
        return
    multipliers = dict(
        zip((c.multiplier for c in system.constraints), taken.multipliers, strict=False)
    )
    symbols = {x for o in system.outputs for x in o.formula.free_symbols}
    known = (taken.tape, multipliers) if symbols & multipliers.keys() else None
    checks = taken.checks if known else ()
    derived = outputs.outputs(system, with_derivatives=system.run.needs_derivatives, base=known)
    labels = [o.name for o in system.outputs]
    yield lower("outputs", derived.tape, derived.values, system.names, checks=checks, labels=labels)
    if rows := [x for row in derived.slopes for x in row]:
        yield lower("output_slopes", derived.tape, rows, system.names, checks=checks)
    if rows := [x for row in derived.sensitivity for x in row]:
        yield lower("output_sensitivity", derived.tape, rows, system.names, checks=checks)


def _events(system: System, taken: Candidate) -> Iterator[Function]:
    """Yield the event functions, and the states after jumps.

    taken: the accelerations. Their tape has the quantities that stick-slip friction depends on.
    """
    if not system.events:
        return
    state, values = [x.name for x in (*system.q, *system.qd)], []
    for e in system.events:
        jump_values = dict(e.jump)
        values += [jump_values.get(name, symbol(name)) for name in state]
    jumps = any(e.action == "jump" for e in system.events)
    switched_parts = {
        x: value
        for k, values_of_parts in taken.parts.items()
        for x, value in zip(system.constraints[k].parts, values_of_parts, strict=True)
    }
    begins = [S.NegativeOne if e.begins is None else e.begins for e in system.events]
    formulas_of = {"events": [e.when for e in system.events]}
    formulas_of |= {"begins": begins} if any(e.begins is not None for e in system.events) else {}
    formulas_of |= {"jumps": values} if jumps else {}
    for name, formulas in formulas_of.items():
        formula_outputs = tuple(Output(f"{name}_{k}", value) for k, value in enumerate(formulas))
        symbols = {x for f in formulas for x in f.free_symbols}
        known = (taken.tape, switched_parts) if symbols & switched_parts.keys() else None
        derived = outputs.outputs(
            replace(system, outputs=formula_outputs), with_derivatives=False, base=known
        )
        yield lower(name, derived.tape, derived.values, system.names)
        if system.run.linearize != "products" or system.constraints or name == "begins":
            continue
        if name == "jumps":
            products = outputs.jump_vjp(system, derived.tape, derived.values)
            yield lower("jump_vjp", derived.tape, products, system.names)
        else:
            sums = [[(value, S.One)] for value in derived.values]
            slopes = outputs.gradients(system, derived.tape, sums)
            yield lower("event_slopes", derived.tape, slopes, system.names)


def _requested(system: System) -> Iterator[Function]:
    """Yield the functions that [run] requests: frames, inverse dynamics and momenta."""
    frames = [f.name for f in system.output_frames]
    if frames:
        kinematics = motions(system)
        entries = ("x", "y", "angle") if system.plane else ("x", "y", "z")
        where = [f"{name}_{entry}" for name in frames for entry in entries]
        for name in ("poses", "velocities", "accelerations", "jacobians", "forces"):
            labels = where if name == "poses" and system.plane else ()
            values = getattr(kinematics, name)
            yield lower(f"frame_{name}", kinematics.tape, values, system.names, labels=labels)
    if system.run.inverse_dynamics:
        tape, forces = inverse_dynamics(system)
        labels = [f"tau_{c.name}" for c in system.coordinates]
        yield lower("inverse_dynamics", tape, forces, system.names, labels=labels)
    if system.run.momentum:
        tape, values = momentum(system)
        yield lower("momentum", tape, values, system.names)


def _signal_slopes(system: System, functions: Mapping[str, Function]) -> Iterator[Function]:
    """Yield [du/dq, du/dqd] of signals that depend on the state, where the derivatives exist.

    If derivatives with respect to the parameters are requested, yield du/dp of signals that depend
    on parameters, too.
    """
    state = {x.name for x in (*system.q, *system.qd)}
    parameters = {p.name for p in system.parameters if system.run.by_parameters}
    used = functions["signal"].uses if "signal" in functions else frozenset()
    if not system.run.needs_derivatives or not used & (state | parameters):
        return
    try:
        derived = outputs.signal_slopes(system)
    except SceneError:  # there is no derivative
        if not system.run.discretize:
            return
        message = (
            "a signal jumps (sign or heaviside of a coordinate or velocity), so steps under it "
            "have no derivatives: make it smooth, say tanh(x/width), or do without discretize"
        )
        raise SceneError([system.problem("run.discretize", message)]) from None
    if used & state:
        rows = [x for row in derived.slopes for x in row[: len(state)]]
        yield lower("signal_slopes", derived.tape, rows, system.names)
    if used & parameters:
        rows = [x for row in derived.sensitivity for x in row]
        yield lower("signal_sensitivity", derived.tape, rows, system.names)


def _applied(system: System) -> Iterator[Function]:
    """Yield the inputs saturated to their limits, where there are limits."""
    if all(i.limited == i.symbol for i in system.inputs):
        return
    leaves = {p.symbol: Stage.PARAMETER for p in system.parameters}
    tape = Tape(leaves | dict.fromkeys(system.u, Stage.TIME))
    saturated = [tape.define(i.limited) for i in system.inputs]
    labels = [f"{i.name}_limited" for i in system.inputs]
    yield lower("applied", tape, saturated, system.names, labels=labels)


def _unsuited(program: Program) -> list[Problem]:
    """Return problems for requests of [run] that are not possible for this system."""
    s, problems = program.system, []
    implicit = [name for name in s.run.methods if METHODS[name].implicit]
    if implicit and s.run.batch:
        message = f"'{implicit[0]}' is for one trajectory: leave out batch = true, or that method"
        problems.append(s.problem("run.batch", message))
    for name in (name for name in implicit if METHODS[name].newton or s.run.discretize):
        size = METHODS[name].stages * len(s.q)
        if size > MAX_IMPLICIT_UNKNOWNS:
            message = (
                f"'{name}' would solve for {size} numbers at once, more than "
                f"{MAX_IMPLICIT_UNKNOWNS}: take an explicit method, or one with fewer stages"
            )
            problems.append(s.problem("run.method", message))
    by_fixed_sweeps = [name for name in implicit if METHODS[name].sweeps]
    if by_fixed_sweeps and (jumps := _jumps(program)):
        message = (
            f"'{by_fixed_sweeps[0]}' needs smooth accelerations, and {jumps} of a coordinate or "
            "velocity jumps: make it smooth, say tanh(x/width), or take 'rk4' or 'dp8'"
        )
        if s.modes:
            message = (
                f"'{by_fixed_sweeps[0]}' needs smooth accelerations, and {STICKS[0]}: {STICKS[1]}, "
                "or take 'rk4' or 'dp8'"
            )
        problems.append(s.problem("run.method", message))
    velocities = {x.name for x in s.qd}
    velocities_read = {
        name: sorted(program[name].uses & velocities)
        for name in ("signal", "tau", "bias", "acceleration")
        if name in program
    }
    if "verlet" in s.run.methods and (
        velocities_read["acceleration"] or velocities_read.get("signal")
    ):
        name = next(name for name, names in velocities_read.items() if names)
        names_read = ", ".join(velocities_read[name])
        message = (
            f"'verlet' needs accelerations that depend on positions and time alone, "
            f"{_READERS[name]} {names_read}. "
            "Take 'rk4', 'dp8' or 'gauss4'"
        )
        problems.append(s.problem("run.method", message))
    return problems


def _jumps(program: Program) -> str:
    """Return a discontinuous function that the accelerations depend on; the empty string if
    none.
    """
    for name in ("acceleration", "signal"):
        for a in program[name].body if name in program else ():
            if isinstance(a.value, Call) and a.stage >= Stage.POSITION:
                if a.value.function in ("sign", "heaviside"):
                    return a.value.function
    return ""


def inertia(program: Program) -> list[Problem]:
    """Return a warning if the mass matrix D is not positive definite at the start, else nothing.

    Raises SceneError if D is not positive definite at states around the start either.
    """
    s = program.system
    unresisted = _without_inertia(program, 0)
    if not unresisted:
        return []
    coordinate = unresisted[-1]
    if all(_without_inertia(program, k) for k in range(1, 6)):
        message = (
            f"D is not positive definite: '{coordinate}' has no inertia of its own. Give it a "
            "mass, or leave out a coordinate that others determine"
        )
        if len(unresisted) > 1:
            message = (
                f"D is not positive definite: nothing resists {listed(unresisted)} as they move "
                "together. Give what lies between them mass and inertia, or leave out a coordinate "
                "that others determine"
            )
        names = program["D" if "D" in program else "D_column"].uses
        if nonpositive := [
            f"{p.name} = {p.value:g}" for p in s.parameters if p.value <= 0 and p.name in names
        ]:
            message = (
                f"D is not positive definite, '{coordinate}' has no inertia, at "
                f"{', '.join(nonpositive)}: "
                "masses and moments of inertia are positive"
            )
        elif body := _massless(s, unresisted):
            message = (
                f"D is not positive definite: nothing resists {listed(unresisted)} as they move "
                f"together, '{body}' has no inertia of its own. Give it mass and inertia, or fix it"
            )
            raise SceneError([s.problem(f"body.{body}", message)])
        raise SceneError([s.problem("energy.kinetic", message)])
    message = (
        f"D is not positive definite at the start, '{coordinate}' has no inertia there: "
        "start elsewhere, or choose coordinates that are regular there"
    )
    return [s.problem("energy.kinetic", message, "warning")]


def matrix(program: Program, name: str, values: Mapping[str, float]) -> list[list[float]]:
    """Return the mass matrix D or the Coriolis matrix C, (nq, nq), at one state, in Python floats.

    `name` is "D" or "C"; `values` contains coordinates, velocities and parameters by name. Raises
    ArithmeticError or ValueError if an entry is not a finite real number.
    """
    names = [c.name for c in program.system.coordinates]
    n = len(names)
    if name in program:
        flat, _ = evaluator(program[name])(values)
        return [flat[n * i : n * i + n] for i in range(n)]
    column, columns = evaluator(program[f"{name}_column"]), []
    for coordinate in names:
        unit = {f"{other}{ALONG}": float(other == coordinate) for other in names}
        columns.append(column({**values, **unit})[0])
    return [list(row) for row in zip(*columns, strict=True)]


def _massless(system: System, names: Sequence[str]) -> str:
    """Return the first massless body that moves with several of the given coordinates, or ""."""
    links = system.tree.links if system.tree and len(names) > 1 else ()
    with_inertia = {link.name for link in links if any((link.mass, *link.inertia, link.armature))}
    moving = (link.name for link in links if {x.name for x in link.q.free_symbols} & {*names})
    return next((name for name in moving if name not in with_inertia), "")


def _without_inertia(program: Program, k: int) -> list[str]:
    """Return coordinates that can move together without inertia at the k-th state; [] where D is
    regular.

    The last one is the first without a positive pivot.
    """
    names = [c.name for c in program.system.coordinates]
    n = len(names)
    values = nearby(program.system, k)
    try:
        D = matrix(program, "D", values)
        rows = weighted_gradients(program.functions, program.system, values)
    except (ArithmeticError, ValueError):
        return names[:1]
    for w, row in rows:
        D = [
            [x + w * a * b for x, b in zip(of, row, strict=True)]
            for of, a in zip(D, row, strict=True)
        ]
    A = [list(row) for row in D]
    for i in range(n):
        if not A[i][i] > 8 * n * 2.0**-52 * D[i][i]:
            return _null_motion(A, i, names)
        for j in range(i + 1, n):
            factor = A[j][i] / A[i][i]
            A[j] = [a - factor * b for a, b in zip(A[j], A[i], strict=True)]
    return []


def _null_motion(A: Sequence[Sequence[float]], i: int, names: Sequence[str]) -> list[str]:
    """Return the coordinates that move in the null vector of D. A: D eliminated up to pivot i."""
    qd = [0.0] * i + [1.0]
    for j in reversed(range(i)):
        qd[j] = -sum(A[j][k] * qd[k] for k in range(j + 1, i + 1)) / A[j][j]
    largest = max(map(abs, qd))
    return [name for name, x in zip(names, qd, strict=False) if abs(x) > 1e-9 * largest or x == 1]


# --- parameters without effect --------------------------------------------------------------------

ENERGIES = frozenset({"kinetic_energy", "potential_energy", "energy", "jacobi", "power"})
OUTPUTS = frozenset({"outputs", "output_slopes", "output_sensitivity"})


def unused_parameters(program: Program) -> list[Problem]:
    """Return a warning for each parameter that has no effect on the motion, such as M in M x_dot/2.

    Parameters that are used elsewhere, as in an output, an initial value or a body, are not
    reported.
    """
    s = program.system
    excluded = ENERGIES | OUTPUTS  # the scene says which outputs name it
    used = {x for f in program.functions.values() if f.name not in excluded for x in f.uses}
    problems = []
    for p in s.parameters:
        key = _key_of(s.scene, p.name) if s.scene and p.name not in used else ""
        if key:
            message = f"'{p.name}' reaches no equation of motion: {_reason(s, p.symbol)}"
            problems.append(s.problem(key, message, "warning"))
    return problems


def _key_of(scene: Scene, name: str) -> str:
    """Return the key where a name first occurs; "" if it occurs outside of energies and forces."""
    roots = _tables(scene, name)
    return ".".join(scene.used[name][0]) if roots and roots <= {"energy", "forces"} else ""


def _tables(scene: Scene, name: str) -> set[str]:
    """Return the tables in which a name occurs, directly or through definitions."""
    paths, queue = set[tuple[str, ...]](), [name]
    while queue:
        new = {*scene.used.get(queue.pop(), ())} - paths
        paths |= new
        queue += [path[1] for path in new if path[0] == "definitions"]
    return {path[0] for path in paths} - {"definitions"}


def _has(system: System, expression: Expr, name: Symbol) -> bool:
    """Return True if an expression contains a symbol, directly or through definitions."""
    expressions = (
        expression,
        *(e for _, e in needed_definitions(system.definitions, [expression])),
    )
    return any(name in e.free_symbols for e in expressions)


def _reason(system: System, parameter: Symbol) -> str:
    """Return the reason why no equation contains the parameter, and the remedy."""
    for term in Add.make_args(expand(system.kinetic)):
        if _has(system, term, parameter):
            rates = {*system.qd} & term.free_symbols | term.atoms(dot)
            if rates:
                rate = min(map(str, rates))
                return f"the kinetic energy has it with {rate}, but not its square; write {rate}**2"
    return (
        "what it adds to energies or forces cancels, or depends on no coordinate or velocity; "
        "remove it, or use it"
    )


# --- constraints: residuals, multipliers, projection, reactions -----------------------------------


def _constrained_functions(derived: Derivation, taken: Candidate) -> Iterator[Function]:
    """Yield the additional functions of a system with constraints; none without constraints.

    `derived` contains the equations of motion. `taken` is the selected computation of the
    accelerations, which also gives the Lagrange multipliers.
    """
    system = derived.system
    if not system.constraints:
        return
    yield from constraint_functions(derived)
    names = [f"lambda_{c.name}" for c in system.constraints]
    yield lower(
        "multipliers", taken.tape, taken.multipliers, system.names, checks=taken.checks,
        labels=names,
    )  # fmt: skip
    e, values, pivots, correction = min(
        (_correction(system, e) for e in _all_equations(derived)),
        key=lambda candidate: weight(candidate[-1].cost),
    )
    assert e.rows is not None
    yield correction
    if terms := rate_terms(e.tape, e.rows, system.qd):
        yield lower("rate_terms", e.tape, terms, system.names)
    if system.run.discretize:
        corrections = values[: 2 * len(system.q)]
        values_and_derivatives = [
            *corrections,
            *directional_derivatives(system, e.tape, corrections),
        ]
        yield lower("projection_along", e.tape, values_and_derivatives, system.names, checks=pivots)
    if system.reactions:
        yield _reactions(system)
    if system.run.needs_derivatives:
        gradients = [x for r in e.rows.rates for x in e.tape.gradient([(r, S.One)], system.q)]
        yield lower("constraint_slopes", e.tape, gradients, system.names)


def constraint_functions(derived: Derivation) -> Iterator[Function]:
    """Yield the functions for residuals, Jacobian and rates of the constraint equations.

    They are used to find initial values that satisfy the constraints. `derived` contains the
    equations of motion.
    """
    system, e = derived.system, _equations(derived)
    assert e.rows is not None
    names = [c.name for c in system.constraints]
    yield lower("constraints", e.tape, e.rows.values, system.names, labels=names)
    jacobian = [x for row in e.rows.jacobian for x in row]
    yield lower("constraint_jacobian", e.tape, jacobian, system.names)
    labels = [f"{name}_rate" for name in names]
    yield lower("constraint_rates", e.tape, e.rows.rates, system.names, labels=labels)
    if errors := e.rows.rotation_errors:
        slopes = [x for error, _ in errors for x in e.tape.gradient([(error, S.One)], system.q)]
        values = [*(error for error, _ in errors), *(half for _, half in errors)]
        yield lower("rotation_errors", e.tape, [*values, *slopes], system.names)


def _equations(derived: Derivation) -> EquationsOfMotion:
    """Return the equations with the constraints: the shorter ones if there are two."""
    return min(
        _all_equations(derived), key=lambda e: len(e.tape.live([x for row in e.D for x in row]))
    )


def _all_equations(derived: Derivation) -> list[EquationsOfMotion]:
    """Return the equations of motion by Lagrange and by Newton-Euler, where they exist."""
    return [e for e in (derived.lagrange, derived.newton_euler) if e is not None]


def _correction(
    system: System, e: EquationsOfMotion
) -> tuple[EquationsOfMotion, Vector, Pairs, Function]:
    """Derive the projection onto the constraints: the equations, corrections, pivots and the
    function.
    """
    assert e.rows is not None
    values, pivots = projection(e.tape, e.D, e.rows, system.q)
    return e, values, pivots, lower("projection", e.tape, values, system.names, checks=pivots)


def _reactions(system: System) -> Function:
    """Return the function of forces and moments in the loops, which depend on the multipliers."""
    values = [x for r in system.reactions for x in r.values]
    formulas = tuple(Output(f"reaction_{k}", x) for k, x in enumerate(values))
    multipliers = [c.multiplier for c in system.constraints]
    derived = outputs.outputs(
        replace(system, outputs=formulas), with_derivatives=False, extra_symbols=multipliers
    )
    return lower("reactions", derived.tape, derived.values, system.names)


def weighted_gradients(
    functions: Mapping[str, Function], system: System, values: Mapping[str, float]
) -> list[tuple[float, list[float]]]:
    """Return the pairs (weight w_k, gradient a_k) with which D + sum_k w_k a_k a_k^T is regular.

    There is one pair for each constraint equation that is not redundant. The list is empty if the
    mass matrix D is regular by itself.

    Parameters
    ----------
    functions
        Functions of the generated code by name, among them "constraint_jacobian".
    values
        Coordinates and parameters by name.

    Raises
    ------
    ArithmeticError, ValueError
        If an entry of the Jacobian is not a finite real number.
    """
    closure = system.closure
    if closure is None or not closure.weights:
        return []
    flat, _ = evaluator(functions["constraint_jacobian"])(values)
    n = len(system.q)
    return [
        (w, list(flat[n * k : n * k + n]))
        for k, (w, row) in enumerate(zip(closure.weights, system.constraints, strict=True))
        if not row.redundant
    ]
