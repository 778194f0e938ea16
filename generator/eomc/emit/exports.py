"""Packages for CasADi, JAX and PyTorch: accelerations and steps with their derivatives.

For CasADi, accelerations are written twice: in C with its calling convention of external functions,
on top of portable C, and line by line in Python for symbolic expressions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

from eomc.base.errors import EomcError, SceneError
from eomc.emit.common.c_expression import C_NAMES, PIVOT, Printer
from eomc.emit.common.c_function import break_long_lines
from eomc.emit.common.c_names import local_name, rename_reserved
from eomc.emit.common.functions import SceneFunctions
from eomc.emit.common.templates import show
from eomc.integrators.tableaux import METHODS
from eomc.model.system import System
from eomc.program.ir import Call, Operand
from eomc.program.program import TIME

LIBRARIES = {"casadi": "CasADi", "jax": "JAX", "torch": "PyTorch"}
# functions of the program that CasADi has under another name, or that Python has itself
_COMPOSED = {"cbrt", "erfc", "pow", "sign", "heaviside", "reciprocal", PIVOT}


def differentiable(system: System, library: str, h: float | None) -> System:
    """Return a system with the settings of [run] that an export needs: doubles and derivatives.

    library: key of LIBRARIES. h: step size of exported steps, s; None for that of the scene. Raises
    SceneError if the scene has events, which interrupt a run between steps, and EomcError if h is
    not positive.
    """
    name = LIBRARIES[library]
    if h is not None and not 0 < h < math.inf:
        raise EomcError(f"the step size is a positive number of seconds, here {h!r}")
    if system.modes:
        why = f"friction that sticks has no derivatives for {name}: take friction = 'smooth'"
        raise SceneError([system.problem("run.friction", why)])
    if system.events:
        why = (
            f"the event '{system.events[0].name}' interrupts a run, which a function for {name} "
            "can't express: leave out the events, or replace impacts and stops by stiff springs "
            "and dampers; eomc export fmu includes events"
        )
        raise SceneError([system.problem("event.1", why)])
    run = replace(
        system.run, linearize="products", discretize=True, real="double", tolerance=None,
        batch=library != "casadi",
    )  # fmt: skip
    if run.batch:  # many states at once, which implicit methods do not have
        explicit = tuple(m for m in run.methods if not METHODS[m].implicit)
        run = replace(run, methods=explicit or ("rk4",))
    return replace(system, run=run if h is None else replace(run, h=h))


def _depends_on_time(functions: SceneFunctions) -> bool:
    """Return True if accelerations or projections depend on the time other than through inputs."""
    names = ("acceleration", "projection")
    program = functions.target.program
    return any(name in program and TIME in program[name].uses for name in names)


# --- CasADi ---------------------------------------------------------------------------------------


class _SymbolicPrinter(Printer):
    """Translator of the values of a function into expressions of CasADi in Python."""

    def _sign(self, argument: Operand) -> str:
        return f"sign({self.operand(argument)})"


def _symbolic_lines(functions: SceneFunctions) -> tuple[list[str], list[str]]:
    """Return Python statements for the accelerations, one for each operation, and the results."""
    function = rename_reserved(functions.target.program["acceleration"])
    s = functions.target.system
    variables = (*s.q, *s.qd, *s.u, *(p.symbol for p in s.parameters))
    where = {x.name: local_name(x.name) for x in variables}
    printer = _SymbolicPrinter(functions.prefix, functions.target.real, where)
    lines = [f"{a.name} = {printer.value(a.value)[0]}" for a in (*function.early, *function.body)]
    return lines, [printer.operand(o) for o in function.outputs]


def _called(functions: SceneFunctions) -> set[str]:
    """Return the names of the functions that the accelerations call."""
    function = functions.target.program["acceleration"]
    values = (a.value for a in (*function.early, *function.body))
    return {v.function for v in values if isinstance(v, Call)}


def _pattern(rows: int, columns: Sequence[Sequence[int]]) -> str:
    """Return a sparsity pattern as CasADi stores it, by columns, as the text of a C initialiser.

    rows: the number of rows. columns: the rows of the nonzero entries of each column.
    """
    starts = [sum(map(len, columns[:k])) for k in range(len(columns) + 1)]
    numbers = (rows, len(columns), *starts, *(row for column in columns for row in column))
    return ", ".join(map(str, numbers))


def _patterns(functions: SceneFunctions) -> Iterator[tuple[str, str]]:
    """Yield the sparsity patterns of inputs, outputs and derivatives, by name.

    x = [q; qd], and the derivatives of dx/dt = [qd; qdd] have the rows [0, 1] above.
    """
    s = functions.target.system
    n, m, k = len(s.q), len(s.u), len(s.parameters)
    whole, below = range(2 * n), range(n, 2 * n)
    for name, size in (("x", 2 * n), ("u", m), ("p", k), ("t", 1)):
        yield name, _pattern(size, [range(size)])
    yield "none", _pattern(2 * n, [()])
    yield "no_t", _pattern(1, [()])
    yield "ode_x", _pattern(2 * n, [*[below] * n, *[(j, *below) for j in range(n)]])
    yield "ode_u", _pattern(2 * n, [below] * m)
    yield "ode_p", _pattern(2 * n, [below] * k)
    yield "step_x", _pattern(2 * n, [whole] * (2 * n))
    yield "step_u", _pattern(2 * n, [whole] * m)
    yield "step_p", _pattern(2 * n, [whole] * k)


def casadi_files(functions: SceneFunctions) -> dict[str, str]:
    """Return the C and the Python of a package for CasADi, besides the portable C, by file name."""
    lines, results = _symbolic_lines(functions)
    called = _called(functions)
    text = show(
        "exports/casadi.c", functions, patterns=dict(_patterns(functions)),
        timed=_depends_on_time(functions),
    )  # fmt: skip
    names = {C_NAMES[name] for name in called - _COMPOSED}
    names |= {"sign"} if called & {"cbrt", "sign", "heaviside"} else set()
    names |= {"erf"} if "erfc" in called else set()
    symbolic = show(
        "exports/casadi.py", functions, lines=lines, results=results, called=called,
        imported=sorted({*names, *({"fabs"} if "cbrt" in called else ())}), local=local_name,
    )  # fmt: skip
    return {f"{functions.prefix}_casadi.c": break_long_lines(text), "__init__.py": symbolic}


# --- JAX and PyTorch ------------------------------------------------------------------------------


def array_files(functions: SceneFunctions, library: str) -> dict[str, str]:
    """Return the Python of a package for JAX or PyTorch, by file name.

    The scene's built module is a subpackage of the package.
    """
    timed = _depends_on_time(functions)
    return {
        "__init__.py": show(f"exports/{library}.py", functions, timed=timed),
        "_arrays.py": show("exports/arrays.py", functions, timed=timed),
    }
