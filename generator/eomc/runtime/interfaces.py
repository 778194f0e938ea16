"""The parts of a compiled scene that computations with it use."""

from __future__ import annotations

from typing import Any, Protocol

from .arguments import Arguments
from .constraints import Constraints
from .frames import Frames
from .functions import Functions
from .info import CLibrary, SceneInfo


class CompiledModel(Protocol):
    """Parts of `model.Model`, for annotations in the modules that `model` imports.

    Attributes
    ----------
    info, c, arguments : SceneInfo, CLibrary, Arguments
        Facts about the scene, its compiled functions, and the conversion of arguments for them.
    functions, frames, constraints : Functions, Frames, Constraints
        Functions of a state, of bodies and points, and of constraint equations.
    integrator : Integrator
        Steps and runs.
    extensions, extension_of
        As in `model.Model`.
    """

    info: SceneInfo
    c: CLibrary
    arguments: Arguments
    functions: Functions
    frames: Frames
    constraints: Constraints
    integrator: Any
    extensions: dict[str, Any]
    extension_of: tuple[Any, Any] | None


class CompiledBatchModel(CompiledModel, Protocol):
    """Parts of `batch.BatchModel`, which has `batch` (a `Batch`: steps and runs of instances)."""

    batch: Any
