"""The two-point form of an acceleration: a configuration part for two points, a velocity part.

What a configuration q alone decides, D and its factors above all, RK4 needs at q and q + h/2 qd
when a step begins, and at its other two configurations as soon as two accelerations are there. So
that part is written once, as loops over two configurations in vector registers; the rest, the
velocity part, follows stage by stage.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from itertools import count

from sympy import Expr, S

from eomc.derive.atoms import is_negative
from eomc.derive.tape import Stage
from eomc.model.system import System
from eomc.program import outline
from eomc.program.ir import Assignment, Function, Operand, Product, Sum, rename
from eomc.program.trig import Angle

FEWEST = 5  # angles from which on it pays
SUM, PRODUCT, QUOTIENT = 4, 3, 13  # cycles until their results are there, about
SHORT = 400  # operations of a step up to which its parts are inlined


@dataclass(frozen=True)
class Parts:
    """configuration: gives the values that `velocity` reads of it, by their names `handed`.

    What parameters alone decide is in neither.
    """

    configuration: Function
    velocity: Function
    handed: tuple[str, ...]

    @property
    def short(self) -> bool:
        """Whether both are inlined, by the operations of a step."""
        weight = 2 * outline.weight(self.configuration) + 4 * outline.weight(self.velocity)
        return weight <= SHORT


def apart(rest: Function, angles: Sequence[Angle], system: System, fixed: Set[str]) -> Parts | None:
    """The two parts of an acceleration that reads the sines of `angles`; None: they bring nothing.

    fixed: what parameters alone decide.
    """
    if not angles or not (len(angles) >= FEWEST or outline.is_large(rest)):
        return None
    sines = {name for a in angles for name in (a.sine, a.cosine)}
    place = {*(c.name for c in system.coordinates), *sines}
    first: list[Assignment] = []
    for a in rest.body:
        if place.issuperset(set(a.value.names) - fixed):
            place.add(a.name)
            first.append(a)
    made = {a.name for a in first}
    late, more = _without_factors([a for a in rest.body if a.name not in made], place, fixed)
    first += more
    checks = [
        (made.issuperset({o.name for o in pair if o.name} - fixed), pair) for pair in rest.checks
    ]
    velocity = replace(
        rest, body=tuple(late), checks=tuple(pair for early, pair in checks if not early)
    )
    read = velocity.uses
    handed = tuple(a.name for a in first if a.name in read)
    configuration = replace(
        rest,
        name="configuration",
        body=tuple(first),
        outputs=tuple(Operand(S.One, name) for name in handed),
        checks=tuple(pair for early, pair in checks if early),
    )
    if 4 * outline.weight(configuration) < outline.weight(velocity):
        return None
    new = _numbered(configuration, handed, system.names)
    configuration, velocity = rename(configuration, new), rename(velocity, new)
    handed = tuple(new.get(name, name) for name in handed)
    named = frozenset(handed)
    configuration = outline.with_names(configuration, named)
    return Parts(_last_come_last(configuration), _last_come_last(velocity), handed)


def _without_factors(
    late: Sequence[Assignment], place: Set[str], fixed: Set[str]
) -> tuple[list[Assignment], list[Assignment]]:
    """Products with one factor of all that the configuration decides in them; and these factors."""
    made: dict[Product, str] = {}
    out = []
    for a in late:
        if isinstance(a.value, Product):
            known = [f for f in a.value.factors if f in place or f in fixed]
            sign, size = a.value.coefficient, S.One
            if abs(sign) != 1:
                sign, size = (-S.One, -sign) if is_negative(sign) else (S.One, sign)
            if not place.isdisjoint(known) and (size != 1 or len(known) > 1):
                factor = Product(size, tuple(known))
                name = made.setdefault(factor, f"_f{len(made)}")
                rest = [f for f in a.value.factors if f not in known]
                a = replace(a, value=Product(sign, (name, *rest)))
        out.append(a)
    return out, [Assignment(name, value, Stage.POSITION) for value, name in made.items()]


def _last_come_last(function: Function) -> Function:
    """The function with the terms of its sums in the order in which they are known.

    What is known last waits for one operation then: a b + c d is taken as a b + (c d), with one
    operation behind a b, so of the first two the later stands first.
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
                """When a term's last operand is known, and whether a product is left to do."""
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
    """k1, k2, ... for values that have no name of their own and are handed on."""
    own = {a.name for a in function.body if a.named}
    taken = {*function.uses, *reserved, *(a.name for a in function.body)}
    fresh = (name for n in count(1) if (name := f"k{n}") not in taken)
    return dict(zip((name for name in handed if name not in own), fresh, strict=False))
