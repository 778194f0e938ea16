"""Derivatives of the accelerations: along the state and inputs, along the parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sympy import Expr, S, Symbol

from eomc.base.errors import SceneError
from eomc.derive.energies import directions
from eomc.derive.equations import WRITTEN_OUT
from eomc.derive.ldl import Rows, Vector
from eomc.derive.tape import RoughError, Tape
from eomc.model.system import System

# that accelerations jump, and what makes them smooth; by formulas, by friction that sticks
JUMPS = (
    "the accelerations jump (sign or heaviside of a coordinate or velocity)",
    "make them smooth, say tanh(x/width)",
)
STICKS = (
    'accelerations jump where friction = "stick" holds and lets go',
    'write friction = "smooth"',
)


def linearization(system: System, tape: Tape, accelerations: Sequence[Expr]) -> Rows:
    """[da/dq, da/dqd, da/du] at held inputs, (nq, 2 nq + nu), of accelerations a on the tape.

    By rows, or where that would be long a single column, the derivative along a direction whose
    entries are `directions`. Raises SceneError where the accelerations jump.
    """
    entries = directions(system)
    if len(entries) * len(tape.live(accelerations)) > WRITTEN_OUT:
        return (_slopes(system, tape, accelerations, [entries])[0],)
    columns = _slopes(system, tape, accelerations, [{x: S.One} for x in entries])
    return tuple(zip(*columns, strict=True))


def along(system: System, tape: Tape, values: Sequence[Expr]) -> Vector:
    """The derivatives of values of the state along a direction, `directions`. Raises likewise."""
    return _slopes(system, tape, values, [directions(system)])[0]


def sensitivity(system: System, tape: Tape, accelerations: Sequence[Expr]) -> Rows:
    """da/dp at held inputs, (nq, np), of accelerations a on the tape. Raises as linearization."""
    entries = [{p.symbol: S.One} for p in system.parameters]
    return tuple(zip(*_slopes(system, tape, accelerations, entries), strict=True))


def _slopes(
    system: System,
    tape: Tape,
    accelerations: Sequence[Expr],
    along: Sequence[Mapping[Symbol, Expr]],
) -> list[Vector]:
    """The derivatives of accelerations along each of some directions."""
    try:
        return [tuple(tape.forward(accelerations, entries)) for entries in along]
    except RoughError:
        jump, smooth = STICKS if system.modes else JUMPS
        message = (
            f"{jump}, so they have no derivatives: {smooth}, or do without linearize and the "
            "implicit methods"
        )
        raise SceneError([system.problem("run", message)]) from None
