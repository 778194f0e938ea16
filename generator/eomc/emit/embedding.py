"""Files beside the C code: an example program, CMake and pkg-config files, and a table of costs."""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass
from typing import ClassVar

from eomc.base.resources import __version__
from eomc.base.texts import FreeText
from eomc.emit import adaptive
from eomc.emit.c_names import Target
from eomc.emit.public import KINDS, Public, program_function, refuses, takes_qdd
from eomc.emit.views import stamp
from eomc.integrators.tableaux import METHODS
from eomc.program.ir import Cost

MAIN_ROWS = 200  # approximate number of rows that main.c prints
COLUMNS_WIDTH = 88  # width of the column names there


@dataclass(frozen=True)
class MainView:
    """Data for c/main.c.jinja: an example program that simulates the scene.

    The scene is the TOML file (or Python model) that the code is generated from. The program prints
    time, state, outputs and energy as CSV.

    Attributes
    ----------
    has_p
        Whether the C functions take parameters.
    method
        Integration method, as in the C name of the workspace type.
    adaptive
        Whether steps are adaptive; the scene then has a tolerance.
    rows, t_end, tolerance
        Number of printed lines, end time (s) and error tolerance, for adaptive steps.
    h, steps, every
        Step size (s), number of steps, and steps between printed lines, for steps of fixed size.
    events
        Whether the scene has events.
    columns
        Names of the CSV columns, in pieces that each fit on a line.
    run, energy, outputs, accelerations
        C calls: of the integrator, the energy, the outputs, and the accelerations that the outputs
        read. Empty if not needed.
    refuses
        Whether the C function of the outputs returns a status.
    """

    TEMPLATE: ClassVar[str] = "c/main.c"
    title: FreeText
    stamp: tuple[FreeText, ...]
    prefix: str
    PREFIX: str
    real: str
    has_p: bool
    method: str
    adaptive: bool
    rows: int
    t_end: str
    tolerance: str
    events: bool
    h: str
    steps: int
    every: int
    columns: tuple[str, ...]
    run: str
    energy: str
    outputs: str
    accelerations: str
    refuses: bool


@dataclass(frozen=True)
class CMakeView:
    """Data for c/CMakeLists.txt.jinja, which builds the generated C as a library.

    Other projects use the library by add_subdirectory or find_package.
    """

    TEMPLATE: ClassVar[str] = "c/CMakeLists.txt"
    stamp: tuple[FreeText, ...]
    prefix: str
    PREFIX: str
    version: str


@dataclass(frozen=True)
class PkgConfigView:
    """Data for c/package.pc.in.jinja: a pkg-config file of the generated C library.

    CMake completes and installs the file.
    """

    TEMPLATE: ClassVar[str] = "c/package.pc.in"
    stamp: tuple[FreeText, ...]
    prefix: str
    version: str


@dataclass(frozen=True)
class FunctionCost:
    """The name of a generated C function, and the operation counts of one call."""

    name: str
    cost: Cost


@dataclass(frozen=True)
class StepCost:
    """The name of a C function that makes a step of an integration method.

    `words` states how often a step computes the accelerations.
    """

    name: str
    words: str


@dataclass(frozen=True)
class CostsView:
    """Data for c/costs.txt.jinja: a table of operation counts of the C functions.

    `width` is the width of the column of names, in characters.
    """

    TEMPLATE: ClassVar[str] = "c/costs.txt"
    stamp: tuple[FreeText, ...]
    prefix: str
    width: int
    functions: tuple[FunctionCost, ...]
    steps: tuple[StepCost, ...]


def main_view(target: Target) -> MainView:
    """Return the data for main.c, an example program that simulates the scene.

    The program prints about 200 lines.
    """
    s, public = target.system, Public(target)
    steps = max(1, math.ceil(s.run.duration / s.run.h * (1 - 1e-12)))
    names = [target.scene_name(c.name) for c in s.coordinates]
    method, output_names = s.run.methods[0], [o.name for o in s.outputs]
    columns = ", ".join(("t", *names, *(f"{n}_dot" for n in names), *output_names, "energy"))
    outputs = public.evaluation("outputs").call(u="NULL") if output_names else ""
    solved = output_names and takes_qdd(target, "outputs")
    rows = {"q_rows": "NULL", "qd_rows": "NULL", "memory": "&memory", "status": "&status"}
    if s.run.tolerance is None:
        run = public.run(method).call(
            t0="0", first="n", steps="next", u="NULL", u_stride="0", every="0", **rows
        )
    else:
        method, limits = f"{adaptive.METHOD.name}_adaptive", {"t_end": "next", "max_step": "0"}
        run = public.adaptive(adaptive.METHOD.name).call(
            t="&t", **limits, u="NULL", steps="1000000", times="NULL", count="0", t_rows="NULL",
            room="0", events="NULL", which="NULL", event_rows="NULL", **rows,
        )  # fmt: skip
    return MainView(
        title=FreeText(s.title),
        stamp=tuple(stamp(target)),
        prefix=target.prefix,
        PREFIX=target.PREFIX,
        real=target.real.name,
        has_p=target.needs_p,
        method=method,
        adaptive=s.run.tolerance is not None,
        rows=MAIN_ROWS,
        t_end=target.literal(s.run.duration),
        tolerance=target.literal(s.run.tolerance or 0.0),
        events=bool(s.events),
        h=target.literal(s.run.h),
        steps=steps,
        every=max(1, steps // MAIN_ROWS),
        columns=tuple(line.replace(" ", "") for line in textwrap.wrap(columns, COLUMNS_WIDTH)),
        run=run,
        energy=public.evaluation("energy").call(),
        outputs=outputs,
        accelerations=public.acceleration.call(u="NULL") if solved else "",
        refuses=bool(output_names and refuses(target, "outputs")),
    )  # fmt: skip


def cmake_view(target: Target) -> CMakeView:
    """Return the data for CMakeLists.txt, which builds the generated C as a library."""
    return CMakeView(tuple(stamp(target)), target.prefix, target.PREFIX, __version__)


def pkg_config_view(target: Target) -> PkgConfigView:
    """Return the data for NAME.pc.in, a pkg-config file of the generated C library."""
    return PkgConfigView(tuple(stamp(target)), target.prefix, __version__)


def costs_view(target: Target) -> CostsView:
    """Return the data for costs.txt, a table of operation counts of the C functions.

    Each count is for one call. The functions are in the order of the header; the steps of the
    integration methods follow.
    """
    names = (*KINDS, "acceleration", "linearization")
    functions = tuple(
        FunctionCost(f.name, f.cost) for name in names if (f := program_function(target, name))
    )
    steps = tuple(
        StepCost(f"{name}_step", _cost_of_step(name)) for name in target.system.run.methods
    )
    width = max(map(len, [*(f.name for f in functions), *(m.name for m in steps)]))
    return CostsView(tuple(stamp(target)), target.prefix, width, functions, steps)


def _cost_of_step(name: str) -> str:
    """Return a text that tells how many accelerations one step of the method `name` computes."""
    m = METHODS[name]
    if m.implicit:
        return f"{m.stages} accelerations an iteration, until the stages settle"
    return f"{m.stages} accelerations" if m.stages > 1 else "1 acceleration"
