"""The variables of an FMU and their units of measurement.

Variables are in the order of their value references, as in csrc/fmi/unit.h.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from math import inf

from eomc.emit.c_names import Target
from eomc.emit.package import start_formulas
from eomc.model.symbols import Input
from eomc.program.interpret import evaluate, nearby

_ENERGIES: Mapping[str, str] = {
    "kinetic": "kinetic energy",
    "potential": "potential energy",
    "total": "kinetic and potential energy",
}
TIME_NAME = "t"  # no scene can use this name for anything else


@dataclass(frozen=True)
class Variable:
    """A variable of an FMU, as modelDescription.xml lists it.

    Attributes
    ----------
    reference
        Value reference: the number by which simulation tools access the variable.
    causality, variability, initial
        As in the FMI standard; "" for no attribute.
    unit, words
        Unit and description; "" for none.
    start, minimum, maximum
        Numbers as text; "" for none.
    derivative
        For time derivatives, the value reference of the state; otherwise None.
    boolean
        Whether the variable is a truth value rather than a number.
    """

    name: str
    reference: int
    causality: str
    variability: str = "continuous"
    initial: str = ""
    unit: str = ""
    start: str = ""
    words: str = ""
    minimum: str = ""
    maximum: str = ""
    derivative: int | None = None
    boolean: bool = False


@dataclass(frozen=True)
class Variables:
    """All variables of an FMU, by kind, in the order of their value references.

    Value references are the numbers by which FMI identifies variables.

    Attributes
    ----------
    der_q, der_qd
        The time derivatives of q and q̇.
    indicators
        The event functions, one variable for each event.
    switches
        The truth value that makes the scene's signals (formulas) replace the inputs; empty if the
        scene has no signals.
    """

    time: Variable
    q: tuple[Variable, ...]
    qd: tuple[Variable, ...]
    der_q: tuple[Variable, ...]
    der_qd: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    parameters: tuple[Variable, ...]
    energies: tuple[Variable, ...]
    indicators: tuple[Variable, ...]
    switches: tuple[Variable, ...]

    def __iter__(self) -> Iterator[Variable]:
        yield self.time
        for kind in (self.q, self.qd, self.der_q, self.der_qd, self.inputs, self.outputs):
            yield from kind
        for kind in (self.parameters, self.energies, self.indicators, self.switches):
            yield from kind


def has_signals(target: Target) -> bool:
    """Return True if the scene defines signals: formulas that give its inputs values by default."""
    return any(i.signal != 0 for i in target.system.inputs)


def input_starts(target: Target) -> list[float]:
    """Return the initial value of each input of a scene.

    It is the value of the input's signal (the scene's formula for it) at the start, limited to the
    numeric limits of the input. If signals can't be evaluated there, it is 0, limited likewise.
    """
    inputs = target.system.inputs
    if not inputs:
        return []
    try:
        starts = evaluate(target.program["signal"], nearby(target.system, 0))[0]
    except (ArithmeticError, ValueError):
        starts = [0.0] * len(inputs)
    return [
        min(max(start, -inf if low is None else low), inf if high is None else high)
        for start, (low, high) in zip(starts, map(numeric_limits, inputs), strict=True)
    ]


def numeric_limits(one: Input) -> tuple[float | None, float | None]:
    """Return the lower and the upper limit of an input as numbers.

    None stands for a limit that is missing, or that is a formula of parameters.
    """
    low, high = (float(x) if x is not None and x.is_number else None for x in one.limits)
    return low, high


def variables(target: Target) -> Variables:
    """Return all variables of the FMU of a scene, with their value references."""
    s, written, next_reference = target.system, target.scene_name, count().__next__
    of_parameters = start_formulas(target)

    def new_variable(name: str, causality: str, **more: str | int | bool) -> Variable:
        return Variable(name, next_reference(), causality, **more)  # type: ignore[arg-type]

    def state(name: str, start: float, unit: str, words: str) -> Variable:
        initial = "approx" if name in of_parameters else "exact"
        return new_variable(
            name, "output", initial=initial, start=repr(start), unit=unit, words=words
        )

    time = new_variable(TIME_NAME, "independent", unit="s", words="time")
    named = [(written(c.name), c) for c in s.coordinates]
    q = tuple(state(name, c.start, c.unit, c.note) for name, c in named)
    qd = tuple(
        state(f"{name}_dot", c.rate, derivative_unit(c.unit, 1), f"rate of {name}")
        for name, c in named
    )
    der_q = tuple(
        new_variable(f"der({x.name})", "local", initial="calculated", unit=v.unit, words=v.words,
             derivative=x.reference)
        for x, v in zip(q, qd, strict=True)
    )  # fmt: skip
    der_qd = tuple(
        new_variable(f"der({v.name})", "local", initial="calculated",
             unit=derivative_unit(c.unit, 2), words=f"acceleration of {name}",
             derivative=v.reference)
        for v, (name, c) in zip(qd, named, strict=True)
    )  # fmt: skip
    return Variables(
        time, q, qd, der_q, der_qd,
        inputs=tuple(
            new_variable(written(i.name), "input", start=repr(value), unit=i.unit, words=i.note,
                 **_range_of(i))
            for i, value in zip(s.inputs, input_starts(target), strict=True)
        ),
        outputs=tuple(
            new_variable(o.name, "output", initial="calculated", unit=o.unit, words=o.note)
            for o in s.outputs
        ),
        parameters=tuple(
            new_variable(written(p.name), "parameter", variability="tunable", initial="exact",
                 start=repr(p.value), unit=p.unit, words=p.note)
            for p in s.parameters
        ),
        energies=tuple(
            new_variable(f"energy.{name}", "local", initial="calculated", unit="J", words=words)
            for name, words in _ENERGIES.items()
        ),
        indicators=tuple(
            new_variable(f"indicator.{e.name}", "local", initial="calculated",
                 words=f"zero where event {e.name} happens")
            for e in s.events
        ),
        switches=tuple(
            new_variable(name, "parameter", variability="tunable", initial="exact", start="false",
                 boolean=True, words="whether the scene's signals act in place of the inputs")
            for name in ["inputs.follow_signals"] * has_signals(target)
        ),
    )  # fmt: skip


def _range_of(one: Input) -> dict[str, str]:
    """Return `minimum` and `maximum` of an input as text, where its limits are numbers."""
    limits = zip(("minimum", "maximum"), numeric_limits(one), strict=True)
    return {key: repr(limit) for key, limit in limits if limit is not None}


# --- units of measurement -------------------------------------------------------------------------

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
class UnitOfMeasurement:
    """A unit of measurement in terms of FMI's base units (`BASE`: kg, m, s, ...).

    The unit is `factor` times the product of the base units, each raised to its power. powers: the
    integer exponents, in the order of BASE.
    """

    factor: float
    powers: tuple[int, ...]

    def times(self, other: UnitOfMeasurement, power: int) -> UnitOfMeasurement:
        """Return the product of this unit and `other` raised to the integer `power`."""
        powers = (a + power * b for a, b in zip(self.powers, other.powers, strict=True))
        return UnitOfMeasurement(self.factor * other.factor**power, tuple(powers))

    @property
    def attributes(self) -> tuple[tuple[str, str], ...]:
        """The attributes of FMI's XML element BaseUnit for this unit, as pairs (name, value).

        There is one for each base unit with an exponent other than 0, and "factor" unless it is 1.
        """
        named = [(b, str(n)) for b, n in zip(BASE, self.powers, strict=True) if n]
        return (*named, *([("factor", repr(self.factor))] if self.factor != 1 else []))


ONE = UnitOfMeasurement(1.0, _NONE)


def parse_unit(text: str) -> UnitOfMeasurement | None:
    """Return the meaning of a unit written as text, such as "N m/rad" or "kg*m^2".

    None if the text is empty or is not a known unit.

    >>> parse_unit("N m/rad").attributes
    (('kg', '1'), ('m', '2'), ('s', '-2'), ('rad', '-1'))
    >>> parse_unit("furlongs") is parse_unit("") is None
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


def _product(left: Iterator[str], token: str) -> tuple[UnitOfMeasurement, str]:
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


def _factor(left: Iterator[str], token: str) -> tuple[UnitOfMeasurement, str]:
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


def _word(word: str) -> UnitOfMeasurement:
    """Return the meaning of a unit with an optional prefix. Raises ValueError."""
    if word in _OTHERS:
        return UnitOfMeasurement(*_OTHERS[word])
    if word in _SI:
        return UnitOfMeasurement(1e-3 if word == "g" else 1.0, _SI[word])
    scale, unit = _PREFIXES.get(word[:1]), word[1:]
    if scale is None or unit not in _SI or unit == "kg":
        raise ValueError(f"{word} is no unit")
    return UnitOfMeasurement(scale * (1e-3 if unit == "g" else 1.0), _SI[unit])


def derivative_unit(text: str, times: int) -> str:
    """Return the unit of a time derivative of a quantity, as text.

    text: the unit of the quantity; for "", the result is "" too. times: 1 for the first derivative,
    2 for the second.

    >>> derivative_unit("m", 2), derivative_unit("N m", 1)
    ('m/s^2', '(N m)/s')
    """
    if not text:
        return ""
    whole = text if re.fullmatch(r"\w+", text) else f"({text})"
    return f"{whole}/s" + ("" if times == 1 else f"^{times}")
