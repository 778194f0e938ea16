"""The contents of an FMU (FMI unit) without a binary: texts by their path in the FMU."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from eomc.base import resources
from eomc.base.texts import FreeText
from eomc.derive.tape import Stage, Tape
from eomc.emit import adaptive, c_function, portable, views
from eomc.emit.c_expression import REALS
from eomc.emit.c_names import Target, rename_for_c
from eomc.emit.events import DIRECTIONS
from eomc.emit.fmu import description
from eomc.emit.fmu.variables import input_starts
from eomc.emit.package import start_formulas
from eomc.emit.public import Public, program_function, refuses, takes_qdd
from eomc.emit.views import Show
from eomc.model.algebra import expression
from eomc.program.lower import lower
from eomc.program.outline import weight
from eomc.program.program import Program
from eomc.scene.formulas import parse
from eomc.scene.schema import ACTIONS

VERSIONS = (2, 3)
# headers of the FMI standard, by version
_HEADERS = {
    2: ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    3: ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
}
ENERGIES = ("kinetic_energy", "potential_energy", "energy")
STEPS = 10_000  # largest number of adaptive steps in one call


@dataclass(frozen=True)
class Unit:
    """The contents of an FMU (FMI unit) as texts, without a binary.

    Attributes
    ----------
    name
        Name of the scene in C.
    version
        Version of FMI, 2 or 3.
    files
        Texts by their path in the FMU.
    sources
        Paths, relative to sources/, of the C files that are compiled.
    operations
        Number of arithmetic operations of the scene's functions, which determines compile time.
    """

    name: str
    version: int
    files: Mapping[str, str]
    sources: tuple[str, ...]
    operations: int


@dataclass(frozen=True)
class EventEntry:
    """An event of the scene, for the C header of an FMU.

    An event triggers when its event function crosses zero. direction: -1 if it triggers when the
    function falls, 1 when it rises, 0 for both. action: 0 for record (the motion goes on), 1 for
    stop, 2 for a jump of the state.
    """

    name: str
    direction: int
    action: int


@dataclass(frozen=True)
class StartFormula:
    """An initial value that the scene gives as a formula of parameters, for the C header of an FMU.

    state: index of the coordinate or velocity in [q; q̇]. element: C expression of the array element
    to which the value is assigned. value: C expression of the value.
    """

    state: int
    element: str
    value: str


@dataclass(frozen=True)
class SceneHeaderView:
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
    events: tuple[EventEntry, ...]
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
    starts: tuple[StartFormula, ...]
    sensitivity: str
    output_sensitivity: str
    signals_of_parameters: bool
    linearization: str
    output_slopes: str
    slopes_solved: bool
    refuses: bool
    slopes_refuse: bool


@dataclass(frozen=True)
class BuildDescriptionView:
    """Data for the template fmu/build_description.xml: the C files of an FMU to be compiled.

    prefix: name of the model. sources: the files, relative to the folder sources/.
    """

    TEMPLATE: ClassVar[str] = "fmu/build_description.xml"
    prefix: str
    sources: tuple[str, ...]


def render_unit(program: Program, version: int, show: Show) -> Unit:
    """Return the texts that form the FMU of a program. There is no compiled binary among them.

    The same program always gives the same texts. version: version of FMI, 2 or 3. show: function
    that renders template data as text.
    """
    safe, written = rename_for_c(program)
    target = Target(safe, REALS[safe.system.run.real], written)
    name = target.prefix
    sources = (f"{name}.c", f"fmi/fmi{version}.c")

    def render(token: str) -> dict[str, str]:
        files = {
            "modelDescription.xml": show(
                description.model_description(target, version, token, sources)
            ),
            "sources/fmi/scene.h": c_function.break_long_lines(show(scene_header(target, token))),
        }
        if version == 3:
            files["sources/buildDescription.xml"] = show(BuildDescriptionView(name, sources))
        return files | texts

    portable_files = portable.files(safe, show, written=written)
    texts = {f"sources/{file}": text for file, text in portable_files.items()}
    texts |= {
        f"sources/fmi/{file}": resources.text("csrc", f"fmi/{file}")
        for file in (*_HEADERS[version], f"fmi{version}.c", "both.h", "unit.h")
    }
    texts["documentation/licenses/fmi-headers.txt"] = resources.text("csrc", "fmi/LICENSE.txt")
    whole = "\0".join(f"{file}\0{text}" for file, text in sorted(render("").items()))
    digest = hashlib.sha256(whole.encode(errors="surrogateescape")).hexdigest()
    token = "-".join((digest[:8], digest[8:12], digest[12:16], digest[16:20], digest[20:32]))
    operations = sum(map(weight, safe.functions.values()))
    return Unit(name, version, render(token), sources, operations)


def scene_header(target: Target, token: str) -> SceneHeaderView:
    """Return the data for the template of scene.h, a C header of the FMU.

    The header lets the hand-written C, which is the same in all FMUs, call the functions of this
    scene. target: the scene's program and its C names. token: text that identifies the build, as in
    modelDescription.xml.
    """
    s, public = target.system, Public(target)
    by_tolerance = s.run.tolerance is not None
    method, rows = s.run.methods[0], s.coordinates if s.constraints else ()
    calls = {name: _call_of(target, name) for name in (*ENERGIES, "outputs", "events", "jumps")}
    start_lines, starts = _start_formulas(target)
    workspace = adaptive.METHOD.name + "_adaptive" if by_tolerance else method
    return SceneHeaderView(
        title=FreeText(s.title),
        stamp=views.stamp(target)[0],
        token=token,
        prefix=target.prefix,
        PREFIX=target.PREFIX,
        real=target.real.name,
        h=repr(s.run.h),
        tolerance=repr(s.run.tolerance or 0.0),
        memory=f"{target.prefix}_{workspace}_memory",
        inputs=tuple(map(target.literal, input_starts(target))),
        parameters=tuple(p.name for p in s.parameters),
        output_count=len(s.outputs),
        events=tuple(
            EventEntry(e.name, DIRECTIONS[e.direction], ACTIONS.index(e.action)) for e in s.events
        ),
        feedback=target.signal_state,
        solved=bool(calls["outputs"]) and takes_qdd(target, "outputs"),
        acceleration=public.acceleration.call(),
        signal=_call_of(target, "signal"),
        outputs=calls["outputs"],
        energies=tuple(calls[name] for name in ENERGIES),
        values=calls["events"],
        jumps=calls["jumps"],
        project=public.project.call() if s.constraints else "",
        fixed=tuple(
            int(x) for x in (*(c.start_fixed for c in rows), *(c.rate_fixed for c in rows))
        ),
        run="" if by_tolerance else public.run(method).call(
            h="(unitReal)unitStep", u_stride="0", every="0", q_rows="NULL", qd_rows="NULL",
            status="&status",
        ),
        step="" if by_tolerance else public.step(method).call(),
        adaptive=public.adaptive(adaptive.METHOD.name).call(
            max_step="0", steps=str(STEPS), times="NULL", count="0", t_rows="NULL", q_rows="NULL",
            qd_rows="NULL", room="unitRoom", status="&status",
        ) if by_tolerance else "",
        start_lines=start_lines,
        starts=starts,
        sensitivity=_call_of(target, "sensitivity"),
        output_sensitivity=_call_of(target, "output_sensitivity"),
        signals_of_parameters=_signals_read_parameters(target),
        linearization=public.linearization.call() if s.run.needs_derivatives else "",
        output_slopes=_call_of(target, "output_slopes"),
        refuses=refuses(target, "outputs"),
        slopes_refuse=refuses(target, "output_slopes"),
        slopes_solved=any(
            takes_qdd(target, name)
            for name in ("output_slopes", "output_sensitivity")
            if name in target.program
        ),
    )  # fmt: skip


def _start_formulas(target: Target) -> tuple[tuple[str, ...], tuple[StartFormula, ...]]:
    """Return C statements and the states whose start is a formula of parameters."""
    s, formulas = target.system, start_formulas(target)
    symbols = {target.scene_name(p.name): p.symbol for p in s.parameters}
    tape = Tape({p.symbol: Stage.PARAMETER for p in s.parameters})
    values = [tape.define(expression(parse(text), symbols)) for text in formulas.values()]
    body = target.body(lower("starts", tape, values, s.names))
    states = [(array, c.name) for array in ("q", "qd") for c in s.coordinates]
    names = [target.scene_name(n) + ("_dot" if array == "qd" else "") for array, n in states]
    places = [names.index(name) for name in formulas]
    return body.lines, tuple(
        StartFormula(k, target.element(*states[k]), value)
        for k, value in zip(places, body.results, strict=True)
    )


def _signals_read_parameters(target: Target) -> bool:
    """Return whether the scene's signals depend on parameters."""
    parameters = {p.name for p in target.system.parameters}
    return "signal" in target.program and bool(target.program["signal"].uses & parameters)


def _call_of(target: Target, name: str) -> str:
    """Return the C call of an evaluation function; "" if the scene does not have it."""
    return (
        Public(target).evaluation(name).call() if program_function(target, name) is not None else ""
    )
