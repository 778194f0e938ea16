"""Derivatives of the accelerations with respect to state, inputs and parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sympy import Expr, Rational, S, Symbol

from eomc.base.errors import SceneError
from eomc.derive.energies import tangent_symbols
from eomc.derive.lagrange import UNROLLED_SIZE_LIMIT
from eomc.derive.ldl import Rows, Vector
from eomc.derive.tape import NotDifferentiableError, Tape
from eomc.model.system import System

# the bound of roots that are differentiated: far below any root but 0, its reciprocal is finite and
# the square of that overflows
LEAST_ROOT = {"double": Rational(1, 2**1000), "float": Rational(1, 2**120)}

# (cause, remedy) of discontinuous accelerations: in formulas, and by stick-slip friction
JUMPS = (
    "the accelerations jump (sign or heaviside of a coordinate or velocity)",
    "make them smooth, say tanh(x/width)",
)
STICKS = (
    'accelerations jump where friction = "stick" holds and lets go',
    'write friction = "smooth"',
)


def linearization(system: System, tape: Tape, accelerations: Sequence[Expr]) -> Rows:
    """Return the derivatives [da/dq, da/dqd, da/du] of the accelerations a.

    The result is a matrix (nq, 2 nq + nu) by rows. If its expressions would be too long, return a
    single row (nq,) instead: the directional derivative of a. The components of the direction, one
    for each coordinate, velocity and input, are then the symbols `tangent_symbols(system)`.

    Raises
    ------
    SceneError
        If the accelerations contain a discontinuous function.
    """
    entries = tangent_symbols(system)
    if len(entries) * len(tape.live(accelerations)) > UNROLLED_SIZE_LIMIT:
        return (_slopes(system, tape, accelerations, [entries])[0],)
    columns = _slopes(system, tape, accelerations, [{x: S.One} for x in entries])
    return tuple(zip(*columns, strict=True))


def directional_derivatives(system: System, tape: Tape, values: Sequence[Expr]) -> Vector:
    """Return the directional derivative of each of `values`, which depend on q, qd and u.

    The direction v has one component for each coordinate, velocity and input; the components are
    the symbols that `tangent_symbols(system)` returns. The result for a value f is
    sum_x df/dx v_x over all x in (q, qd, u). The values and results are defined on `tape`, a list
    of elementary operations. Raises SceneError if a value contains a discontinuous function.
    """
    return _slopes(system, tape, values, [tangent_symbols(system)])[0]


def sensitivity(system: System, tape: Tape, accelerations: Sequence[Expr]) -> Rows:
    """Return the derivatives da/dp of accelerations a with respect to the parameters, (nq, np).

    The state and the inputs are held constant. Raises SceneError if the accelerations contain a
    discontinuous function.
    """
    entries = [{p.symbol: S.One} for p in system.parameters]
    return tuple(zip(*_slopes(system, tape, accelerations, entries), strict=True))


def _slopes(
    system: System,
    tape: Tape,
    accelerations: Sequence[Expr],
    directions: Sequence[Mapping[Symbol, Expr]],
) -> list[Vector]:
    """Return the derivatives of accelerations along each of the given directions."""
    try:
        least = LEAST_ROOT[system.run.real]
        return [tuple(tape.forward(accelerations, entries, least)) for entries in directions]
    except NotDifferentiableError:
        jump, smooth = STICKS if system.modes else JUMPS
        message = (
            f"{jump}, so they have no derivatives: {smooth}, or do without linearize and the "
            "implicit methods"
        )
        raise SceneError([system.problem("run", message)]) from None
