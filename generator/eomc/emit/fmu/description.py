"""modelDescription.xml for both versions of FMI: variables, units and dependencies."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from eomc.base.texts import FreeText
from eomc.base.version import __version__
from eomc.emit.c_names import Target
from eomc.emit.fmu import units
from eomc.emit.fmu.dependencies import Dependencies, Names
from eomc.emit.fmu.variables import Variable, Variables, has_signals, variables
from eomc.emit.fmu.views import Attributes, Described, Description2, Description3, Unknown
from eomc.emit.package import start_formulas
from eomc.program.program import TIME
from eomc.scene.formulas import parse


def view(
    target: Target, version: int, token: str, sources: Sequence[str]
) -> Description2 | Description3:
    """Return the template data of modelDescription.xml, which describes an FMU to simulation tools.

    target: the scene's program and its C names. version: version of FMI, 2 or 3. token: text that
    identifies the build. sources: names of the C files to compile.
    """
    s, known = target.system, variables(target)
    dependencies = Dependencies(target.program, has_signals(target))
    structure = _Structure(target, known, version)
    rates = [*zip(known.der_q, (frozenset({x.name}) for x in s.qd), strict=True)]
    rates += zip(known.der_qd, dependencies.accelerations, strict=True)
    outputs = [
        (v, frozenset({x.name})) for v, x in zip((*known.q, *known.qd), (*s.q, *s.qd), strict=True)
    ]
    computed = [*zip(known.outputs, dependencies.outputs, strict=True)]
    names = {target.as_written(p.name): p.name for p in s.parameters}
    formulas = start_formulas(target)
    starts = [
        (v, frozenset(names[n.id] for n in parse(formulas[v.name]).names()))
        for v in (*known.q, *known.qd)
        if v.name in formulas
    ]
    about = [("description", s.title), ("version", s.digest[:16])]
    experiment = [("startTime", "0"), ("stopTime", repr(s.run.duration))]
    tolerance, h = s.run.tolerance, repr(s.run.h)
    experiment += [("stepSize", h)] if tolerance is None else [("tolerance", repr(tolerance))]
    common: dict[str, Any] = {
        "prefix": target.prefix,
        "token": token,
        "tool": f"eomc {__version__}",
        "about": _free(about),
        "exchange": not s.constraints,
        "derivatives": "true" if s.run.needs_derivatives else "false",
        "experiment": _free(experiment),
        "units": _units(known),
        # FMI 2 needs no variable for the time, and some importers take it for an error
        "variables": tuple(_described(v, version) for v in known if v.reference or version == 3),
        "outputs": structure.unknowns([*outputs, *computed]),
        "rates": structure.unknowns(rates),
        "initial": structure.unknowns([*starts, *rates, *computed], initial=True),
    }
    if version == 2:
        return Description2(**common, indicators=len(known.indicators), sources=tuple(sources))
    crossings = zip(known.indicators, dependencies.events, strict=True)
    return Description3(**common, crossings=structure.unknowns(crossings))


class _Structure:
    """Value references of variables by the names of a program's values."""

    def __init__(self, target: Target, known: Variables, version: int) -> None:
        s = target.system
        by_name = {x.name: v for x, v in zip((*s.q, *s.qd), (*known.q, *known.qd), strict=True)}
        by_name |= {x.name: v for x, v in zip(s.inputs, known.inputs, strict=True)}
        if version == 3:
            by_name[TIME] = known.time
        self._moving = {n: (v.reference,) for n, v in by_name.items()}
        by_name |= {p.name: v for p, v in zip(s.parameters, known.parameters, strict=True)}
        self._all: dict[str, tuple[int, ...]] = {n: (v.reference,) for n, v in by_name.items()}
        for i in s.inputs:  # which may follow their signals
            self._all[i.name] += tuple(v.reference for v in known.switches)

    def unknowns(
        self, pairs: Iterable[tuple[Variable, Names]], initial: bool = False
    ) -> tuple[Unknown, ...]:
        """Return each computed variable with the value references that it depends on.

        pairs: the variables, and the names of values that each depends on. initial: whether
        parameters are included, as for initial values.
        """
        references = self._all if initial else self._moving
        return tuple(
            Unknown(v.reference, tuple(sorted({r for n in names for r in references.get(n, ())})))
            for v, names in pairs
        )


def _free(pairs: Iterable[tuple[str, str]]) -> Attributes:
    return tuple((key, FreeText(text)) for key, text in pairs if text)


def _units(known: Variables) -> tuple[Described, ...]:
    """Return the units that are used and that FMI can express."""
    meanings = {v.unit: meaning for v in known if (meaning := units.parsed(v.unit)) is not None}
    return tuple(
        Described("Unit", _free([("name", text)]), _free(meaning.attributes))
        for text, meaning in meanings.items()
    )


def _described(v: Variable, version: int) -> Described:
    unit = v.unit if units.parsed(v.unit) is not None else ""
    # the start of an input is always exact, and FMI 2 forbids the attribute
    initial = "" if v.causality == "input" else v.initial
    outer = _free(
        [
            ("name", v.name),
            ("valueReference", str(v.reference)),
            ("description", v.words),
            ("causality", v.causality),
            ("variability", v.variability),
            ("initial", initial),
        ]
    )
    derivative = "" if v.derivative is None else str(v.derivative)
    limits = [("min", v.minimum), ("max", v.maximum)]
    inner = _free([("unit", unit), *limits, ("start", v.start), ("derivative", derivative)])
    if version == 2:
        return Described("Boolean" if v.boolean else "Real", outer, inner)
    return Described("Boolean" if v.boolean else "Float64", outer, inner)
