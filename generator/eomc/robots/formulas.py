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
    """Return the TOML text of an angle x (rad): a number such as 0.3, or a formula such as "pi/2".

    The formula, in quotes, is used for multiples of pi/12, to within 1e-10.
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
    """Return the TOML text of x, an angle if `of` is "rad", or a length if `of` is "m".

    An angle that is a multiple of pi/12 is written as a formula in quotes, such as "pi/2".
    """
    return angle(x) if of == "rad" else number(x)


def vector(v: Vector) -> str:
    """Return the TOML text of a vector, an array of numbers."""
    return f"[{', '.join(map(number, v))}]"


def total(terms: Sequence[tuple[float, str]]) -> str:
    """Return the formula of a linear combination as text, such as "2*q1 - q2".

    `terms` are pairs (factor, name of a coordinate).
    """
    shown = [{1.0: q, -1.0: f"-{q}"}.get(by, f"{number(by)}*{q}") for by, q in terms]
    return " + ".join(shown).replace("+ -", "- ") or "0"


def less(text: str, x: float) -> str:
    """Return the text of the formula `text` minus the number x, such as "q1 - 0.5"."""
    return f"{text} - {number(x)}".replace("- -", "+ ") if x else text
