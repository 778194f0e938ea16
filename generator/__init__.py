"""eomc, the equations-of-motion compiler: from energies to fast, checked C.

    scene.toml -> Scene -> System -> Equations -> Program -> Sources -> Module

`load` goes the whole way; `sources` stops at the text. Each arrow is a function of one module:
scene.read, system.from_scene, mechanics.derive, program.build, render.render, compile.build.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

from eomc.problems import EomcError, SceneError

if TYPE_CHECKING:
    from eomc.compile import Built
    from eomc.problems import Problem
    from eomc.render import Sources
    from eomc.system import System

__version__ = "0.1.0"
__all__ = ["EomcError", "SceneError", "System", "build", "load", "read", "sources"]

ScenePath = str | os.PathLike[str]


def __getattr__(name: str) -> Any:
    """System, imported when it is asked for: SymPy takes half a second."""
    if name == "System":
        from eomc.system import System

        return System
    raise AttributeError(f"module 'eomc' has no attribute {name!r}")


@contextmanager
def _garbage_kept() -> Iterator[None]:
    """No search for cycles: a derivation makes hundreds of thousands of values and hardly a cycle.

    The search takes an eighth of the time, and a humanoid's build is no larger without it.
    """
    on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()


@_garbage_kept()
def read(scene: ScenePath) -> System:
    """The checked scene as a SymPy system. Raises SceneError with every fault."""
    from eomc import scene as scenes
    from eomc.system import from_scene

    _refuse_other(scene, "")
    if not isinstance(scene, (str, os.PathLike)):
        raise EomcError(f"give the path of a scene, here {scene!r}")
    return from_scene(scenes.read(scene))


@_garbage_kept()
def sources(
    system: System,
    extension: str = "_extension",
    *,
    warn: Callable[[Problem], None] | None = None,
) -> Sources:
    """The generated files of a system, as text. warn is called with each warning."""
    from eomc import mechanics, program, render

    if isinstance(system, (str, os.PathLike)):
        raise EomcError(f"give a System, such as eomc.read({str(system)!r})")
    derived = program.build(mechanics.derive(system))
    for problem in (*system.warnings, *program.inertia(derived)):
        if warn is not None:
            warn(problem)
    return render.render(derived, extension)


def build(
    scene: ScenePath | System,
    root: ScenePath = "build",
    *,
    form: Literal["fast", "plain"] = "fast",
    warn: Callable[[Problem], None] | None = None,
) -> Built:
    """The compiled module of a scene file or a System, in `root`/<name>/.

    Nothing is derived or compiled where nothing has changed. form: of the C that it is compiled
    from; that from "plain" is for comparison and lies in `root`/<name>/.plain/. warn is called with
    each warning.
    Raises SceneError for a faulty scene, EomcError for what else fails.
    """
    from eomc import compile as compiler

    _refuse_other(scene, root)
    if not isinstance(scene, (str, os.PathLike)):
        made, name, digest = scene, scene.name, scene.digest
    else:
        made = None
        name, digest = name_and_digest(Path(scene))
    wanted = compiler.key(digest, form)
    if name and compiler.found(folder := compiler.place(name, Path(root), form), wanted):
        return compiler.Built(name, folder, False)
    if made is None:
        assert isinstance(scene, (str, os.PathLike))
        made = read(scene)

    def texts(extension: str) -> Sources:
        return sources(made, extension, warn=warn)

    return compiler.build(made.name, wanted, texts, Path(root), form)


def _refuse_other(scene: object, root: object) -> None:
    """Raise EomcError where one is neither a path nor a System."""
    paths = (str, os.PathLike)
    if not isinstance(root, paths):
        raise EomcError(f"root: give the path of a folder, here {root!r}")
    if not isinstance(scene, paths) and not (hasattr(scene, "digest") and hasattr(scene, "q")):
        raise EomcError(f"give the path of a scene, or a System, here {scene!r}")
    if isinstance(scene, str) and (not scene or "\n" in scene):
        raise EomcError("give the path of a scene, not its text: write the text to a file")


def load(
    scene: ScenePath | System,
    root: ScenePath = "build",
    *,
    form: Literal["fast", "plain"] = "fast",
    warn: Callable[[Problem], None] | None = None,
) -> ModuleType:
    """The compiled module of a scene, built where it is not there yet, imported. As `build`.

    >>> cartpole = load("scenes/cartpole.toml")     # doctest: +SKIP
    >>> cartpole.simulate(duration=1.0).q[-1]       # doctest: +SKIP
    """
    from eomc import compile as compiler

    return compiler.load(build(scene, root, form=form, warn=warn))


def name_and_digest(path: Path) -> tuple[str, str]:
    """What a scene is called and the digest of its text, without checking it; no SymPy."""
    from eomc.tomltext import tree_and_digest

    try:
        tree, digest = tree_and_digest(path)
    except (OSError, ValueError):
        return "", ""  # the reader tells what is wrong
    name = tree.get("name", "")
    return name if isinstance(name, str) and name.isidentifier() else "", digest
