"""A scene for tests of sweeps, and the results of a sweep of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from support.sweep_scene import SCENE, SWEEP


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("scene") / "sweep_pendulum.toml"
    file.write_text(SCENE, encoding="utf-8")
    return file


@pytest.fixture(scope="session")
def reference(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    from eomc.sweeps.sweep import sweep

    return sweep(scene, **SWEEP, out=tmp_path_factory.mktemp("reference") / "a.zarr")
