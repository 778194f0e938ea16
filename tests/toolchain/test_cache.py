"""A build is done once: what it depends on, and which compiler it takes."""

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
from builds import CHANGED, TEXT, marks, script
from click.testing import CliRunner
from conftest import needs, tiers

import eomc
from eomc import pipeline
from eomc.base import resources
from eomc.cli.main import main
from eomc.emit import render
from eomc.toolchain import cache, compiler

pytestmark = pytest.mark.usefixtures("quickly_compiled")


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


def test_builds_of_other_versions_are_kept_some_of_them(
    scene: Path, root: Path, found: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For what they have pickled; not of the same scene with other flags."""
    monkeypatch.setattr(cache, "MAX_ARCHIVED_BUILDS", 1)
    folder = root / "simple_pendulum"
    kept, keys = folder / ".builds", [json.loads((folder / cache.MANIFEST).read_text())["key"]]
    monkeypatch.setenv("EOMC_CFLAGS", "-O0 -DOTHER")
    eomc.build(scene, root)
    assert not kept.exists()
    for text in (CHANGED, CHANGED + "# a comment\n"):
        keys.append(json.loads((folder / cache.MANIFEST).read_text())["key"])
        scene.write_text(text, encoding="utf-8")
        eomc.build(scene, root)
        assert [place.name for place in kept.iterdir()] == [keys[-1][:12]]
        assert cache.is_built(kept / keys[-1][:12], keys[-1])


def test_a_list_of_files_that_lacks_one_is_no_build(root: Path, found: None) -> None:
    """Whatever lies there would be run."""
    folder = root / "simple_pendulum"
    manifest = json.loads((folder / cache.MANIFEST).read_text(encoding="utf-8"))
    key, files = manifest["key"], manifest["files"]
    assert cache.is_built(folder, key)

    def altered(**change: object) -> bool:
        text = json.dumps({k: x for k, x in (manifest | change).items() if x is not None})
        (folder / cache.MANIFEST).write_text(text, encoding="utf-8")
        return cache.is_built(folder, key)

    assert altered()
    for name in files:
        assert not altered(files={n: x for n, x in files.items() if n != name}), name
    for change in ({"files": {}}, {"files": {}, "files_digest": None}, {"files_digest": None}):
        assert not altered(**change)
    assert not altered(files=[]) and not altered(files=None)


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
    (built.folder / "_runtime" / "status.py").write_text("", encoding="utf-8")  # no longer whole
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


def test_the_folder_of_a_model_lists_what_its_user_needs(root: Path, scene: Path) -> None:
    """Python's own files are in `_runtime`; those that a former version left are removed."""
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
