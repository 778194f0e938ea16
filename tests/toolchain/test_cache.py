"""A build is done once, whole or not at all, and says what went wrong."""

from __future__ import annotations

import contextlib
import errno
import gc
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing import get_context
from multiprocessing.context import ForkProcess
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from builds import CHANGED, TEXT, gravity, leftovers, script
from click.testing import CliRunner
from conftest import needs, tiers
from instrument import in_a_fork

import eomc
from eomc import pipeline
from eomc.base import resources
from eomc.cli.main import main
from eomc.emit import render
from eomc.toolchain import cache, compiler

pytestmark = pytest.mark.usefixtures("quickly_compiled")


FRESH = 10  # what a process that builds returns, and one less where it was there already


def started(scene: Path, root: Path, **environment: str) -> ForkProcess:
    """A process that builds, and has SymPy already."""

    def build() -> None:
        os.environ.update(environment)
        sys.exit(FRESH - 1 + eomc.build(scene, root).fresh)

    process = get_context("fork").Process(target=build)
    process.start()
    return process


def marks(folder: Path) -> dict[str, tuple[int, int, int]]:
    """What tells whether a file was touched, by name."""
    return {
        f.name: (f.stat().st_ino, f.stat().st_mtime_ns, f.stat().st_size)
        for f in folder.iterdir()
        if f.name != "__pycache__"
    }


# --- when ----------------------------------------------------------------------------------------


def test_nothing_is_built_where_nothing_has_changed(
    scene: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = eomc.build(scene, root)
    assert first.fresh
    assert first.folder == root / "simple_pendulum"
    before = marks(first.folder)
    assert {"simple_pendulum.c", "simple_pendulum.h", "main.c", "__init__.py"} <= set(before)

    def never(*_: object, **__: object) -> None:
        raise AssertionError("nothing is to be read or derived")

    monkeypatch.setattr(eomc, "read", never)
    monkeypatch.setattr(eomc, "sources", never)
    second = eomc.build(scene, root)
    assert not second.fresh
    assert marks(second.folder) == before


def test_what_is_found_is_found_without_sympy(scene: Path, root: Path, found: None) -> None:
    """That is what makes it take a tenth of a second."""
    assert not eomc.build(scene, root).fresh
    code = "import sys, eomc; eomc.load(*sys.argv[1:]).D([0.0]); sys.exit('sympy' in sys.modules)"
    subprocess.run([sys.executable, "-c", code, str(scene), str(root)], check=True)


@pytest.fixture
def bytecode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder in which Python keeps bytecode; those of the package are there."""
    monkeypatch.setattr(sys, "pycache_prefix", str(tmp_path / "kept"))
    Path(importlib.util.cache_from_source(render.__file__)).parent.mkdir(parents=True)
    return tmp_path / "kept"


def test_templates_are_compiled_once_and_kept_with_pythons_bytecode(
    scene: Path, bytecode: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    system, made = eomc.read(scene), []
    for k in range(3):
        render.environment.cache_clear()
        made.append(eomc.sources(system).files)
        files = list(bytecode.rglob("eomc-template-*.cache"))
        assert len(files) > 5
        for file in files:  # whatever happens to them
            file.write_bytes(b"nonsense" if k else file.read_bytes()[:-40])
    assert made[0] == made[1] == made[2]


def test_no_bytecode_is_written_where_python_may_write_none(
    scene: Path, bytecode: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    render.environment.cache_clear()
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    eomc.sources(eomc.read(scene))
    assert not [path for path in bytecode.rglob("*") if path.is_file()]


def test_garbage_is_collected_again(scene: Path, tmp_path: Path) -> None:
    assert gc.isenabled()
    eomc.sources(eomc.read(scene))
    assert gc.isenabled()
    scene.write_text("no scene", encoding="utf-8")
    with pytest.raises(eomc.SceneError):
        eomc.read(scene)
    assert gc.isenabled()
    gc.disable()  # somebody else's wish
    try:
        with pytest.raises(eomc.SceneError):
            eomc.read(scene)
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_what_a_build_depends_on(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scene, flags, compiler, generator: each of them changed gives another key."""
    keys: list[str] = []

    def key() -> str:
        return cache.key(pipeline.name_and_digest(scene)[1])

    def new() -> bool:
        keys.append(key())
        assert key() == keys[-1]
        return keys[-1] not in keys[:-1]

    assert new()
    scene.write_text(TEXT + "\n# a comment\n", encoding="utf-8")
    assert new()
    monkeypatch.setenv("EOMC_CFLAGS", "-O1")
    assert new()
    monkeypatch.setenv("CC", script(tmp_path / "mycc", 'exec cc "$@"\n'))
    assert new()
    generator = tmp_path / "clone" / "generator" / "eomc"
    shutil.copytree(resources.PACKAGE, generator)
    for part in ("templates", "csrc"):
        shutil.copytree(resources.folder(part), tmp_path / "clone" / part)
    monkeypatch.setattr(resources, "PACKAGE", generator)
    cache.generator_digest.cache_clear()
    try:
        assert not new()  # an exact copy
        with (generator / "derive" / "tape.py").open("a") as file:
            file.write("\n")
        cache.generator_digest.cache_clear()
        assert new()
    finally:
        cache.generator_digest.cache_clear()


# --- what goes wrong -----------------------------------------------------------------------------


def test_a_failing_compiler_is_heard(
    scene: Path, root: Path, built: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In its own words, with the command; the old module stays, and nothing half-made."""
    before = marks(root / "simple_pendulum")
    failing = script(tmp_path / "failing", "echo 'out of cheese' >&2\nexit 3\n")
    monkeypatch.setenv("CC", failing)
    with pytest.raises(eomc.EomcError) as fault:
        eomc.build(scene, root)
    for words in ("simple_pendulum", "out of cheese", "status 3", failing, "simple_pendulum.c"):
        assert words in str(fault.value)
    assert marks(root / "simple_pendulum") == before
    assert leftovers(root) == []
    assert gravity(root) == built
    monkeypatch.delenv("CC")
    assert eomc.build(scene, root).fresh
    assert gravity(root) == 2 * built


def test_a_failing_linker_is_heard(
    scene: Path, root: Path, built: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = 'case "$*" in *-shared*) echo "no such library"; exit 1;; esac\nexec cc "$@"\n'
    monkeypatch.setenv("CC", script(tmp_path / "no_linker", text))
    with pytest.raises(eomc.EomcError, match=r"(?s)-shared.*no such library"):
        eomc.build(scene, root)
    assert leftovers(root) == []
    assert gravity(root) == built


def test_no_compiler_is_left_running_after_a_failure(
    scene: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both compilations are over when the error comes, whichever of them failed."""
    text = 'case "$*" in *binding.c*) exec sleep 3;; esac\necho "out of cheese"; exit 1\n'
    monkeypatch.setenv("CC", script(tmp_path / "failing", text))

    def build() -> bool:
        with pytest.raises(eomc.EomcError, match="out of cheese"):
            eomc.build(scene, root)
        try:
            os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return True
        return False

    assert in_a_fork(build, 20) == ("done", True), "a compiler is still running"


def test_a_compiler_that_is_ended_removes_its_temporary_files(
    scene: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One compilation fails while the other has a file of its own, as gcc has."""
    own = tmp_path / "ccOwn.s"
    text = f"""case "$*" in *binding.c*)
        trap 'rm {own}; exit 1' TERM; touch {own}; sleep 20 & wait;; esac
    until [ -f {own} ]; do sleep 0.01; done; exit 1\n"""
    monkeypatch.setenv("CC", script(tmp_path / "failing", text))
    with pytest.raises(eomc.EomcError, match="status 1"):
        eomc.build(scene, root)
    assert not own.exists()


def contents(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Bytes and dates of the files below, by path."""
    files = (f for f in folder.rglob("*") if f.is_file() and f.suffix != ".pyc")
    return {str(f): (f.read_bytes(), f.stat().st_mtime_ns) for f in files}


@pytest.mark.parametrize(
    ("fault", "links"),
    [
        (OSError(errno.EDQUOT, "no"), True),
        pytest.param(OSError(errno.EDQUOT, "no"), False, marks=pytest.mark.slow),
        pytest.param(KeyboardInterrupt(), True, marks=pytest.mark.slow),
        (KeyboardInterrupt(), False),
    ],
    ids=["full-links", "full-copies", "ctrl_c-links", "ctrl_c-copies"],
)
def test_a_build_that_cant_be_moved_leaves_all_as_it_was(
    fault: BaseException, links: bool, scene: Path, root: Path, built: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Header, C, Python's files and library, at whichever of them it fails."""
    folder, move, moved = root / "simple_pendulum", os.replace, list[str]()
    (folder / "slices.py").write_text("of another version", encoding="utf-8")
    (folder / "laws.py").unlink()  # which that had not yet
    before, last = contents(folder), ""

    def failing(old: Path, new: Path) -> None:
        if ".old" not in Path(old).parts:
            moved.append(str(Path(new).relative_to(folder)))
            if moved[-1] == last:
                raise fault
        move(old, new)

    def no_links(*_: Path) -> None:
        raise OSError(errno.EPERM, "not here")

    monkeypatch.setattr(os, "replace", failing)
    if not links:
        monkeypatch.setattr(os, "link", no_links)
    for last in ("simple_pendulum.c", "slices.py", "__init__.py", "build.json"):
        with pytest.raises(eomc.EomcError if isinstance(fault, OSError) else KeyboardInterrupt):
            eomc.build(scene, root)
        assert contents(folder) == before and leftovers(root) == []
        assert moved[-1] == last and "simple_pendulum.h" in moved
    last = ""
    assert eomc.build(scene, root).fresh and leftovers(root) == []
    assert gravity(root) == 2 * built


@contextlib.contextmanager
def sleeping_compiler(folder: Path) -> Iterator[tuple[str, Path]]:
    """A compiler that sleeps, and the file where it tells its process ids.

    It tells them late: by then who has started it knows it too, and may be interrupted.
    """
    pids = folder / "pids"
    cc = script(folder / "sleeping", f"sleep 0.3\necho $$ >> {pids}\nexec sleep 60\n")
    try:
        yield cc, pids
    finally:
        for pid in pids.read_text().split() if pids.exists() else ():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGKILL)


def sleepers(pids: Path) -> list[int]:
    """Those of the compilers that are still there."""
    found = []
    for pid in map(int, pids.read_text().split()):
        with contextlib.suppress(OSError):
            if "sleep" in Path(f"/proc/{pid}/cmdline").read_text():
                found.append(pid)
    return found


def wait_for(file: Path, lines: int) -> None:
    for _ in range(500):
        if file.exists() and len(file.read_text().split()) >= lines:
            return
        time.sleep(0.02)
    raise AssertionError("the compiler was never called")


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT], ids=["SIGKILL", "SIGINT"])
def test_a_build_that_is_killed_leaves_the_old_module(
    scene: Path, root: Path, built: float, tmp_path: Path, how: signal.Signals
) -> None:
    """What SIGKILL leaves the next build clears away; Ctrl-C ends the compilers too.

    Even where they did not hear of it themselves.
    """
    with sleeping_compiler(tmp_path) as (cc, pids):
        process = started(scene, root, CC=cc)
        wait_for(pids, 2)
        assert process.pid is not None
        os.kill(process.pid, how)
        process.join(20)
        assert process.exitcode not in (0, None, FRESH - 1, FRESH)
        assert gravity(root) == built
        if how is signal.SIGINT:
            assert leftovers(root) == []
            for _ in range(50):
                if not sleepers(pids):
                    break
                time.sleep(0.1)
            assert sleepers(pids) == []
    if how is signal.SIGKILL:
        assert leftovers(root) != []
        assert eomc.build(scene, root).fresh
        assert leftovers(root) == []
        assert gravity(root) == 2 * built


@pytest.mark.parametrize("n", tiers([1, 2, 3], 2))
def test_ctrl_c_while_a_compiler_is_started_ends_it_too(
    n: int, scene: Path, root: Path, built: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the n-th, the linker at last, the process is there, but Popen not over."""

    class Popen(subprocess.Popen):  # type: ignore[type-arg]
        count = 0

        def __init__(self, *args: Any, **how: Any) -> None:
            super().__init__(*args, **how)
            Popen.count += 1
            if Popen.count == n:
                wait_for(pids, 2 if n == 2 else 1)
                os.kill(os.getpid(), signal.SIGINT)

    with sleeping_compiler(tmp_path) as (cc, pids):
        linker = f'case "$*" in *-shared*) exec {cc};; esac\nexec cc "$@"\n'
        monkeypatch.setenv("CC", cc if n < 3 else script(tmp_path / "linker", linker))
        monkeypatch.setattr(subprocess, "Popen", Popen)
        begun = time.monotonic()
        how, words = in_a_fork(lambda: eomc.build(scene, root).name, 20)
        assert (how, words) == ("raised", "KeyboardInterrupt: ")
        assert sleepers(pids) == [] and time.monotonic() - begun < 10
    assert leftovers(root) == [] and gravity(root) == built


@pytest.mark.usefixtures("quickly_compiled")
def test_bytecode_of_the_build_before_is_not_taken(scene: Path, root: Path, found: None) -> None:
    """Python knows it by the second and the size of its source, which may be the same."""
    files = sorted((root / "simple_pendulum").glob("*.py"))
    ahead = time.time() + 100
    for file in files:
        os.utime(file, (ahead, ahead))
    scene.write_text(CHANGED, encoding="utf-8")
    assert eomc.build(scene, root).fresh
    assert all(int(file.stat().st_mtime) > int(ahead) for file in files)


@pytest.mark.usefixtures("quickly_compiled")
def test_a_module_that_another_build_replaces_is_not_taken_for_ones_own(
    scene: Path, root: Path, found: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scene of the same name, built between this one's build and its loading: tried again."""
    other, load, times = tmp_path / "other.toml", cache.load, 0
    other.write_text(CHANGED, encoding="utf-8")

    def late(built: cache.Built) -> ModuleType:
        nonlocal times
        times += 1
        if times <= most:
            eomc.build(other, root)
        return load(built)

    monkeypatch.setattr(cache, "load", late)
    most = 2
    assert eomc.load(scene, root).g([1.0])[0] == pytest.approx(8.2548, abs=1e-3)
    assert times == 3
    most, times = 100, 0
    with pytest.raises(eomc.EomcError, match=r"other builds of a scene of this .*--build DIR"):
        eomc.load(scene, root)


@pytest.mark.usefixtures("quickly_compiled")
def test_a_face_that_another_build_replaces_meanwhile_is_not_loaded(
    scene: Path, root: Path, found: None, tmp_path: Path
) -> None:
    """The manifest, which is moved last, is still the old one's."""
    folder, other = root / "simple_pendulum", tmp_path / "other.toml"
    scene.write_text(TEXT.replace('"m*g*y"', '"3*m*g*y"'), encoding="utf-8")  # loaded by no test
    old = eomc.build(scene, root)
    manifest = (folder / "build.json").read_bytes()
    other.write_text(CHANGED, encoding="utf-8")
    eomc.build(other, root)
    (folder / "build.json").write_bytes(manifest)

    def load() -> None:
        cache.load(old)

    how, words = in_a_fork(load, 20)
    assert how == "raised" and str(words).startswith("ReplacedError: "), words


def test_two_builds_at_once_both_end_well(scene: Path, root: Path) -> None:
    """One of them builds, the other waits and finds."""
    both = [started(scene, root) for _ in range(2)]
    for process in both:
        process.join(60)
    assert sorted(str(process.exitcode) for process in both) == [str(FRESH), str(FRESH - 1)]
    assert leftovers(root) == []
    assert gravity(root) == pytest.approx(8.2548, abs=1e-3)


@pytest.mark.slow
def test_two_scenes_of_one_name_built_at_once(scene: Path, root: Path, tmp_path: Path) -> None:
    """The last one stays, and it is whole."""
    other = tmp_path / "other.toml"
    other.write_text(CHANGED, encoding="utf-8")
    both = [started(file, root) for file in (scene, other)]
    for process in both:
        process.join(60)
    assert [process.exitcode for process in both] == [FRESH, FRESH]
    assert round(gravity(root)) in (8, 17)
    assert leftovers(root) == []


def test_a_place_that_cannot_be_written(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    with pytest.raises(
        eomc.EomcError, match=r"file.*can't be written .*: choose another folder, root="
    ):
        eomc.build(scene, tmp_path / "file" / "build")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_place(scene: Path, root: Path) -> None:
    root.mkdir()
    root.chmod(0o500)
    with pytest.raises(eomc.EomcError, match=r"can't be written \(Permission denied\).*--build"):
        eomc.build(scene, root)


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    real = compiler.importlib.util.find_spec
    hidden = lambda name, *a: None if name == "ziglang" else real(name, *a)  # noqa: E731 - a stub
    monkeypatch.setattr(compiler.importlib.util, "find_spec", hidden)


def test_what_is_built_and_unchanged_needs_no_compiler(
    scene: Path, root: Path, found: None, no_compiler: None
) -> None:
    """Of any compiler; not where anything else has changed."""
    built = cache.Built("simple_pendulum", root / "simple_pendulum", False)
    before = marks(built.folder)
    assert not eomc.build(scene, root).fresh and marks(built.folder) == before
    assert eomc.load(scene, root).simulate(steps=10).status == "ok"
    listed = CliRunner().invoke(main, ["list", str(scene.parent), "--build", str(root), "--json"])
    assert [row["built"] for row in json.loads(listed.output)] == [True]
    scene.write_text(CHANGED, encoding="utf-8")
    with pytest.raises(eomc.EomcError, match="no C compiler found"):
        eomc.build(scene, root)
    scene.write_text(TEXT, encoding="utf-8")
    (built.folder / "slices.py").write_text("", encoding="utf-8")  # no longer whole
    with pytest.raises(eomc.EomcError, match="no C compiler found"):
        eomc.build(scene, root)


@pytest.mark.usefixtures("no_compiler")
def test_no_compiler_at_all(scene: Path, root: Path) -> None:
    """One sentence, and the one thing that pip can install."""
    with pytest.raises(eomc.EomcError) as fault:
        eomc.build(scene, root)
    assert "\n" not in str(fault.value)
    for words in ("no C compiler found", "gcc", "clang", "pip install"):
        assert words in str(fault.value)
    assert not root.exists()


def test_a_compiler_that_is_not_there(
    scene: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", "/nowhere/cc -m64")
    with pytest.raises(eomc.EomcError, match="CC='/nowhere/cc -m64' is not there"):
        eomc.build(scene, root)


@pytest.mark.parametrize("cc", tiers(["clang", "gcc -m64"], "gcc -m64"))
def test_the_compiler_that_was_asked_for(
    scene: Path, root: Path, monkeypatch: pytest.MonkeyPatch, cc: str
) -> None:
    needs(cc.split()[0])
    monkeypatch.setenv("CC", cc)
    if cc == "clang":
        monkeypatch.delenv("EOMC_CFLAGS")
    module = eomc.load(scene, root)
    assert module.simulate(steps=10).status == "ok"
    assert cc.split()[-1] in (root / "simple_pendulum" / "build.json").read_text()


def test_a_faulty_scene_is_not_built(scene: Path, root: Path, found: None) -> None:
    before = marks(root / "simple_pendulum")
    scene.write_text(TEXT.replace('"m*g*y"', '"m*gg*y"'), encoding="utf-8")
    with pytest.raises(eomc.SceneError, match="'gg'"):
        eomc.build(scene, root)
    assert marks(root / "simple_pendulum") == before


def test_what_compilers_vectorise_goes_into_half_of_the_widest_registers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Straight-line code is faster so; lanes are as wide as they are asked to be."""
    monkeypatch.delenv("EOMC_CFLAGS", raising=False)
    monkeypatch.setattr(compiler, "processor", lambda: "flags : fma avx2 avx512f")
    assert compiler.flags()[-1] == "-mprefer-vector-width=256"
    monkeypatch.setattr(compiler, "processor", lambda: "flags : fma avx2")
    assert compiler.flags() == compiler.FLAGS


def test_a_relative_root_survives_another_current_folder(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pendulum: tuple[Path, float]
) -> None:
    """Python caches a finder for each path; that of a relative one looked in the old folder."""
    shutil.copytree(pendulum[0], tmp_path / "one" / "build" / "simple_pendulum")
    for place in ("one", "other"):
        (tmp_path / place).mkdir(exist_ok=True)
        monkeypatch.chdir(tmp_path / place)
        assert eomc.load(scene, "build").g([1.0]).size == 1
        scene.write_text(CHANGED, encoding="utf-8")


def test_a_system_of_which_something_was_replaced_is_built_anew(tmp_path: Path) -> None:
    made = eomc.System.make("swing", {"a": 1.0}, "a_dot**2/2", "-cos(a)")
    assert eomc.load(made, tmp_path).methods == ("rk4",)
    other = replace(made, run=replace(made.run, methods=("dp8",)))
    assert eomc.load(other, tmp_path).methods == ("dp8",)
    assert not pipeline.build(other, tmp_path).fresh
