"""Outputs on a tape, formulas of state, inputs and accelerations; derivatives of both on a tape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from sympy import Expr, Rational, S, Symbol

from eomc.base.errors import SceneError
from eomc.derive.energies import leaves, tangent_symbols
from eomc.derive.ldl import Rows, Vector
from eomc.derive.tape import NotDifferentiableError, Stage, Tape
from eomc.model.symbols import ALONG, Output, dot, needed_definitions
from eomc.model.system import System, symbol, t

# the bound of roots that are differentiated: far below any root but 0, its reciprocal is finite and
# the square of that overflows
LEAST_ROOT = {"double": Rational(1, 2**1000), "float": Rational(1, 2**120)}


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
    rates = {**system.rates, **dict(zip(system.qd, system.qdd, strict=True)), t: S.One}

    def value(expr: Expr) -> Expr:
        """Return the atom of an expression on the tape.

        Time derivatives dot(...) are replaced by the chain rule, the innermost first.
        """
        rates_of: dict[Expr, Expr] = {}
        for derivative in expr.atoms(dot):
            position = value(derivative.args[0])
            assert not tape.leaves_of([position]) & {*system.u, *system.qdd}, derivative
            (rates_of[derivative],) = tape.forward([position], rates)
        return tape.define(expr.xreplace(rates_of).xreplace(definitions))

    for defined, expr in needed_definitions(
        system.definitions, [o.formula for o in system.outputs]
    ):
        definitions[defined] = tape.named(value(expr), defined.name)
    values = tuple(tape.named(value(o.formula), o.name) for o in system.outputs)
    if not with_derivatives:
        return Outputs(tape, values, ((),) * len(values))
    parameters = system.parameters if system.run.by_parameters else ()
    variables = (*state, *system.u, *system.qdd, *(p.symbol for p in parameters))
    saved, tape.constant_leaves = tape.constant_leaves, frozenset()  # discrete variables count here
    least = LEAST_ROOT[system.run.real]
    rows = [tuple(tape.gradient([(y, S.One)], variables, least=least)) for y in values]
    tape.constant_leaves = saved
    count = len(variables) - len(parameters)
    slopes, sensitivity = (tuple(row[:count] for row in rows), tuple(row[count:] for row in rows))
    return Outputs(tape, values, slopes, sensitivity)


# --- derivatives of the accelerations -------------------------------------------------------------

# Names of the accelerations times columns up to which all columns are unrolled. Columns share their
# factors on the tape, so that their number of operations is a fraction of this number.
MAX_LINEARIZATION_SIZE = 25_000

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
    if len(entries) * len(tape.live(accelerations)) > MAX_LINEARIZATION_SIZE:
        return (differentiate(system, tape, accelerations, [entries])[0],)
    columns = differentiate(system, tape, accelerations, [{x: S.One} for x in entries])
    return tuple(zip(*columns, strict=True))


def directional_derivatives(system: System, tape: Tape, values: Sequence[Expr]) -> Vector:
    """Return the directional derivative of each of `values`, which depend on q, qd, u and p.

    The direction v has one component for each coordinate, velocity and input, and for each
    parameter if the scene requests derivatives with respect to them; the components are the symbols
    that `tangent_symbols` returns. The result for a value f is sum_x df/dx v_x over all x in
    (q, qd, u, p). The values and results are defined on `tape`, a list of elementary operations.
    Raises SceneError if a value contains a discontinuous function.
    """
    direction = tangent_symbols(system, parameters=system.run.by_parameters)
    return differentiate(system, tape, values, [direction])[0]


def sensitivity(system: System, tape: Tape, accelerations: Sequence[Expr]) -> Rows:
    """Return the derivatives da/dp of accelerations a with respect to the parameters, (nq, np).

    The state and the inputs are held constant. Raises SceneError if the accelerations contain a
    discontinuous function.
    """
    entries = [{p.symbol: S.One} for p in system.parameters]
    return tuple(zip(*differentiate(system, tape, accelerations, entries), strict=True))


def jacobian_products(
    system: System, tape: Tape, accelerations: Sequence[Expr]
) -> tuple[Vector, Vector]:
    """Return the products J v and w^T J of the accelerations' Jacobian J = da/d[q, qd, u, p].

    The components of v, one for each variable, and of w, one for each acceleration, are symbols:
    the variable's name with the suffix `ALONG`. The products cost a small multiple of the
    accelerations, whatever the number of columns of J: the first by a forward sweep over the tape,
    the second by a reverse sweep (Griewank & Walther, ch. 3). Raises SceneError if the
    accelerations contain a discontinuous function.
    """
    variables = _variables(system)
    direction = _vector_symbols(tape, variables)
    along = dict(zip(variables, direction, strict=True))
    (forward,) = differentiate(system, tape, accelerations, [along])
    return forward, _pull_back(system, tape, accelerations, system.qdd)


def signal_vjp(system: System) -> tuple[Tape, Vector]:
    """Return the product w^T J of the Jacobian J = du/d[q, qd, u, p] of the scene's signals u.

    The components of w are the symbols of the inputs with the suffix `ALONG`. The derivatives with
    respect to u are 0. Raises NotDifferentiableError if a signal contains a discontinuous function.
    """
    signals = tuple(Output(i.name, i.signal) for i in system.inputs)
    derived = outputs(replace(system, outputs=signals, inputs=()), with_derivatives=False)
    return derived.tape, _pull_back(system, derived.tape, derived.values, system.u)


def gradients(system: System, tape: Tape, sums: Sequence[Sequence[tuple[Expr, Expr]]]) -> Vector:
    """Return the gradients of weighted sums of values by [q, qd, u, p, t], one after the other.

    A sum consists of pairs (value, weight). sign and heaviside are piecewise constant: their
    derivatives are 0.
    """
    saved, tape.constant_leaves = tape.constant_leaves, tape.find_jumps()
    variables, least = (*_variables(system), t), LEAST_ROOT[system.run.real]
    rows = [tape.gradient(pairs, variables, least=least) for pairs in sums]
    tape.constant_leaves = saved
    return tuple(x for row in rows for x in row)


def jump_vjp(system: System, tape: Tape, values: Sequence[Expr]) -> Vector:
    """Return w^T J for the states after jumps, with their derivatives J by [q, qd, u, p, t].

    values: the state [q, qd] after the jump of each event. The components of w are the symbols of q
    and qd with the suffix `ALONG`.
    """
    weights = _vector_symbols(tape, (*system.q, *system.qd))
    n = len(weights)
    states = [values[k : k + n] for k in range(0, len(values), n)]
    return gradients(system, tape, [[*zip(x, weights, strict=True)] for x in states])


def _variables(system: System) -> tuple[Symbol, ...]:
    """Return the symbols of q, qd, u and the parameters."""
    return (*system.q, *system.qd, *system.u, *(p.symbol for p in system.parameters))


def _vector_symbols(tape: Tape, names: Sequence[Symbol]) -> list[Symbol]:
    """Return the symbols of a vector with an entry for each name, as leaves of the tape."""
    entries = [symbol(f"{x.name}{ALONG}") for x in names]
    stages = dict.fromkeys(entries, Stage.VELOCITY)
    tape.leaves |= stages
    tape.stage |= stages
    return entries


def _pull_back(
    system: System, tape: Tape, values: Sequence[Expr], names: Sequence[Symbol]
) -> Vector:
    """Return the gradient of the sum of values times the entries of a vector, see _vector_symbols.

    The gradient is with respect to [q, qd, u, p].
    """
    variables = _variables(system)
    pairs = list(zip(values, _vector_symbols(tape, names), strict=True))
    varying = set(variables)  # what depends on nothing else may jump
    for name in tape.live(values):
        varying |= {name} if varying.intersection(tape.parts[name]) else set()
    saved, tape.constant_leaves = tape.constant_leaves, frozenset(tape.stage.keys() - varying)
    gradient = tape.gradient(pairs, variables, least=LEAST_ROOT[system.run.real])
    tape.constant_leaves = saved
    return tuple(gradient)


def differentiate(
    system: System,
    tape: Tape,
    values: Sequence[Expr],
    directions: Sequence[Mapping[Symbol, Expr]],
) -> list[Vector]:
    """Return the derivatives of values along each of the given directions.

    Raises SceneError if the values contain a discontinuous function.
    """
    try:
        least = LEAST_ROOT[system.run.real]
        return [tuple(tape.forward(values, entries, least)) for entries in directions]
    except NotDifferentiableError:
        jump, smooth = STICKS if system.modes else JUMPS
        message = (
            f"{jump}, so they have no derivatives: {smooth}, or do without derivatives "
            "(linearize, exports) and the implicit methods"
        )
        raise SceneError([system.problem("run", message)]) from None
