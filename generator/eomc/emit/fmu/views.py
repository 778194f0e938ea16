"""Data for the templates of FMUs (views): frozen dataclasses with values only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from eomc.base.texts import FreeText

Attributes = tuple[tuple[str, FreeText], ...]


@dataclass(frozen=True)
class SceneEvent:
    """An event of the scene, for the C header of an FMU.

    An event triggers when its event function crosses zero. direction: -1 if it triggers when the
    function falls, 1 when it rises, 0 for both. action: 0 for record (the motion goes on), 1 for
    stop, 2 for a jump of the state.
    """

    name: str
    direction: int
    action: int


@dataclass(frozen=True)
class Start:
    """An initial value that the scene gives as a formula of parameters, for the C header of an FMU.

    state: index of the coordinate or velocity in [q; q̇]. element: C expression of the array element
    to which the value is assigned. value: C expression of the value.
    """

    state: int
    element: str
    value: str


@dataclass(frozen=True)
class SceneCalls:
    """Data for the template fmu/scene.h: what the hand-written C of an FMU needs from the scene.

    Strings from `acceleration` on are C calls; "" for functions that the scene does not have.

    Attributes
    ----------
    token
        Text that identifies the build, as in modelDescription.xml.
    prefix, PREFIX, real
        Beginnings of C names and of C macros, and the C type of numbers.
    h, tolerance, memory
        Step size in s, tolerance of adaptive steps (0 for fixed steps), and C type of the
        workspace.
    inputs, parameters
        Initial values of the inputs as C literals, and C names of the parameters.
    feedback, signals_of_parameters
        Whether the scene's signals, which may replace the inputs, depend on the state and on
        parameters.
    solved, slopes_solved
        Whether the outputs, and their derivatives, depend on accelerations.
    acceleration, signal, outputs, energies, values, jumps
        Calls of the accelerations, signals, outputs, energies, event functions, and jump map.
    project, fixed
        Call of the projection onto the constraints; for each entry of [q; q̇], 1 if the projection
        of the initial state leaves it unchanged, else 0.
    run, step, adaptive
        Calls of many fixed steps and of one fixed step, or of adaptive steps; the others are "".
    start_lines, starts
        C statements that the initial values by formulas need, and these values.
    sensitivity, output_sensitivity, linearization, output_slopes
        Calls of derivatives: of accelerations and of outputs by parameters; of accelerations and of
        outputs by state and inputs.
    refuses, slopes_refuse
        Whether the calls of outputs, and of their derivatives, return a status.
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
class Description:
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
    units: tuple[Described, ...]
    variables: tuple[Described, ...]
    outputs: tuple[Unknown, ...]
    rates: tuple[Unknown, ...]
    initial: tuple[Unknown, ...]


@dataclass(frozen=True)
class Description2(Description):
    """Data for the template fmu/fmi2.xml: modelDescription.xml of FMI 2.

    indicators: the number of event functions. sources: names of the C files to be compiled.
    """

    TEMPLATE: ClassVar[str] = "fmu/fmi2.xml"
    indicators: int
    sources: tuple[str, ...]


@dataclass(frozen=True)
class Description3(Description):
    """Data for the template fmu/fmi3.xml: modelDescription.xml of FMI 3.

    crossings: the event functions, each with the variables that it depends on.
    """

    TEMPLATE: ClassVar[str] = "fmu/fmi3.xml"
    crossings: tuple[Unknown, ...]


@dataclass(frozen=True)
class BuildDescription:
    """Data for the template fmu/build_description.xml: the C files of an FMU to be compiled.

    prefix: name of the model. sources: the files, relative to the folder sources/.
    """

    TEMPLATE: ClassVar[str] = "fmu/build_description.xml"
    prefix: str
    sources: tuple[str, ...]


View = SceneCalls | Description2 | Description3 | BuildDescription
