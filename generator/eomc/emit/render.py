"""Rendering of a program to files: header, source, example, self-test, package."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass

from eomc.base import resources
from eomc.base.texts import name as plain
from eomc.emit import exports, package, portable, selftest
from eomc.emit.common import c_function as c
from eomc.emit.common.c_expression import REALS
from eomc.emit.common.c_names import Target, rename_for_c
from eomc.emit.common.functions import SceneFunctions
from eomc.emit.common.public import KINDS, program_function
from eomc.emit.common.templates import show
from eomc.emit.fmu import Unit, render_unit
from eomc.emit.optimised import files as optimised
from eomc.program.outline import weight
from eomc.program.program import Program

MAIN_ROWS = 200  # approximate number of rows that main.c prints
COLUMNS_WIDTH = 88  # width of the column names there
FAST = "fast"  # the folder of optimised C, from which the Python module is compiled


@dataclass(frozen=True)
class Sources:
    """The generated files, and the sources of the compiled extension of the Python package.

    Attributes
    ----------
    name
        Name of the scene.
    files
        Text of each generated file by its path.
    binding, cdef
        C code between the scene's C functions and Python, and its declarations for cffi.
    stub
        Type stubs of the Python package.
    operations
        Total number of operations of all functions, a measure of compile time.
    """

    name: str
    files: Mapping[str, str]
    binding: str
    cdef: str
    stub: str
    operations: int

    @property
    def embeddable(self) -> dict[str, str]:
        """The files for use from C, by path, without the Python package."""
        return {file: text for file, text in self.files.items() if not file.endswith(".py")}


def _plain_names(program: Program) -> None:
    """Raise ValueError if a name of the program is not plain, so that it cannot stand in code."""
    s = program.system
    for item in (*s.coordinates, *s.parameters, *s.inputs, *(d for d, _ in s.definitions), s):
        plain(item.name)


def render(program: Program, extension: str) -> Sources:
    """Return all generated files of a program, the list of functions derived from a scene.

    The same program always gives the same text. extension: name of the compiled extension module,
    which the Python package imports.
    """
    _plain_names(program)
    program, written = rename_for_c(program)
    run = program.system.run
    target = Target(program, REALS[run.real], written)
    functions = SceneFunctions(target)
    binding, cdef = package.binding(functions)
    name = program.system.name
    return Sources(
        name=name,
        files={
            **portable.files(program, written=written),
            **{f"{FAST}/{file}": text for file, text in optimised.files(functions).items()},
            **companion_files(functions),
            "selftest.c": selftest.selftest(functions),
            "__init__.py": package.init(functions, extension),
            **resources.runtime(run.batch),
        },
        binding=binding,
        cdef=cdef,
        stub=show("python/stub.pyi", functions, exports=package.exports(target)),
        operations=sum(map(weight, program.functions.values())),
    )


def companion_files(functions: SceneFunctions) -> dict[str, str]:
    """Return the texts of the files that accompany the C code, by file name.

    main.c is an example program that simulates the scene and prints about MAIN_ROWS lines.
    costs.txt has the operation counts of one call of each function, in the order of the header, and
    the steps of the integration methods.
    """
    target, run = functions.target, functions.target.system.run
    steps = max(1, math.ceil(run.duration / run.h * (1 - 1e-12)))
    names = [c.scene_name for c in target.coordinates]
    outputs = [o.name for o in target.outputs]
    columns = ", ".join(("t", *names, *(f"{n}_dot" for n in names), *outputs, "energy"))
    lines = [line.replace(" ", "") for line in textwrap.wrap(columns, COLUMNS_WIDTH)]
    main = show(
        "c/main.c", functions, rows=MAIN_ROWS, steps=steps, every=max(1, steps // MAIN_ROWS),
        columns=lines,
    )  # fmt: skip
    evaluated = (program_function(target, n) for n in (*KINDS, "acceleration", "linearization"))
    return {
        "main.c": c.break_comments(main),
        "CMakeLists.txt": show("c/CMakeLists.txt", functions),
        f"{functions.prefix}.pc.in": show("c/package.pc.in", functions),
        "costs.txt": show("c/costs.txt", functions, costs=[f for f in evaluated if f]),
    }


def unit(program: Program, version: int) -> Unit:
    """Return the functional mock-up unit (FMU) of a program: its C code and model description.

    version: version of the FMI standard, 2 or 3.
    """
    _plain_names(program)
    program, written = rename_for_c(program)
    functions = SceneFunctions(Target(program, REALS[program.system.run.real], written))
    files = portable.files(program, written=written)
    return render_unit(functions, version, files)


def export_package(program: Program, library: str) -> dict[str, str]:
    """Return the package of a program for a library of `exports.LIBRARIES`, as texts by file name.

    A package for CasADi contains portable C; the others need the built module as a subpackage.
    """
    _plain_names(program)
    program, written = rename_for_c(program)
    functions = SceneFunctions(Target(program, REALS[program.system.run.real], written))
    if library != "casadi":
        return exports.array_files(functions, library)
    return {**portable.files(program, written=written), **exports.casadi_files(functions)}
