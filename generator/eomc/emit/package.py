"""The Python package of a scene: its C binding, its modules and its type stubs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from eomc.base.texts import FreeText
from eomc.emit import adaptive
from eomc.emit.c_expression import DOUBLE
from eomc.emit.c_function import cast, member
from eomc.emit.c_names import Target
from eomc.emit.public import KINDS, Public, refuses, takes_qdd
from eomc.emit.views import stamp, unit_and_note
from eomc.integrators.tableaux import METHODS, Method
from eomc.runtime.package import CONSTRAINED
from eomc.scene.formulas import fold_values, parse

FUNCTIONS = {  # public functions of each package, by the part of `runtime.model.Model`
    "functions": "C D acceleration applied bias energy g jacobi kinetic_energy limits linearize "
    "output potential_energy power rhs sensitivity signal tau".split(),
    "integrator": "advice discretize simulate step".split(),
    "statics": ["equilibrium"],
}
OPTIONAL = {  # functions by the option that brings them
    "frames": ("pose", "frame_velocity", "frame_acceleration", "jacobian", "frame_forces"),
    "inverse_dynamics": ("inverse_dynamics", "drive_forces"),
    "momentum": ("momentum",),
}
_FRAMES = (*OPTIONAL["frames"], "inverse_dynamics", "momentum")  # functions of `Model.frames`


@dataclass(frozen=True)
class BoundFunction:
    """An evaluation function, such as D or energy, in the Python binding, called for n states.

    Attributes
    ----------
    name
        Name of the function without the scene's prefix.
    call
        C call for the state with index k, with an assignment if the function returns a number.
    solve
        C call that first computes the accelerations which the function reads; "" if it reads none.
    at
        C call at x = [q; qd], for SciPy's LowLevelCallable; "" unless the function returns a double
        that depends on the state and parameters only.
    refuses
        Number of results for each state, as C text, if the function returns a status; otherwise "".
    """

    name: str
    call: str
    solve: str
    at: str
    refuses: str


@dataclass(frozen=True)
class BoundMethod:
    """C calls of one integration method in the Python binding.

    Attributes
    ----------
    step, run, batch
        Calls for one step, for a run, and for a run of many instances.
    derivative
        Call for the derivatives of a step from the state with index k; "" if these are not
        generated.
    step_between, derivative_between
        Calls for each further step and its derivatives, where the derivatives of several steps are
        multiplied; "" as for `derivative`.
    """

    name: str
    implicit: bool
    step: str
    run: str
    batch: str
    derivative: str
    step_between: str
    derivative_between: str


@dataclass(frozen=True)
class BoundAdaptive:
    """Adaptive steps in the Python binding.

    Attributes
    ----------
    memory
        C type of the workspace.
    run, batch
        C calls for a run, and for runs of many instances.
    events
        Whether the scene has events.
    """

    memory: str
    run: str
    events: bool
    batch: str


@dataclass(frozen=True)
class BindingView:
    """Data for the template python/binding.c.jinja: C functions that Python calls for many states.

    Attributes
    ----------
    evaluations
        The evaluation functions, such as D or energy.
    acceleration, project, linearization
        C calls for the accelerations, the projection onto the constraints and the linearization;
        "" for those that are not generated.
    batch
        Whether runs of many instances are generated.
    methods, adaptive
        Integration methods with steps of fixed size, and adaptive steps (None without a tolerance).
    parameter_count, input_count
        Number of parameters and inputs of the scene.
    timed
        Whether the C functions of steps take the time.
    """

    TEMPLATE: ClassVar[str] = "python/binding.c"
    prefix: str
    PREFIX: str
    real: str
    evaluations: tuple[BoundFunction, ...]
    acceleration: str
    project: str
    linearization: str
    batch: bool
    methods: tuple[BoundMethod, ...]
    adaptive: BoundAdaptive | None
    parameter_count: int
    input_count: int
    timed: bool  # whether steps depend on the time


@dataclass(frozen=True)
class DeclarationsView:
    """Data for the template python/binding.cdef.jinja: declarations of the Python binding for cffi.

    The fields are those of `BindingView` with the same names.
    """

    TEMPLATE: ClassVar[str] = "python/binding.cdef"
    real: str
    evaluations: tuple[BoundFunction, ...]
    project: str
    linearization: str
    batch: bool
    methods: tuple[BoundMethod, ...]
    adaptive: BoundAdaptive | None


@dataclass(frozen=True)
class ListedItem:
    """A coordinate, parameter, input or output, as listed in the Python package.

    Attributes
    ----------
    written
        Its name in the scene, which may differ from the name in C.
    words
        Its unit and note.
    number
        Value of a parameter as Python text; otherwise "".
    """

    written: str
    words: FreeText
    number: str = ""


@dataclass(frozen=True)
class FaceView:
    """Data for the template python/face.py.jinja: the __init__.py of the generated Python package.

    Attributes
    ----------
    extension
        Name of the compiled extension module.
    digest
        Digest (SHA-256) of the scene.
    coordinate_units, input_units, output_units, units
        Units by name; `units` has all that are not empty, also of parameters.
    plane
        Whether frames, momentum or reactions are planar.
    start
        Initial values of the coordinates and of the velocities.
    follows
        Formulas of the initial values that depend on parameters, by name.
    h, duration, tolerance
        Default step size (s), duration (s) and error tolerance of a simulation.
    fixed
        Whether assembly keeps the initial value of each coordinate, then of each velocity.
    holonomic, redundant
        Number of holonomic constraint equations, and indices of the redundant ones.
    modes
        For each coordinate with stick-slip friction, the index of the discrete coordinate that
        stores whether it slides or sticks, and its own index.
    discrete
        Number of discrete coordinates that are parameters set by state jumps.
    functions
        Public functions of the package: attributes of the model, such as "functions.D", by name.
    optional
        Option of [run] and the functions that it would add, for options that are off.
    from_python
        Whether the model was made in Python rather than from a scene.
    """

    TEMPLATE: ClassVar[str] = "python/face.py"
    title: FreeText
    stamp: tuple[FreeText, ...]
    prefix: str
    extension: str
    digest: str
    dtype: str
    coordinates: tuple[ListedItem, ...]
    parameters: tuple[ListedItem, ...]
    inputs: tuple[ListedItem, ...]
    outputs: tuple[ListedItem, ...]
    coordinate_units: FreeText
    parameter_values: Mapping[str, float]
    input_units: FreeText
    output_units: FreeText
    frames: tuple[str, ...]
    plane: bool
    units: FreeText
    start: tuple[list[float], list[float]]
    follows: FreeText
    h: float
    duration: float
    tolerance: float | None
    events: tuple[str, ...]
    constraints: tuple[str, ...]
    fixed: tuple[bool, ...]
    holonomic: int
    redundant: tuple[int, ...]
    modes: tuple[tuple[int, int], ...]
    discrete: int
    reactions: tuple[str, ...]
    batch: bool
    methods: tuple[Method, ...]
    functions: Mapping[str, str]
    optional: tuple[tuple[str, tuple[str, ...]], ...]
    from_python: bool


@dataclass(frozen=True)
class StubView:
    """Data for the template python/stub.pyi.jinja: type stubs of the generated Python package."""

    TEMPLATE: ClassVar[str] = "python/stub.pyi"
    stamp: tuple[FreeText, ...]
    batch: bool
    functions: Mapping[str, str]


@dataclass(frozen=True)
class Form:
    """A variant of the compiled extension in a wheel, for processors with certain features.

    Attributes
    ----------
    name
        Name of the variant.
    extension
        Name of the extension module.
    needs
        CPU features that the variant requires, as named by /proc/cpuinfo in Linux.
    """

    name: str
    extension: str
    needs: tuple[str, ...]


@dataclass(frozen=True)
class CompiledView:
    """Data for the template python/compiled.py.jinja: a module that imports one of the variants.

    By default it imports the first of `forms` whose features the processor has.
    """

    TEMPLATE: ClassVar[str] = "python/compiled.py"
    prefix: str
    version: str
    forms: tuple[Form, ...]


_OF_STEPS = ("Phi", "Gamma")


def binding_view(target: Target) -> BindingView:
    """Return the data for the Python binding, C functions that Python calls.

    All functions have the same signature, and each evaluates many states in one call.
    """
    public, at, NQ = Public(target), _rows(target), f"{target.PREFIX}_NQ"
    linear = public.linearization
    matrices = {a.name: f"{a.name} + {a.extent}*k" for a in linear.arguments if a.name[0] in "AB"}
    return BindingView(
        prefix=target.prefix,
        PREFIX=target.PREFIX,
        real=target.real.name,
        evaluations=_bound(target),
        acceleration=public.acceleration.call(qdd=f"out + {NQ}*k", **at),
        project=public.project.call(**at) if target.system.constraints else "",
        linearization=linear.call(**at, **matrices) if _linearized(target) else "",
        batch=target.system.run.batch,
        methods=_methods(target),
        adaptive=_adaptive(target),
        parameter_count=len(target.system.parameters),
        input_count=len(target.system.inputs),
        timed=any(a.name == "t0" for a in public.batch(target.system.run.methods[0]).arguments),
    )


def _bound(target: Target) -> tuple[BoundFunction, ...]:
    """Return the evaluation functions for the Python binding, with their C calls for state k."""
    state_arguments, bindings = _rows(target), []
    for function in Public(target).evaluations():
        name = function.name.removeprefix(f"{target.prefix}_")
        kind = KINDS[name]
        extents = {a.name: a.extent for a in function.arguments}
        rows = {kind.out: f"out + {extents[kind.out]}*k"} if kind.out else {}
        if kind.extra_argument:  # passed in place of the inputs
            rows[kind.extra_argument] = f"u + {member('own', 'u')}*k"
        call = function.call(**(state_arguments | rows))
        solve = (
            Public(target).acceleration.call(**state_arguments) if takes_qdd(target, name) else ""
        )
        # functions for SciPy's LowLevelCallable take doubles only
        state_only = not kind.out and target.real is DOUBLE and not {"t", "u", "qdd"} & set(extents)
        at_x = function.call(q="x", qd=f"x + {target.PREFIX}_NQ", p=_parameters(target))
        text = call if kind.out else f"out[k] = {call}"
        size = extents[kind.out] if refuses(target, name) else ""
        bindings.append(BoundFunction(name, text, solve, at_x if state_only else "", size))
    return tuple(bindings)


def _parameters(target: Target, place: str = "p") -> str:
    """Return the C expression `place`, an array of numbers, cast to the struct of parameters.

    Returns "" if the scene has no parameters.
    """
    return cast(f"{target.prefix}_params", place) if target.needs_p else ""


def _rows(target: Target) -> dict[str, str]:
    """Return the C arguments q, qd, t, u and p for the state with index k, by name.

    The binding's arrays have one row for each state; t, u and p may be the same for all.
    """
    NQ = f"{target.PREFIX}_NQ"
    return {
        "q": f"q + {NQ}*k",
        "qd": f"qd + {NQ}*k",
        "t": f"{member('own', 't')} ? {member('own', 't')}[k] : t",
        "u": f"u ? u + {member('own', 'u')}*k : u",
        "p": _parameters(target, f"(p + {member('own', 'p')}*k)"),
    }


def _methods(target: Target) -> tuple[BoundMethod, ...]:
    """Return the C calls of each integration method in the Python binding."""
    public, p, NQ = Public(target), _parameters(target), f"{target.PREFIX}_NQ"
    memory = f"work ? &{member('work', 'memory')} : NULL"
    return tuple(
        BoundMethod(
            name,
            METHODS[name].implicit,
            public.step(name).call(q="at", qd="moving", p=p),
            public.run(name).call(
                u="u ? u + first*u_stride : u", q_rows=f"q_rows + {NQ}*(row + 1)",
                qd_rows=f"qd_rows + {NQ}*(row + 1)", p=p, memory=memory,
                status="&result",
            ),
            public.batch(name).call(
                count="many", q=f"q + {NQ}*base", qd=f"qd + {NQ}*base", t0="t[t_instance*base]",
                u="u ? u + u_instance*base : u",
                q_rows=f"q_rows ? q_rows + {NQ}*row_count*base : q_rows",
                qd_rows=f"qd_rows ? qd_rows + {NQ}*row_count*base : qd_rows",
                p=f"{p} + p_instance*base", completed="completed + base", status="status + base",
            ),
            *(_derivative(target, name) if target.system.run.discretize else ("", "", "")),
        )
        for name in target.system.run.methods
    )  # fmt: skip


def _adaptive(target: Target) -> BoundAdaptive | None:
    """Return the data for adaptive steps in the binding; None if the scene has no tolerance."""
    if target.system.run.tolerance is None:
        return None
    run = Public(target).adaptive(adaptive.METHOD.name)
    call = run.call(
        q="x", qd=f"x + {target.PREFIX}_NQ", p=_parameters(target), status="&result",
        memory=f"&{member('work', 'memory')}", events=f"&{member('work', 'events')}",
    )  # fmt: skip
    many = Public(target).adaptive_batch(adaptive.METHOD.name).call(p=_parameters(target))
    return BoundAdaptive(f"{run.name}_memory", call, bool(target.system.events), many)


def _derivative(target: Target, method: str) -> tuple[str, str, str]:
    """Return three C calls for the derivatives of several steps from the state with index k.

    They compute the derivatives of the first step, make the next step, and compute its derivatives.
    """
    function, rows = Public(target).derivative(method), _rows(target)
    out = {a.name: f"{a.name} + {a.extent}*k" for a in function.arguments if a.name in _OF_STEPS}
    later = rows | {"q": "at", "qd": "moving"}
    before, now = later, later
    if target.driven:
        before = later | {"t": f"({rows['t']}) + (step - 1)*h"}
        now = later | {"t": f"({rows['t']}) + step*h"}
    return (
        function.call(**rows, **out),
        Public(target).step(method).call(**before),
        function.call(**now, Phi="A", Gamma="B"),
    )


def _linearized(target: Target) -> bool:
    """Return True if the program has a linearization."""
    return bool({"linearization", "linearization_column"} & set(target.program.functions))


def declarations_view(bound: BindingView) -> DeclarationsView:
    """Return the data for the C declarations from which cffi makes the Python binding."""
    return DeclarationsView(
        bound.real, bound.evaluations, bound.project, bound.linearization, bound.batch,
        bound.methods, bound.adaptive,
    )  # fmt: skip


def face_view(target: Target, extension: str) -> FaceView:
    """Return the data for the __init__.py of the Python package.

    extension: name of the compiled extension module, which it imports.
    """
    s, written = target.system, target.scene_name
    units = {c.name: c.unit for c in s.coordinates} | {p.name: p.unit for p in s.parameters}
    units |= {i.name: i.unit for i in s.inputs} | {o.name: o.unit for o in s.outputs}
    return FaceView(
        title=FreeText(s.title),
        stamp=tuple(stamp(target)),
        prefix=target.prefix,
        extension=extension,
        digest=s.digest,
        dtype=target.real.dtype,
        coordinates=tuple(
            ListedItem(written(c.name), unit_and_note(c.unit, c.note)) for c in s.coordinates
        ),
        parameters=tuple(
            ListedItem(written(p.name), unit_and_note(p.unit, p.note), repr(p.value))
            for p in s.parameters
        ),
        inputs=tuple(ListedItem(written(i.name), unit_and_note(i.unit, i.note)) for i in s.inputs),
        outputs=tuple(ListedItem(o.name, unit_and_note(o.unit, o.note)) for o in s.outputs),
        coordinate_units=FreeText({written(c.name): c.unit for c in s.coordinates}),
        parameter_values={written(p.name): p.value for p in s.parameters},
        input_units=FreeText({written(i.name): i.unit for i in s.inputs}),
        output_units=FreeText({o.name: o.unit for o in s.outputs}),
        frames=tuple(f.name for f in s.output_frames),
        plane=bool(s.plane and (s.output_frames or s.run.momentum or s.reactions)),
        units=FreeText({written(name): unit for name, unit in units.items() if unit}),
        start=([c.start for c in s.coordinates], [c.rate for c in s.coordinates]),
        follows=FreeText(start_formulas(target)),
        h=s.run.h,
        duration=s.run.duration,
        tolerance=s.run.tolerance,
        events=tuple(e.name for e in s.events),
        constraints=tuple(c.name for c in s.constraints),
        fixed=(*(c.start_fixed for c in s.coordinates), *(c.rate_fixed for c in s.coordinates)),
        holonomic=sum(c.holonomic for c in s.constraints),
        redundant=tuple(k for k, c in enumerate(s.constraints) if c.redundant),
        modes=tuple((m.at, m.of) for m in s.modes),
        discrete=len(s.discrete),
        reactions=tuple(r.name for r in s.reactions),
        batch=s.run.batch,
        methods=tuple(METHODS[name] for name in s.run.methods),
        functions=_functions(target),
        optional=tuple(x for x in OPTIONAL.items() if not getattr(s.run, x[0])),
        from_python=s.scene is None,
    )


def start_formulas(target: Target) -> dict[str, str]:
    """Return the formulas of those initial values that depend on parameters.

    They are given by the name of a coordinate (`theta`) or velocity (`theta_dot`) in the scene.
    Parameters that state jumps change are replaced by their values.
    """
    s, written = target.system, target.scene_name
    set_by_jumps = {written(c.name): c.start for c in s.coordinates if c.name in s.discrete}
    return {
        f"{written(c.name)}{end}": fold_values(parse(text), set_by_jumps)
        for c in s.coordinates
        for end, text in (("", c.follows), ("_dot", c.rate_follows))
        if text
    }


def stub_view(target: Target) -> StubView:
    """Return the data for the type stubs of the Python package."""
    return StubView(tuple(stamp(target)), target.system.run.batch, _functions(target))


def _functions(target: Target) -> dict[str, str]:
    """Return the public functions of the Python package: attributes of the model by name.

    They are sorted by name. An attribute is a path, such as "functions.D" for the function D.
    """
    s, run = target.system, target.system.run
    functions = {name: f"{part}.{name}" for part, names in FUNCTIONS.items() for name in names}
    functions["load_run"] = "load_run"
    if run.batch:
        functions |= {name: f"batch.{name}" for name in ("simulate_batch", "step_batch")}
    constrained = (*(CONSTRAINED if s.constraints else ()), *(["reactions"] if s.reactions else ()))
    functions |= {name: f"constraints.{name}" for name in constrained}
    for option, names in OPTIONAL.items():
        if getattr(run, option):
            parts = {name: "frames" if name in _FRAMES else "statics" for name in names}
            functions |= {name: f"{part}.{name}" for name, part in parts.items()}
    return dict(sorted(functions.items()))
