"""Simultaneous builds of one name: each loads its own module, or the last one."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest
from support.builds import CHANGED, FRESH, TEXT, gravity, leftovers, start_build
from support.forks import in_a_fork

import eomc
from eomc.toolchain import cache

pytestmark = pytest.mark.usefixtures("quickly_compiled")


@pytest.mark.usefixtures("quickly_compiled")
def test_module_replaced_by_another_build_is_not_loaded(
    scene: Path, root: Path, existing_build: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scene of the same name is built between this build and its loading, which is repeated."""
    other, load, times = tmp_path / "other.toml", cache.load, 0
    other.write_text(CHANGED, encoding="utf-8")

    def build_other_scene(built: cache.Built) -> ModuleType:
        nonlocal times
        times += 1
        if times <= most:
            eomc.build(other, root)
        return load(built)

    monkeypatch.setattr(cache, "load", build_other_scene)
    most = 2
    assert eomc.load(scene, root).g([1.0])[0] == pytest.approx(8.2548, abs=1e-3)
    assert times == 3
    most, times = 100, 0
    with pytest.raises(eomc.EomcError, match=r"other builds of a scene of this .*--build DIR"):
        eomc.load(scene, root)


@pytest.mark.usefixtures("quickly_compiled")
def test_module_with_the_manifest_of_another_build_is_not_loaded(
    scene: Path, root: Path, existing_build: None, tmp_path: Path
) -> None:
    """The manifest, which is moved last, is still the old one."""
    folder, other = root / "simple_pendulum", tmp_path / "other.toml"
    scene.write_text(TEXT.replace('"m*g*y"', '"3*m*g*y"'), encoding="utf-8")  # no test loads it
    old = eomc.build(scene, root)
    manifest = (folder / "build.json").read_bytes()
    other.write_text(CHANGED, encoding="utf-8")
    eomc.build(other, root)
    (folder / "build.json").write_bytes(manifest)

    def load() -> None:
        cache.load(old)

    how, words = in_a_fork(load, 20)
    assert how == "raised" and str(words).startswith("ReplacedError: "), words


def test_two_simultaneous_builds_succeed(scene: Path, root: Path) -> None:
    """One of them builds; the other waits and uses the result."""
    both = [start_build(scene, root) for _ in range(2)]
    for process in both:
        process.join(60)
    assert sorted(str(process.exitcode) for process in both) == [str(FRESH), str(FRESH - 1)]
    assert leftovers(root) == []
    assert gravity(root) == pytest.approx(8.2548, abs=1e-3)


@pytest.mark.slow
def test_simultaneous_builds_of_two_scenes_of_one_name(
    scene: Path, root: Path, tmp_path: Path
) -> None:
    """The last module remains and is complete."""
    other = tmp_path / "other.toml"
    other.write_text(CHANGED, encoding="utf-8")
    both = [start_build(file, root) for file in (scene, other)]
    for process in both:
        process.join(60)
    assert [process.exitcode for process in both] == [FRESH, FRESH]
    assert round(gravity(root)) in (8, 17)
    assert leftovers(root) == []
