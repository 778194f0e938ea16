"""A build is done once: its dependencies and its compiler."""

from __future__ import annotations

import gc
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from support.builds import CHANGED, TEXT, file_states, script
from support.session import needs, tiers

import eomc
from eomc import pipeline
from eomc.base import resources
from eomc.cli.main import main
from eomc.emit.common import templates
from eomc.toolchain import cache, compiler

pytestmark = pytest.mark.usefixtures("quickly_compiled")


# --- when ----------------------------------------------------------------------------------------


def test_unchanged_scene_is_not_built_again(
    scene: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = eomc.build(scene, root)
    assert first.fresh
    assert first.folder == root / "simple_pendulum"
    before = file_states(first.folder)
    assert {"simple_pendulum.c", "simple_pendulum.h", "main.c", "__init__.py"} <= set(before)

    def fail_if_called(*_: object, **__: object) -> None:
        raise AssertionError("nothing is to be read or derived")

    monkeypatch.setattr(eomc, "read", fail_if_called)
    monkeypatch.setattr(eomc, "sources", fail_if_called)
    second = eomc.build(scene, root)
    assert not second.fresh
    assert file_states(second.folder) == before


def test_current_build_is_loaded_without_sympy(
    scene: Path, root: Path, existing_build: None
) -> None:
    """The command then takes a tenth of a second."""
    assert not eomc.build(scene, root).fresh
    code = "import sys, eomc; eomc.load(*sys.argv[1:]).D([0.0]); sys.exit('sympy' in sys.modules)"
    subprocess.run([sys.executable, "-c", code, str(scene), str(root)], check=True)


@pytest.fixture
def bytecode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Set an empty folder as the cache of Python's bytecode, with the package's own subfolder."""
    monkeypatch.setattr(sys, "pycache_prefix", str(tmp_path / "kept"))
    Path(importlib.util.cache_from_source(templates.__file__)).parent.mkdir(parents=True)
    return tmp_path / "kept"


def test_templates_are_compiled_once_and_cached_with_bytecode(
    scene: Path, bytecode: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    system, files_of_builds = eomc.read(scene), []
    for k in range(3):
        templates.environment.cache_clear()
        files_of_builds.append(eomc.sources(system).files)
        files = list(bytecode.rglob("eomc-template-*.cache"))
        assert len(files) > 5
        for file in files:  # even if they are damaged
            file.write_bytes(b"nonsense" if k else file.read_bytes()[:-40])
    assert files_of_builds[0] == files_of_builds[1] == files_of_builds[2]


def test_no_bytecode_is_written_if_python_may_not(
    scene: Path, bytecode: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    templates.environment.cache_clear()
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    eomc.sources(eomc.read(scene))
    assert not [path for path in bytecode.rglob("*") if path.is_file()]


def test_garbage_collection_is_restored(scene: Path, tmp_path: Path) -> None:
    assert gc.isenabled()
    eomc.sources(eomc.read(scene))
    assert gc.isenabled()
    scene.write_text("no scene", encoding="utf-8")
    with pytest.raises(eomc.SceneError):
        eomc.read(scene)
    assert gc.isenabled()
    gc.disable()  # the caller has disabled it
    try:
        with pytest.raises(eomc.SceneError):
            eomc.read(scene)
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_key_depends_on_scene_flags_compiler_and_generator(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A change of any of them gives another key."""
    keys: list[str] = []

    def key() -> str:
        return cache.key(pipeline.name_and_digest(scene)[1])

    def is_new_key() -> bool:
        keys.append(key())
        assert key() == keys[-1]
        return keys[-1] not in keys[:-1]

    assert is_new_key()
    scene.write_text(TEXT + "\n# a comment\n", encoding="utf-8")
    assert is_new_key()
    monkeypatch.setenv("EOMC_CFLAGS", "-O1")
    assert is_new_key()
    monkeypatch.setenv("CC", script(tmp_path / "mycc", 'exec cc "$@"\n'))
    assert is_new_key()
    generator = tmp_path / "clone" / "generator" / "eomc"
    shutil.copytree(resources.PACKAGE, generator)
    for part in ("templates", "csrc"):
        shutil.copytree(resources.folder(part), tmp_path / "clone" / part)
    monkeypatch.setattr(resources, "PACKAGE", generator)
    cache.generator_digest.cache_clear()
    try:
        assert not is_new_key()  # an exact copy
        version = resources.generator_version()  # in the header of generated files
        with (generator / "derive" / "tape.py").open("a") as file:
            file.write("\n")
        cache.generator_digest.cache_clear()
        assert is_new_key()
        assert resources.generator_version() != version
    finally:
        cache.generator_digest.cache_clear()


@pytest.mark.usefixtures("quickly_compiled")
def test_bytecode_of_the_previous_build_is_not_used(
    scene: Path, root: Path, existing_build: None
) -> None:
    """Python identifies it by the second and the size of its source, which may be the same."""
    files = sorted((root / "simple_pendulum").glob("*.py"))
    future = time.time() + 100
    for file in files:
        os.utime(file, (future, future))
    scene.write_text(CHANGED, encoding="utf-8")
    assert eomc.build(scene, root).fresh
    assert all(int(file.stat().st_mtime) > int(future) for file in files)


@pytest.mark.slow
def test_some_previous_builds_are_archived(
    scene: Path, root: Path, existing_build: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pickled runs need them; a build of the same scene with other flags is not archived."""
    monkeypatch.setattr(cache, "MAX_ARCHIVED_BUILDS", 1)
    folder = root / "simple_pendulum"
    archive, keys = folder / ".builds", [json.loads((folder / cache.MANIFEST).read_text())["key"]]
    monkeypatch.setenv("EOMC_CFLAGS", "-O0 -DOTHER")
    eomc.build(scene, root)
    assert not archive.exists()
    for text in (CHANGED, CHANGED + "# a comment\n"):
        keys.append(json.loads((folder / cache.MANIFEST).read_text())["key"])
        scene.write_text(text, encoding="utf-8")
        eomc.build(scene, root)
        assert [place.name for place in archive.iterdir()] == [keys[-1][:12]]
        assert cache.is_built(archive / keys[-1][:12], keys[-1])


def test_manifest_without_a_required_file_is_no_build(root: Path, existing_build: None) -> None:
    """A file that is not listed would be executed unchecked."""
    folder = root / "simple_pendulum"
    manifest = json.loads((folder / cache.MANIFEST).read_text(encoding="utf-8"))
    key, files = manifest["key"], manifest["files"]
    assert cache.is_built(folder, key)

    def write_altered_manifest(**change: object) -> bool:
        text = json.dumps({k: x for k, x in (manifest | change).items() if x is not None})
        (folder / cache.MANIFEST).write_text(text, encoding="utf-8")
        return cache.is_built(folder, key)

    assert write_altered_manifest()
    for name in files:
        assert not write_altered_manifest(files={n: x for n, x in files.items() if n != name}), name
    for change in ({"files": {}}, {"files": {}, "files_digest": None}, {"files_digest": None}):
        assert not write_altered_manifest(**change)
    assert not write_altered_manifest(files=[]) and not write_altered_manifest(files=None)


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    real = compiler.importlib.util.find_spec
    hidden = lambda name, *a: None if name == "ziglang" else real(name, *a)  # noqa: E731 - a stub
    monkeypatch.setattr(compiler.importlib.util, "find_spec", hidden)


def test_current_build_needs_no_compiler(
    scene: Path, root: Path, existing_build: None, no_compiler: None
) -> None:
    """Whatever compiler built it; after any other change a compiler is needed."""
    built = cache.Built("simple_pendulum", root / "simple_pendulum", False)
    before = file_states(built.folder)
    assert not eomc.build(scene, root).fresh and file_states(built.folder) == before
    assert eomc.load(scene, root).simulate(steps=10).status == "ok"
    listed = CliRunner().invoke(main, ["list", str(scene.parent), "--build", str(root), "--json"])
    assert [row["built"] for row in json.loads(listed.output)] == [True]
    scene.write_text(CHANGED, encoding="utf-8")
    with pytest.raises(eomc.EomcError, match="no C compiler found"):
        eomc.build(scene, root)
    scene.write_text(TEXT, encoding="utf-8")
    (built.folder / "_runtime" / "status.py").write_text("", encoding="utf-8")  # damaged
    with pytest.raises(eomc.EomcError, match="no C compiler found"):
        eomc.build(scene, root)


@pytest.mark.usefixtures("no_compiler")
def test_missing_compiler_is_reported_with_a_remedy(scene: Path, root: Path) -> None:
    """The message is one sentence and names the package that pip can install."""
    with pytest.raises(eomc.EomcError) as error:
        eomc.build(scene, root)
    assert "\n" not in str(error.value)
    for words in ("no C compiler found", "gcc", "clang", "pip install"):
        assert words in str(error.value)
    assert not root.exists()


def test_unknown_compiler_is_reported(
    scene: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", "/nowhere/cc -m64")
    with pytest.raises(eomc.EomcError, match="CC='/nowhere/cc -m64' is not there"):
        eomc.build(scene, root)


@pytest.mark.parametrize("cc", tiers(["clang", "gcc -m64"], "gcc -m64"))
def test_requested_compiler_is_used(
    scene: Path, root: Path, monkeypatch: pytest.MonkeyPatch, cc: str
) -> None:
    needs(cc.split()[0])
    monkeypatch.setenv("CC", cc)
    if cc == "clang":
        monkeypatch.delenv("EOMC_CFLAGS")
    module = eomc.load(scene, root)
    assert module.simulate(steps=10).status == "ok"
    assert cc.split()[-1] in (root / "simple_pendulum" / "build.json").read_text()


def test_compilers_vectorise_with_half_of_the_widest_registers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Straight-line code is faster so; lanes have the requested width."""
    monkeypatch.delenv("EOMC_CFLAGS", raising=False)
    monkeypatch.setattr(compiler, "processor", lambda: "flags : fma avx2 avx512f")
    assert compiler.flags()[-1] == "-mprefer-vector-width=256"
    monkeypatch.setattr(compiler, "processor", lambda: "flags : fma avx2")
    assert compiler.flags() == compiler.FLAGS


def test_relative_root_is_valid_in_another_current_folder(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pendulum: tuple[Path, float]
) -> None:
    """Python caches a finder for each path; that of a relative path searched the old folder."""
    shutil.copytree(pendulum[0], tmp_path / "one" / "build" / "simple_pendulum")
    for place in ("one", "other"):
        (tmp_path / place).mkdir(exist_ok=True)
        monkeypatch.chdir(tmp_path / place)
        assert eomc.load(scene, "build").g([1.0]).size == 1
        scene.write_text(CHANGED, encoding="utf-8")


@pytest.mark.slow
def test_system_with_a_replaced_part_is_rebuilt(tmp_path: Path) -> None:
    system = eomc.System.make("swing", {"a": 1.0}, "a_dot**2/2", "-cos(a)")
    assert eomc.load(system, tmp_path).methods == ("rk4",)
    other = replace(system, run=replace(system.run, methods=("dp8",)))
    assert eomc.load(other, tmp_path).methods == ("dp8",)
    assert not pipeline.build(other, tmp_path).fresh


def test_folder_of_a_model_contains_the_files_for_its_user(root: Path, scene: Path) -> None:
    """Python's own files are in `_runtime`; those of a previous version are removed."""
    built = eomc.build(scene, root)
    manifest = built.folder / "build.json"
    contents = json.loads(manifest.read_text(encoding="utf-8"))
    contents["files"]["former.py"] = contents["files"]["../other.py"] = ""
    manifest.write_text(json.dumps(contents), encoding="utf-8")
    for file in (built.folder / "former.py", root / "other.py"):
        file.write_text("", encoding="utf-8")
    assert eomc.build(scene, root).fresh
    names = {path.name for path in built.folder.iterdir() if not path.name.startswith("_simple")}
    assert names - {"__pycache__"} == {
        "CMakeLists.txt", "__init__.py", "_runtime", "build.json", "costs.txt", "fast", "main.c",
        "selftest.c", "simple_pendulum.c", "simple_pendulum.h", "simple_pendulum.pc.in",
    }  # fmt: skip
    assert (root / "other.py").exists()
