"""Outputs on a tape: formulas of state, inputs and accelerations, and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from sympy import Expr, S, Symbol

from eomc.base.errors import EomcError, SceneError
from eomc.derive.energies import leaves
from eomc.derive.ldl import Rows, Vector
from eomc.derive.linearize import LEAST_ROOT
from eomc.derive.tape import NotDifferentiableError, Tape
from eomc.model.symbols import MULTIPLIER, Output, dot, needed_definitions
from eomc.model.system import System, t


@dataclass(frozen=True)
class Outputs:
    """The outputs of a scene and their derivatives, as atoms of the attribute `tape`.

    A tape is a list of elementary operations, each with a named result. An atom is a number, a name
    on the tape, or a number times a name.

    Attributes
    ----------
    values : (ny,)
        The outputs.
    slopes : (ny, 3 nq + nu)
        Derivatives with respect to q, qd, u and qdd. The rows are empty if no derivatives were
        requested.
    sensitivity : (ny, np)
        Derivatives with respect to the parameters at constant q, qd, u and qdd. The rows are empty
        if no derivatives were requested.
    """

    tape: Tape
    values: Vector
    slopes: Rows
    sensitivity: Rows = ()


def outputs(
    system: System,
    with_derivatives: bool,
    extra_symbols: Sequence[Symbol] = (),
    base: tuple[Tape, Mapping[Symbol, Expr]] | None = None,
) -> Outputs:
    """Return the outputs of a system, defined on a tape (list of elementary operations).

    Parameters
    ----------
    with_derivatives
        Whether the derivatives of the outputs are computed, too.
    extra_symbols
        Symbols that outputs may contain in addition to those of the system.
    base
        The pair (tape, values): the tape to which the outputs are added, and the expression on it
        of each further symbol in the outputs. By default the tape is new.

    Raises
    ------
    SceneError
        If the derivative of a discontinuous function is needed.
    """
    stages = leaves(system, *system.qdd, *extra_symbols)
    tape, known = base or (Tape(stages), {})
    tape.leaves |= stages  # a tape that solves for accelerations has no symbols for them
    tape.stage |= stages
    try:
        return _outputs(system, with_derivatives, tape, dict(known))
    except NotDifferentiableError:
        message = (
            "a derivative of something that jumps is needed (sign or heaviside, in dot(...) or for "
            "linearize): make it smooth, say tanh(x/width)"
        )
        raise SceneError([system.problem("outputs", message)]) from None


def signal_slopes(system: System) -> Outputs:
    """Return the formulas of the inputs (signals) and their derivatives by q, qd and qdd.

    They are returned in the form of outputs of a scene: the signals are the `values`.
    """
    signals = tuple(Output(i.name, i.signal) for i in system.inputs)
    return outputs(replace(system, outputs=signals, inputs=()), with_derivatives=True)


def _outputs(
    system: System, with_derivatives: bool, tape: Tape, definitions: dict[Symbol, Expr]
) -> Outputs:
    """Derive outputs on a given tape, with the atoms of known symbols. Raises RoughError."""
    state = (*system.q, *system.qd)
    multipliers = {c.multiplier for c in system.constraints}
    rates = {**system.rates, **dict(zip(system.qd, system.qdd, strict=True)), t: S.One}

    def value(expr: Expr) -> Expr:
        """Return the atom of an expression on the tape.

        Time derivatives dot(...) are replaced by the chain rule, the innermost first.
        """
        rates_of: dict[Expr, Expr] = {}
        for derivative in expr.atoms(dot):
            if unknown_multipliers := sorted(map(str, derivative.free_symbols & multipliers)):
                name = unknown_multipliers[0].removesuffix(MULTIPLIER)
                raise EomcError(
                    f"{system.file or system.name}: dot(...) holds lambda_{name}, the multiplier "
                    "of a constraint, whose rate is not known"
                )
            position = value(derivative.args[0])
            if unknown := tape.leaves_of([position]) & {*system.u, *system.qdd}:
                raise EomcError(
                    f"{system.file or system.name}: {derivative} is the rate of something that "
                    f"depends on {', '.join(sorted(map(str, unknown)))}, whose rate is not known"
                )
            (rates_of[derivative],) = tape.forward([position], rates)
        return tape.define(expr.xreplace(rates_of).xreplace(definitions))

    for defined, expr in needed_definitions(
        system.definitions, [o.formula for o in system.outputs]
    ):
        definitions[defined] = tape.named(value(expr), defined.name)
    values = tuple(tape.named(value(o.formula), o.name) for o in system.outputs)
    if not with_derivatives:
        return Outputs(tape, values, ((),) * len(values))
    parameters = system.parameters if system.run.linearize == "parameters" else ()
    variables = (*state, *system.u, *system.qdd, *(p.symbol for p in parameters))
    saved, tape.constant_leaves = tape.constant_leaves, frozenset()  # discrete variables count here
    least = LEAST_ROOT[system.run.real]
    rows = [tuple(tape.gradient([(y, S.One)], variables, least=least)) for y in values]
    tape.constant_leaves = saved
    count = len(variables) - len(parameters)
    slopes, sensitivity = (tuple(row[:count] for row in rows), tuple(row[count:] for row in rows))
    return Outputs(tape, values, slopes, sensitivity)
