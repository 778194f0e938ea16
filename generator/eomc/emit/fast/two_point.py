"""The two-point form of an acceleration: a configuration part for two points, a velocity part.

What a configuration q alone decides, D and its factors above all, RK4 needs at q and q + h/2 qd
when a step begins, and at its other two configurations as soon as two accelerations are there. So
that part is written once, as loops over two configurations in vector registers; the rest, the
velocity part, follows stage by stage.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

from sympy import Expr, S

from eomc.derive.tape import Stage, is_negative
from eomc.emit import c_expression, vectors
from eomc.emit.c_expression import DOUBLE
from eomc.emit.c_names import FAILED, Argument, Target, arguments
from eomc.program import outline, trig
from eomc.program.ir import Assignment, Function, Operand, Product, Sum, rename
from eomc.program.trig import Angle

FEWEST = 5  # angles from which on it pays to interleave them
FOUR = 4  # numbers that are loaded and stored at once
SUM, PRODUCT, QUOTIENT = 4, 3, 13  # cycles until their results are there, about
SHORT = 400  # operations of a step up to which its parts are inlined


@dataclass(frozen=True)
class Parts:
    """angles: those whose sines and cosines come from outside. configuration: gives the values that
    `velocity` reads of it, by their names `handed`. What parameters alone decide is in neither."""

    angles: tuple[Angle, ...]
    configuration: Function
    velocity: Function
    handed: tuple[str, ...]


def apart(target: Target, function: Function) -> Parts | None:
    """The two parts of an acceleration; None where they bring nothing."""
    if target.real is not DOUBLE or "rk4" not in target.system.run.methods:
        return None
    rotated, rest = trig.apart(function, target.names)
    if not rotated or not (len(rotated) >= FEWEST or outline.is_large(function)):
        return None
    sines = {name for a in rotated for name in (a.sine, a.cosine)}
    own = [p.name for p in target.system.parameters]
    fixed = {*own, *(a.name for a in function.early)}
    _, rest = outline.staged(rest, own)
    place = {*target.names, *sines}
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
    new = _numbered(configuration, handed, target.system.names)
    configuration, velocity = rename(configuration, new), rename(velocity, new)
    handed = tuple(new.get(name, name) for name in handed)
    named = frozenset(handed)
    configuration = outline.with_names(configuration, named)
    return Parts(tuple(rotated), _last_come_last(configuration), _last_come_last(velocity), handed)


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


def context(
    target: Target, parts: Parts, kept: Sequence[str], timed: bool, takes_p: bool
) -> dict[str, Any]:
    """What two_point.c.jinja and rk4_two_point.c.jinja print.

    kept: what parameters alone decide; timed: whether accelerations depend on t by themselves;
    takes_p: whether the scene's signals need the parameters.
    """
    P, real = target.prefix, target.real.name
    groups = target.groups()
    where = {n: f"c->{n}" for n in kept}
    inline = _step_weight(parts) <= SHORT

    def sines(index: str) -> dict[str, str]:
        found = {}
        for k, a in enumerate(parts.angles):
            found[a.sine] = f"at->sine[{_interleaved(k)} + {index}]"
            found[a.cosine] = f"at->cosine[{_interleaved(k)} + {index}]"
        return found

    def state(index: str) -> Callable[[str, str], str]:
        return lambda array, name: (
            f"at->q[{_interleaved(target.names.index(name))} + {index}]"
            if array == "q"
            else f"qd->x[{target.enum[name]}]"
        )

    place = frozenset({*groups["q"], *sines("i")})
    configuration = target.outlined(
        parts.configuration,
        "configuration",
        [
            Argument(f"const {P}_two_points *{target.PREFIX}_ALONE at", "at", place),
            Argument(f"const {P}_constants *c", "c", frozenset(kept)),
            Argument(f"{real} *{target.PREFIX}_ALONE failures", "failures", frozenset({FAILED})),
        ],
        [f"k->{name}[i]" for name in parts.handed],
        Argument(f"{P}_configuration_results *{target.PREFIX}_ALONE k", "k", frozenset()),
        lambda f: target.loads(f, state("i"), target.element),
        where | sines("i"),
        pair=True,
        inline=inline,
        in_order=True,
    )
    u_arg = f"const {real} *u"
    velocity = target.outlined(
        parts.velocity,
        "velocity",
        [
            Argument("int point", "point", place | set(parts.handed)),
            Argument(f"const {P}_configuration_results *k", "k", frozenset(parts.handed)),
            Argument(f"const {P}_two_points *at", "at", place),
            Argument(f"const {P}_vector *qd", "qd", groups["qd"]),
            Argument(f"{real} t", "t", groups["t"]),
            Argument(u_arg, "u", groups["u"]),
            Argument(f"const {P}_constants *c", "c", frozenset(kept)),
        ],
        [f"a->x[{target.enum[name]}]" for name in target.names],
        Argument(f"{P}_vector *{target.PREFIX}_ALONE a", "a", frozenset()),
        lambda f: target.loads(f, state("point"), target.element),
        where | sines("point") | {name: f"k->{name}[point]" for name in parts.handed},
        inline=inline,
        in_order=True,
    )
    _put_together(target, velocity["functions"], width(target, parts))
    t, driven = "t" if timed else "", "t" if target.driven else ""
    u, c, p = "u" if groups["u"] else "", "c" if kept else "", "p" if takes_p else ""
    t_arg, c_arg = f"{real} t", f"const {P}_constants *c" if c else ""
    whole = f"{P}_vector *a, int point, const {P}_configuration_results *k, "
    whole += f"const {P}_two_points *at, const {P}_vector *qd"
    configuration_lines = [
        *([f"{real} failures[2] = {{ 0, 0 }};"] if configuration["fails"] else []),
        *configuration["locals"],
        "",
        *configuration["calls"],
        "return !(failures[0] + failures[1] > 0);" if configuration["fails"] else "return 1;",
    ]
    velocity_lines = [*velocity["locals"], *velocity["calls"], f"return {velocity['outcome']};"]
    place_now = ", ".join(state("point")("q", name) for name in target.names)
    places = bool(groups["q"] & (parts.configuration.uses | parts.velocity.uses))
    places = places or (bool(groups["u"]) and target.signal_state)

    def call_with(given: str, time: str) -> str:
        return f"{P}_velocity_part({arguments('a, point, k, at, qd', time, given, c)})"

    def stage(to: str, qd: str, time: str) -> str:
        shared = f"{to}, &k, &now, {qd}"
        if u:
            return f"{P}_driven_velocity_part({arguments(shared, time if driven else '', u, c, p)})"
        return f"{P}_velocity_part({arguments(shared, time if timed else '', c)})"

    return {
        "members": [f"{name}[2]" for name in parts.handed],
        "width": width(target, parts),
        "count": len(parts.angles),
        "whole": _whole(len(parts.angles)),
        "inline": f"{target.PREFIX}_INLINE" if inline else "static",
        "coordinates": places,
        "each": lambda lines: c_expression.indent(
            vectors.each(target, True, lines, width=width(target, parts))
        ),
        "configuration": configuration,
        "velocity": velocity,
        "angles": {
            name: _angles(target, parts, *given)
            for name, given in {
                "one": ("x", "one->x", True),
                "other": ("y", "other->x", True),
                "d": ("x", "d->x", False),
                "e": ("y", "e->x", False),
                "mid": ("x", "mid->x", True),
                "rotation": ("rotation", "d->x", False),
            }.items()
        },
        "configuration_arguments": arguments(
            f"{P}_configuration_results *k, const {P}_two_points *at", c_arg
        ),
        "configuration_call": arguments("&k, &now", c),
        "configuration_lines": configuration_lines,
        "configuration_unused": _unread([c] if c else [], configuration_lines),
        "velocity_arguments": arguments(whole, t and t_arg, u and u_arg, c_arg),
        "velocity_lines": velocity_lines,
        "velocity_unused": _unread(
            [x for x in ("point", "k", "at", "qd", t, u, c) if x], velocity_lines
        ),
        "driven_arguments": arguments(
            whole, driven and t_arg, u_arg, c_arg, target.p_arg if p else ""
        ),
        "signal_at": [
            f"const {real} place[{target.PREFIX}_NQ] = {{ {place_now} }};",
            vectors.gathered(target, True, "qd", "moving"),
        ]
        if target.signal_state
        else [],
        "signal_call": target.signal_call("now", "place", "moving"),
        "moved_now": call_with("now", t),
        "moved_given": call_with("u", t),
        "stage": stage,
        "solve_locals": [f"{P}_two_points at;", f"{P}_configuration_results k;", "int good;"],
        "solve_lines": [
            f"{P}_two_point_angles(&at, q, q);",
            *([f"{P}_two_point_coordinates(&at, q, q);"] if places else []),
            f"good = {P}_configuration_part({arguments('&k, &at', c)});",
        ],
        "solve_end": [
            f"return {P}_velocity_part({arguments('a, 0, &k, &at, qd', t, u, c)}) && good;"
        ],
    }


def _unread(names: Sequence[str], lines: Sequence[str]) -> list[str]:
    """Arguments that no statement has."""
    return [n for n in names if not any(re.search(rf"\b{n}\b", line) for line in lines)]


def _whole(count: int) -> int:
    """SourceMap for so many numbers, a multiple of four."""
    return -(-count // FOUR) * FOUR


def width(target: Target, parts: Parts) -> int:
    """SourceMap in a vector: loops over whole registers go up to there, behind the coordinates over
    zeros; angles that are coordinates are read from there too."""
    first = target.names.index(parts.angles[0].terms[0][1])
    return max(_whole(len(target.names)), _whole(first + _whole(len(parts.angles))))


def _interleaved(k: int) -> int:
    """Where number k of two points stands in an array of both, as interleave.h has it."""
    return 2 * (k - k % FOUR) + (0, 4, 2, 6)[k % FOUR]


def _step_weight(parts: Parts) -> int:
    """The operations of the parts in a step, those for both points counted once."""
    return 2 * outline.weight(parts.configuration) + 4 * outline.weight(parts.velocity)


def _put_together(target: Target, cut: Sequence[dict[str, Any]], width: int) -> None:
    """The accelerations that a function makes, stored four at a time where all four are there."""
    for f in cut:
        ready = dict(f["results"])
        if f is cut[-1]:
            ready |= dict.fromkeys(range(len(target.names), width), target.zero)
        lines = []
        for begin in range(0, width, FOUR):
            block = [k for k in range(begin, begin + FOUR) if k in ready]
            if len(block) == FOUR:
                four = ", ".join(ready[k] for k in block)
                lines.append(f"{target.prefix}_store(a->x + {begin}, {four});")
            else:
                lines += [f"a->x[{k}] = {ready[k]};" for k in block]
        f["stores"] = lines


def _angles(target: Target, parts: Parts, to: str, vector: str, offset: bool) -> dict[str, Any]:
    """Where the angles of one point are found, or without offset what they are rotated by."""
    rotated, real = parts.angles, target.real.name
    first = target.names.index(rotated[0].terms[0][1])
    names = target.names[first : first + len(rotated)]
    plain = len(names) == len(rotated) and all(
        a.terms == ((S.One, name),) and (a.offset == 0 or not offset)
        for a, name in zip(rotated, names, strict=True)
    )
    if plain:
        at = f"{vector} + {first}" if first else vector
        return {"declared": f"const {real} *const {to} = {at};", "lines": []}
    texts = [_along(target, a, vector, a.offset if offset else S.Zero) for a in rotated]
    texts += [target.zero] * (_whole(len(texts)) - len(texts))
    return {
        "declared": f"{real} {to}[{len(texts)}];",
        "lines": [
            f"{target.prefix}_store({to} + {k}, {', '.join(texts[k : k + FOUR])});"
            for k in range(0, len(texts), FOUR)
        ],
    }


def _along(target: Target, angle: Angle, vector: str, offset: Expr) -> str:
    """An angle of coordinates in an array."""
    where = {name: f"{vector}[{target.enum[name]}]" for _, name in angle.terms}
    return c_expression.Printer(target.prefix, target.real, where).value(Sum(angle.terms, offset))[
        0
    ]
