"""The Python package of a scene: its C binding, its modules and its type stubs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from eomc.base.texts import FreeText
from eomc.emit.common.c_expression import DOUBLE
from eomc.emit.common.c_function import CFunction, cast, member, prototypes
from eomc.emit.common.c_names import Item, Target
from eomc.emit.common.functions import SceneFunctions
from eomc.emit.common.public import KINDS
from eomc.emit.common.templates import show
from eomc.model.system import System
from eomc.runtime.package import CONSTRAINED
from eomc.scene.schema import RunSettings

FUNCTIONS = {  # public functions of each package, by the part of `runtime.model.Model`
    "functions": "C D acceleration applied bias energy g jacobi kinetic_energy limits linearize "
    "output potential_energy power rhs sensitivity signal tau".split(),
    "integrator": "advice discretize simulate step".split(),
    "statics": ["equilibrium"],
}
OPTIONAL = {  # functions by the option that brings them, with its value if that is not "true"
    'linearize "products"': ("acceleration_jvp", "acceleration_vjp"),
    "frames": ("pose", "frame_velocity", "frame_acceleration", "jacobian", "frame_forces"),
    "inverse_dynamics": ("inverse_dynamics", "drive_forces"),
    "momentum": ("momentum",),
}
# the parts of the model with optional functions other than "frames"
_PARTS = {
    "drive_forces": "statics", "acceleration_jvp": "functions", "acceleration_vjp": "functions",
}  # fmt: skip
# arrays of the binding with a row for each state
_ROWS = frozenset(
    {"q", "qd", "qdd", "along", "qdd_bar", "rates", "bar", "A_q", "A_qd", "B", "Phi", "Gamma", "E"}
)


@dataclass(frozen=True)
class BoundFunction:
    """An evaluation function, such as D or energy, in the Python binding, called for n states.

    Attributes
    ----------
    name
        Name of the quantity.
    call
        C call for the state with index k, with an assignment if the function returns a number.
    solve
        C call that first computes the accelerations which the function reads; "" if it reads none.
    at
        C call in a function for SciPy's LowLevelCallable, which takes x = [q; qd]. "" unless the
        function returns a double that depends on the state and parameters only.
    refuses
        Number of results for each state, as C text, if the function returns a status; otherwise "".
    """

    name: str
    call: str
    solve: str
    at: str
    refuses: str


@dataclass(frozen=True)
class BoundAccelerations:
    """The accelerations, or a product of their derivatives with a vector, called for n states.

    Attributes
    ----------
    name
        Name of the function.
    out, vector
        Names of the arrays for the results and with the vector; "" without a vector.
    function
        The scene's C function.
    """

    name: str
    out: str
    vector: str
    function: CFunction


@dataclass(frozen=True)
class Binding:
    """The calls of the scene's functions in the Python binding, which evaluates many states."""

    scene: SceneFunctions

    @cached_property
    def evaluations(self) -> tuple[BoundFunction, ...]:
        """The evaluation functions, without products."""
        names = (n for n, kind in KINDS.items() if self.scene.public.has(n) and not kind.is_product)
        return tuple(map(self._evaluation, names))

    @cached_property
    def accelerations(self) -> tuple[BoundAccelerations, ...]:
        """The accelerations, and the products of their derivatives with a vector."""
        public = self.scene.public
        names = (n for n, kind in KINDS.items() if public.has(n) and kind.is_product)
        return (
            BoundAccelerations("acceleration", "qdd", "", public.acceleration),
            *(
                BoundAccelerations(n, KINDS[n].out, KINDS[n].extra_argument, public.evaluation(n))
                for n in names
            ),
        )

    @cached_property
    def parameters(self) -> str:
        """The array p of numbers, cast to the struct of parameters; "" without parameters."""
        return self._parameters("p")

    def row_call(self, f: CFunction, **passed: str) -> str:
        """Return the C call of a function of the scene for the state with index k.

        The binding's arrays have one row for each state; t, u and p may be the same for all.
        passed: C expressions of other arguments, by name.
        """
        rows = {
            a.name: f"{a.name} + ({a.extent})*k" if "+" in a.extent else f"{a.name} + {a.extent}*k"
            for a in f.arguments
            if a.extent and a.name in _ROWS
        }
        own_t, own_u, own_p = (member("own", name) for name in "tup")
        rows |= {
            "t": f"{own_t} ? {own_t}[k] : t",
            "u": f"u ? u + {own_u}*k : u",
            "p": self._parameters(f"(p + {own_p}*k)"),
        }
        return f.call(**(rows | passed))

    def block_call(self, f: CFunction) -> str:
        """Return the C call of a function of the scene for the states from index k on.

        It takes the addresses of the results of these states and returns how many it computed.
        """
        NQ, columns = self.scene.NQ, self.scene.public.step_columns
        sizes = {"A": f"2*{NQ}*2*{NQ}", "B": f"2*{NQ}*{self.scene.NU}", "q": NQ, "qd": NQ}
        sizes |= {name: f"2*{NQ}*{count}" for name, count in columns.items()}
        passed = {name: f"{name} + {size}*k" for name, size in sizes.items()}
        own_t, own_u, own_p = (member("own", name) for name in "tup")
        return f.call(
            **passed, count="n - k",
            t=f"{own_t} ? {own_t} + k : &t", t_instance=f"{own_t} != NULL",
            u=f"u ? u + {own_u}*k : u", u_instance=own_u,
            p=f"p + {own_p}*k", p_instance=own_p,
        )  # fmt: skip

    def _parameters(self, place: str) -> str:
        """Return a C expression, an array of numbers, cast to the struct of parameters."""
        target = self.scene.target
        return cast(f"{target.prefix}_params", place) if target.needs_p else ""

    def _evaluation(self, name: str) -> BoundFunction:
        """Return an evaluation function of the binding. name: that of the quantity."""
        target, public = self.scene.target, self.scene.public
        kind, function = KINDS[name], self.scene.public.evaluation(name)
        extents = {a.name: a.extent for a in function.arguments}
        rows = {kind.out: f"out + {extents[kind.out]}*k"} if kind.out else {}
        if kind.extra_argument:  # passed in place of the inputs
            rows[kind.extra_argument] = f"u + {member('own', 'u')}*k"
        if public.takes_qdd(name):
            rows["qdd"] = "qdd"  # a local array, for one state
        call = self.row_call(function, **rows)
        # functions for SciPy's LowLevelCallable take doubles only
        state_only = not kind.out and target.real is DOUBLE and not {"t", "u", "qdd"} & set(extents)
        at_call = function.call(q="x", qd=f"x + {self.scene.NQ}", p=self.parameters)
        return BoundFunction(
            name,
            call if kind.out else f"out[k] = {call}",
            self.row_call(public.acceleration, qdd="qdd") if public.takes_qdd(name) else "",
            at_call if state_only else "",
            extents[kind.out] if public.refuses(name) else "",
        )


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


def binding(functions: SceneFunctions) -> tuple[str, str]:
    """Return the C code between the scene's C functions and Python, and its declarations for cffi.

    The declarations are those of the functions that Python calls.
    """
    source = show("python/binding.c", functions, binding=Binding(functions))
    return source, show("python/binding.cdef", functions, prototypes=prototypes("PYTHON", source))


def init(functions: SceneFunctions, extension: str) -> str:
    """Return the text of __init__.py of the Python package.

    extension: name of the compiled extension module, which it imports.
    """
    target, run = functions.target, functions.target.system.run
    return show(
        "python/face.py",
        functions,
        extension=extension,
        arguments=_model_arguments(target),
        exports=exports(target),
        optional=tuple(x for x in OPTIONAL.items() if not _has(run, x[0])),
        from_python=not target.system.file,
    )


def _model_arguments(target: Target) -> dict[str, FreeText]:
    """Return the keyword arguments of the model besides its name, title, dtype and methods."""
    s = target.system

    def units(items: Sequence[Item]) -> dict[str, str]:
        return {x.scene_name: x.unit.text for x in items}

    arguments: dict[str, Any] = {
        "coordinates": units(target.coordinates),
        "parameters": {p.scene_name: p.value for p in target.parameters},
        "inputs": units(target.inputs),
        "outputs": units(target.outputs),
    }
    if s.output_frames:
        arguments["frames"] = tuple(f.name for f in s.output_frames)
    if s.plane and (s.output_frames or s.run.momentum or s.reactions):
        arguments["plane"] = True
    every = (*target.coordinates, *target.parameters, *target.inputs, *target.outputs)
    arguments["units"] = {name: unit for name, unit in units(every).items() if unit}
    arguments["start"] = ([*target.q0], [*target.qd0])
    if follows := target.start_formulas:
        arguments["follows"] = follows
    arguments |= {"h": s.run.h, "duration": s.run.duration}
    if s.run.tolerance:
        arguments["tolerance"] = s.run.tolerance
    if s.events:
        arguments["events"] = tuple(e.name for e in s.events)
    if s.constraints or s.discrete:
        arguments["constrained"] = _constrained(s)
    return {name: FreeText(value) for name, value in arguments.items()}


def _constrained(s: System) -> tuple[Any, ...]:
    """Return what the model needs of constraints.

    They are the names of the equations; the names of the reactions; whether assembly keeps each
    initial coordinate, then each velocity; the number of holonomic equations; and the indices of
    redundant ones. If there are discrete coordinates, two more follow: for each coordinate with
    stick-slip friction, the index of the coordinate for its mode and its own index; and the number
    of those that are parameters set by jumps.
    """
    modes = tuple((m.at, m.of) for m in s.modes)
    return (
        tuple(c.name for c in s.constraints),
        tuple(r.name for r in s.reactions),
        (*(c.start_fixed for c in s.coordinates), *(c.rate_fixed for c in s.coordinates)),
        sum(c.holonomic for c in s.constraints),
        tuple(k for k, c in enumerate(s.constraints) if c.redundant),
        *([modes] if modes or s.discrete else []),
        *([len(s.discrete)] if s.discrete else []),
    )


def _has(run: RunSettings, option: str) -> bool:
    """Return True if the settings of the scene contain an option of OPTIONAL."""
    key, _, value = option.partition(" ")
    return str(getattr(run, key)) == value.strip('"') if value else bool(getattr(run, key))


def exports(target: Target) -> dict[str, str]:
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
        if _has(run, option):
            functions |= {name: f"{_PARTS.get(name, 'frames')}.{name}" for name in names}
    return dict(sorted(functions.items()))
