"""The variables of a unit, in the order of their value references, as csrc/fmi/unit.h has them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count

from eomc.emit.c_names import Target
from eomc.emit.fmu.units import rate
from eomc.program.interpret import evaluate, nearby

TIME_NAME = "t"  # which no scene can give to anything else


@dataclass(frozen=True)
class Variable:
    """One variable; start: a number as text, or none. derivative: the reference of its state."""

    name: str
    reference: int
    causality: str
    variability: str = "continuous"
    initial: str = ""
    unit: str = ""
    start: str = ""
    words: str = ""
    derivative: int | None = None
    boolean: bool = False


@dataclass(frozen=True)
class Variables:
    """All of them, by kind; there are as many indicators as events, and one switch at most."""

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
    """Whether inputs of the scene have values of their own."""
    return any(i.signal != 0 for i in target.system.inputs)


def input_starts(target: Target) -> list[float]:
    """What inputs are until they are set: their signals at the start, 0 where these have none."""
    if not target.system.inputs:
        return []
    try:
        return evaluate(target.program["signal"], nearby(target.system, 0))[0]
    except (ArithmeticError, ValueError):
        return [0.0] * len(target.system.inputs)


def variables(target: Target) -> Variables:
    """Those of a scene."""
    s, written, next_reference = target.system, target.as_written, count().__next__

    def made(name: str, causality: str, **more: str | int | bool) -> Variable:
        return Variable(name, next_reference(), causality, **more)  # type: ignore[arg-type]

    def state(name: str, start: float, unit: str, words: str) -> Variable:
        return made(
            name, "output", initial="exact", start=repr(start), unit=unit, words=words
        )  # fmt: skip

    time = made(TIME_NAME, "independent", unit="s", words="time")
    named = [(written(c.name), c) for c in s.coordinates]
    q = tuple(state(name, c.start, c.unit, c.note) for name, c in named)
    qd = tuple(
        state(f"{name}_dot", c.rate, rate(c.unit, 1), f"rate of {name}") for name, c in named
    )
    der_q = tuple(
        made(f"der({x.name})", "local", initial="calculated", unit=v.unit, words=v.words,
             derivative=x.reference)
        for x, v in zip(q, qd, strict=True)
    )  # fmt: skip
    der_qd = tuple(
        made(f"der({v.name})", "local", initial="calculated", unit=rate(c.unit, 2),
             words=f"acceleration of {name}", derivative=v.reference)
        for v, (name, c) in zip(qd, named, strict=True)
    )  # fmt: skip
    return Variables(
        time, q, qd, der_q, der_qd,
        inputs=tuple(
            made(written(i.name), "input", start=repr(value), unit=i.unit, words=i.note)
            for i, value in zip(s.inputs, input_starts(target), strict=True)
        ),
        outputs=tuple(
            made(o.name, "output", initial="calculated", unit=o.unit, words=o.note)
            for o in s.outputs
        ),
        parameters=tuple(
            made(written(p.name), "parameter", variability="tunable", initial="exact",
                 start=repr(p.value), unit=p.unit, words=p.note)
            for p in s.parameters
        ),
        energies=tuple(
            made(f"energy.{name}", "local", initial="calculated", unit="J", words=words)
            for name, words in _ENERGIES.items()
        ),
        indicators=tuple(
            made(f"indicator.{e.name}", "local", initial="calculated",
                 words=f"zero where event {e.name} happens")
            for e in s.events
        ),
        switches=tuple(
            made(name, "parameter", variability="tunable", initial="exact", start="false",
                 boolean=True, words="whether the scene's signals act in place of the inputs")
            for name in ["inputs.follow_signals"] * has_signals(target)
        ),
    )  # fmt: skip


_ENERGIES: Mapping[str, str] = {
    "kinetic": "kinetic energy",
    "potential": "potential energy",
    "total": "kinetic and potential energy",
}
