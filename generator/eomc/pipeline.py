"""The stages from a scene to a module; each arrow is a function.

    scene.toml -> Scene -> System -> Equations -> Program -> Sources -> Module

`load` runs all stages; `sources` stops at the text. The arrows are the functions scene.read.read,
model.system.from_scene, derive.lagrange.derive, program.program.build, emit.render.render and
toolchain.cache.build.
"""

from __future__ import annotations

import gc
import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

from eomc.base.errors import EomcError, NoCompilerError
from eomc.runtime.package import model_of

if TYPE_CHECKING:
    from eomc.base.errors import Problem, SceneError
    from eomc.emit.fmu import Unit
    from eomc.emit.render import Sources
    from eomc.model.system import System
    from eomc.program.program import Program
    from eomc.toolchain.archives import Exported
    from eomc.toolchain.cache import Built


ScenePath = str | os.PathLike[str]
LOADS = 5  # attempts while other builds replace the module


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Disable the garbage collector: a derivation allocates many objects and hardly any cycles.

    The collector takes an eighth of the time; without it a humanoid's build needs no more memory.
    """
    on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()


@_without_garbage_collection()
def read(scene: ScenePath) -> System:
    """Read a scene file and return it as a System of SymPy expressions.

    scene: path of the TOML file that describes the mechanical system. If the system has
    constraints, initial values that are not fixed are adjusted to satisfy them. Raises SceneError,
    which lists all problems of the scene, if the scene is invalid.
    """
    from eomc.model.system import from_scene
    from eomc.scene import read as scenes

    _refuse_other(scene, "")
    if not isinstance(scene, (str, os.PathLike)):
        raise EomcError(f"give the path of a scene, here {scene!r}")
    return assemble(from_scene(scenes.read(scene)))


def assemble(system: System) -> System:
    """Return a system with initial values that satisfy its constraints, if it has any."""
    if not system.constraints:
        return system
    from eomc.mechanism import assembly

    return assembly.assembled(system)


@_without_garbage_collection()
def sources(
    system: System,
    extension: str = "_extension",
    *,
    warn: Callable[[Problem], None] | None = None,
) -> Sources:
    """Generate the C and Python files of the Python module of a system; return their texts.

    No file is written. extension: name of the compiled extension module that the Python files
    import. warn: function that is called with each warning; by default warnings are discarded.
    """
    from eomc.emit import render

    return render.render(_program(system, warn), extension)


def _program(system: System, warn: Callable[[Problem], None] | None) -> Program:
    from eomc.derive import lagrange
    from eomc.program import program

    if isinstance(system, (str, os.PathLike)):
        raise EomcError(f"give a System, such as eomc.read({str(system)!r})")
    system = assemble(system)
    derived = program.build(lagrange.derive(system))
    for problem in (
        *system.warnings,
        *program.inertia(derived),
        *program.unused_parameters(derived),
    ):
        if warn is not None:
            warn(problem)
    return derived


@_without_garbage_collection()
def unit(system: System, fmi: int = 2, *, warn: Callable[[Problem], None] | None = None) -> Unit:
    """Generate the files of an FMU (Functional Mock-up Unit) of a system and return their text.

    fmi: version of the FMI standard, 2 or 3. warn: function that is called with each warning; by
    default warnings are discarded. Raises EomcError for another version.
    """
    from eomc.emit import render

    if fmi not in (2, 3):
        raise EomcError(f"fmi: give the version of FMI, 2 or 3, here {fmi!r}")
    return render.unit(_program(system, warn), fmi)


def export_fmu(
    scene: ScenePath | System,
    out: ScenePath | None = None,
    fmi: int = 2,
    *,
    binary: bool = True,
    warn: Callable[[Problem], None] | None = None,
) -> Exported:
    """Export a scene file or a System as an FMU file; return its path and what it contains.

    Parameters
    ----------
    scene
        Path of the TOML file, or a System.
    out
        File to write; an existing file is replaced. By default <name of the scene>.fmu in the
        current folder.
    fmi
        Version of the FMI standard, 2 or 3.
    binary
        Whether to add a binary for this machine to the C sources. Without a compiler, the FMU
        contains the sources only.
    warn
        Function that is called with each warning; by default warnings are discarded.

    Raises
    ------
    SceneError
        If the scene is invalid.
    EomcError
        If anything else fails.
    """
    from eomc.toolchain import archives

    _refuse_other(scene, "" if out is None else out)
    fmu_files = unit(
        read(scene) if isinstance(scene, (str, os.PathLike)) else scene, fmi, warn=warn
    )
    return archives.write_fmu(
        fmu_files, Path(f"{fmu_files.name}.fmu" if out is None else out), binary
    )


def export(
    scene: ScenePath | System,
    library: str,
    folder: ScenePath | None = None,
    *,
    h: float | None = None,
    warn: Callable[[Problem], None] | None = None,
) -> Path:
    """Export a scene or a System as a package for a library of optimisation; return its folder.

    Parameters
    ----------
    scene
        Path of the TOML file, or a System.
    library
        "casadi": accelerations as symbolic expressions in Python; accelerations and steps as
        compiled external functions with derivatives. "jax", "torch": accelerations and steps of
        many states as differentiable functions.
    folder
        Folder of the package, by default <name of the scene>_<library> in the current folder. Files
        that eomc did not write are not replaced.
    h
        Step size of exported steps, s; by default that of the scene.
    warn
        Function that is called with each warning; by default warnings are discarded.

    Raises
    ------
    SceneError
        If the scene is invalid, or has events or no derivatives.
    EomcError
        If anything else fails.
    """
    from eomc.emit import exports, render
    from eomc.toolchain.files import write_c_folder

    _refuse_other(scene, "" if folder is None else folder)
    if library not in exports.LIBRARIES:
        raise EomcError(f"give one of {', '.join(exports.LIBRARIES)}, here {library!r}")
    system = read(scene) if isinstance(scene, (str, os.PathLike)) else scene
    system = exports.differentiable(system, library, h)
    program = _program(system, warn)
    folder = Path(f"{system.name}_{library}" if folder is None else folder)
    texts = render.export_package(program, library)
    write_c_folder(texts, folder)
    if library == "casadi":
        _write_library(f"{system.name}_{library}", texts, program, folder, warn)
    else:
        build(system, folder, warn=None)
    return folder


def _write_library(
    name: str, texts: Mapping[str, str], program: Program, folder: Path,
    warn: Callable[[Problem], None] | None,
) -> None:  # fmt: skip
    """Compile the C files among `texts` to a shared library `name` in a folder.

    Without a compiler a warning is issued.
    """
    from eomc.base.errors import Problem, writing
    from eomc.program.outline import weight
    from eomc.runtime.atomic_write import atomic_write
    from eomc.toolchain import compiler

    sources = [file for file in texts if file.endswith(".c")]
    try:
        chosen = compiler.compiler_for(sum(map(weight, program.functions.values())))
    except NoCompilerError as fault:
        if warn is not None:
            warn(Problem(f"sources only: {fault}", severity="warning"))
        return
    binary = compiler.compile_library(chosen, name, texts, sources, f"{program.system.name}_ode")
    file = folder / f"{name}{compiler.SUFFIX}"
    with writing(file), atomic_write(file) as new:
        new.write_bytes(binary)


def build(
    scene: ScenePath | System,
    root: ScenePath = "build",
    *,
    form: Literal["fast", "plain"] = "fast",
    warn: Callable[[Problem], None] | None = None,
) -> Built:
    """Build the compiled Python module of a scene and return the name and folder of the build.

    If the folder contains an up-to-date build, nothing is compiled.

    Parameters
    ----------
    scene
        Path of the TOML file, or a System.
    root
        Folder of all builds. The module of the scene is written to `root`/<name of the scene>/.
    form
        "fast": optimised C. "plain": portable C, for comparison, in the subfolder .plain/.
    warn
        Function that is called with each warning; by default warnings are discarded.

    Raises
    ------
    SceneError
        If the scene is invalid.
    EomcError
        If anything else fails.
    """
    from eomc.toolchain import cache

    _refuse_other(scene, root)
    if not isinstance(scene, (str, os.PathLike)):
        from eomc.model.mechanics import Mechanics

        # dataclasses.replace does not change the digest of a System, so all fields are digested
        system, name = scene, scene.name
        digest = hashlib.sha256(f"{scene.digest} {Mechanics.__repr__(scene)}".encode()).hexdigest()
    else:
        system = None
        name, digest = name_and_digest(Path(scene))
    folder = cache.build_folder(name, Path(root), form)
    try:
        key = cache.key(digest, form)
    except NoCompilerError:
        if name and (there := cache.find_valid_key(folder, digest, form)):
            return cache.Built(name, folder, False, there)
        raise
    if name and cache.is_built(folder, key):
        return cache.Built(name, folder, False, key)
    if system is None:
        assert isinstance(scene, (str, os.PathLike))
        system = read(scene)

    def texts(extension: str) -> Sources:
        _tell_preparing(warn)
        return sources(system, extension, warn=warn)

    return cache.build(system.name, key, texts, Path(root), form, digest)


def write_c(
    scene: ScenePath,
    folder: ScenePath,
    prefix: str | None = None,
    *,
    warn: Callable[[Problem], None] | None = None,
) -> dict[str, str]:
    """Write the C files of a scene into `folder`; return a dict from file name to text.

    No compiler is called. prefix: beginning of all C names and file names, by default the name of
    the scene. warn: function that is called with each warning. Raises SceneError if the scene is
    invalid and EomcError if anything else fails.
    """
    from dataclasses import replace

    from eomc.base import names
    from eomc.toolchain.files import write_c_folder

    if prefix is not None and (why := names.module_fault(prefix)):
        raise EomcError(f"--prefix: {why}")
    system = read(scene)
    system = system if prefix is None else replace(system, name=prefix)
    files = sources(system, warn=warn).embeddable
    write_c_folder(files, Path(folder))
    return files


def write_wheel(
    scene: ScenePath, folder: ScenePath, *, warn: Callable[[Problem], None] | None = None
) -> Path:
    """Compile the module of a scene file into a wheel in `folder`; return the path of the wheel.

    warn: function that is called with each warning. Raises SceneError if the scene is invalid and
    EomcError if anything else fails.
    """
    from eomc.toolchain import archives

    system = read(scene)
    text = Path(scene).read_bytes()
    _tell_preparing(warn)
    return archives.write_wheel(
        sources(system, archives.COMPILED, warn=warn),
        text,
        system.digest,
        system.title,
        Path(folder),
    )


def _tell_preparing(warn: Callable[[Problem], None] | None) -> None:
    """Call `warn` with a note if the first call of the compiler takes long."""
    from eomc.base.errors import Problem
    from eomc.toolchain.compiler import first_call_note

    if warn is not None and (why := first_call_note()):
        warn(Problem(why, severity="note"))


def _refuse_other(scene: object, root: object) -> None:
    """Raise EomcError if `scene` is neither a path nor a System, or `root` is not a path."""
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
    """Build the compiled module of a scene if necessary, import it and return it.

    The arguments are those of `build`.

    >>> cartpole = load("scenes/cartpole.toml")     # doctest: +SKIP
    >>> cartpole.simulate(duration=1.0).q[-1]       # doctest: +SKIP
    """
    from eomc.toolchain import cache

    for tries in range(1, LOADS + 1):
        try:
            module = cache.load(build(scene, root, form=form, warn=warn))
            break
        except cache.ReplacedError:
            if tries == LOADS:
                raise
    # the model draws pictures of its scene
    own = Path(os.path.abspath(scene)) if isinstance(scene, (str, os.PathLike)) else scene
    model_of(module).source = own
    return module


def with_events(model: Any, events: Mapping[str, Any], folder: Path) -> ModuleType:
    """Build and import the Python module of a model with additional events; return the module.

    Parameters
    ----------
    model
        Model of an imported module; its attribute `source` is the path of its scene or its System.
    events
        Mapping from the name of each new event to its event function as a formula, or to a dict
        with the keys of [[event]] in a scene. If the model was made from a System, the argument
        `events` of System.make.
    folder
        Folder in whose subfolder .events/ the build is written.

    Raises
    ------
    SceneError
        If an event is invalid.
    EomcError
        If the scene is missing or has changed since the model was built.
    """
    from eomc.base.errors import SceneError, writing
    from eomc.runtime.atomic_write import atomic_write
    from eomc.scene import read as scenes
    from eomc.scene import toml_text

    name, source, what = model.info.name, model.source, "simulate(events=)"
    if source is None:
        raise EomcError(f"{what}: {name} was imported without its scene: load it with eomc.load")
    if not isinstance(source, Path) and source.file and read(source.file) == source:
        source = Path(source.file)
    if not isinstance(source, Path):
        system = _add_events(source, events, what)
        return load(system, folder / ".events" / system.digest[:16])
    try:
        data = source.read_bytes()
    except OSError as fault:
        raise EomcError(f"{what}: {source}: can't be read ({fault.strerror})") from None
    if hashlib.sha256(data).hexdigest() != model.info.digest:
        raise EomcError(f"{what}: {source} has changed since it was built: load it again")
    text = data.decode() + toml_text.events_to_toml(events, what)
    root = folder / ".events" / hashlib.sha256(text.encode()).hexdigest()[:16]
    file = root / f"{name}.toml"
    if not file.is_file():
        try:
            scenes.parse(text, what)
        except SceneError as wrong:
            raise _name_events(wrong, len(model.info.events), events) from None
        with writing(f"{what}: {file}"):
            root.mkdir(parents=True, exist_ok=True)
            with atomic_write(file) as new:
                new.write_text(text, encoding="utf-8")
    return load(file, root)


def _add_events(system: System, events: Mapping[str, Any], what: str) -> System:
    """Return the system that System.make returns with additional events."""
    from dataclasses import replace

    from eomc.base.errors import SceneError

    remedy = f"{what}: {system.name} was changed since System.make made it: give that its events"
    if not isinstance(events, Mapping):
        raise EomcError(f'{what}: give a dict, such as {{"section": "x"}}, here {events!r}')
    if system.again is None or system.again() != system:
        raise EomcError(remedy)
    own = system.again.keywords["events"] or {}
    if double := sorted({*map(str, own)} & {*map(str, events)}):
        raise EomcError(f"{what}: event {double[0]}: '{double[0]}' is an event already: rename it")
    try:
        extended: System = system.again(events={**own, **events})
        return extended
    except SceneError as wrong:
        raise SceneError([replace(p, file=what) for p in wrong.problems]) from None


def _name_events(wrong: SceneError, own: int, events: Mapping[str, Any]) -> SceneError:
    """Replace the numbers of events in problems by names; `own` events of the scene come first."""
    from dataclasses import replace

    names = {f"event.{own + k}": str(called) for k, called in enumerate(events, start=1)}
    return type(wrong)(
        [
            replace(p, line=0, column=-1, source="", key=_rename_key(p.key, names))
            for p in wrong.problems
        ]
    )


def _rename_key(key: str, names: Mapping[str, str]) -> str:
    """Return the key of an event with its name in place of its number."""
    start = ".".join(key.split(".")[:2])
    return names.get(start, start) + key[len(start) :]


def name_and_digest(path: Path) -> tuple[str, str]:
    """Return the name of a scene file and the digest of its text, without checking the scene.

    The digest is the SHA-256 hash of the file. Both are "" if the file cannot be read or is not
    TOML. The name is "" if the scene's entry `name` is not an identifier.
    """
    from eomc.scene.toml_text import tree_and_digest

    try:
        tree, digest = tree_and_digest(path)
    except (OSError, EomcError):
        return "", ""  # the reader says what is wrong
    name = tree.get("name", "")
    return name if isinstance(name, str) and name.isidentifier() else "", digest
