"""K, P, R and Q of a system on a tape, with the points whose rates they hold."""

from __future__ import annotations

from dataclasses import dataclass

from sympy import Expr, S, Symbol

from eomc.base.errors import EomcError
from eomc.derive.tape import Stage, Tape
from eomc.model.symbols import ALONG, needed
from eomc.model.system import System, dot, symbol, t


@dataclass
class Energies:
    """K, P, a.qd, R and Q on the tape, with the points y_k and their velocities w_k = dot(y_k)."""

    tape: Tape
    kinetic: Expr
    potential: Expr
    linear_potential: Expr
    dissipation: Expr
    forces: list[Expr]
    signals: list[Expr]
    points: dict[Symbol, Expr]  # w -> y
    applied: list[tuple[Expr, Expr]]  # the velocity of a position, and the force there
    rows: list[Expr]  # of constraints


def directions(system: System) -> dict[Symbol, Symbol]:
    """The entries of a direction in (q, qd, u), by what each goes along."""
    return {x: symbol(f"{x.name}{ALONG}") for x in (*system.q, *system.qd, *system.u)}


def leaves(system: System, *more: Symbol) -> dict[Symbol, Stage]:
    """t, parameters, inputs, coordinates, velocities, and what else changes as these do."""
    found: dict[Symbol, Stage] = {t: Stage.TIME}
    found |= {p.symbol: Stage.PARAMETER for p in system.parameters}
    found |= dict.fromkeys(system.u, Stage.TIME)
    found |= dict.fromkeys(system.q, Stage.POSITION)
    return found | dict.fromkeys((*system.qd, *more), Stage.VELOCITY)


def on_tape(
    system: System, kinetic: Expr, potential: Expr, accelerations: bool = False
) -> Energies:
    """K and P, with the system's dissipation, forces and signals, and what they are made of."""
    more = system.qdd if accelerations else directions(system).values()
    tape = Tape(leaves(system, *more), frozenset(system.q) - system.rates.keys())
    rates: dict[Symbol, Expr] = {**system.rates, t: S.One}
    known: dict[Symbol, Expr] = {}
    points: dict[Symbol, Expr] = {}

    def value(expr: Expr) -> Expr:
        velocities = {}
        for moving in sorted(expr.atoms(dot), key=str):
            position = tape.define(_position(system, moving).xreplace(known))
            held = tape.leaves_of([position]) & {*system.qd, *system.u}
            if held:
                raise EomcError(
                    f"{system.file or system.name}: {moving} is the rate of something that "
                    f"depends on {', '.join(sorted(map(str, held)))}: only t, coordinates and "
                    "parameters have known rates"
                )
            (velocity,) = tape.forward([position], rates)
            inside = moving.args[0]
            name = f"{inside}_dot" if inside.is_Symbol else f"w{len(points) + 1}"
            velocity = tape.named(velocity, name)
            if velocity in tape.parts and tape.stage[velocity] is Stage.VELOCITY:
                points.setdefault(velocity, position)
            velocities[moving] = velocity
        return tape.define(expr.xreplace(velocities).xreplace(known))

    forces = system.forces or (S.Zero,) * len(system.coordinates)
    applied = [(dot(y), force) for y, force in system.applied]
    ends = [kinetic, potential, system.linear_potential, system.dissipation, *forces]
    ends += [i.signal for i in system.inputs]
    ends += [e for pair in applied for e in pair]
    ends += [row.formula for row in system.constraints]
    for defined, expr in needed(system.definitions, ends):
        known[defined] = tape.named(value(expr), defined.name)
    return Energies(
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
    )


def _position(system: System, moving: dot) -> Expr:
    (inside,) = moving.args
    if inside.has(dot):
        raise EomcError(
            f"{system.file or system.name}: {moving} would hold accelerations, which are what is "
            "solved for"
        )
    return inside
