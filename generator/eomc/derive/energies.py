"""Kinetic and potential energy, dissipation and generalized forces of a system on a tape."""

from __future__ import annotations

from dataclasses import dataclass

from sympy import Expr, S, Symbol

from eomc.derive.tape import Stage, Tape
from eomc.model.symbols import ALONG, needed_definitions
from eomc.model.system import System, dot, symbol, t


@dataclass
class Energies:
    """Energies, forces and constraint residuals of a system, as atoms of the attribute `tape`.

    A tape is a list of elementary operations, each with a named result. An atom is a number, a name
    on the tape, or a number times a name.

    Attributes
    ----------
    kinetic, potential : Expr
        Energies K and P (J).
    linear_potential : Expr
        The velocity-dependent potential a(q, t) . qd (J).
    dissipation : Expr
        Rayleigh's dissipation function R (W).
    forces : list of Expr
        Generalized force Q on each coordinate.
    signals : list of Expr
        Value of each input, by its formula in the scene.
    points : dict
        For each velocity w_k = dot(y_k) in a formula, the position y_k. The keys are the symbols
        w_k.
    applied : list of (Expr, Expr)
        For each force at a point: the velocity of the point, and the force.
    rows : list of Expr
        Residual of each constraint equation.
    rotation_errors : list of (Expr, Expr)
        For each axis equation of a loop whose rotation error is an angle a about n: the component
        of 2 tan(a/2) n along the axis, and cos(a/2)^2.
    """

    tape: Tape
    kinetic: Expr
    potential: Expr
    linear_potential: Expr
    dissipation: Expr
    forces: list[Expr]
    signals: list[Expr]
    points: dict[Symbol, Expr]  # velocity w of a point -> its position y
    applied: list[tuple[Expr, Expr]]  # (velocity of a point, force applied there)
    rows: list[Expr]  # residuals of the constraints
    rotation_errors: list[tuple[Expr, Expr]]  # of the constraints that have one


def tangent_symbols(system: System, parameters: bool = False) -> dict[Symbol, Symbol]:
    """Return a symbol for the component of a direction along each coordinate, velocity and input.

    The keys are the symbols of q, qd and u, with `parameters` also those of the parameters. The
    values are symbols v_x with which a directional derivative sum_x df/dx v_x is written.
    """
    variables = (*system.q, *system.qd, *system.u)
    if parameters:
        variables += tuple(p.symbol for p in system.parameters)
    return {x: symbol(f"{x.name}{ALONG}") for x in variables}


def leaves(system: System, *velocities: Symbol) -> dict[Symbol, Stage]:
    """Return the variables of the equations of motion, each with its binding time (`Stage`).

    The binding time says when a value can be computed: once for each set of parameters, from the
    time, from the positions, or from the velocities. The variables are t, the parameters, inputs,
    q and qd. Further symbols `velocities` are added with the binding time of qd.
    """
    stages: dict[Symbol, Stage] = {t: Stage.TIME}
    stages |= {p.symbol: Stage.PARAMETER for p in system.parameters}
    stages |= dict.fromkeys(system.u, Stage.TIME)
    stages |= dict.fromkeys(system.q, Stage.POSITION)
    return stages | dict.fromkeys((*system.qd, *velocities), Stage.VELOCITY)


def energies_on_tape(
    system: System, kinetic: Expr, potential: Expr, accelerations: bool = False
) -> Energies:
    """Return the energies and other terms of the equations of motion, defined on a new tape.

    The tape is a list of elementary operations. The other terms are the dissipation, forces, inputs
    and constraint residuals of the system.

    Parameters
    ----------
    kinetic, potential
        Formulas of the energies to use in place of `system.kinetic` and `system.potential`.
    accelerations
        If True, formulas on the tape may contain the accelerations `system.qdd`. If False, they may
        contain the components of a direction, see `tangent_symbols`.
    """
    more = system.qdd if accelerations else tangent_symbols(system, parameters=True).values()
    tape = Tape(leaves(system, *more), frozenset(system.q) - system.rates.keys())
    rates: dict[Symbol, Expr] = {**system.rates, t: S.One}
    definitions: dict[Symbol, Expr] = {}
    points: dict[Symbol, Expr] = {}

    def value(expr: Expr) -> Expr:
        velocities = {}
        for derivative in sorted(expr.atoms(dot), key=str):
            (inside,) = derivative.args
            position = tape.define(inside.xreplace(definitions))
            assert not tape.leaves_of([position]) & {*system.qd, *system.u}, derivative
            (velocity,) = tape.forward([position], rates)
            name = f"{inside}_dot" if inside.is_Symbol else f"w{len(points) + 1}"
            velocity = tape.named(velocity, name)
            if velocity in tape.parts and tape.stage[velocity] is Stage.VELOCITY:
                points.setdefault(velocity, position)
            velocities[derivative] = velocity
        return tape.define(expr.xreplace(velocities).xreplace(definitions))

    forces = system.forces or (S.Zero,) * len(system.coordinates)
    applied = [(dot(y), force) for y, force in system.applied]
    formulas = [kinetic, potential, system.linear_potential, system.dissipation, *forces]
    formulas += [i.signal for i in system.inputs]
    formulas += [e for pair in applied for e in pair]
    formulas += [row.formula for row in system.constraints]
    for defined, expr in needed_definitions(system.definitions, formulas):
        definitions[defined] = tape.named(value(expr), defined.name)
    energies = Energies(
        tape,
        value(kinetic),
        value(potential),
        value(system.linear_potential),
        value(system.dissipation),
        [value(force) for force in forces],
        [value(i.signal) for i in system.inputs],
        points,
        [(value(v), value(force)) for v, force in applied],
        [value(row.formula) for row in system.constraints],
        [],
    )
    errors = [c.rotation_error for c in system.constraints if c.rotation_error is not None]
    # last, since no other function needs their definitions
    for defined, expr in needed_definitions(
        system.definitions, [x for pair in errors for x in pair]
    ):
        if defined not in definitions:
            definitions[defined] = tape.named(value(expr), defined.name)
    energies.rotation_errors += [(value(error), value(half)) for error, half in errors]
    return energies
