"""The whole way from a scene to a module, an arrow a function.

    scene.toml -> Scene -> System -> Equations -> Program -> Sources -> Module

`load` goes the whole way; `sources` stops at the text. Each arrow is a function of one module:
scene.read, system.from_scene, lagrange.derive, program.build, render.render, cache.build.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Literal

from eomc.base.errors import EomcError

if TYPE_CHECKING:
    from eomc.base.errors import Problem
    from eomc.emit.render import Sources
    from eomc.model.system import System
    from eomc.toolchain.cache import Built


ScenePath = str | os.PathLike[str]


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
    from eomc.model.from_scene import from_scene
    from eomc.scene import read as scenes

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
    from eomc.derive import lagrange
    from eomc.emit import render
    from eomc.program import program

    if isinstance(system, (str, os.PathLike)):
        raise EomcError(f"give a System, such as eomc.read({str(system)!r})")
    derived = program.build(lagrange.derive(system))
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
    from eomc.toolchain import cache

    _refuse_other(scene, root)
    if not isinstance(scene, (str, os.PathLike)):
        made, name, digest = scene, scene.name, scene.digest
    else:
        made = None
        name, digest = name_and_digest(Path(scene))
    wanted = cache.key(digest, form)
    if name and cache.found(folder := cache.place(name, Path(root), form), wanted):
        return cache.Built(name, folder, False)
    if made is None:
        assert isinstance(scene, (str, os.PathLike))
        made = read(scene)

    def texts(extension: str) -> Sources:
        return sources(made, extension, warn=warn)

    return cache.build(made.name, wanted, texts, Path(root), form)


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
    from eomc.toolchain import cache

    module = cache.load(build(scene, root, form=form, warn=warn))
    # what pictures are made from
    own = Path(os.path.abspath(scene)) if isinstance(scene, (str, os.PathLike)) else scene
    module._model.source = own
    return module


def name_and_digest(path: Path) -> tuple[str, str]:
    """What a scene is called and the digest of its text, without checking it; no SymPy."""
    from eomc.scene.toml_text import tree_and_digest

    try:
        tree, digest = tree_and_digest(path)
    except (OSError, ValueError):
        return "", ""  # the reader says what is wrong
    name = tree.get("name", "")
    return name if isinstance(name, str) and name.isidentifier() else "", digest
