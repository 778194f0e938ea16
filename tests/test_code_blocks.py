"""Every code block of the documentation is run, or says in a comment why not.

Tutorials are followed by tests/test_tutorials.py; the README, embedding.md and interfaces.md have
tests of their own.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.cases import SCENES
from support.pages import blocks, follow
from support.session import ROOT, needs

import eomc

DOCS = ROOT / "docs"
OTHERS = {  # pages, and the tests that follow them
    "docs/embedding.md": "test_embedding_page.py",
    "docs/interfaces.md": "test_interfaces.py",
    "README.md": "test_readme.py",
}
PAGES = {
    file.relative_to(DOCS).as_posix(): file
    for file in sorted(DOCS.rglob("*.md"))
    if file.parent.name != "tutorials" and file.relative_to(ROOT).as_posix() not in OTHERS
}
PACKAGES = ("casadi", "jax", "torch", "fmpy", "scipy", "matplotlib", "xarray", "pandas", "zarr")
Setup = dict[str, Callable[[], Any]]


def load(text: str, **settings: object) -> Any:
    """Load a scene from its text, or a scene of eomc by its name, with other settings of [run]."""
    if "\n" not in text:
        text = (SCENES / f"{text}.toml").read_text(encoding="utf-8")
    for key in settings:
        text = re.sub(rf"^{key} *=.*\n", "", text, flags=re.MULTILINE)
    if "[run]" not in text:
        text += "\n[run]\n"
    count = len(list(Path().glob("setup_*")))
    lines = "".join(f"{key} = {value}\n" for key, value in settings.items())
    file = Path(f"setup_{count}.toml")
    file.write_text(text.replace("[run]\n", f"[run]\n{lines}"), encoding="utf-8")
    return eomc.load(file)


def scene_of_page(page: str, phrase: str) -> str:
    """Return the scene of a page that contains a phrase."""
    (text,) = [
        block.text
        for block in blocks((DOCS / page).read_text(encoding="utf-8"))
        if block.text.startswith("eomc = 1") and phrase in block.text
    ]
    return text


PENDULUM = """eomc = 1
name = "arm"
[coordinates]
theta = { unit = "rad", start = 0.1 }
[parameters]
m = 1.0
[inputs]
torque = { unit = "N m", signal = "-20*theta - theta_dot" }
[energy]
kinetic = "m*theta_dot**2/2"
potential = "-9.81*m*cos(theta)"
[forces]
theta = "torque"
"""
CART = """eomc = 1
name = "cart"
[coordinates]
x = { unit = "m", friction = 3.0 }
theta = { unit = "rad" }
[energy]
kinetic = "x_dot**2 + theta_dot**2/2 + x_dot*theta_dot*cos(theta)/2"
potential = "-5*cos(theta)"
"""


def _many() -> dict[str, Any]:
    """Return a module for batches, and states and parameters of eight instances."""
    state = np.full((8, 2), 0.1)
    return {
        "many": load("cartpole_driven", batch="true"), "q0": state, "qd0": state * 0,
        "masses": np.linspace(1, 2, 8), "forces": np.zeros((8, 1)), "clocks": np.zeros(8),
    }  # fmt: skip


def _balance() -> dict[str, Any]:
    import scipy

    text = (DOCS / "examples" / "balance.toml").read_text(encoding="utf-8")
    zero = np.zeros((256, 2))
    return {
        "cartpole": load(text), "scipy": scipy, "Q": np.eye(4), "R": np.eye(1),
        "actions": np.zeros((256, 1)), "q": zero.copy(), "qd": zero.copy(),
    }  # fmt: skip


def _pictures() -> dict[str, Any]:
    runs = load("cartpole", batch="true").simulate_batch(np.full((41, 2), 0.1))
    cartpole = load("cartpole")
    return {"cartpole": cartpole, "other_run": cartpole.simulate(duration=2), "runs": runs}


def _linkage() -> dict[str, Any]:
    linkage = load("four_bar", batch="true", inverse_dynamics="true")
    q, qd = linkage.project(linkage.start[0], linkage.start[1])
    return {"four_bar": linkage, "q0": np.tile(q, (3, 1)), "qdd": linkage.acceleration(q, qd)}


def ball(**settings: object) -> Any:
    """Load the ball of adaptive.md."""
    return load(scene_of_page("adaptive.md", 'name = "ball"\n'), **settings)


def _vectors() -> dict[str, Any]:
    one = np.ones(1)
    arm = load(PENDULUM.replace("arm", "arm_products"), linearize='"products"')
    return {"arm": arm, "q": one, "qd": one, "qdd_bar": one, "t": 0.0, "u": one,
            "dq": one, "dqd": one, "du": one, "dp": one}  # fmt: skip


def _double_pendulum() -> dict[str, Any]:
    text = (SCENES / "double_pendulum.toml").read_text(encoding="utf-8")
    text = text.replace("[definitions]\n", '[definitions]\ny = "1 - cos(theta2)"\n')
    return {"pendulum": load(text, tolerance=1e-9)}


def _policy() -> dict[str, Any]:
    Path("pendulum.toml").write_text(PENDULUM + "[run]\nbatch = true\n", encoding="utf-8")
    return {}


def _discrete() -> dict[str, Any]:
    arm = load(PENDULUM, discretize="true", linearize='"parameters"')
    return {"arm": arm, "q": [0.1], "qd": [0.0], "table": np.zeros((100, 1))}


SETUPS: dict[str, Setup] = {
    "python.md": {
        "motor.equilibrium": lambda: {"motor": load(scene_of_page("scenes.md", "charge_dot"))},
        "closed=True": _discrete,
        "acceleration_vjp": _vectors,
        "run.vjp": lambda: {
            "cartpole": load("cartpole_driven", linearize='"products"'), "u": np.zeros((200, 1))
        },
        "of the time of the first impact": lambda: {
            "ball": ball(linearize='"products"')
        },
        "arm.discretize": _discrete,
        "solve_discrete_are": _balance,
        "u=actions": _balance,
        "masses": _many,
    },
    "adaptive.md": {
        "kepler.simulate": lambda: {"kepler": load("kepler_orbit", tolerance=1e-9)},
        "K @": lambda: {
            "cartpole": load("cartpole_driven", tolerance=1e-9), "K": np.ones((1, 4))
        },
        "balls.simulate_batch": lambda: {"balls": ball(batch="true")},
        'impacts = run.events["impact"]': lambda: {"run": ball().simulate(duration=2)},
        '"section": "theta2"': _double_pendulum,
        'ball.simulate(h=0.01': lambda: {"ball": ball()},
        "x_sticks": lambda: {"cart": load(CART, friction='"stick"', tolerance=1e-9)},
    },
    "constraints.md": {"four_bar.simulate": _linkage},
    "pictures.md": {"other_run": _pictures},
    "plotting.md": {"masses": _many},
    "sweeps.md": {"policy=policy": _policy},
    "optimisation.md": {
        "pitch.simulate": lambda: {"pitch": load(scene_of_page("optimisation.md", '"pitch"'))}
    },
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", [n for n, f in PAGES.items() if any(blocks(f.read_text("utf-8")))])
def test_blocks_of_page_run(name: str, tmp_path: Path) -> None:
    text = PAGES[name].read_text(encoding="utf-8")
    needs("cc")
    for package in PACKAGES:
        if re.search(rf"\b{package}\b|to_{package}\b", text):
            pytest.importorskip(package)
    if "eomc new" not in text:  # which writes into this folder
        shutil.copytree(SCENES, tmp_path / "scenes")
    for file in (DOCS / "examples" / "sweeps").glob("*.toml"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    follow(text, tmp_path, SETUPS.get(name))


@pytest.mark.parametrize("page", OTHERS)
def test_other_pages_are_followed_by_their_tests(page: str) -> None:
    assert Path(page).name in (ROOT / "tests" / OTHERS[page]).read_text(encoding="utf-8")
