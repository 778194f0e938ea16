"""Outputs on a tape: formulas over the state, the inputs and the accelerations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from sympy import Expr, S, Symbol

from eomc.base.errors import EomcError, SceneError
from eomc.derive.energies import leaves
from eomc.derive.ldl import Rows, Vector
from eomc.derive.tape import RoughError, Tape
from eomc.model.symbols import MULTIPLIER, Output, dot, needed
from eomc.model.system import System, t


@dataclass(frozen=True)
class Outputs:
    """Outputs and their derivatives as atoms of a tape.

    values: (ny,). slopes: with respect to q, qd, u and qdd, (ny, 3 nq + nu). sensitivity: with
    respect to the parameters, the others held, (ny, np).
    """

    tape: Tape
    values: Vector
    slopes: Rows
    sensitivity: Rows = ()


def outputs(
    system: System,
    sloped: bool,
    more: Sequence[Symbol] = (),
    beside: tuple[Tape, Mapping[Symbol, Expr]] | None = None,
) -> Outputs:
    """The system's outputs, with slopes where it is `sloped`. more: what they read besides.

    beside: a tape that they go on, with what some symbols are there. Raises SceneError where a
    derivative is needed that does not exist.
    """
    given = leaves(system, *system.qdd, *more)
    tape, known = beside or (Tape(given), {})
    tape.leaves |= given  # which one that solves for accelerations has not
    tape.stage |= given
    try:
        return _outputs(system, sloped, tape, dict(known))
    except RoughError:
        message = (
            "a derivative of something that jumps is needed (sign or heaviside, in dot(...) or for "
            "linearize): make it smooth, say tanh(x/width)"
        )
        raise SceneError([system.problem("outputs", message)]) from None


def signal_slopes(system: System) -> Outputs:
    """The signals as outputs, with their slopes along q, qd and qdd. Raises as `outputs` does."""
    signals = tuple(Output(i.name, i.signal) for i in system.inputs)
    return outputs(replace(system, outputs=signals, inputs=()), sloped=True)


def _outputs(system: System, sloped: bool, tape: Tape, known: dict[Symbol, Expr]) -> Outputs:
    state = (*system.q, *system.qd)
    multipliers = {c.multiplier for c in system.constraints}
    rates = {**system.rates, **dict(zip(system.qd, system.qdd, strict=True)), t: S.One}

    def value(expr: Expr) -> Expr:
        """The expression's atom; dot(...) by the chain rule, from the innermost."""
        found: dict[Expr, Expr] = {}
        for moving in expr.atoms(dot):
            if held := sorted(map(str, moving.free_symbols & multipliers)):
                name = held[0].removesuffix(MULTIPLIER)
                raise EomcError(
                    f"{system.file or system.name}: dot(...) holds lambda_{name}, the multiplier "
                    "of a constraint, whose rate is not known"
                )
            position = value(moving.args[0])
            if unknown := tape.leaves_of([position]) & {*system.u, *system.qdd}:
                raise EomcError(
                    f"{system.file or system.name}: {moving} is the rate of something that depends "
                    f"on {', '.join(sorted(map(str, unknown)))}, whose rate is not known"
                )
            (found[moving],) = tape.forward([position], rates)
        return tape.define(expr.xreplace(found).xreplace(known))

    for defined, expr in needed(system.definitions, [o.formula for o in system.outputs]):
        known[defined] = tape.named(value(expr), defined.name)
    values = tuple(tape.named(value(o.formula), o.name) for o in system.outputs)
    if not sloped:
        return Outputs(tape, values, ((),) * len(values))
    parameters = system.parameters if system.run.linearize == "parameters" else ()
    along = (*state, *system.u, *system.qdd, *(p.symbol for p in parameters))
    kept, tape.still = tape.still, frozenset()  # outputs have slopes along discrete variables
    rows = [tuple(tape.gradient([(y, S.One)], along)) for y in values]
    tape.still = kept
    first = len(along) - len(parameters)
    slopes, sensitivity = (tuple(row[:first] for row in rows), tuple(row[first:] for row in rows))
    return Outputs(tape, values, slopes, sensitivity)
