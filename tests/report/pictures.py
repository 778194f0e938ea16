"""Scenes and prescribed motions for tests of pictures; nothing is derived or compiled."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from eomc.robots import edit, scene_text, urdf
from eomc.scene.read import parse, read
from eomc.scene.scene import Scene

SCENES = Path(__file__).parents[2] / "scenes"
OWN = Path(__file__).parent / "pictured"
ROBOTS = {
    "allegro": "/allegro_right_hand.urdf", "anymal": "b_simple_description/robots/anymal.urdf",
    "double_pendulum_urdf": "/double_pendulum.urdf", "finger": "/finger_edu.urdf",
    "kinova": "/kinova.urdf", "panda": "/panda.urdf", "so101": "/so101.urdf",
    "solo12": "/solo12.urdf", "talos_arm": "/talos_left_arm.urdf", "ur5": "/ur5_robot.urdf",
}  # fmt: skip
FREE = ("anymal", "solo12")  # these stand on no ground


def scene(name: str) -> Scene:
    """Return a scene of eomc or of a robot file."""
    if (file := OWN / f"{name}.urdf").exists():
        return robot(file)
    if name in ROBOTS:
        return robot(robot_data(ROBOTS[name]), name in FREE)
    folder = OWN if (OWN / f"{name}.toml").exists() else SCENES
    return read(folder / f"{name}.toml")


def robot(file: Path, free: bool = False) -> Scene:
    """Return the scene of a URDF as eomc import writes it."""
    model = edit.with_nearest_inertias(edit.with_base(urdf.read(file), free))
    return parse(scene_text.scene_text(scene_text.prepare_for_scene(model)))


def robot_data(name: str) -> Path:
    """Return a URDF of example-robot-data; skip the test if it is not installed."""
    try:
        matches = [f for f in files("example-robot-data") or () if str(f).endswith(name)]
    except PackageNotFoundError:
        pytest.skip('example-robot-data is not there: pip install ".[robots]"')
    return Path(str(matches[0].locate()))


def system(model: Scene, title: str = "") -> Any:
    """Return the attributes of a System that pictures use."""
    return SimpleNamespace(
        scene=model, name=model.name, title=title or model.title, outputs=(),
        coordinates=model.coordinates, parameters=(*model.parameters,), inputs=(),
        q=model.coordinates, discrete=(),
    )  # fmt: skip


def motion(model: Scene, seconds: float = 2.0, rows: int = 121) -> Any:
    """Return a run in which each coordinate oscillates about its initial value."""
    t = np.linspace(0, seconds, rows)
    start = np.array(model.start()[0])
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
    """Return a free trunk with limbs of revolute joints, with the freedoms of a humanoid."""
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
