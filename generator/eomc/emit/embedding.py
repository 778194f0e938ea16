"""Files for embedding the C code: CMake and pkg-config files, and a table of costs."""

from __future__ import annotations

from eomc.base.version import __version__
from eomc.emit.c_names import Target
from eomc.emit.evaluations import KINDS, source
from eomc.emit.heading import stamp
from eomc.emit.views import CMake, Costs, Counted, PkgConfig, Stepped
from eomc.integrators.tableaux import METHODS


def cmake(target: Target) -> CMake:
    """Return the data for CMakeLists.txt, which builds the generated C as a library."""
    return CMake(tuple(stamp(target)), target.prefix, target.PREFIX, __version__)


def pkg_config(target: Target) -> PkgConfig:
    """Return the data for NAME.pc.in, a pkg-config file of the generated C library."""
    return PkgConfig(tuple(stamp(target)), target.prefix, __version__)


def costs(target: Target) -> Costs:
    """Return the data for costs.txt, a table of operation counts of the C functions.

    Each count is for one call. The functions are in the order of the header; the steps of the
    integration methods follow.
    """
    names = (*KINDS, "acceleration", "linearization")
    functions = tuple(Counted(f.name, f.cost) for name in names if (f := source(target, name)))
    steps = tuple(Stepped(f"{name}_step", _step(name)) for name in target.system.run.methods)
    width = max(map(len, [*(f.name for f in functions), *(m.name for m in steps)]))
    return Costs(tuple(stamp(target)), target.prefix, width, functions, steps)


def _step(name: str) -> str:
    """Return a text that tells how many accelerations one step of the method `name` computes."""
    m = METHODS[name]
    if m.implicit:
        return f"{m.stages} accelerations an iteration, until the stages settle"
    return f"{m.stages} accelerations" if m.stages > 1 else "1 acceleration"
