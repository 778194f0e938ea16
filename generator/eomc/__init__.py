"""eomc, the equations-of-motion compiler: from energies to fast, checked C.

    scene.toml -> Scene -> System -> Equations -> Program -> Sources -> Module

`load` goes the whole way, `sources` stops at the text; pipeline.py shows each step.
"""

from typing import TYPE_CHECKING

from eomc.base.errors import EomcError, SceneError
from eomc.base.resources import __version__
from eomc.pipeline import build, export, export_fmu, load, read, sources

if TYPE_CHECKING:
    from eomc.identification import fit
    from eomc.inertial_parameters import regressor
    from eomc.model.system import System, dot
    from eomc.report.equations import equations
    from eomc.sweeps.sweep import sweep

__all__ = [
    "EomcError", "SceneError", "System", "__version__", "build", "dot", "equations", "export",
    "export_fmu", "fit", "load", "read", "regressor", "sources", "sweep",
]  # fmt: skip


def __dir__() -> list[str]:
    """Return the public names, including those that are imported on first use."""
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})


def __getattr__(name: str) -> object:
    """Import System and other names on first use, because SymPy alone takes half a second."""
    if name in ("System", "dot"):
        from eomc.model import system

        return getattr(system, name)
    if name == "equations":
        from eomc.report.equations import equations

        return equations
    if name == "fit":
        from eomc.identification import fit

        return fit
    if name == "regressor":
        from eomc.inertial_parameters import regressor

        return regressor
    if name == "sweep":
        from eomc.sweeps.sweep import sweep

        return sweep
    raise AttributeError(f"module 'eomc' has no attribute {name!r}")
