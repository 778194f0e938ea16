"""The compiled scene as a whole: its parts, and loading of saved runs.

The modules of this folder are copied into each built package, which therefore needs only NumPy and
cffi. Angles are in rad, all other quantities in SI units.
"""

from __future__ import annotations

from typing import Any, Self

from . import saved
from .arguments import Arguments
from .atomic_write import File
from .constraints import Constraints
from .frames import Frames
from .functions import Functions
from .info import CLibrary, SceneInfo
from .integrator import Integrator
from .package import MODEL, option, reduced
from .statics import Statics
from .trajectory import Trajectory


class Model:
    """A compiled scene. Each built package has one, and exports the methods of its parts.

    Attributes
    ----------
    info : SceneInfo
        Facts about the scene: names, dimensions, initial values.
    c : CLibrary
        The compiled functions.
    arguments : Arguments
        Conversion of arguments to arrays and pointers for C.
    functions : Functions
        D, C, g, energies, accelerations and other functions of a state.
    frames : Frames
        Poses, velocities and Jacobians of bodies and points, inverse dynamics.
    constraints : Constraints
        Residuals, multipliers and projection.
    statics : Statics
        Equilibria, and the actuator forces that a motion requires.
    integrator : Integrator
        Steps and runs.
    source : path, System or None
        What `eomc.load` built the module from; pictures need it.
    extensions : dict of Model
        Models that were extended by the events of a run, by these events.
    extension_of : (Model, events) or None
        The model that was extended to this one, and the additional events.
    """

    def __init__(self, extension: Any, **scene: Any) -> None:
        """Create the model from a compiled extension module (cffi) and the data of the scene.

        scene: the arguments of `SceneInfo.create`.
        """
        self.info = SceneInfo.create(scene)
        self.c = CLibrary(extension, self.info.dtype)
        self.arguments = Arguments(self.info, self.c)
        self.functions = Functions(self.arguments)
        self.frames = Frames(self.functions)
        self.constraints = Constraints(self.functions)
        self.integrator = Integrator(self)
        self.statics = Statics(self)
        self.source: Any = None
        self.extensions: dict[str, Any] = {}
        self.extension_of: tuple[Any, Any] | None = None

    def component(self, name: str) -> Any:
        """Return the part of this name, such as "functions"; pickles of parts call it."""
        return getattr(self, name)

    def itself(self) -> Self:
        """Return the model; pickles of the model call it."""
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return reduced(MODEL)

    @property
    def trajectory_classes(self) -> dict[str, Any]:
        """The classes of runs by their names."""
        return {"Trajectory": Trajectory}

    def load_run(self, file: File) -> Any:
        """Load a run, or a batch of runs, from an .npz file that `run.save` has written.

        Additional events of the run (its argument `events`) are compiled if needed. A warning is
        issued if the run is of another version of the scene.

        Parameters
        ----------
        file : str or path
            The .npz file.

        Returns
        -------
        Trajectory or BatchTrajectory

        Raises
        ------
        ValueError
            If the file is not a run of this scene, or is a batch and the module has no batches.
        OSError
            If the file cannot be read.
        """
        model, kind, arrays = saved.read(self, file)
        if (run_class := model.trajectory_classes.get(kind)) is None:
            raise ValueError(
                f"{file}: is a run of many at once: build the module with {option('batch')}"
            )
        return saved.from_arrays(run_class, model, arrays)
