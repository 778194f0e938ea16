"""Events in both forms of C: constants and tables of the library's event detection."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from math import cos, pi

from eomc.emit.common import c_function as c
from eomc.emit.common.c_names import Target
from eomc.emit.common.coefficients import c_matrix, c_vector
from eomc.emit.common.functions import SceneFunctions
from eomc.integrators.tableaux import GAUSS16, Row
from eomc.scene.schema import ACTIONS

SAMPLES = 9  # values of an event function in a step
EVENTS_PER_STEP = 32  # without events at the same time
DIRECTIONS = {"falling": -1, "both": 0, "rising": 1}

COMMENTS = {  # of the tables of integers, by name
    "direction": "Directions in which the events trigger: -1 falling, 1 rising, 0 both.",
    "action": "Actions of the events: 0 record, 1 stop, 2 jump.",
    "above": "Whether the event leaves zero upwards in any case.",
    "mode": "Indices of each friction mode and of the coordinate that it belongs to.",
    "jump_sets": "Which entries of [q, qd] the jump of each event sets.",
}


def sizes(functions: SceneFunctions) -> dict[str, str]:
    """Return the texts of the library's constants that depend on the scene's events."""
    target = functions.target
    system, is_double = target.system, target.real.epsilon < 1e-10
    initial = sum(e.begins is not None for e in system.events)
    return {
        "EOM_SAMPLES": str(SAMPLES),
        "EOM_MAX_EVENTS": str(EVENTS_PER_STEP + initial),
        "EOM_MAX_SIMULTANEOUS": str(EVENTS_PER_STEP + 4 * initial),
        "EOM_OWN_EVENTS": str(len(system.own_events)),
        "EOM_MODES": str(len(system.modes)),
        "EOM_CLOSE": target.literal(1e-10 if is_double else 1e-5),
        "EOM_DIFFERENCE": target.literal(1e-6 if is_double else 1e-3),
        "EOM_SHIFT": target.literal(1e-7 if is_double else 1e-4),
    }


def tables(functions: SceneFunctions) -> tuple[str, ...]:
    """Return the tables of the library that depend on the scene's events, and nodes and weights."""
    target = functions.target
    system, x, real = target.system, chebyshev_nodes(), target.real
    stages = GAUSS16.stages
    integers: dict[str, Sequence[Sequence[int]] | Sequence[int]] = {
        "direction": [DIRECTIONS[e.direction] for e in system.events],
        "action": [ACTIONS.index(e.action) for e in system.events],
        "above": [int(e.above) for e in system.events],
    }
    if system.modes:
        integers["mode"] = [(m.at, m.of) for m in system.modes]
    if system.own_events:
        integers["jump_sets"] = _jump_flags(target)
    return (
        *(c.define_int_table(f"eom_{name}", row, COMMENTS[name]) for name, row in integers.items()),
        c_vector("eom_nodes", x, real, "Chebyshev nodes, as fractions of a step."),
        c_matrix("eom_once_integrated", power_integrals(x, stages, 1), real),
        c_matrix("eom_twice_integrated", power_integrals(x, stages, 2), real),
    )


def _jump_flags(target: Target) -> list[list[int]]:
    """Return, for each event of the scene, flags of the entries of [q, qd] that jump."""
    coordinates = [target.scene_name(c.name) for c in target.system.coordinates]
    states = [name + end for end in ("", "_dot") for name in coordinates]
    rows = ({name for name, _ in e.jump} for e in target.system.own_events)
    return [[int(name in names) for name in states] for names in rows]


def chebyshev_nodes() -> Row:
    """Return the fractions of a step, from 0 to 1, at which event functions are evaluated.

    They are the extrema of a Chebyshev polynomial and include both ends.
    """
    last = SAMPLES - 1
    return tuple(Fraction((1 - cos(pi * j / last)) / 2).limit_denominator(10**12)
                 for j in range(SAMPLES))  # fmt: skip


def power_integrals(x: Row, count: int, times: int) -> Sequence[Row]:
    """Return the integrals of the powers (2 c - 1)^n over c, from 0 to each x.

    The result has a row for each x and a column for each power n < `count`. With `times` = 2, it
    has the integrals of these integrals.
    """
    signs = [Fraction((-1) ** n) for n in range(count + 3)]

    def once(n: int, at: Fraction) -> Fraction:
        power = Fraction(1)
        for _ in range(n + 1):
            power *= 2 * at - 1
        return (power - signs[n + 1]) / (2 * (n + 1))

    def twice(n: int, at: Fraction) -> Fraction:
        return (once(n + 1, at) - signs[n + 1] * at) / (2 * (n + 1))

    integral = (once, twice)[times - 1]
    return [tuple(integral(n, at) for n in range(count)) for at in x]
