"""Numbers, angles and sums as formulas of a scene have them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from eomc.robots.rotations import SNAP, Vector


def number(x: float) -> str:
    """The shortest text that reads back as x."""
    short = repr(float(x)).removesuffix(".0")
    return "0" if short == "-0" else short


def angle(x: float) -> str:
    """An angle as a scene has it: 0.3, or "pi/2" in quotes within 1e-10 of multiples of pi/12."""
    twelfths = round(x * 12 / math.pi)
    if abs(x - twelfths * math.pi / 12) > SNAP or abs(twelfths) > 48:
        return _shortest(x)
    if not twelfths:
        return "0"
    common = math.gcd(twelfths, 12)
    above, below = abs(twelfths) // common, 12 // common
    words = ("-" if twelfths < 0 else "") + (f"{above}*pi" if above > 1 else "pi")
    return f'"{words}/{below}"' if below > 1 else f'"{words}"'


def _shortest(x: float) -> str:
    """An angle of a rotation, computed to about 4e-16: no more digits than that means."""
    for digits in range(1, 17):
        short = f"{x:.{digits}g}"
        if abs(float(short) - x) <= 4e-16:
            return number(float(short))
    return number(x)


def length(x: float, of: str) -> str:
    """An angle, or a length, by its unit."""
    return angle(x) if of == "rad" else number(x)


def vector(v: Vector) -> str:
    """A vector as TOML has it."""
    return f"[{', '.join(map(number, v))}]"


def total(terms: Sequence[tuple[float, str]]) -> str:
    """The sum of terms, each with its factor."""
    shown = [{1.0: q, -1.0: f"-{q}"}.get(by, f"{number(by)}*{q}") for by, q in terms]
    return " + ".join(shown).replace("+ -", "- ") or "0"


def less(text: str, x: float) -> str:
    """The formula less a number."""
    return f"{text} - {number(x)}".replace("- -", "+ ") if x else text
