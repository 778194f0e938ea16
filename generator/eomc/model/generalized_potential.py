"""Generalized potentials U(q, qd, t) = P(q, t) + a(q, t).qd, such as that of a magnetic field.

The generalized force is Q = d/dt dU/dqd - dU/dq (Goldstein, Poole & Safko, *Classical Mechanics*,
sec. 1.5), so that L = K - U. The linear part does no work: where K is quadratic in the velocities,
qd.dL/dqd - L = K + P, without a.qd.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import sympy
from sympy import Dummy, Expr, S, Symbol

from eomc.model.symbols import dot, needed_definitions

NOT_LINEAR = (
    "the potential energy can contain velocities in linear terms only, such as those of a magnetic "
    "field: inertia belongs in 'kinetic', friction in 'dissipation'"
)


class NotLinearError(ValueError):
    """Error for a potential energy that is nonlinear in the velocities."""


def split_potential(
    potential: Expr, definitions: Sequence[tuple[Symbol, Expr]], velocities: Iterable[Symbol]
) -> tuple[Expr, Expr]:
    """Split a generalized potential U = P(q, t) + a(q, t).qd and return the pair (P, a.qd).

    A time derivative dot(y) in U counts as a velocity and is not expanded. A term with dot(y)
    therefore belongs to a.qd even if y depends on t explicitly. Symbols whose definitions contain
    velocities are replaced by their expressions.

    Parameters
    ----------
    potential
        The generalized potential U.
    definitions
        Pairs (symbol, expression), each expression over the symbols before it.
    velocities
        Symbols of the generalized velocities.

    Raises
    ------
    NotLinearError
        If U is nonlinear in the velocities.
    """
    moving = {*velocities}
    for name, e in definitions:
        if e.free_symbols & moving or e.has(dot):
            moving.add(name)

    def moves(e: Expr) -> bool:
        return bool(e.free_symbols & moving or e.has(dot))

    terms = sympy.Add.make_args(potential)
    conservative = sympy.Add(*(e for e in terms if not moves(e)))
    rest = sympy.Add(*filter(moves, terms))
    if rest == 0:
        return potential, S.Zero
    known: dict[Expr, Expr] = {}
    for name, e in needed_definitions(definitions, [rest]):
        if name in moving:
            known[name] = e.xreplace(known)
    rest = rest.xreplace(known)
    rates = sorted(rest.atoms(dot), key=str)
    outer = [e for e in rates if not any(other != e and other.has(e) for other in rates)]
    stand_ins: dict[Expr, Expr] = {e: Dummy(real=True) for e in outer}
    rest = rest.xreplace(stand_ins)
    variables = [*(rest.free_symbols & {*velocities}), *stand_ins.values()]
    variables.sort(key=str)
    at_rest = dict.fromkeys(variables, S.Zero)
    slopes = [_eliminate_variables(sympy.diff(rest, x), variables) for x in variables]
    linear = sympy.Add(*(a * x for a, x in zip(slopes, variables, strict=True)))
    back = {dummy: e for e, dummy in stand_ins.items()}
    return conservative + rest.xreplace(at_rest), linear.xreplace(back)


def _eliminate_variables(slope: Expr, variables: Sequence[Expr]) -> Expr:
    """Return a derivative in a form without the variables. Raises NotLinearError if impossible."""
    for attempt in (lambda e: e, sympy.expand, sympy.simplify):
        slope = attempt(slope)
        if not slope.has(*variables):
            return slope
    raise NotLinearError(NOT_LINEAR)
