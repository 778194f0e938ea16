"""The acceleration split into position-dependent and velocity-dependent parts, for RK4.

RK4 needs the terms that depend on the configuration q only, above all D and its factors, at q and q
+ h/2 qd at the beginning of a step, and at its two other configurations once two accelerations are
known. That part is therefore evaluated for two configurations at once in vector registers. The
velocity-dependent part follows stage by stage.

Before the split, sines and cosines of angles that are linear in the coordinates are separated from
the function, so that they can be computed at other times: RK4 computes them at configurations that
are known at the beginning of a step and rotates them by the small remaining angle. This shortens
the dependency chain that limits the speed of small scenes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import count

from sympy import Expr, S

from eomc.derive.tape import Stage, is_negative
from eomc.model.system import System
from eomc.program import outline
from eomc.program.ir import (
    Assignment,
    Call,
    Function,
    Operand,
    Product,
    Sum,
    Value,
    names_of_pair,
    rename,
)

MIN_ANGLES = 5  # from which the split is faster
SUM, PRODUCT, QUOTIENT = 4, 3, 13  # approximate latencies in cycles
MAX_INLINED_OPERATIONS = 400  # of a step, up to which its parts are inlined


@dataclass(frozen=True)
class Parts:
    """The computation of accelerations, split into position-dependent and other operations.

    Operations that depend on parameters only belong to neither of the two functions.

    Attributes
    ----------
    configuration
        The function of the coordinates.
    velocity
        The function of the state, which reads the results of `configuration`.
    handed
        Names of the values that `configuration` computes and `velocity` reads.
    """

    configuration: Function
    velocity: Function
    handed: tuple[str, ...]

    @property
    def short(self) -> bool:
        """Whether `configuration` and `velocity` are short enough to be inlined in a time step."""
        weight = 2 * outline.weight(self.configuration) + 4 * outline.weight(self.velocity)
        return weight <= MAX_INLINED_OPERATIONS


def split(rest: Function, angles: Sequence[Angle], system: System, fixed: Set[str]) -> Parts | None:
    """Split the computation of accelerations into a position-dependent part and the rest.

    None is returned if the split has no advantage.

    Parameters
    ----------
    rest
        The function for the accelerations, which reads the sines and cosines of `angles`.
    fixed
        Names of values that depend on parameters only.
    """
    if not angles or not (len(angles) >= MIN_ANGLES or outline.is_large(rest)):
        return None
    sines = {name for a in angles for name in (a.sine, a.cosine)}
    positional = {*(c.name for c in system.coordinates), *sines}
    first: list[Assignment] = []
    for a in rest.body:
        if positional.issuperset(set(a.value.names) - fixed):
            positional.add(a.name)
            first.append(a)
    first_names = {a.name for a in first}
    later, factors = _without_factors(
        [a for a in rest.body if a.name not in first_names], positional, fixed
    )
    first += factors
    checks = [
        (first_names.issuperset({o.name for o in pair if o.name} - fixed), pair)
        for pair in rest.checks
    ]
    velocity = replace(
        rest, body=tuple(later), checks=tuple(pair for early, pair in checks if not early)
    )
    used = velocity.uses
    handed = tuple(a.name for a in first if a.name in used)
    configuration = replace(
        rest,
        name="configuration",
        body=tuple(first),
        outputs=tuple(Operand(S.One, name) for name in handed),
        checks=tuple(pair for early, pair in checks if early),
    )
    if 4 * outline.weight(configuration) < outline.weight(velocity):
        return None
    new_names = _numbered(configuration, handed, system.names)
    configuration, velocity = rename(configuration, new_names), rename(velocity, new_names)
    handed = tuple(new_names.get(name, name) for name in handed)
    names = frozenset(handed)
    configuration = outline.with_names(configuration, names)
    return Parts(_sort_by_latency(configuration), _sort_by_latency(velocity), handed)


def _without_factors(
    later: Sequence[Assignment], positional: Set[str], fixed: Set[str]
) -> tuple[list[Assignment], list[Assignment]]:
    """Combine the position-dependent factors of each product. Returns the assignments and these
    factors.
    """
    name_of_factor: dict[Product, str] = {}
    assignments = []
    for a in later:
        if isinstance(a.value, Product):
            known = [f for f in a.value.factors if f in positional or f in fixed]
            sign, size = a.value.coefficient, S.One
            if abs(sign) != 1:
                sign, size = (-S.One, -sign) if is_negative(sign) else (S.One, sign)
            if not positional.isdisjoint(known) and (size != 1 or len(known) > 1):
                factor = Product(size, tuple(known))
                name = name_of_factor.setdefault(factor, f"_f{len(name_of_factor)}")
                others = [f for f in a.value.factors if f not in known]
                a = replace(a, value=Product(sign, (name, *others)))
        assignments.append(a)
    return assignments, [
        Assignment(name, value, Stage.POSITION) for value, name in name_of_factor.items()
    ]


def _sort_by_latency(function: Function) -> Function:
    """Sort the terms of sums by the time when they are available.

    The term that is available last then delays the result by one operation only. Since a b + c d is
    computed as a b + (c d), with one operation after a b, the later of the first two terms comes
    first.
    """
    uses = Counter(n for a in function.body for n in a.value.names)
    uses.update(o.name for o in function.outputs)
    values = {a.name: a.value for a in function.body if not a.named and uses[a.name] == 1}
    ready: dict[str, int] = {}
    body = []
    for a in function.body:
        value = a.value
        if isinstance(value, Sum):

            def known(term: tuple[Expr, str]) -> tuple[int, bool]:
                """Return the cycle when a term is available, and whether it is a product."""
                weight, name = term
                if isinstance(inner := values.get(name), Product):
                    return max(ready.get(n, 0) for n in inner.factors), True
                return ready.get(name, 0), abs(weight) != 1

            terms = sorted(value.terms, key=lambda term: known(term)[0])
            if len(terms) > 1 and value.constant == 0 and known(terms[1])[1]:
                terms[:2] = terms[1::-1]
            value = replace(value, terms=tuple(terms))
            ready[a.name] = max(known(term)[0] for term in terms) + SUM
        elif isinstance(value, Product):
            ready[a.name] = max(ready.get(n, 0) for n in value.factors) + PRODUCT
        else:
            ready[a.name] = max((ready.get(n, 0) for n in value.names), default=0) + QUOTIENT
        body.append(replace(a, value=value))
    return replace(function, body=tuple(body))


def _numbered(
    function: Function, handed: Sequence[str], reserved: frozenset[str]
) -> dict[str, str]:
    """Return names k1, k2, ... for values that are passed on and have no meaningful name."""
    meaningful = {a.name for a in function.body if a.named}
    used = {*function.uses, *reserved, *(a.name for a in function.body)}
    new_names = (name for n in count(1) if (name := f"k{n}") not in used)
    return dict(zip((name for name in handed if name not in meaningful), new_names, strict=False))


# --- sines and cosines ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Angle:
    """An angle, offset + sum of coefficient times coordinate, and the names of its sine and cosine.

    `terms` contains the pairs (coefficient, coordinate).
    """

    terms: tuple[tuple[Expr, str], ...]
    offset: Expr
    sine: str
    cosine: str


def separate_angles(
    function: Function, coordinates: Collection[str]
) -> tuple[tuple[Angle, ...], Function]:
    """Turn the sines and cosines of angles of a function into values that it reads.

    The angles are those that are linear in the coordinates, whose names are `coordinates`. Returns
    the angles, and the function without the computation of their sines and cosines.
    """
    values = {a.name: a.value for a in function.body}
    by_argument: dict[tuple[Operand, ...], dict[str, str]] = {}
    for a in function.body:
        if isinstance(a.value, Call) and a.value.function in ("sin", "cos"):
            if _terms(a.value.args[0], values, coordinates) is not None:
                by_argument.setdefault(a.value.args, {})[a.value.function] = a.name
    if not by_argument:
        return (), function
    angles = []
    for args, names in by_argument.items():
        terms, offset = _terms(args[0], values, coordinates) or ((), S.Zero)
        angles.append(Angle(terms, offset, *names_of_pair(names)))
    separated = {name for names in by_argument.values() for name in names.values()}
    return tuple(angles), _remove_values(function, separated)


def _terms(
    angle: Operand, values: Mapping[str, Value], coordinates: Collection[str]
) -> tuple[tuple[tuple[Expr, str], ...], Expr] | None:
    """Return an angle as (terms over coordinates, constant); None where it has another form."""
    if angle.name in coordinates:
        return ((angle.coefficient, angle.name),), S.Zero
    definition = values.get(angle.name)
    if not isinstance(definition, Sum) or not all(
        name in coordinates for _, name in definition.terms
    ):
        return None
    k = angle.coefficient
    return tuple((k * c, name) for c, name in definition.terms), k * definition.constant


def _remove_values(function: Function, separated: Collection[str]) -> Function:
    """Return the function without the given values, which become inputs, and values that only they
    need.
    """
    ends = [*function.outputs, *(o for pair in function.checks for o in pair)]
    needed = {o.name for o in ends}
    body: list[Assignment] = []
    for a in reversed(function.body):
        if a.name not in separated and a.name in needed:
            body.append(a)
            needed.update(a.value.names)
    return replace(function, body=tuple(reversed(body)))
