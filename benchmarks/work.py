"""What is run in benchmarks/peers.py: scenes, their equations, starts and step sizes."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from functools import cache
from importlib.metadata import files
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import physics
import robots
from physics import Function, Matrices, Numbers
from scipy.integrate import solve_ivp

import eomc

HERE = Path(__file__).resolve().parent
Array = np.ndarray


@dataclass(frozen=True)
class Case:
    """Equations, a start x0 = [q; qd], and so many steps of h."""

    scene: str
    matrices: Matrices
    x0: Array
    h: float
    steps: int


def scene(name: str) -> str:
    return (HERE.parent / "scenes" / f"{name}.toml").read_text(encoding="utf-8")


def start(*q: float) -> Array:
    return np.array([*q, *np.zeros(len(q))])


def write(case: Case, root: Path, extra: str = "") -> Path:
    path = Path(tempfile.mkdtemp(dir=root)) / "scene.toml"
    path.write_text(case.scene + extra, encoding="utf-8")
    return path


def load(case: Case, root: Path, extra: str = "") -> ModuleType:
    path = write(case, root, extra)
    return eomc.load(path, path.parent)


_ends: dict[tuple[Matrices, bytes, float], Array] = {}


def trusted(matrices: Matrices, x0: Array, end: float) -> Array:
    """The state at the end, by DOP853 at rtol 1e-13; looked up the second time."""
    key, n = (matrices, x0.tobytes(), end), len(x0) // 2

    def rate(_: float, y: Array) -> Array:
        a = physics.acceleration(matrices, list(y), math.sin, math.cos)
        return np.concatenate([y[n:], a])

    if key not in _ends:
        found = solve_ivp(rate, (0, end), x0, "DOP853", rtol=1e-13, atol=1e-14, t_eval=[end])
        _ends[key] = found.y[:, -1]
    return _ends[key]


def error(case: Case, x: Array, last: Array, steps: int) -> float:
    """The largest error in a component of the last state. Of a batch, in its first four."""
    columns = x.reshape(len(x), -1)[:, :4].T
    ends = [trusted(case.matrices, column, case.h * steps) for column in columns]
    return float(np.abs(last[:, : len(columns)] - np.transpose(ends)).max())


# --- chains ------------------------------------------------------------------------------------

UNITS = 'm = { value = 1.0, unit = "kg" }\nl = { value = 1.0, unit = "m" }\n'
UNITS += 'g = { value = 9.81, unit = "m/s^2" }'


def chain_scene(n: int) -> str:
    """n point masses on massless links, absolute angles, energies by hand."""
    links = range(1, n + 1)
    squares = " + ".join(f"dot(x{i})**2 + dot(y{i})**2" for i in links)
    lines = ["eomc = 1", f'name = "chain{n}"', "[coordinates]"]
    lines += [f'a{i} = {{ unit = "rad" }}' for i in links]
    lines += ["[parameters]", UNITS, "[definitions]"]
    for i in links:
        x, y = (f"x{i - 1} + ", f"y{i - 1} ") if i > 1 else ("", "")
        lines += [f'x{i} = "{x}l*sin(a{i})"', f'y{i} = "{y}- l*cos(a{i})"']
    lines += ["[energy]", f'kinetic = "m*({squares})/2"']
    lines += [f'potential = "m*g*({" + ".join(f"y{i}" for i in links)})"', "[run]", "h = 0.001"]
    return "\n".join([*lines, ""])


def chain_of_bodies(n: int) -> str:
    """The same chain as bodies on joints, relative angles."""
    links = range(1, n + 1)
    lines = ["eomc = 1", f'name = "bodies{n}"', 'gravity = [0, "-g"]', "[coordinates]"]
    lines += [f'r{i} = {{ unit = "rad" }}' for i in links]
    lines += ["[parameters]", UNITS]
    for i in links:
        lines += ["[[body]]", f'name = "link{i}"', 'joint = "revolute"', f'coordinates = "r{i}"']
        lines += ['mass = "m"', 'center = [0, "-l"]', "inertia = 0"]
        lines += [f'parent = "link{i - 1}"', 'offset = [0, "-l"]'] if i > 1 else []
    return "\n".join([*lines, "[run]", "h = 0.001", ""])


# --- the Panda ---------------------------------------------------------------------------------


PANDA = "panda_description/urdf/panda.urdf"


@cache
def panda_model() -> Any:
    """Pinocchio's model of the Panda, its fingers locked: the judge of errors, and a peer."""
    import pinocchio

    found = next(f for f in files("example-robot-data") or () if str(f).endswith(PANDA))
    full = pinocchio.buildModelFromUrdf(str(found.locate()))
    fingers = [full.getJointId(name) for name in robots.FINGERS]
    return pinocchio.buildReducedModel(full, fingers, pinocchio.neutral(full))


def panda_matrices(q: Numbers, v: Numbers, sin: Function, cos: Function) -> tuple[Any, Any]:
    """D (its lower half) and tau - bias of the Panda, joint friction included, by Pinocchio."""
    import pinocchio

    model, at, moving = panda_model(), np.array(q, float), np.array(v, float)
    data = model.createData()
    D = pinocchio.crba(model, data, at)
    bias = pinocchio.nonLinearEffects(model, data, at, moving)
    lower = [[float(D[j, i]) for j in range(i + 1)] for i in range(len(q))]  # it fills the upper
    return lower, list(-bias - model.damping * moving)


def panda() -> Case:
    """The scene that `eomc import` writes, fingers locked; falls and swings from a bent pose."""
    text = robots.robot(PANDA, locked=robots.FINGERS)
    x0 = np.array([*np.linspace(0.1, 0.7, 7), *np.linspace(0.5, -0.3, 7)])
    return Case(f"{text}\n[run]\nh = 0.0005\n", panda_matrices, x0, 0.0005, 1000)


CASES = {
    "cart-pole": Case(scene("cartpole"), physics.cartpole, start(0.0, math.pi / 2), 0.005, 20_000),
    "double pendulum": Case(
        scene("double_pendulum"), physics.chain, start(0.5, 0.7), 0.005, 20_000
    ),
    **{
        f"chain of {n}": Case(chain_scene(n), physics.chain, start(*[0.3] * n), 0.001, steps)
        for n, steps in ((5, 10_000), (10, 5_000), (20, 1_000))
    },
}
