"""Built modules: found by a key, built under a lock, loaded, unpickled.

A module lies in `build/<name>/`. Its extension carries a digest in its name, and `__init__.py`,
which says which extension is its own, is moved into place last: whatever interrupts a build, the
module that was there stays whole, and what fails is taken back. A file lock keeps builds of one
scene apart. The build of another version of the scene that it replaces is kept in
`build/<name>/.builds/`, where values that it has pickled find it.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shutil
import sys
import sysconfig
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from eomc.base import resources
from eomc.base.errors import EomcError, FolderError
from eomc.base.version import __version__
from eomc.toolchain.compiler import (
    MANY_OPERATIONS,
    STANDARD,
    compiler_for,
    flags,
    processor,
    standard,
)
from eomc.toolchain.lock import locked

if TYPE_CHECKING:
    from eomc.emit.render import Sources

MANIFEST = "build.json"
HALF = 32  # letters of a key
KEPT_BUILDS = 32  # of other versions of a scene, some 0.5 MB each: designs compared in one pool


@dataclass(frozen=True)
class Built:
    """A module on disk; `fresh` where it was built just now and not found; key: "" for any."""

    name: str
    folder: Path
    fresh: bool
    key: str = ""


class ReplacedError(EomcError):
    """Another build has taken a module's place before it was loaded."""


@lru_cache(maxsize=1)
def generator_digest() -> str:
    """What the generator is: its version and the text of all its parts."""
    total = hashlib.sha256(__version__.encode())
    for name, file in resources.parts():
        total.update(name.encode() + file.read_bytes())
    return total.hexdigest()


def key(scene_digest: str, form: str = "fast") -> str:
    """What a build depends on: scene, generator, flags, processor, and with these the compiler.

    Half is the digest of all of it, half that of all but the compiler. Raises EomcError where
    there is none.
    """
    small, large = compiler_for(0), compiler_for(MANY_OPERATIONS + 1)
    parts = _parts(scene_digest, form)
    return _total(*parts, small.identity, large.identity)[:HALF] + _total(*parts)[:HALF]


def key_there(folder: Path, scene_digest: str, form: str = "fast") -> str:
    """The key of the build in `folder` where it is whole and of this scene; else "".

    It may be another compiler's: for where there is none now.
    """
    try:
        there = _key(folder)
    except (OSError, ValueError, KeyError, TypeError):
        return ""
    same = there[HALF:] == _total(*_parts(scene_digest, form))[:HALF]
    return there if same and found(folder, there) else ""


def _parts(scene_digest: str, form: str) -> tuple[str, ...]:
    """All that a build depends on but the compiler."""
    return (
        scene_digest, form, generator_digest(), STANDARD, *flags(form), processor(), sys.version,
        str(sysconfig.get_config_var("EXT_SUFFIX")),
    )  # fmt: skip


def _total(*parts: str) -> str:
    # a variable of the environment may hold bytes that are no text
    return hashlib.sha256("\0".join(parts).encode(errors="surrogateescape")).hexdigest()


def found(folder: Path, wanted: str) -> bool:
    """Whether `folder` holds a whole build of this key: all of its files, each with its digest.

    A single bit that has changed in an extension may end the process that loads it.
    """
    try:
        manifest = _manifest(folder)
        files = manifest["files"]
        return (
            manifest["key"] == wanted
            and manifest["files_digest"] == _digest_of_files(files)
            and all(_digest(folder / name) == digest for name, digest in files.items())
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def _manifest(folder: Path) -> dict[str, Any]:
    """What the build in `folder` says of itself."""
    manifest: dict[str, Any] = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    return manifest


def _python_files_of(folder: Path) -> set[Path]:
    """Return the Python files of the build in `folder`; none if its manifest can't be read."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        names = [Path(file) for file in _manifest(folder)["files"]]
        own = (Path(), Path("_runtime"))  # a manifest that was tampered with may name any path
        return {folder / p for p in names if p.parent in own and p.suffix == ".py"}
    return set()


def _digest_of_files(files: dict[str, str]) -> str:
    """SHA-256 of a list of files and their digests: a list that lacks one is no build."""
    return hashlib.sha256(json.dumps(sorted(files.items())).encode()).hexdigest()


def _digest(file: Path) -> str:
    """SHA-256; some 0.3 ms for a small scene."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def build(
    name: str,
    wanted: str,
    sources: Callable[[str], Sources],
    root: Path,
    form: str = "fast",
    scene_digest: str = "",
) -> Built:
    """The module of one scene under `root`, built where it isn't there yet.

    wanted: the key. sources: makes the files, given the name of the extension; called only where
    something is to be built. form: of the C that it is compiled from. scene_digest: of the scene;
    a build of another one is kept, for what it has pickled.
    Raises EomcError where the compiler fails, with its own words, or the folder can't be written.
    """
    folder = place(name, root, form)
    root = folder.parent
    if found(folder, wanted):
        return Built(name, folder, False, wanted)
    try:
        root.mkdir(parents=True, exist_ok=True)
        with locked(root / f".{folder.name}.lock"):
            if found(folder, wanted):  # by another process, meanwhile
                return Built(name, folder, False, wanted)
            _free(folder)
            for left in root.glob(f".{folder.name}.build-*"):  # by a build that was killed
                shutil.rmtree(left, ignore_errors=True)
            with tempfile.TemporaryDirectory(dir=root, prefix=f".{folder.name}.build-") as new:
                _build(name, wanted, sources, folder, Path(new), form, scene_digest)
    except OSError as fault:
        raise FolderError(
            f"{fault.filename or folder}: can't be written ({fault.strerror})"
        ) from None
    return Built(name, folder, True, wanted)


def place(name: str, root: Path, form: str = "fast") -> Path:
    """The folder of a scene's module; that of the plain form, for comparison, lies inside it."""
    return root / name if form == "fast" else root / name / ".plain"


def _free(folder: Path) -> None:
    """An EomcError where a folder holds a package that no build made, or is none."""
    if folder.is_symlink() or folder.exists():
        if not folder.is_dir():
            raise EomcError(f"{folder}: is in the way of the module: remove it, or use --build DIR")
        ours = (folder / "_runtime").is_dir() or (folder / MANIFEST).exists()
        if (folder / "__init__.py").exists() and not ours:
            raise EomcError(
                f"{folder}: is a package that eomc did not build, and stays as it is: "
                "rename the scene, or use --build DIR"
            )


def _build(
    name: str,
    wanted: str,
    sources: Callable[[str], Sources],
    folder: Path,
    new: Path,
    form: str,
    scene_digest: str,
) -> None:
    from eomc.toolchain import extension
    from eomc.toolchain.subprocesses import write_files

    called = f"_{name}_{wanted[:12]}"
    made = sources(called)
    write_files(made.files, new)
    library = called + str(sysconfig.get_config_var("EXT_SUFFIX"))
    compiler = compiler_for(made.operations)
    extension.build(made, called, new, library, compiler, form)
    kept = [library, *(f for f in made.files if form == "fast" or f.endswith(".py"))]
    files = {file: _digest(new / file) for file in kept}
    manifest = {
        "key": wanted,
        "name": name,
        "scene": scene_digest,
        "eomc": __version__,
        "compiler": " ".join(compiler.command),
        "flags": " ".join((standard(form), *flags(form))),
        "files": files,
        "files_digest": _digest_of_files(files),
    }
    (new / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    for file in kept:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
    _keep(folder, scene_digest, new / ".kept")
    stale = [p for p in folder.glob(f"_{name}_*") if p.name != library]
    stale += _python_files_of(folder) - {folder / file for file in kept}
    # the face last: until it is there, the old one is whole; the manifest after it
    _move(new, folder, [*(f for f in kept if f != "__init__.py"), "__init__.py", MANIFEST])
    for path in stale:
        path.unlink(missing_ok=True)


def _keep(folder: Path, scene_digest: str, links: Path) -> None:
    """Keep the build in `folder`, if it is of another version of the scene, in its `.builds`.

    links: where its files are put together. The oldest of more than KEPT_BUILDS are removed. A
    build that can't be kept is left out: values that it has pickled are refused then.
    """
    with suppress(OSError, ValueError, KeyError, TypeError):
        manifest = _manifest(folder)
        key = str(manifest["key"])
        place = _place_of_kept(folder, key)
        if manifest["scene"] == scene_digest or found(place, key) or not found(folder, key):
            return
        for file in (*manifest["files"], MANIFEST):
            _also_at(folder / file, links / file)
        shutil.rmtree(place, ignore_errors=True)
        place.parent.mkdir(exist_ok=True)
        os.replace(links, place)
        dated = sorted((p.stat().st_mtime, p) for p in place.parent.iterdir())
        for _, old in dated[:-KEPT_BUILDS]:
            shutil.rmtree(old, ignore_errors=True)


def _place_of_kept(folder: Path, key: str) -> Path:
    """Where the build of this key lies, once another has replaced it in `folder`."""
    return folder / ".builds" / key[:12]


def _move(new: Path, folder: Path, files: list[str]) -> None:
    """Move files into place, in their order; where that fails, those there before are there again.

    Not where the process is killed: the next build mends that.
    """
    there = {file: _also_at(folder / file, new / ".old" / file) for file in files}
    try:
        for file in files:
            _date_later(new / file, folder / file)
            os.replace(new / file, folder / file)
    except BaseException:  # Ctrl-C too
        for file in reversed(files):
            with suppress(OSError):  # the others all the same
                if there[file]:
                    os.replace(new / ".old" / file, folder / file)
                else:
                    (folder / file).unlink(missing_ok=True)
        raise


def _also_at(file: Path, other: Path) -> bool:
    """Whether a file is there; it is then also at another place, by a link if that can be."""
    if not file.exists():
        return False
    other.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(file, other)
    except OSError:  # file systems without, or that are full of them
        shutil.copy2(file, other)
    return True


def _date_later(new: Path, old: Path) -> None:
    """Date a file at least a second later than the one that it replaces.

    Python knows the source of kept bytecode by its second and its size: else the old one's ran.
    """
    if not old.is_file():
        return
    before = old.stat().st_mtime
    if int(new.stat().st_mtime) <= int(before):
        os.utime(new, (before + 1, before + 1))


def load(built: Built, home: str = "") -> ModuleType:
    """Import a built module, whatever else bears its name; the same build gives the same module.

    home: the folder of builds of this scene, where that is another. Raises ReplacedError where
    another build has replaced it.
    """
    folder = built.folder.resolve()  # Python caches finders by path, whatever the current folder
    key = _key(folder)
    replaced = ReplacedError(
        f"{folder}: other builds of a scene of this name replace the module while it is loaded: "
        "rename the scene, or use --build DIR"
    )
    if built.key not in ("", key):
        raise replaced
    alias = _alias(built.name, key)
    if alias in sys.modules:
        return sys.modules[alias]
    spec = importlib.util.spec_from_file_location(
        alias, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[alias] = module
    try:
        spec.loader.exec_module(module)
        if f"{alias}._{built.name}_{key[:12]}" not in sys.modules:  # another face was read
            raise replaced
    except BaseException as fault:
        del sys.modules[alias]
        if isinstance(fault, Exception) and _key(folder) != key:
            raise replaced from None
        raise
    # another process can't import the alias; what is pickled here is found by its place there
    place = (built.name, home or str(folder), key)
    sys.modules[f"{alias}._runtime.package"].found_by = (unpickled, place)  # type: ignore[attr-defined]
    return module


def _alias(name: str, key: str) -> str:
    """What the module of a build is called in `sys.modules`."""
    return f"_eomc_{name}_{key[:12]}"


def _key(folder: Path) -> str:
    """Of the build that lies there now."""
    return str(_manifest(folder)["key"])


def unpickled(
    place: tuple[str, str, str], identity: tuple[Any, ...], path: str, arguments: tuple[Any, ...]
) -> Any:
    """A value that was pickled by a module that `load` had imported; pickle calls this.

    place: the name of the scene, the folder of its builds, and the key of the one that pickled.
    A pool of processes waits for ever where a task can't be read, so nothing is raised here: what
    can't be read is an `Unreadable`, which raises EomcError when it is used.
    """
    from eomc.runtime import status
    from eomc.runtime.package import Unreadable

    name, folder, _ = place
    try:
        package = importlib.import_module(f"{_build_of(place).__name__}._runtime.package")
        why = package.refusal(identity, path)
        if not why:
            return package.made(path, arguments)
        why = f"{folder}: {why}"
    except Exception as fault:  # whatever it is, a pool would wait
        if path.startswith("status."):
            return getattr(status, path.removeprefix("status."))(*arguments)
        lacking = isinstance(fault, (OSError, KeyError))
        cause = "" if lacking else f" ({type(fault).__name__}: {fault})"
        why = (
            f"{folder}: the build of {name} that pickled this is gone{cause}: build the scene "
            "again, and pickle anew"
        )
    return Unreadable(why, EomcError, (unpickled, (place, identity, path, arguments)))


def _build_of(place: tuple[str, str, str]) -> ModuleType:
    """The module of the build at a place, also where another has replaced it; else that other."""
    name, folder, key = place
    if (loaded := sys.modules.get(_alias(name, key))) is not None:
        return loaded
    for there in (Path(folder), _place_of_kept(Path(folder), key), Path(folder)):
        # another process may replace it just now: then it is kept, or the other is looked at
        if found(there, key):
            with suppress(ReplacedError, OSError):
                return load(Built(name, there, False, key), folder)
    return load(Built(name, Path(folder), False))
