"""The cases with reference solutions in data/cases.json, as scenes."""

from __future__ import annotations

import json
import os
import re
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from eomc.base import names
from eomc.emit.render import Sources
from eomc.model.system import System, from_scene
from eomc.scene.read import parse, read

ROOT = Path(__file__).parents[2]
SCENES = ROOT / "scenes"
DATA = ROOT / "tests" / "data" / "cases.json"

# Scenes and the cases with the same equations and initial state.
ALIKE = {
    "mass_spring": "harmonic_1e6_periods",
    "cartpole": "cartpole_drop_physicalP",
    "cartpole_bodies": "cartpole_drop_physicalP",
    "cartpole_driven": "cartpole_torque_physicalP",
    "cartpole_tutorial": "cartpole_drop_tutorialP",
    "simple_pendulum": "pendulum_large_swing",
    "double_pendulum": "double_pendulum_regular",
    "acrobot": "acrobot_torque",
    "furuta_pendulum": "furuta_pendulum",
    "spring_pendulum": "spring_pendulum_resonant",
    "kapitza_pendulum": "kapitza_pendulum",
    "bead_on_hoop": "bead_on_hoop_near_critical",
    "foucault_pendulum": "foucault_day",
    "swinging_atwood": "swinging_atwood_mu3",
    "kepler_orbit": "kepler_e0.9_cartesian",
    "heavy_top": "lagrange_top_nutation",
}


FMA = "fma" in Path("/proc/cpuinfo").read_text(encoding="utf-8")  # of this processor

# Angles that are sums of coordinates and numbers, and one that is not.
ODD = """
eomc = 1
name = "odd"
[coordinates]
a = { start = 0.4 }
b = { start = -0.7 }
[parameters]
phase = 0.3
[energy]
kinetic = "a_dot**2/2 + b_dot**2/2 + a_dot*b_dot*cos(a - b)/3"
potential = "cos(2*a) + sin(b + 1/2) + cos(a + phase)/2 + sin(a*b)/4 + cos(a - b)/5"
"""


def odd_system() -> System:
    return from_scene(parse(ODD, "odd.toml"))


# other lines under [run], and the scenes that get them
RUN_VARIANTS = {
    "dp8": ("cartpole_driven", 'method = ["rk4", "dp8"]'),
    "batch": ("cartpole", 'batch = true\nmethod = ["rk4", "dp8"]'),
    "batch of a tree": ("chain", "batch = true"),
    "float": ("cartpole", 'real = "float"\nbatch = true'),
    "tolerance": ("cartpole_driven", "tolerance = 1e-9"),
    "batch by a tolerance": ("cartpole", "batch = true\ntolerance = 1e-9"),
    "linearize": ("cartpole_driven", 'linearize = "parameters"'),
}

# scenes that the quick tier compares
FEW_ALIKE = (
    "mass_spring", "cartpole_driven", "kapitza_pendulum", "foucault_pendulum", "heavy_top",
)  # fmt: skip


def text_of(name: str, more: str = "") -> str:
    """Return the text of a scene, with further lines under [run]."""
    text = (SCENES / f"{name}.toml").read_text(encoding="utf-8")
    return text.replace("[run]\n", f"[run]\n{more}\n")


def fast_kit(sources: Sources) -> dict[str, str]:
    """Return the generated files, with header and source of optimised C in place of portable C."""
    flat = {f: text for f, text in sources.files.items() if "/" not in f}
    fast = {f[5:]: text for f, text in sources.files.items() if f.startswith("fast/")}
    return flat | fast


def fast_files(module: ModuleType) -> dict[str, str]:
    """Return the files of a module's folder like `fast_kit`."""
    folder = Path(str(module.__file__)).parent
    files = (*folder.glob("*.[ch]"), *(folder / "fast").glob("*.[ch]"))
    return {file.name: file.read_text(encoding="utf-8") for file in files}


@cache
def cases() -> dict[str, dict[str, Any]]:
    """Return the cases by name; "contract" in the file explains their keys."""
    return {case["name"]: case for case in json.loads(DATA.read_text())["cases"]}


def scene_text(name: str) -> str:
    """Return a case as the text of a scene; parameters with names reserved in C are renamed."""
    case = cases()[name]
    if case["constraints"]:
        raise ValueError(f"{name} has constraints, which scenes can't say")
    renamed = {p: names.plain(p) if names.fault(p) else p for p in case["parameters"]}

    def formula(text: str) -> str:
        return json.dumps(re.sub(r"\b[A-Za-z]\w*", lambda m: renamed.get(m[0], m[0]), text))

    starts = zip(case["coordinates"], case["q0"], case["qd0"], strict=True)
    return "\n".join(
        [
            "eomc = 1",
            f"name = {json.dumps(re.sub('[^a-z0-9]+', '_', name.lower()))}",
            "[coordinates]",
            *(f'{q} = {{ start = "{q0}", rate = "{qd0}" }}' for q, q0, qd0 in starts),
            "[parameters]",
            *(f"{renamed[p]} = {float(value)!r}" for p, value in case["parameters"].items()),
            "[energy]",
            f"kinetic = {formula(case['K'])}",
            f"potential = {formula(case['P'])}",
            "[forces]",
            *(f"{q} = {formula(force)}" for q, force in case["generalized_forces"].items()),
            "[run]",
            f"h = {case['rk4_measured'][0]['h']!r}",
            f"duration = {float(case['t_end'])!r}",
        ]
    )


@cache
def case_system(name: str) -> System:
    """Return a case as a System, with the largest measured step size and t_end as its run."""
    return from_scene(parse(scene_text(name), f"{name}.toml"))


@cache
def scene_system(name: str) -> System:
    """Return the System of scenes/<name>.toml."""
    return from_scene(read(SCENES / f"{name}.toml"))


def error_of(name: str, q: Any) -> float:
    """Return max_i |q_i - q_ref_i| at t_end."""
    return float(np.max(np.abs(np.asarray(q) - np.array(cases()[name]["q_ref"], float))))


def scene_file(name: str, text: str) -> Path:
    """Write the text of a scene to a file; return its path."""
    path = Path("build/tests") / f"{name}.toml"
    path.parent.mkdir(parents=True, exist_ok=True)
    # other processes may read it at the same time
    own = path.with_suffix(f".{os.getpid()}")
    own.write_text(text, encoding="utf-8")
    own.replace(path)
    return path


def variant(scene: str, name: str, **replaced: str) -> Path:
    """Write a scene of scenes/ with another name and with lines added under [run]."""
    text = (SCENES / f"{scene}.toml").read_text(encoding="utf-8")
    lines = "\n".join(f"{key} = {value}" for key, value in replaced.items())
    old = next(line for line in text.splitlines() if line.startswith("name "))
    text = text.replace(old, f'name = "{name}"').replace("[run]", f"[run]\n{lines}")
    return scene_file(name, text)


def block_at_rest(block: Any, tol: float) -> Any:
    """Return the run of a block on a spring with dry friction, which must stop as expected."""
    case = cases()["coulomb_friction"]
    run = block.simulate(tol=tol, duration=6.0)
    assert run.status == "ok" and run.steps + run.rejected < 50
    (there,) = case["checkpoints"]
    q, qd = run(float(there["t"]))
    exact = max(tol, 1e-13)
    assert abs(run.q[-1, 0] - float(case["q_ref"][0])) <= exact
    assert run.q[-1, 1] == 0 and abs(run.qd[-1, 0]) < 1e-15
    assert abs(q[0] - float(there["q"][0])) <= exact
    assert abs(qd[0] - float(there["qd"][0])) <= 10 * exact
    return run
