"""An acceleration in two parts, of which the first is computed for two places side by side.

What a configuration q alone decides, D and its factors above all, RK4 needs at q and q + h/2 qd
when a step begins, and at its other two places as soon as two accelerations are there. So that part
is written once, as loops over two configurations in vector registers; what is left, the motion's
part, follows stage by stage.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

from sympy import Expr, S

from eomc import angles, ccode, pieces, vectors
from eomc.angles import Angle
from eomc.assignments import Assignment, Function, Operand, Sum, rename
from eomc.ccode import DOUBLE
from eomc.target import TROUBLE, Argument, Target, arguments

FEWEST = 5  # angles from which on it pays to have them side by side
LOOPED = 10  # coordinates from which on loops over them pay


@dataclass(frozen=True)
class Parts:
    """angles: those whose sines and cosines come from outside. configuration: gives the values that
    `motion` reads of it, by their names `kept`. What parameters alone decide is in neither."""

    angles: tuple[Angle, ...]
    configuration: Function
    motion: Function
    kept: tuple[str, ...]


def apart(target: Target, function: Function) -> Parts | None:
    """The two parts of an acceleration; None where they bring nothing."""
    if target.real is not DOUBLE or "rk4" not in target.system.run.methods:
        return None
    turned, rest = angles.apart(function, target.names)
    if not turned or not (len(turned) >= FEWEST or pieces.is_large(function)):
        return None
    sines = {name for a in turned for name in (a.sine, a.cosine)}
    own = [p.name for p in target.system.parameters]
    fixed = {*own, *(a.name for a in function.early)}
    _, rest = pieces.staged(rest, own)
    place = {*target.names, *sines}
    first: list[Assignment] = []
    for a in rest.body:
        if place.issuperset(set(a.value.names) - fixed):
            place.add(a.name)
            first.append(a)
    made = {a.name for a in first}
    late = [a for a in rest.body if a.name not in made]
    checks = [
        (made.issuperset({o.name for o in pair if o.name} - fixed), pair) for pair in rest.checks
    ]
    motion = replace(
        rest, body=tuple(late), checks=tuple(pair for early, pair in checks if not early)
    )
    read = motion.uses
    kept = tuple(a.name for a in first if a.name in read)
    configuration = replace(
        rest,
        name="configuration",
        body=tuple(first),
        outputs=tuple(Operand(S.One, name) for name in kept),
        checks=tuple(pair for early, pair in checks if early),
    )
    if 4 * pieces.weight(configuration) < pieces.weight(motion):
        return None
    new = _numbered(configuration, kept)
    configuration, motion = rename(configuration, new), rename(motion, new)
    kept = tuple(new.get(name, name) for name in kept)
    named = frozenset(kept)
    return Parts(tuple(turned), pieces.with_names(configuration, named), motion, kept)


def _numbered(function: Function, kept: Sequence[str]) -> dict[str, str]:
    """k1, k2, ... for values that have no name of their own and are handed on."""
    own = {a.name for a in function.body if a.named}
    taken = {*function.uses, *(a.name for a in function.body)}
    fresh = (name for n in count(1) if (name := f"k{n}") not in taken)
    return dict(zip((name for name in kept if name not in own), fresh, strict=False))


def context(
    target: Target, parts: Parts, kept: Sequence[str], timed: bool, takes_p: bool
) -> dict[str, Any]:
    """What pairs.c.jinja and rk4_pairs.c.jinja print.

    kept: what parameters alone decide; timed: whether accelerations hang on t by themselves;
    takes_p: whether the scene's signals need the parameters.
    """
    P, real = target.prefix, target.real.name
    groups = target.groups()
    where = {n: f"c->{n}" for n in kept}

    def sines(index: str) -> dict[str, str]:
        found = {}
        for k, a in enumerate(parts.angles):
            found[a.sine] = f"at->sine[{2 * k} + {index}]"
            found[a.cosine] = f"at->cosine[{2 * k} + {index}]"
        return found

    def state(index: str) -> Callable[[str, str], str]:
        return lambda array, name: (
            f"at->q[2*{target.enum[name]} + {index}]"
            if array == "q"
            else f"qd->x[{target.enum[name]}]"
        )

    place = frozenset({*groups["q"], *sines("i")})
    configuration = target.in_pieces(
        parts.configuration,
        "configuration",
        [
            Argument(f"const {P}_pair *{target.PREFIX}_ALONE at", "at", place),
            Argument(f"const {P}_prepared *c", "c", frozenset(kept)),
            Argument(f"{real} *{target.PREFIX}_ALONE troubles", "troubles", frozenset({TROUBLE})),
        ],
        [f"k->{name}[i]" for name in parts.kept],
        Argument(f"{P}_kept *{target.PREFIX}_ALONE k", "k", frozenset()),
        lambda f: target.loads(f, state("i"), target.element),
        where | sines("i"),
        pair=True,
    )
    u_arg = f"const {real} *u"
    motion = target.in_pieces(
        parts.motion,
        "motion",
        [
            Argument("int lane", "lane", place | set(parts.kept)),
            Argument(f"const {P}_kept *k", "k", frozenset(parts.kept)),
            Argument(f"const {P}_pair *at", "at", place),
            Argument(f"const {P}_vector *qd", "qd", groups["qd"]),
            Argument(f"{real} t", "t", groups["t"]),
            Argument(u_arg, "u", groups["u"]),
            Argument(f"const {P}_prepared *c", "c", frozenset(kept)),
        ],
        [f"a->x[{target.enum[name]}]" for name in target.names],
        Argument(f"{P}_vector *a", "a", frozenset()),
        lambda f: target.loads(f, state("lane"), target.element),
        where | sines("lane") | {name: f"k->{name}[lane]" for name in parts.kept},
    )
    t, driven = "t" if timed else "", "t" if target.driven else ""
    u, c, p = "u" if groups["u"] else "", "c" if kept else "", "p" if takes_p else ""
    t_arg, c_arg = f"{real} t", f"const {P}_prepared *c" if c else ""
    whole = f"{P}_vector *a, int lane, const {P}_kept *k, const {P}_pair *at, const {P}_vector *qd"
    configuration_lines = [
        *([f"{real} troubles[2] = {{ 0, 0 }};"] if configuration["troubled"] else []),
        *configuration["locals"],
        "",
        *configuration["calls"],
        "return !(troubles[0] + troubles[1] > 0);" if configuration["troubled"] else "return 1;",
    ]
    motion_lines = [*motion["locals"], *motion["calls"], f"return {motion['outcome']};"]
    place_now = ", ".join(f"at->q[2*{target.enum[name]} + lane]" for name in target.names)

    def motion_call(given: str, time: str) -> str:
        return f"{P}_motion({arguments('a, lane, k, at, qd', time, given, c)})"

    def stage(to: str, velocity: str, time: str) -> str:
        shared = f"{to}, &k, &now, {velocity}"
        if u:
            return f"{P}_moving({arguments(shared, time if driven else '', u, c, p)})"
        return f"{P}_motion({arguments(shared, time if timed else '', c)})"

    return {
        "members": [f"{name}[2]" for name in parts.kept],
        "count": len(parts.angles),
        "configuration": configuration,
        "motion": motion,
        "angles": _angles(target, parts.angles),
        "configuration_arguments": arguments(f"{P}_kept *k, const {P}_pair *at", c_arg),
        "configuration_call": arguments("&k, &now", c),
        "configuration_lines": configuration_lines,
        "configuration_unused": _unread([c] if c else [], configuration_lines),
        "motion_arguments": arguments(whole, t and t_arg, u and u_arg, c_arg),
        "motion_lines": motion_lines,
        "motion_unused": _unread(
            [x for x in ("lane", "k", "at", "qd", t, u, c) if x], motion_lines
        ),
        "moving_arguments": arguments(
            whole, driven and t_arg, u_arg, c_arg, target.p_arg if p else ""
        ),
        "signal_at": [
            f"const {real} place[{target.PREFIX}_NQ] = {{ {place_now} }};",
            vectors.gathered(target, True, "qd", "moving"),
        ]
        if target.signal_state
        else [],
        "signal_call": target.signal_call("now", "place", "moving"),
        "moved_now": motion_call("now", t),
        "moved_given": motion_call("u", t),
        "stage": stage,
        "each": lambda lines: ccode.indent(_each(target, lines)),
        "solve_locals": [f"{P}_pair at;", f"{P}_kept k;", "int good;"],
        "solve_lines": [
            *vectors.each(target, True, ["at.q[2*#] = at.q[2*# + 1] = q->$;"]),
            f"{P}_pair_angles(&at);",
            f"good = {P}_configuration({arguments('&k, &at', c)});",
        ],
        "solve_end": [f"return {P}_motion({arguments('a, 0, &k, &at, qd', t, u, c)}) && good;"],
    }


def _unread(names: Sequence[str], lines: Sequence[str]) -> list[str]:
    """Arguments that no statement has."""
    return [n for n in names if not any(re.search(rf"\b{n}\b", line) for line in lines)]


def _each(target: Target, lines: Sequence[str]) -> list[str]:
    """Statements for every coordinate, one by one where they are few: what was stored one by one
    just before can't be loaded several at a time without waiting."""
    if len(target.names) < LOOPED:
        return vectors.one_by_one(target, True, lines)
    return vectors.each(target, True, lines)


def _angles(target: Target, turned: Sequence[Angle]) -> dict[str, Any]:
    """Where the angles of two places and of one are found, and what they are turned by."""

    def gathered(to: str, vector: str, offset: bool, pair: bool) -> dict[str, Any]:
        first = target.names.index(turned[0].terms[0][1])
        plain = all(
            a.terms == ((S.One, name),) and (a.offset == 0 or not offset)
            for a, name in zip(turned, target.names[first:], strict=False)
        )
        if plain:
            start = target.enum[target.names[first]]
            at = f"{vector} + {'2*' if pair else ''}{start}" if first else vector
            return {"declared": f"const {target.real.name} *const {to} = {at};", "lines": []}
        lines = []
        for k, a in enumerate(turned):
            text = _along(target, a, vector, pair, a.offset if offset else S.Zero)
            lines.append(f"{to}[{2 * k} + i] = {text};" if pair else f"{to}[{k}] = {text};")
        return {
            "declared": f"{target.real.name} {to}[{(2 if pair else 1) * len(turned)}];",
            "lines": vectors.loop("i", "2", lines) if pair else lines,
        }

    return {
        "pair": gathered("x", "at->q", True, True),
        "pair_change": gathered("x", "d", False, True),
        "mid": gathered("x", "mid->x", True, False),
        "mid_change": gathered("turn", "d->x", False, False),
    }


def _along(target: Target, angle: Angle, vector: str, pair: bool, offset: Expr) -> str:
    """An angle of coordinates in an array."""

    def place(name: str) -> str:
        return f"2*{target.enum[name]} + i" if pair else target.enum[name]

    where = {name: f"{vector}[{place(name)}]" for _, name in angle.terms}
    return ccode.Printer(target.prefix, target.real, where).value(Sum(angle.terms, offset))[0]
