"""The C header, and the data that the C sources of both forms share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from eomc.base.texts import FreeText
from eomc.emit import adaptive, views
from eomc.emit.c_function import CFunction, GeneratedFunction
from eomc.emit.derivatives import LinearizationView
from eomc.emit.functions import SceneFunctions
from eomc.emit.views import NameFields, Show
from eomc.integrators.tableaux import METHODS, Method
from eomc.model.symbols import Constraint, Coordinate, Event, Input, Output


@dataclass(frozen=True)
class Enumerator:
    """A C enumerator in the generated header: the index of a coordinate, input, output or the like.

    Constraints and events have enumerators too. enum: name of the enumerator. words: unit and note
    from the scene file, for the C comment.
    """

    enum: str
    words: FreeText


@dataclass(frozen=True)
class ParameterMember:
    """A parameter of the scene, as a member of the parameter struct in the C header.

    name: name of the member. value: the parameter's value in the scene file, as a C literal. words:
    unit and note from the scene file, for the C comment.
    """

    name: str
    value: str
    words: FreeText


@dataclass(frozen=True)
class MethodDeclarations:
    """The C functions of one integration method with fixed steps, as declared in the C header.

    Attributes
    ----------
    name, title
        The method's name in C names, and its title in comments.
    implicit
        Whether the method is implicit.
    workspace
        Length of the workspace of a run, as a count of numbers; 0 for a run that needs none.
    step, run, batch
        Prototypes of the functions for one step, for many steps, and for many instances; `batch` is
        None if the scene does not request it.
    derivative
        Prototype of the function for the derivatives of the state at the end of a step with respect
        to the state at its start and the inputs; None if the scene does not request it.
    """

    name: str
    title: str
    implicit: bool
    workspace: int
    step: CFunction
    run: CFunction
    batch: CFunction | None
    derivative: CFunction | None


@dataclass(frozen=True)
class AdaptiveDeclarations:
    """The C functions of runs with adaptive step-size control, as declared in the C header.

    Attributes
    ----------
    title
        The method's title in comments.
    memory, workspace
        C type of the workspace of a run, and its length as a count of numbers.
    run, batch
        Prototypes of the functions for one instance and for many; `batch` is None if the scene does
        not request it.
    together
        Whether the optimised C steps many instances of a batch in parallel.
    fixed
        C function type for one step of fixed size. A run with event detection can make such steps
        instead of adaptive ones. None for scenes without events.
    """

    title: str
    memory: str
    workspace: int
    run: CFunction
    batch: CFunction | None
    together: bool
    fixed: CFunction | None


@dataclass(frozen=True)
class HeaderView(NameFields):
    """Data for c/header.h: the header of the generated C.

    Attributes
    ----------
    stamp, notes, description
        Lines of comments at the top.
    handshake
        Number by which the source detects the header of another build.
    fast
        Whether the header belongs to the optimised rather than the portable C.
    implicit
        Whether some steps are implicit, or adaptive.
    timed
        Whether steps take the time t as an argument.
    functions, linearization, project
        Prototypes of the functions of mechanics (such as D, energy and accelerations), of the
        derivatives of the accelerations, and of the projection onto the constraints; None for those
        that the scene does not have.
    methods, adaptive
        The integration methods with fixed steps, and with adaptive steps (None if not requested).
    max_events
        Largest number of events in one step.
    """

    TEMPLATE: ClassVar[str] = "c/header.h"
    title: FreeText
    stamp: tuple[FreeText, ...]
    notes: tuple[str, ...]
    description: tuple[FreeText, ...]
    handshake: str
    fast: bool
    coordinates: tuple[Enumerator, ...]
    inputs: tuple[Enumerator, ...]
    outputs: tuple[Enumerator, ...]
    constraints: tuple[Enumerator, ...]
    events: tuple[Enumerator, ...]
    frames: tuple[str, ...]
    parameters: tuple[ParameterMember, ...]
    implicit: bool
    timed: bool
    functions: tuple[CFunction, ...]
    linearization: CFunction | None
    project: CFunction | None
    methods: tuple[MethodDeclarations, ...]
    adaptive: AdaptiveDeclarations | None
    max_events: int


@dataclass(frozen=True)
class SourceFields:
    """Data that the templates of the portable and of the optimised C source share.

    Attributes
    ----------
    stamp
        Lines of the comment at the top.
    handshake
        Number that must be equal to the one in the header of the same build.
    q0, qd0
        Initial coordinates and velocities, as C literals.
    evaluations, acceleration
        The functions of mechanics, and the function for the accelerations.
    solved
        Lines of a comment on how D q̈ = τ - bias is solved for the accelerations q̈.
    slopes, steppers
        C text for the derivatives of the accelerations ("" for none), and for the steps and runs of
        each method: the rendered text of other templates.
    """

    title: FreeText
    stamp: tuple[FreeText, ...]
    handshake: str
    parameters: tuple[ParameterMember, ...]
    q0: tuple[str, ...]
    qd0: tuple[str, ...]
    evaluations: tuple[GeneratedFunction, ...]
    acceleration: GeneratedFunction
    solved: tuple[str, ...]
    constrained: bool
    slopes: str
    steppers: tuple[str, ...]


def header_view(
    functions: SceneFunctions,
    slopes: LinearizationView | None,
    stamp: str,
    workspace_sizes: Sequence[int] = (),
    fast: bool = False,
) -> HeaderView:
    """Return the data for the template of the C header, of portable or of optimised C.

    Parameters
    ----------
    functions
        The C functions of the scene.
    slopes
        Template data of the derivatives of the accelerations; None if the scene does not need them.
    stamp
        Number that the source compares with its own, to detect a header of another build.
    workspace_sizes
        Length of the workspace, as a count of numbers, for each integration method in optimised C,
        and then for adaptive steps. Empty for portable C, whose runs with fixed steps need none.
    fast
        Whether the header belongs to the optimised C.
    """
    target, s = functions.target, functions.target.system
    methods = [METHODS[name] for name in s.run.methods]
    *fixed_sizes, adaptive_size = workspace_sizes or [
        *(0 for _ in methods),
        adaptive.workspace_size(s, len(s.coordinates)),
    ]
    return HeaderView(
        title=FreeText(s.title),
        stamp=tuple(views.stamp(target)),
        notes=tuple(views.energy_notes(target)),
        description=tuple(views.description(target)),
        **functions.names,
        handshake=stamp,
        fast=fast,
        coordinates=enumerators(functions, s.coordinates),
        inputs=enumerators(functions, s.inputs),
        outputs=enumerators(functions, s.outputs, "OUT_"),
        constraints=enumerators(functions, s.constraints, "CONSTRAINT_"),
        events=enumerators(functions, s.events, "EVENT_"),
        frames=tuple(target.enum[f"FRAME_{f.name}"] for f in s.output_frames),
        parameters=parameter_members(functions),
        implicit=any(m.implicit for m in methods) or s.run.tolerance is not None,
        timed=target.driven,
        functions=tuple(x.function for x in (*functions.evaluations, functions.acceleration)),
        linearization=slopes.linearization if slopes else None,
        project=functions.public.project if s.constraints else None,
        methods=tuple(
            MethodDeclarations(
                m.name, method_title(m), m.implicit, size, functions.public.step(m.name),
                functions.public.run(m.name),
                functions.public.batch(m.name) if s.run.batch else None,
                functions.public.derivative(m.name) if s.run.discretize else None,
            )
            for m, size in zip(methods, fixed_sizes, strict=True)
        ),
        adaptive=AdaptiveDeclarations(
            adaptive.TITLE, adaptive.workspace_type(functions), adaptive_size,
            functions.public.adaptive(adaptive.METHOD.name),
            functions.public.adaptive_batch(adaptive.METHOD.name) if s.run.batch else None,
            adaptive.steps_in_parallel(target),
            functions.public.fixed_type if s.events else None,
        ) if s.run.tolerance else None,
        max_events=adaptive.max_events_per_step(s),
    )  # fmt: skip


def source_fields(
    functions: SceneFunctions, stamp: str, slopes: LinearizationView | None, show: Show
) -> dict[str, Any]:
    """Return the template fields that the sources of portable and optimised C share, by name.

    These are all fields of `SourceFields` except `steppers`. functions: the C functions of the
    scene. stamp, slopes: as in `header_view`. show: function that renders template data as text.
    """
    target, s = functions.target, functions.target.system
    return {
        "title": FreeText(s.title),
        "stamp": tuple(views.stamp(target)),
        **functions.names,
        "handshake": stamp,
        "parameters": parameter_members(functions),
        "q0": tuple(target.literal(x.start) for x in s.coordinates),
        "qd0": tuple(target.literal(x.rate) for x in s.coordinates),
        "evaluations": functions.evaluations,
        "acceleration": functions.acceleration,
        "solved": tuple(views.solution_method(target)),
        "constrained": bool(s.constraints),
        "slopes": show(slopes).rstrip("\n") if slopes else "",
    }


def enumerators(
    functions: SceneFunctions,
    items: Sequence[Constraint | Coordinate | Event | Input | Output],
    prefix: str = "",
) -> tuple[Enumerator, ...]:
    """Return the C enumerator, unit and note of each of the given items of the scene.

    items: coordinates, inputs, outputs, constraints or events. prefix: "OUT_", "EVENT_" or
    "CONSTRAINT_", which `Target.enum` adds to the names of such items.
    """
    target = functions.target
    return tuple(
        Enumerator(
            target.enum[prefix + x.name],
            views.unit_and_note(x.unit, x.note, target.full_name(x.name)),
        )
        for x in items
    )


def parameter_members(functions: SceneFunctions) -> tuple[ParameterMember, ...]:
    """Return C name, default value (C literal) and comment (unit and note) of each parameter."""
    target = functions.target
    return tuple(
        ParameterMember(
            p.name,
            target.literal(p.value),
            views.unit_and_note(p.unit, p.note, target.full_name(p.name)),
        )
        for p in target.system.parameters
    )


# --- methods of integration -----------------------------------------------------------------------


def method_title(m: Method) -> str:
    """Return the title of a method with its order."""
    return m.title if "order" in m.title else f"{m.title}, order {m.order}"
