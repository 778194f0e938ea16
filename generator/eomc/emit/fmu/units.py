"""Units of measurement in terms of FMI's base units."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
# exponents of the units in BASE
_SI: Mapping[str, tuple[int, ...]] = {
    **{name: tuple(int(name == b) for b in BASE) for name in BASE},
    "g": (1, 0, 0, 0, 0, 0, 0, 0),
    "N": (1, 1, -2, 0, 0, 0, 0, 0),
    "J": (1, 2, -2, 0, 0, 0, 0, 0),
    "W": (1, 2, -3, 0, 0, 0, 0, 0),
    "Pa": (1, -1, -2, 0, 0, 0, 0, 0),
    "Hz": (0, 0, -1, 0, 0, 0, 0, 0),
    "C": (0, 0, 1, 1, 0, 0, 0, 0),
    "V": (1, 2, -3, -1, 0, 0, 0, 0),
    "F": (-1, -2, 4, 2, 0, 0, 0, 0),
    "H": (1, 2, -2, -2, 0, 0, 0, 0),
    "Wb": (1, 2, -2, -1, 0, 0, 0, 0),
    "T": (1, 0, -2, -1, 0, 0, 0, 0),
    "S": (-1, -2, 3, 2, 0, 0, 0, 0),
    "Ohm": (1, 2, -3, -2, 0, 0, 0, 0),
}
_PREFIXES = {
    "n": 1e-9, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1, "k": 1e3, "M": 1e6, "G": 1e9,
}  # fmt: skip
_NONE = (0,) * len(BASE)
_TIME = _SI["s"]
_ANGLE = _SI["rad"]
_OTHERS: Mapping[str, tuple[float, tuple[int, ...]]] = {
    "min": (60.0, _TIME),
    "h": (3600.0, _TIME),
    "deg": (math.pi / 180, _ANGLE),
    "°": (math.pi / 180, _ANGLE),
    "rev": (2 * math.pi, _ANGLE),
    "t": (1000.0, _SI["kg"]),
    "L": (1e-3, (0, 3, 0, 0, 0, 0, 0, 0)),
    "bar": (1e5, _SI["Pa"]),
    "Ω": (1.0, _SI["Ohm"]),
    "%": (0.01, _NONE),
}
_TOKEN = re.compile(r"\s*(\*\*|[*/()^·.]|-?\d+|[A-Za-zµΩ°%]+|[⁻⁰¹²³⁴-⁹]+)")
_RAISED = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_MOST = 20  # largest magnitude of an exponent


@dataclass(frozen=True)
class Meaning:
    """A unit of measurement in terms of FMI's base units (`BASE`: kg, m, s, ...).

    The unit is `factor` times the product of the base units, each raised to its power. powers: the
    integer exponents, in the order of BASE.
    """

    factor: float
    powers: tuple[int, ...]

    def times(self, other: Meaning, power: int) -> Meaning:
        """Return the product of this unit and `other` raised to the integer `power`."""
        powers = (a + power * b for a, b in zip(self.powers, other.powers, strict=True))
        return Meaning(self.factor * other.factor**power, tuple(powers))

    @property
    def attributes(self) -> tuple[tuple[str, str], ...]:
        """The attributes of FMI's XML element BaseUnit for this unit, as pairs (name, value).

        There is one for each base unit with an exponent other than 0, and "factor" unless it is 1.
        """
        named = [(b, str(n)) for b, n in zip(BASE, self.powers, strict=True) if n]
        return (*named, *([("factor", repr(self.factor))] if self.factor != 1 else []))


ONE = Meaning(1.0, _NONE)


def parsed(text: str) -> Meaning | None:
    """Return the meaning of a unit written as text, such as "N m/rad" or "kg*m^2".

    None if the text is empty or is not a known unit.

    >>> parsed("N m/rad").attributes
    (('kg', '1'), ('m', '2'), ('s', '-2'), ('rad', '-1'))
    >>> parsed("furlongs") is parsed("") is None
    True
    """
    tokens: list[str] = []
    at = 0
    text = text.rstrip()
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            return None
        tokens.append(match[1])
        at = match.end()
    if not tokens:
        return None
    try:
        left = iter([*tokens, ""])
        meaning, end = _product(left, next(left))
    except (ValueError, OverflowError):
        return None
    fits = all(abs(n) <= _MOST for n in meaning.powers) and 1e-60 < meaning.factor < 1e60
    return meaning if end == "" and fits else None


def _product(left: Iterator[str], token: str) -> tuple[Meaning, str]:
    """Parse factors up to a bracket or the end. A slash applies to the next factor only."""
    meaning, sign = ONE, 1
    while True:
        factor, token = _factor(left, token)
        meaning, sign = meaning.times(factor, sign), 1
        if token in ("*", "·", "."):
            token = next(left)
        elif token == "/":
            sign, token = -1, next(left)
        elif token in ("", ")"):
            return meaning, token


def _factor(left: Iterator[str], token: str) -> tuple[Meaning, str]:
    """Parse a unit or a bracket with its power. Returns it and the next token."""
    if token == "(":
        meaning, end = _product(left, next(left))
        if end != ")":
            raise ValueError("a bracket is open")
    elif token == "1":
        meaning = ONE
    else:
        meaning = _word(token)
    token = next(left)
    if token in ("^", "**"):
        power, token = int(next(left)), next(left)
    elif re.fullmatch(r"-?\d+", token):  # as FMI writes them: m/s2
        power, token = int(token), next(left)
    elif token and token[0] in "⁻⁰¹²³⁴⁵⁶⁷⁸⁹":
        power, token = int(token.translate(_RAISED)), next(left)
    else:
        power = 1
    if abs(power) > _MOST:
        raise ValueError("no unit has such a power")
    return ONE.times(meaning, power), token


def _word(word: str) -> Meaning:
    """Return the meaning of a unit with an optional prefix. Raises ValueError."""
    if word in _OTHERS:
        return Meaning(*_OTHERS[word])
    if word in _SI:
        return Meaning(1e-3 if word == "g" else 1.0, _SI[word])
    scale, unit = _PREFIXES.get(word[:1]), word[1:]
    if scale is None or unit not in _SI or unit == "kg":
        raise ValueError(f"{word} is no unit")
    return Meaning(scale * (1e-3 if unit == "g" else 1.0), _SI[unit])


def rate(text: str, times: int) -> str:
    """Return the unit of a time derivative of a quantity, as text.

    text: the unit of the quantity; for "", the result is "" too. times: 1 for the first derivative,
    2 for the second.

    >>> rate("m", 2), rate("N m", 1)
    ('m/s^2', '(N m)/s')
    """
    if not text:
        return ""
    whole = text if re.fullmatch(r"\w+", text) else f"({text})"
    return f"{whole}/s" + ("" if times == 1 else f"^{times}")
