"""Numbers, angles and sums as formulas of a scene have them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from eomc.robots.rotations import SNAP, Vector


def number(x: float) -> str:
    """Return the shortest text that reads back as the number x."""
    short = repr(float(x)).removesuffix(".0")
    return "0" if short == "-0" else short


def angle(x: float) -> str:
    """Return an angle x (rad) as a scene writes it: 0.3, or "pi/2" in quotes.

    Multiples of pi/12, to within 1e-10, are written with pi.
    """
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
    """Return an angle (rad) or a length (m) as a scene writes it; `of` is "rad" or "m"."""
    return angle(x) if of == "rad" else number(x)


def vector(v: Vector) -> str:
    """Return a vector as a TOML array."""
    return f"[{', '.join(map(number, v))}]"


def total(terms: Sequence[tuple[float, str]]) -> str:
    """Return the formula of a sum of terms (factor, name), such as "2*q1 - q2"."""
    shown = [{1.0: q, -1.0: f"-{q}"}.get(by, f"{number(by)}*{q}") for by, q in terms]
    return " + ".join(shown).replace("+ -", "- ") or "0"


def less(text: str, x: float) -> str:
    """Return the formula `text` minus the number x."""
    return f"{text} - {number(x)}".replace("- -", "+ ") if x else text
