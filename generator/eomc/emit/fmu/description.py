"""modelDescription.xml for both versions of FMI: variables, units and dependencies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

from eomc.base.resources import __version__
from eomc.base.texts import FreeText
from eomc.emit.c_names import Target
from eomc.emit.fmu.variables import Variable, Variables, has_signals, parse_unit, variables
from eomc.emit.package import start_formulas
from eomc.program.ir import Function
from eomc.program.program import TIME, Program
from eomc.scene.formulas import parse

Attributes = tuple[tuple[str, FreeText], ...]
Names = frozenset[str]


@dataclass(frozen=True)
class XmlElement:
    """An XML element of modelDescription.xml for a variable or a unit.

    element: for a unit, the name of the element, "Unit"; for a variable, its type, such as "Real".
    attributes: the main attributes as pairs (name, value), such as the name. inner: pairs for
    further attributes, such as base units of a unit or the start of a variable; in FMI 2, and for
    units, they belong to an element inside.
    """

    element: str
    attributes: Attributes
    inner: Attributes = ()


@dataclass(frozen=True)
class Unknown:
    """A computed variable of an FMU, and the variables that it depends on.

    reference, known: their value references, the numbers by which FMI identifies variables. In FMI
    2 they also are positions in the list of variables, counted from 1: reference 0 is the time,
    which that list does not contain.
    """

    reference: int
    known: tuple[int, ...]


@dataclass(frozen=True)
class DescriptionFields:
    """Fields that the templates of modelDescription.xml for FMI 2 and FMI 3 share.

    Attributes
    ----------
    prefix, token, tool, about
        Name of the model, text that identifies the build, name and version of eomc, and attributes
        with title and version of the scene.
    exchange
        Whether a simulation tool may integrate the model itself (model exchange).
    derivatives
        "true" if the FMU provides directional derivatives, else "false".
    experiment
        Attributes of the default experiment: times in s, and step size or tolerance.
    units, variables
        The units and the variables.
    outputs, rates, initial
        Dependencies of outputs, of derivatives of the state, and of computed initial values.
    """

    prefix: str
    token: str
    tool: str
    about: Attributes
    exchange: bool
    derivatives: str
    experiment: Attributes
    units: tuple[XmlElement, ...]
    variables: tuple[XmlElement, ...]
    outputs: tuple[Unknown, ...]
    rates: tuple[Unknown, ...]
    initial: tuple[Unknown, ...]


@dataclass(frozen=True)
class Description2View(DescriptionFields):
    """Data for the template fmu/fmi2.xml: modelDescription.xml of FMI 2.

    indicators: the number of event functions. sources: names of the C files to be compiled.
    """

    TEMPLATE: ClassVar[str] = "fmu/fmi2.xml"
    indicators: int
    sources: tuple[str, ...]


@dataclass(frozen=True)
class Description3View(DescriptionFields):
    """Data for the template fmu/fmi3.xml: modelDescription.xml of FMI 3.

    crossings: the event functions, each with the variables that it depends on.
    """

    TEMPLATE: ClassVar[str] = "fmu/fmi3.xml"
    crossings: tuple[Unknown, ...]


def model_description(
    target: Target, version: int, token: str, sources: Sequence[str]
) -> Description2View | Description3View:
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
    names = {target.scene_name(p.name): p.name for p in s.parameters}
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
        "about": _attributes(about),
        "exchange": not s.constraints,
        "derivatives": "true" if s.run.needs_derivatives else "false",
        "experiment": _attributes(experiment),
        "units": _unit_elements(known),
        # FMI 2 needs no variable for the time, and some importers take it for an error
        "variables": tuple(_xml_element(v, version) for v in known if v.reference or version == 3),
        "outputs": structure.unknowns([*outputs, *computed]),
        "rates": structure.unknowns(rates),
        "initial": structure.unknowns([*starts, *rates, *computed], initial=True),
    }
    if version == 2:
        return Description2View(**common, indicators=len(known.indicators), sources=tuple(sources))
    crossings = zip(known.indicators, dependencies.events, strict=True)
    return Description3View(**common, crossings=structure.unknowns(crossings))


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


def _attributes(pairs: Iterable[tuple[str, str]]) -> Attributes:
    return tuple((key, FreeText(text)) for key, text in pairs if text)


def _unit_elements(known: Variables) -> tuple[XmlElement, ...]:
    """Return the units that are used and that FMI can express."""
    meanings = {v.unit: meaning for v in known if (meaning := parse_unit(v.unit)) is not None}
    return tuple(
        XmlElement("Unit", _attributes([("name", text)]), _attributes(meaning.attributes))
        for text, meaning in meanings.items()
    )


def _xml_element(v: Variable, version: int) -> XmlElement:
    unit = v.unit if parse_unit(v.unit) is not None else ""
    # the start of an input is always exact, and FMI 2 forbids the attribute
    initial = "" if v.causality == "input" else v.initial
    outer = _attributes(
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
    inner = _attributes([("unit", unit), *limits, ("start", v.start), ("derivative", derivative)])
    if version == 2:
        return XmlElement("Boolean" if v.boolean else "Real", outer, inner)
    return XmlElement("Boolean" if v.boolean else "Float64", outer, inner)


@dataclass(frozen=True)
class Dependencies:
    """Names of the variables that accelerations, outputs and event functions depend on.

    Variables are coordinates, velocities, inputs, parameters and the time.

    Attributes
    ----------
    program
        The program that computes these results.
    signals
        Whether the scene's signals (formulas for its inputs) may replace the inputs. If so, results
        that depend on an input also depend on the variables in its signal.
    """

    program: Program
    signals: bool

    @cached_property
    def known(self) -> Names:
        """The names of all variables that a simulation tool sets in the FMU, including the time.

        These are coordinates, velocities, inputs, parameters and the time.
        """
        s = self.program.system
        return frozenset(x.name for x in (*s.q, *s.qd, *s.u, *s.parameters)) | {TIME}

    @cached_property
    def accelerations(self) -> Sequence[Names]:
        """For each acceleration, the names of the variables that it depends on."""
        return self._results_of("acceleration")

    @cached_property
    def outputs(self) -> Sequence[Names]:
        """For each output, the names of the variables that it depends on."""
        return self._results_of("outputs")

    @cached_property
    def events(self) -> Sequence[Names]:
        """For each event function, the names of the variables that it depends on."""
        return self._results_of("events")

    @cached_property
    def _signals(self) -> Mapping[str, Names]:
        """Dependencies of each input on the variables of the scene's signal for it."""
        names = [x.name for x in self.program.system.u]
        if not self.signals or "signal" not in self.program:
            return {}
        return dict(zip(names, dependencies_of_results(self.program["signal"]), strict=True))

    def _results_of(self, name: str) -> Sequence[Names]:
        """Return the dependencies of each result of a function; [] if the program lacks it."""
        return (
            [self._resolved(x) for x in dependencies_of_results(self.program[name])]
            if name in self.program
            else []
        )

    def _resolved(self, names: Names) -> Names:
        """Return names with accelerations and signals replaced by their dependencies."""
        qdd = [x.name for x in self.program.system.qdd]
        result = set(names)
        for name, dependencies in zip(
            qdd, self.accelerations if names & {*qdd} else (), strict=False
        ):
            result |= dependencies if name in names else set()
        for name, dependencies in self._signals.items():
            result |= dependencies if name in result else set()
        return frozenset(result) & self.known


def dependencies_of_results(function: Function) -> list[Names]:
    """Return the names of the arguments that each result of a function depends on.

    function: a function of the program, a list of elementary operations.
    """
    dependencies: dict[str, Names] = {}
    for a in (*function.early, *function.body):
        dependencies[a.name] = frozenset().union(*(dependencies.get(n, {n}) for n in a.value.names))
    return [dependencies.get(o.name, frozenset({o.name} - {""})) for o in function.outputs]
