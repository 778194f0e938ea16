"""Scenes and motions for tests of pictures: prescribed, so that nothing is derived or compiled."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from eomc.scene.read import parse, read
from eomc.scene.scene import Scene

SCENES = Path(__file__).parents[2] / "scenes"
OWN = Path(__file__).parent / "pictured"


def scene(name: str) -> Scene:
    folder = OWN if (OWN / f"{name}.toml").exists() else SCENES
    return read(folder / f"{name}.toml")


def system(made: Scene, title: str = "") -> Any:
    """What pictures ask of a System."""
    return SimpleNamespace(
        scene=made, pictured=None, name=made.name, title=title or made.title, outputs=(),
        coordinates=made.coordinates, parameters=(*made.parameters,), inputs=(), q=made.coordinates,
    )  # fmt: skip


def motion(made: Scene, seconds: float = 2.0, rows: int = 121) -> Any:
    """A motion of each coordinate about its start, as a run has it."""
    t = np.linspace(0, seconds, rows)
    start = np.array(made.start()[0])
    rates = 1 + 0.37 * np.arange(len(start)) % 2
    q = start + 0.4 * np.sin(np.outer(t, rates))
    return SimpleNamespace(t=t, q=q, qd=0 * q, energy=1 + 0 * t, outputs={})


CHAIN = """
eomc = 1
name = "chain"
gravity = [0, -9.81]
[constants]
n = 50
[coordinates]
"theta[i]" = { repeat = "i = 1..n", unit = "rad" }
[[body]]
name = "link[1]"
joint = "revolute"
coordinates = "theta[1]"
center = [0.1, 0]
mass = 1.0
inertia = 0.01
[[body]]
repeat = "i = 2..n"
name = "link[i]"
parent = "link[i-1]"
joint = "revolute"
coordinates = "theta[i]"
offset = [0.2, 0]
center = [0.1, 0]
mass = 1.0
inertia = 0.01
"""


def chain() -> Scene:
    return parse(CHAIN)


def humanoid(limbs: int = 5, joints: int = 6) -> Scene:
    """A free trunk with limbs of revolute joints: as many freedoms as a humanoid has."""
    names = [f"a{k}{j}" for k in range(limbs) for j in range(joints)]
    base = ["x", "y", "z", "yaw", "pitch", "roll"]
    lines = ["eomc = 1", 'name = "humanoid"', "gravity = [0, 0, -9.81]", "[coordinates]"]
    lines += [
        f'{name} = {{ unit = "{"m" if len(name) == 1 else "rad"}" }}' for name in base + names
    ]
    lines += ["[[body]]", 'name = "trunk"', 'joint = "free"', f"coordinates = {base}", "mass = 30",
              "inertia = [1.0, 1.2, 0.5]"]  # fmt: skip
    for k in range(limbs):
        for j in range(joints):
            parent = f"b{k}{j - 1}" if j else "trunk"
            lines += ["[[body]]", f'name = "b{k}{j}"', f'parent = "{parent}"', 'joint = "revolute"',
                      f"axis = {[[1, 0, 0], [0, 1, 0], [0, 0, 1]][j % 3]}",
                      f'coordinates = "a{k}{j}"', f"offset = [{0.1 * (k - 2)}, 0.1, -0.15]",
                      "center = [0, 0, -0.07]", "mass = 2",
                      "inertia = [0.01, 0.01, 0.002]"]  # fmt: skip
    return parse("\n".join(lines))
