"""The variables of an FMU, in the order of their value references, as in csrc/fmi/unit.h."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from math import inf

from eomc.emit.c_names import Target
from eomc.emit.fmu.units import rate
from eomc.emit.package import start_formulas
from eomc.model.symbols import Input
from eomc.program.interpret import evaluate, nearby

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
    s, written, next_reference = target.system, target.as_written, count().__next__
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
        state(f"{name}_dot", c.rate, rate(c.unit, 1), f"rate of {name}") for name, c in named
    )
    der_q = tuple(
        new_variable(f"der({x.name})", "local", initial="calculated", unit=v.unit, words=v.words,
             derivative=x.reference)
        for x, v in zip(q, qd, strict=True)
    )  # fmt: skip
    der_qd = tuple(
        new_variable(f"der({v.name})", "local", initial="calculated", unit=rate(c.unit, 2),
             words=f"acceleration of {name}", derivative=v.reference)
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


_ENERGIES: Mapping[str, str] = {
    "kinetic": "kinetic energy",
    "potential": "potential energy",
    "total": "kinetic and potential energy",
}
