"""The states of selftest.c, and what the program gives there, computed in Python."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from fractions import Fraction
from itertools import chain, islice

from eomc.base.texts import FreeText
from eomc.emit.c_expression import DOUBLE
from eomc.emit.c_names import Target
from eomc.emit.heading import stamp
from eomc.emit.public import Public
from eomc.emit.views import SelfTest, State
from eomc.program.interpret import evaluate, nearby
from eomc.program.program import matrix
from eomc.program.trig import apart

# by whether numbers are doubles: the limit of |x| in sincos.h, sincosf.h
LIMIT = {True: 2.0**20, False: 2.0**13}
USUAL = {True: 1e-9, False: 1e-3}  # what may be off, of the largest entry
# the same where angles are large: sines are off by more where a multiply-add rounds twice
LARGE = {True: 1e-12, False: 1e-5}
STATES = 3  # near the start, and as many with large angles
GRID = 16  # large angles are multiples of 1/GRID: so are their sums and multiples, exactly


def view(target: Target) -> SelfTest:
    """The view of selftest.c."""
    double, public = target.real is DOUBLE, Public(target)
    around = [nearby(target.system, k) for k in range(6)]
    telling = [x for x in around if _telling(target, x)] or around
    near = (_state(target, x, 0.0) for x in telling)
    states = list(islice(filter(None, near), STATES))
    far = (_state(target, x, LARGE[double]) for x in _large(target))
    large = list(islice(filter(None, far), STATES))
    now = {"t": target.zero, "u": "NULL", "p": f"&{target.prefix}_defaults"}
    constrained = {
        name: public.evaluation(name).call(**now)
        for name in ("constraint_jacobian", "multipliers")
        if name in target.program
    }
    return SelfTest(
        title=FreeText(target.system.title),
        stamp=tuple(stamp(target)),
        prefix=target.prefix,
        PREFIX=target.PREFIX,
        real=target.real.name,
        states=(*states, *large),
        tolerance=USUAL[double],
        large_tolerance=LARGE[double] if large else 0,
        large_limit="2^20" if double else "2^13",
        D=public.evaluation("D").call(**now),
        bias=public.evaluation("bias").call(**now),
        tau=public.evaluation("tau").call(**now) if "tau" in target.program else "",
        acceleration=public.acceleration.call(**now),
        jacobian=constrained.get("constraint_jacobian", ""),
        multipliers=constrained.get("multipliers", ""),
    )


def _state(target: Target, x: Mapping[str, float], close: float) -> State | None:
    """One state as literals; None where it has no accelerations, or where angles are large
    (`close` > 0) and numbers are too short to judge D and bias as closely as that.
    """
    s, program = target.system, target.program
    try:
        known = _known(target, x)
        unit = 2.0**-52 if target.real is DOUBLE else 2.0**-20  # eight times a float's
        qdd, regular = evaluate(program["acceleration"], known, unit=unit)
        if not regular or max(map(abs, qdd)) >= 1e8:
            return None
        bias, _ = evaluate(program["bias"], known)
        if close:
            exact, _ = evaluate(program["bias"], known, exact=True)
            exact_qdd, _ = evaluate(program["acceleration"], known, exact=True)
            # a float's rounding is 2^29 times a double's
            room = 64 if target.real is DOUBLE else 4 * 2**29
            usual = USUAL[target.real is DOUBLE]
            if room * _off(bias, exact) > close or room * _off(qdd, exact_qdd) > usual:
                return None
        D = [x for row in matrix(program, "D", known) for x in row]
    except (ArithmeticError, ValueError):
        return None
    return State(
        x=tuple(target.literal(known[name.name]) for name in (*s.q, *s.qd)),
        expected=tuple(target.literal(value) for value in (*D, *bias, *qdd)),
        tolerance=close or USUAL[target.real is DOUBLE],
    )


def _telling(target: Target, x: Mapping[str, float]) -> bool:
    """Whether bias is not what rounding leaves of an angle, as sin(pi) is.

    Few libraries have that to many digits; one that misses it computes well all the same.
    """
    double, program = target.real is DOUBLE, target.program
    step = 1 + 2.0 ** (-52 if double else -23)
    try:
        known = _known(target, x)
        moved = known | {q.name: step * known[q.name] for q in target.system.q}
        bias, other = (evaluate(program["bias"], at)[0] for at in (known, moved))
        return _off(bias, other) <= USUAL[double]
    except (ArithmeticError, ValueError):
        return False


def _known(target: Target, x: Mapping[str, float]) -> dict[str, float]:
    """A state with its inputs, as they are in C: sin(pi) is not that of the float next to pi."""
    program = target.program
    known = dict(x) if target.real is DOUBLE else {name: _single(x[name]) for name in x}
    if "signal" in program:
        u, _ = evaluate(program["signal"], known)
        known |= {i.name: value for i, value in zip(target.system.inputs, u, strict=True)}
    return known


def _single(x: float) -> float:
    return float(struct.unpack("f", struct.pack("f", x))[0])


def _off(found: list[float], exact: list[float]) -> float:
    """The largest difference, of the largest entry."""
    worst = max(abs(a - b) for a, b in zip(found, exact, strict=True))
    return worst / max(map(abs, exact)) if worst else 0.0


def _large(target: Target) -> Iterator[dict[str, float]]:
    """States in which every angle of coordinates alone is large, up to the limit of sincos.h."""
    program, limit = target.program, LIMIT[target.real is DOUBLE]
    coordinates = {c.name: i for i, c in enumerate(program.system.coordinates)}
    found = chain.from_iterable(
        apart(program[name], coordinates)[0] for name in ("bias", "acceleration")
    )
    angles = [a for a in found if a.offset == 0 and all((GRID * c).is_integer for c, _ in a.terms)]
    if not angles:
        return
    most = limit / max(float(sum(abs(c) for c, _ in a.terms)) for a in angles)
    turning = {name for a in angles for _, name in a.terms}
    for k, part in enumerate((0.97, -0.99, 0.4, -0.7, 0.1, -0.05)):
        x = nearby(program.system, k + 1)
        for name in turning:
            inward = -1.3 if part > 0 else 1.3
            some = (part * most + inward * (coordinates[name] + k + j) for j in range(12))
            on_grid = (round(GRID * angle) / GRID for angle in some)
            x[name] = max(on_grid, key=lambda angle: _lost(angle, target.real is DOUBLE))
        # faster than nearby, so that gravity does not cover what the angles bring
        yield x | {v.name: 8 * x[v.name] for v in program.system.qd}


def _lost(angle: float, double: bool) -> float:
    """What n pi/2, the multiple next to an angle, loses where it is rounded."""
    n, rounded = round(angle / (math.pi / 2)), (lambda x: x) if double else _single
    half_pi = rounded(math.pi / 2)
    return float(abs(Fraction(rounded(n * half_pi)) - n * Fraction(half_pi)))
