"""Scenes with batch = true, and batches of their states."""

from __future__ import annotations

import re
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from cases import SCENES, scene_file

import eomc

STEPS = 60
# other scenes are compiled with optimisation
UNOPTIMISED = ("cartpole", "kepler_orbit", "mass_spring")


def module(name: str, **run: str) -> ModuleType:
    """Build a scene with batch = true under build/, where later tests find it, and load it."""
    text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
    options = "".join(f"{k} = {v}\n" for k, v in {"batch": "true", **run}.items())
    many = "_".join(["many", name, *(value.strip('"') for value in run.values())])
    text = re.sub(r"^name\s*=.*", f'name = "{many}"', text, flags=re.M)
    text = text.replace("[run]\n", "[run]\n" + options)
    path = scene_file(many, text)
    with pytest.MonkeyPatch.context() as patch:
        if name in UNOPTIMISED and not run:
            patch.setenv("EOMC_CFLAGS", "-O0")
        return eomc.load(path, path.parent / "modules")


def starts(m: ModuleType, count: int) -> tuple[Any, Any]:
    """Return `count` states around the initial state of the scene."""
    random = np.random.default_rng(1)
    return tuple(x + 0.2 * random.standard_normal((count, len(x))) for x in m.start)  # type: ignore[return-value]
