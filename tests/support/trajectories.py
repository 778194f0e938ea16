"""Scenes with batch = true, states, and comparison of runs."""

from __future__ import annotations

import re
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import eomc
from support.cases import SCENES, scene_file

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


Q, QD = [0.3, 1.1], [-0.4, 0.7]  # a state of the cart-pole


def runs_are_equal(run: Any, other: Any) -> bool:
    """Return True if two runs have equal bits."""
    pairs = ((run.t, other.t), (run.q, other.q), (run.qd, other.qd), (run.energy, other.energy))
    return all(np.array_equal(a, b) for a, b in pairs)


def assert_close(actual: Any, expected: Any) -> None:
    """Compare up to the rounding of some hundred steps."""
    np.testing.assert_allclose(actual, expected, rtol=1e-13, atol=1e-13)
