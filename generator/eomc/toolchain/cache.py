"""Cache of built modules: look-up by key, build under a lock, import, unpickling; cached texts.

A module lies in `build/<name>/`. The name of its extension contains a digest, and `__init__.py`,
which imports that extension, is moved into place last: if a build is interrupted, the old module
stays complete; if it fails, its files are removed again. A file lock serialises the builds of a
scene. A build that replaces one of another version of the scene archives the old one in
`build/<name>/.builds/`, so that pickled values of that version can still be loaded.

Texts that take SymPy seconds to produce, such as the printed equations, are stored in
`build/.shown/` until the scene, eomc or SymPy changes.
"""

from __future__ import annotations

import errno
import hashlib
import importlib.util
import json
import os
import shutil
import stat
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from eomc.base.errors import EomcError, FolderError
from eomc.base.resources import __version__, generator_digest
from eomc.runtime.atomic_write import atomic_write
from eomc.toolchain.compiler import (
    MANY_OPERATIONS,
    STANDARD,
    compiler_for,
    flags,
    processor,
    standard,
)

if TYPE_CHECKING:
    from eomc.emit.render import Sources

MANIFEST = "build.json"
HALF_KEY_LENGTH = 32  # characters
MAX_ARCHIVED_BUILDS = 32  # of other versions of a scene, about 0.5 MB each


@dataclass(frozen=True)
class Built:
    """A built Python module on disk.

    Attributes
    ----------
    name
        Name of the scene.
    folder
        Folder with the files of the module.
    fresh
        Whether the module was built just now rather than found on disk.
    key
        Key of the build, a text that changes with the scene, eomc and the compiler; see the
        function `key`. "" if any build in `folder` may be imported.
    """

    name: str
    folder: Path
    fresh: bool
    key: str = ""


class ReplacedError(EomcError):
    """Error: another build replaced the compiled module on disk before it was loaded."""


def key(scene_digest: str, form: str = "fast") -> str:
    """Return the key of a build: text that changes if anything changes that the build depends on.

    The first half of the text is a digest of scene, eomc, Python, compiler flags, processor and
    compiler. The second half is a digest of the same without the compiler.

    scene_digest: digest of the scene's text. form: "fast" for optimised C, "plain" for portable C.
    Raises EomcError if there is no compiler.
    """
    small, large = compiler_for(0), compiler_for(MANY_OPERATIONS + 1)
    parts = _parts(scene_digest, form)
    return (
        _digest_of_parts(*parts, small.identity, large.identity)[:HALF_KEY_LENGTH]
        + _digest_of_parts(*parts)[:HALF_KEY_LENGTH]
    )


def find_valid_key(folder: Path, scene_digest: str, form: str = "fast") -> str:
    """Return the key of the build in `folder` if it is complete and up to date; otherwise "".

    It is up to date if scene, eomc, Python, flags and processor are the same as now. The compiler
    may differ, so that machines without a compiler can use the build.

    scene_digest: digest of the scene's text. form: "fast" for optimised C, "plain" for portable C.
    """
    try:
        there = _key(folder)
    except (OSError, ValueError, KeyError, TypeError):
        return ""
    same = (
        there[HALF_KEY_LENGTH:] == _digest_of_parts(*_parts(scene_digest, form))[:HALF_KEY_LENGTH]
    )
    return there if same and is_built(folder, there) else ""


def _parts(scene_digest: str, form: str) -> tuple[str, ...]:
    """Return everything that a build depends on except the compiler."""
    return (
        scene_digest, form, generator_digest(), STANDARD, *flags(form), processor(), sys.version,
        str(sysconfig.get_config_var("EXT_SUFFIX")),
    )  # fmt: skip


def _digest_of_parts(*parts: str) -> str:
    # environment variables may contain bytes that are not UTF-8
    return hashlib.sha256("\0".join(parts).encode(errors="surrogateescape")).hexdigest()


def is_built(folder: Path, build_key: str) -> bool:
    """Return True if `folder` contains the complete build with the key `build_key`.

    The files are compared with the digests stored at the build, since loading a corrupt extension
    module may crash the process.
    """
    try:
        manifest = _manifest(folder)
        files = manifest["files"]
        return (
            manifest["key"] == build_key
            and manifest["files_digest"] == _digest_of_files(files)
            and all(_digest(folder / name) == digest for name, digest in files.items())
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def _manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of the build in `folder`."""
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
    """Return the SHA-256 of a manifest's list of files, which detects an incomplete list."""
    return hashlib.sha256(json.dumps(sorted(files.items())).encode()).hexdigest()


def _digest(file: Path) -> str:
    """Return the SHA-256 of a file; about 0.3 ms for a small scene."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def build(
    name: str,
    build_key: str,
    sources: Callable[[str], Sources],
    root: Path,
    form: str = "fast",
    scene_digest: str = "",
) -> Built:
    """Build the module of a scene in a folder below `root`, unless that build is there already.

    Return where the module is on disk; it is not imported.

    Parameters
    ----------
    name
        Name of the scene.
    build_key
        Text that identifies the build, as returned by `key`.
    sources
        Function that returns the generated files, given the name of the extension module; it is
        called only if the module must be built.
    root
        Folder that contains the folders of all scenes.
    form
        "fast" to compile the optimised C, "plain" for the portable C.
    scene_digest
        Digest of the scene's text. If an older build in the folder has another digest, it is
        archived, so that values pickled by its module can still be loaded.

    Raises
    ------
    EomcError
        With the compiler's message if it fails, or if the folder can't be written.
    """
    folder = build_folder(name, root, form)
    root = folder.parent
    if is_built(folder, build_key):
        return Built(name, folder, False, build_key)
    try:
        root.mkdir(parents=True, exist_ok=True)
        with hold_lock(root / f".{folder.name}.lock"):
            if is_built(folder, build_key):  # by another process, meanwhile
                return Built(name, folder, False, build_key)
            _check_folder_is_free(folder)
            for left in root.glob(f".{folder.name}.build-*"):  # by a build that was killed
                shutil.rmtree(left, ignore_errors=True)
            with tempfile.TemporaryDirectory(dir=root, prefix=f".{folder.name}.build-") as new:
                _build(name, build_key, sources, folder, Path(new), form, scene_digest)
    except OSError as fault:
        raise FolderError(
            f"{fault.filename or folder}: can't be written ({fault.strerror})"
        ) from None
    return Built(name, folder, True, build_key)


def build_folder(name: str, root: Path, form: str = "fast") -> Path:
    """Return the folder of the module of a scene: `root`/`name`, or a subfolder of it.

    form: "fast" for the module of optimised C; "plain" for that of portable C, which is in the
    subfolder .plain.
    """
    return root / name if form == "fast" else root / name / ".plain"


def _check_folder_is_free(folder: Path) -> None:
    """Raise EomcError if `folder` is a file, or a package that was not built by eomc."""
    if folder.is_symlink() or folder.exists():
        if not folder.is_dir():
            raise EomcError(f"{folder}: is in the way of the module: remove it, or use --build DIR")
        # files that builds of this version and of the first one have, and moved before __init__.py
        is_build = any((folder / file).exists() for file in ("_runtime/package.py", "slices.py"))
        if (folder / "__init__.py").exists() and not is_build:
            raise EomcError(
                f"{folder}: is a package that eomc did not build, and stays as it is: "
                "rename the scene, or use --build DIR"
            )


def _build(
    name: str,
    build_key: str,
    sources: Callable[[str], Sources],
    folder: Path,
    new: Path,
    form: str,
    scene_digest: str,
) -> None:
    from eomc.toolchain import extension
    from eomc.toolchain.files import write_files

    extension_name = f"_{name}_{build_key[:12]}"
    rendered = sources(extension_name)
    write_files(rendered.files, new)
    library = extension_name + str(sysconfig.get_config_var("EXT_SUFFIX"))
    compiler = compiler_for(rendered.operations)
    extension.build(rendered, extension_name, new, library, compiler, form)
    shipped = [library, *(f for f in rendered.files if form == "fast" or f.endswith(".py"))]
    files = {file: _digest(new / file) for file in shipped}
    manifest = {
        "key": build_key,
        "name": name,
        "scene": scene_digest,
        "eomc": __version__,
        "compiler": " ".join(compiler.command),
        "flags": " ".join((standard(form), *flags(form))),
        "files": files,
        "files_digest": _digest_of_files(files),
    }
    (new / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    for file in shipped:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
    _archive(folder, scene_digest, new / ".kept")
    stale = [p for p in folder.glob(f"_{name}_*") if p.name != library]
    stale += _python_files_of(folder) - {folder / file for file in shipped}
    # __init__.py goes last, before the manifest: until then the old module is complete
    _move(new, folder, [*(f for f in shipped if f != "__init__.py"), "__init__.py", MANIFEST])
    for path in stale:
        path.unlink(missing_ok=True)


def _archive(folder: Path, scene_digest: str, links: Path) -> None:
    """Archive the build in `folder` in its `.builds`, if it is of another version of the scene.

    links: a folder in which to collect its files. Only the newest MAX_ARCHIVED_BUILDS are kept. If
    a build can't be archived, values that it has pickled can't be loaded any more.
    """
    with suppress(OSError, ValueError, KeyError, TypeError):
        manifest = _manifest(folder)
        key = str(manifest["key"])
        place = _archive_folder(folder, key)
        if manifest["scene"] == scene_digest or is_built(place, key) or not is_built(folder, key):
            return
        for file in (*manifest["files"], MANIFEST):
            _link_or_copy(folder / file, links / file)
        shutil.rmtree(place, ignore_errors=True)
        place.parent.mkdir(exist_ok=True)
        os.replace(links, place)
        dated = sorted((p.stat().st_mtime, p) for p in place.parent.iterdir())
        for _, old in dated[:-MAX_ARCHIVED_BUILDS]:
            shutil.rmtree(old, ignore_errors=True)


def _archive_folder(folder: Path, key: str) -> Path:
    """Return the folder in which the build with this key is archived."""
    return folder / ".builds" / key[:12]


def _move(new: Path, folder: Path, files: list[str]) -> None:
    """Move files into `folder`, in their order; restore the previous ones if that fails.

    If the process is killed instead, the next build repairs the folder.
    """
    there = {file: _link_or_copy(folder / file, new / ".old" / file) for file in files}
    try:
        for file in files:
            _date_later(new / file, folder / file)
            os.replace(new / file, folder / file)
    except BaseException:  # Ctrl-C too
        for file in reversed(files):
            with suppress(OSError):  # restore the others even so
                if there[file]:
                    os.replace(new / ".old" / file, folder / file)
                else:
                    (folder / file).unlink(missing_ok=True)
        raise


def _link_or_copy(file: Path, other: Path) -> bool:
    """Hard-link `file` to `other`, or copy it if that fails; return False if it is missing."""
    if not file.exists():
        return False
    other.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(file, other)
    except OSError:  # the file system has no links, or too many to this file
        shutil.copy2(file, other)
    return True


def _date_later(new: Path, old: Path) -> None:
    """Date a file at least one second later than the one that it replaces.

    Python compares the source's time in seconds and its size with those in cached bytecode; with
    equal ones it would run the old bytecode.
    """
    if not old.is_file():
        return
    before = old.stat().st_mtime
    if int(new.stat().st_mtime) <= int(before):
        os.utime(new, (before + 1, before + 1))


def load(built: Built, home: str = "") -> ModuleType:
    """Import a built module and return it.

    Each build is imported under a name of its own in `sys.modules`. Loading the same build again
    returns the same module object.

    home: the scene's folder of builds, if the build lies elsewhere, such as in the archive; ""
    otherwise. Raises ReplacedError if another build has replaced this one on disk.
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
        if f"{alias}._{built.name}_{key[:12]}" not in sys.modules:  # __init__.py was replaced
            raise replaced
    except BaseException as fault:
        del sys.modules[alias]
        if isinstance(fault, Exception) and _key(folder) != key:
            raise replaced from None
        raise
    # other processes can't import the alias: pickled values refer to the build by its place
    place = (built.name, home or str(folder), key)
    sys.modules[f"{alias}._runtime.package"].unpickler = (unpickled, place)  # type: ignore[attr-defined]
    return module


def _alias(name: str, key: str) -> str:
    """Return the name of a build's module in `sys.modules`."""
    return f"_eomc_{name}_{key[:12]}"


def _key(folder: Path) -> str:
    """Return the key of the build that is in `folder` now."""
    return str(_manifest(folder)["key"])


def unpickled(
    place: tuple[str, str, str], identity: tuple[Any, ...], path: str, arguments: tuple[Any, ...]
) -> Any:
    """Return a value that was pickled by a module imported by `load`; pickle calls this function.

    Parameters
    ----------
    place
        The scene's name, the folder of its builds, and the key of the build that pickled the value.
    identity
        Identity of that build, by which the module decides whether it can restore the value.
    path, arguments
        Name of the function or class in the module that restores the value, and its arguments.

    This function never raises, since a pool of processes would wait forever. If the value can't be
    restored, it is an `Unreadable`, which raises EomcError when it is used.
    """
    from eomc.runtime import status
    from eomc.runtime.package import Unreadable

    name, folder, _ = place
    try:
        package = importlib.import_module(f"{_find_build(place).__name__}._runtime.package")
        why = package.refusal(identity, path)
        if not why:
            return package.call_path(path, arguments)
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


def _find_build(place: tuple[str, str, str]) -> ModuleType:
    """Return the module of the build at a place, or from the archive, or else its successor."""
    name, folder, key = place
    if (loaded := sys.modules.get(_alias(name, key))) is not None:
        return loaded
    for there in (Path(folder), _archive_folder(Path(folder), key), Path(folder)):
        # another process may replace it meanwhile: then it is in the archive
        if is_built(there, key):
            with suppress(ReplacedError, OSError):
                return load(Built(name, there, False, key), folder)
    return load(Built(name, Path(folder), False))


# --- locks of builds ------------------------------------------------------------------------------

_LOCK_REFUSED = "{}: is no file, and builds of a scene lock one there: remove it"
_LOCK_FLAGS = ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC")  # missing, and not needed, on Windows


@contextmanager
def hold_lock(path: Path, refusal: str = "") -> Iterator[None]:
    """Hold an exclusive lock on the file `path` while the block of the with statement runs.

    Other processes that lock the same file wait until the block ends. If the file does not exist,
    an empty one is created. refusal: message of the EomcError that is raised at once if another
    process holds the lock; "" to wait. Raises EomcError if `path` is a symbolic link, a folder, a
    pipe or anything else that is not a regular file.
    """
    try:
        flags = os.O_RDWR | os.O_CREAT
        for name in _LOCK_FLAGS:
            flags |= getattr(os, name, 0)
        lock = os.open(path, flags, 0o666)
    except OSError as fault:
        if fault.errno not in (errno.ELOOP, errno.EISDIR, errno.ENXIO, errno.ENODEV):
            raise
        raise EomcError(_LOCK_REFUSED.format(path)) from None
    try:
        if not stat.S_ISREG(os.fstat(lock).st_mode):
            raise EomcError(_LOCK_REFUSED.format(path))
        _wait(lock, refusal)
        yield
    finally:
        os.close(lock)


def _wait(lock: int, refusal: str) -> None:
    """Wait for the exclusive lock, or raise EomcError(refusal); closing the file releases it."""
    if sys.platform == "win32":
        import msvcrt

        while True:
            try:
                msvcrt.locking(lock, msvcrt.LK_NBLCK if refusal else msvcrt.LK_LOCK, 1)
                return  # the first byte is locked, which need not exist
            except OSError as fault:  # LK_LOCK gives up after ten seconds
                if refusal and fault.errno == errno.EACCES:
                    raise EomcError(refusal) from None
                if fault.errno != errno.EDEADLK:
                    raise
    else:
        import fcntl

        try:
            fcntl.flock(lock, fcntl.LOCK_EX | (fcntl.LOCK_NB if refusal else 0))
        except BlockingIOError:
            raise EomcError(refusal) from None


# --- cached texts ---------------------------------------------------------------------------------


def cache_texts(
    root: Path, name: str, kind: str, scene_digest: str, make: Callable[[], dict[str, str]]
) -> dict[str, str]:
    """Return the texts that `make` produces, from a cache on disk if they are up to date.

    They are up to date if the scene, eomc and the version of SymPy have not changed since.

    Parameters
    ----------
    root : Path
        Build directory; the cache is its subfolder .shown.
    name : str
        Name of the scene; "" disables the cache.
    kind : str
        Kind of texts; it is part of the name of the cache's file.
    scene_digest : str
        Digest of the scene's text.
    make : callable
        Returns the texts by name. It is called if they are not in the cache, or out of date.

    Returns
    -------
    dict
        The texts by name. They are returned without being cached if the folder can't be written.
    """
    from importlib.metadata import version

    file = root / ".shown" / f"{name}.{kind}.json"
    parts = (scene_digest, kind, generator_digest(), version("sympy"))
    key = hashlib.sha256("\0".join(parts).encode()).hexdigest()
    if name:
        with suppress(OSError, ValueError, KeyError, TypeError):
            stored = json.loads(file.read_text(encoding="utf-8"))
            if stored["key"] == key:
                return {str(k): str(v) for k, v in stored["texts"].items()}
    results = make()
    if name:
        with suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(file, cached=True) as new:
                new.write_text(json.dumps({"key": key, "texts": results}), encoding="utf-8")
    return results
