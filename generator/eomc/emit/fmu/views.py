"""Views of the templates of FMUs: frozen dataclasses with values only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from eomc.base.texts import FreeText

Attributes = tuple[tuple[str, FreeText], ...]


@dataclass(frozen=True)
class SceneEvent:
    """An event: its name, -1, 0 or 1 for its direction, 0, 1 or 2 for record, stop and jump."""

    name: str
    direction: int
    action: int


@dataclass(frozen=True)
class Start:
    """A state that starts at a formula of parameters.

    state: its index in [q; qd]. element, value: the array element and the value, in C.
    """

    state: int
    element: str
    value: str


@dataclass(frozen=True)
class SceneCalls:
    """fmu/scene.h.jinja. inputs: their starts; from acceleration on calls, "" for none.

    project: onto constraints; fixed: whether each of q and qd stays there as it is. run, step: of
    steps of fixed size; adaptive: of those that fit a tolerance, one or the other. solved,
    slopes_solved: whether outputs, and their derivatives, read accelerations. feedback,
    signals_of_parameters: whether signals depend on the state, on parameters. starts: of states
    whose start is a formula of parameters, after the statements start_lines.
    """

    TEMPLATE: ClassVar[str] = "fmu/scene.h"
    title: FreeText
    stamp: FreeText
    token: str
    prefix: str
    PREFIX: str
    real: str
    h: str
    tolerance: str
    memory: str
    inputs: tuple[str, ...]
    parameters: tuple[str, ...]
    output_count: int
    events: tuple[SceneEvent, ...]
    feedback: bool
    solved: bool
    acceleration: str
    signal: str
    outputs: str
    energies: tuple[str, ...]
    values: str
    jumps: str
    project: str
    fixed: tuple[int, ...]
    run: str
    step: str
    adaptive: str
    start_lines: tuple[str, ...]
    starts: tuple[Start, ...]
    sensitivity: str
    output_sensitivity: str
    signals_of_parameters: bool
    linearization: str
    output_slopes: str
    slopes_solved: bool
    refuses: bool
    slopes_refuse: bool


@dataclass(frozen=True)
class Described:
    """A variable or unit: an element with attributes, and another inside with its own."""

    element: str
    attributes: Attributes
    inner: Attributes = ()


@dataclass(frozen=True)
class Unknown:
    """A computed variable and its dependencies, as value references; in FMI 2 also their indices.

    Indices count from 1, and so do references, since 0 is the time, which FMI 2 is not told of.
    """

    reference: int
    known: tuple[int, ...]


@dataclass(frozen=True)
class Description:
    """Fields of the model descriptions of both FMI versions, except for the events.

    exchange: whether importers may integrate it.
    """

    prefix: str
    token: str
    tool: str
    about: Attributes
    exchange: bool
    derivatives: str
    experiment: Attributes
    units: tuple[Described, ...]
    variables: tuple[Described, ...]
    outputs: tuple[Unknown, ...]
    rates: tuple[Unknown, ...]
    initial: tuple[Unknown, ...]


@dataclass(frozen=True)
class Description2(Description):
    """fmu/fmi2.xml.jinja. indicators: of events, how many. sources: files to be compiled."""

    TEMPLATE: ClassVar[str] = "fmu/fmi2.xml"
    indicators: int
    sources: tuple[str, ...]


@dataclass(frozen=True)
class Description3(Description):
    """fmu/fmi3.xml.jinja."""

    TEMPLATE: ClassVar[str] = "fmu/fmi3.xml"
    crossings: tuple[Unknown, ...]


@dataclass(frozen=True)
class BuildDescription:
    """fmu/build_description.xml.jinja: what is to be compiled."""

    TEMPLATE: ClassVar[str] = "fmu/build_description.xml"
    prefix: str
    sources: tuple[str, ...]


View = SceneCalls | Description2 | Description3 | BuildDescription
