"""Sources to a compiled, importable module: cffi, the C compiler, the cache.

A module lies in `build/<name>/`. Its extension carries a digest in its name, and `__init__.py`,
which says which extension is its own, is moved into place last: whatever interrupts a build, what
was there before stays whole. A file lock keeps builds of one scene apart.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import importlib.util
import json
import os
import platform
import shlex
import shutil
import stat
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from eomc.base import resources
from eomc.base.errors import EomcError, FolderError
from eomc.base.version import __version__

if TYPE_CHECKING:
    from eomc.emit.render import Sources

# no -ffast-math: it breaks the reduction of angles and the checks for singular D
FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fno-tree-slp-vectorize")
STANDARD = "-std=gnu99"  # c99 would forbid the contraction to FMA
MANIFEST = "build.json"
_NO_LOCK = "{}: is no file, and builds of a scene lock one there: remove it"
FORMS = ("fast", "plain")  # of C; the fast one, what modules are compiled from, lies in fast/
# the plain one as it is embedded: any compiler, no processor of its own
PLAIN_STANDARD, PLAIN_FLAGS = "-std=c99", ("-O2",)
# operations over which gcc takes some twenty seconds (0.3 ms each, in pieces) and clang two thirds
MANY = 60_000


@dataclass(frozen=True)
class Compiler:
    """A C compiler: the command, and what identifies it."""

    command: tuple[str, ...]
    identity: str


@dataclass(frozen=True)
class Built:
    """A module on disk; `fresh` where it was built just now and not found."""

    name: str
    folder: Path
    fresh: bool


def find_compiler() -> Compiler:
    """$CC, cc, gcc, clang or the pip-installable ziglang, in this order. Raises EomcError."""
    wish = os.environ.get("CC")
    for candidate in [wish] if wish else ["cc", "gcc", "clang"]:
        words = _words("CC", candidate)
        if words and (path := shutil.which(words[0])):
            return Compiler((path, *words[1:]), _identity(path) + " ".join(words[1:]))
    if wish:
        raise EomcError(f"the C compiler CC={wish!r} is not there: correct or unset CC")
    if importlib.util.find_spec("ziglang") is not None:
        import ziglang

        return Compiler((sys.executable, "-m", "ziglang", "cc"), f"ziglang {ziglang.__file__}")
    raise EomcError(
        "no C compiler found: install gcc or clang (Debian: apt install gcc), "
        "or 'pip install ziglang', which brings one"
    )


def _words(variable: str, text: str) -> list[str]:
    """The words of a variable of the environment, as a shell divides them. Raises EomcError."""
    try:
        return shlex.split(text)
    except ValueError as fault:  # an open quote, a backslash at the end
        said = str(fault).lower()
        raise EomcError(f"{variable}={text!r}: {said}: close it, or unset {variable}") from None


def compiler_for(operations: int) -> Compiler:
    """The compiler for a scene of that size: find_compiler's; clang, where it is there, for many.

    $CC is always obeyed. Raises EomcError.
    """
    found = find_compiler()
    if operations > MANY and not os.environ.get("CC") and (clang := shutil.which("clang")):
        return Compiler((clang,), _identity(clang))
    return found


def _identity(path: str) -> str:
    real = Path(path).resolve()
    state = real.stat()
    return f"{real} {state.st_size} {state.st_mtime_ns}"


def flags(form: str = "fast", wide: bool = False) -> tuple[str, ...]:
    """The optimisation flags: $EOMC_CFLAGS where it is set, else those of the form of C.

    wide: for batches and stage-parallel methods, which take 1.1 to 1.7 times as long in half of
    AVX-512's registers. Straight-line code is shorter there: a chain of five takes 0.85 of the
    time, a Panda 0.94.
    """
    given = os.environ.get("EOMC_CFLAGS")
    if given is not None:
        return tuple(_words("EOMC_CFLAGS", given))
    if form == "plain":
        return PLAIN_FLAGS
    if "avx512f" not in _processor():
        return FLAGS
    return (*FLAGS, f"-mprefer-vector-width={512 if wide else 256}")


def _standard(form: str) -> str:
    return PLAIN_STANDARD if form == "plain" else STANDARD


@lru_cache(maxsize=1)
def _processor() -> str:
    """What -march=native hangs on."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        kept = {line for line in lines if line.startswith(("model name", "flags", "Features"))}
        return platform.machine() + " " + " ".join(sorted(kept))
    except OSError:
        return platform.machine() + " " + platform.processor()


@lru_cache(maxsize=1)
def _generator_digest() -> str:
    """What the generator is: its version and the text of all its parts."""
    total = hashlib.sha256(__version__.encode())
    for name, file in resources.parts():
        total.update(name.encode() + file.read_bytes())
    return total.hexdigest()


def key(scene_digest: str, form: str = "fast") -> str:
    """The digest of all that a build depends on: scene, generator, flags, compiler, processor."""
    small, large = compiler_for(0), compiler_for(MANY + 1)
    parts = (
        scene_digest, form, _generator_digest(), small.identity, large.identity,
        STANDARD, *flags(form), _processor(), sys.version,
        str(sysconfig.get_config_var("EXT_SUFFIX")),
    )  # fmt: skip
    # a variable of the environment may hold bytes that are no text
    return hashlib.sha256("\0".join(parts).encode(errors="surrogateescape")).hexdigest()


def found(folder: Path, wanted: str) -> bool:
    """Whether `folder` holds a whole build of this key, each file with its digest.

    A single bit that has changed in an extension may end the process that loads it.
    """
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        return manifest["key"] == wanted and all(
            _digest(folder / name) == digest for name, digest in manifest["files"].items()
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def _digest(file: Path) -> str:
    """SHA-256; some 0.3 ms for a small scene."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def build(
    name: str,
    wanted: str,
    sources: Callable[[str], Sources],
    root: Path,
    form: str = "fast",
) -> Built:
    """The module of one scene under `root`, built where it isn't there yet.

    wanted: the key. sources: makes the files, given the name of the extension; called only where
    something is to be built. form: of the C that it is compiled from.
    Raises EomcError where the compiler fails, with its own words, or the folder can't be written.
    """
    folder = place(name, root, form)
    root = folder.parent
    if found(folder, wanted):
        return Built(name, folder, False)
    try:
        root.mkdir(parents=True, exist_ok=True)
        with _locked(root / f".{folder.name}.lock"):
            if found(folder, wanted):  # by another process, meanwhile
                return Built(name, folder, False)
            _free(folder)
            for left in root.glob(f".{folder.name}.build-*"):  # by a build that was killed
                shutil.rmtree(left, ignore_errors=True)
            with tempfile.TemporaryDirectory(dir=root, prefix=f".{folder.name}.build-") as beside:
                _build(name, wanted, sources, folder, Path(beside), form)
    except OSError as fault:
        raise FolderError(
            f"{fault.filename or folder}: can't be written ({fault.strerror})"
        ) from None
    return Built(name, folder, True)


def place(name: str, root: Path, form: str = "fast") -> Path:
    """The folder of a scene's module; that of the plain form, for comparison, lies inside it."""
    return root / name if form == "fast" else root / name / ".plain"


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """A lock on a file that is made where it isn't there; nothing is written to it.

    Raises EomcError where something else lies there: no link is followed, no pipe waited for.
    """
    try:
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        lock = os.open(path, flags, 0o666)
    except OSError as fault:
        if fault.errno not in (errno.ELOOP, errno.EISDIR, errno.ENXIO, errno.ENODEV):
            raise
        raise EomcError(_NO_LOCK.format(path)) from None
    try:
        if not stat.S_ISREG(os.fstat(lock).st_mode):
            raise EomcError(_NO_LOCK.format(path))
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)


def _free(folder: Path) -> None:
    """An EomcError where a folder holds a package that no build made, or is none."""
    if folder.is_symlink() or folder.exists():
        if not folder.is_dir():
            raise EomcError(f"{folder}: is in the way of the module: remove it, or use --build DIR")
        if (folder / "__init__.py").exists() and not (folder / "runtime.py").exists():
            raise EomcError(
                f"{folder}: is a package that eomc did not build, and stays as it is: "
                "rename the scene, or use --build DIR"
            )


def _build(
    name: str,
    wanted: str,
    sources: Callable[[str], Sources],
    folder: Path,
    beside: Path,
    form: str,
) -> None:
    extension = f"_{name}_{wanted[:12]}"
    made = sources(extension)
    for file, text in made.files.items():
        (beside / file).parent.mkdir(exist_ok=True)
        # the name of a scene's file may be no text
        (beside / file).write_text(text, encoding="utf-8", errors="backslashreplace")
    library = extension + str(sysconfig.get_config_var("EXT_SUFFIX"))
    compiler = compiler_for(made.operations)
    _compile(made, extension, beside, library, compiler, form)
    _try(name, extension, beside / library, compiler)
    kept = [library, *(f for f in made.files if form == "fast" or f.endswith(".py"))]
    manifest = {
        "key": wanted,
        "name": name,
        "eomc": __version__,
        "compiler": " ".join(compiler.command),
        "flags": " ".join((_standard(form), *flags(form, made.wide))),
        "files": {file: _digest(beside / file) for file in kept},
    }
    (beside / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    for file in kept:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
    stale = [p for p in folder.glob(f"_{name}_*") if p.name != library]
    # the face last: until it is there, the old one is whole; the manifest after it
    for file in [*(f for f in kept if f != "__init__.py"), "__init__.py", MANIFEST]:
        os.replace(beside / file, folder / file)
    for path in stale:
        path.unlink(missing_ok=True)


def _compile(
    made: Sources, extension: str, folder: Path, library: str, compiler: Compiler, form: str
) -> None:
    import cffi

    name = made.name
    ffi = cffi.FFI()
    ffi.cdef(made.cdef)
    ffi.set_source(extension, made.binding, compiler_verbose=0)
    at = "fast/" if form == "fast" else ""  # beside the header that the binding is to include
    ffi.emit_c_code(str(folder / f"{at}binding.c"))
    include = [f"-I{p}" for p in {sysconfig.get_path("include"), sysconfig.get_path("platinclude")}]
    common = [*compiler.command, "-fPIC", "-fvisibility=hidden"]
    jobs = [
        [*common, _standard(form), *flags(form, made.wide), "-c", f"{at}{name}.c", "-o", "scene.o"],
        # the wrapper's speed is that of the calls in it
        [*common, STANDARD, "-O1", *include, "-c", f"{at}binding.c", "-o", "binding.o"],
    ]
    running = [(job, _start(job, folder)) for job in jobs]
    try:
        for job, process in running:
            _finish(name, job, process)
    finally:
        for _, process in running:  # none goes on where another failed
            process.kill()
            process.wait()
    link = [*compiler.command, "-shared", "scene.o", "binding.o", "-lm", "-o", library]
    if sys.platform == "darwin":
        link.insert(1, "-undefined")
        link.insert(2, "dynamic_lookup")
    _finish(name, link, _start(link, folder))


# imports an extension from a file, with nothing of Python's own start-up but cffi's backend
_TRIAL = """
import sys
sys.path.append(sys.argv[1])
from importlib.machinery import ExtensionFileLoader, ModuleSpec
loader = ExtensionFileLoader(sys.argv[2], sys.argv[3])
loader.exec_module(loader.create_module(ModuleSpec(sys.argv[2], loader, origin=sys.argv[3])))
"""


def _try(name: str, extension: str, library: Path, compiler: Compiler) -> None:
    """Load a new extension in a process of its own (some 10 ms), before it replaces another.

    Raises EomcError where it can't be loaded, or ends that process.
    """
    backend = importlib.util.find_spec("_cffi_backend")
    assert backend is not None and backend.origin is not None
    where = os.path.dirname(backend.origin)
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", _TRIAL, where, extension, str(library.resolve())],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="backslashreplace",
    )  # fmt: skip
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        said = lines[-1] if lines else f"status {done.returncode}"
        raise EomcError(
            f"{name}: the C compiler {shlex.join(compiler.command)} returned 0, but what it made "
            f"can't be loaded: correct CC and EOMC_CFLAGS; the last build stays\n  {said}"
        )


def _start(command: Sequence[str], folder: Path) -> subprocess.Popen[str]:
    try:
        return subprocess.Popen(
            command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, encoding="utf-8", errors="backslashreplace",
        )  # fmt: skip
    except OSError as fault:
        raise EomcError(f"{command[0]}: can't be run ({fault.strerror})") from None


def _finish(name: str, command: Sequence[str], process: subprocess.Popen[str]) -> None:
    words, _ = process.communicate()
    if process.returncode:
        raise EomcError(
            f"{name}: the C compiler failed (status {process.returncode}):\n"
            f"  {shlex.join(command)}\n{words.rstrip()}"
        )


def load(built: Built) -> ModuleType:
    """Import a built module, whatever else bears its name; the same build gives the same module."""
    folder = built.folder.resolve()  # Python caches finders by path, whatever the current folder
    manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    alias = f"_eomc_{built.name}_{manifest['key'][:12]}"
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
    except BaseException:
        del sys.modules[alias]
        raise
    # another process can't import the alias; what is pickled here is found by its place there
    place = (built.name, str(folder), alias)
    sys.modules[f"{alias}.package"].found_by = (unpickled, place)  # type: ignore[attr-defined]
    return module


def unpickled(name: str, folder: str, alias: str, path: str, arguments: tuple[Any, ...]) -> Any:
    """A value pickled by a module that `load` had loaded; pickle calls this.

    Raises EomcError where the module is no longer there; a MotionError is made all the same, since
    pools of processes wait for ever for what can't be read.
    """
    try:
        if alias not in sys.modules:
            alias = load(Built(name, Path(folder), False)).__name__
    except (OSError, ValueError, KeyError, ImportError):
        if path == "runtime.MotionError":
            from eomc.runtime.runtime import MotionError

            return MotionError(*arguments)
        raise EomcError(
            f"{folder}: the module that pickled this is not there: build the scene again"
        ) from None
    return importlib.import_module(f"{alias}.package").made(path, arguments)
