"""Forces at points of bodies: Jacobians by hand, both frames, and the check's results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy

import eomc
from eomc.derive import lagrange
from eomc.model.system import from_scene, symbol
from eomc.program import ir, program
from eomc.scene.read import parse
from eomc.verify import symbolic
from eomc.verify.check import check

ARM = """eomc = 1
name = "arm"
gravity = [0, "-9.81"]
[coordinates]
a = { unit = "rad", start = 0.3 }
b = { unit = "rad", start = 0.6 }
[inputs]
F = { signal = "sin(t)" }
M = { signal = 0.3 }
[[body]]
name = "upper"
joint = "revolute"
coordinates = "a"
mass = 2
center = [0.4, 0]
inertia = 0.2
[[body]]
name = "lower"
parent = "upper"
joint = "revolute"
coordinates = "b"
offset = [0.8, 0]
mass = 1
center = [0.3, 0.1]
inertia = 0.1
"""
SPACE = """eomc = 1
name = "space_arm"
gravity = [0, 0, "-9.81"]
[coordinates]
a = { unit = "rad", start = 0.3 }
b = { unit = "rad", start = 0.6 }
c = { unit = "rad", start = 0.2 }
s = { start = 0.1 }
[inputs]
F = { unit = "N", signal = "sin(t)" }
[[body]]
name = "base"
joint = "revolute"
axis = [0.2, 0.3, 1]
coordinates = "a"
mass = 2
center = [0.4, 0, 0.1]
inertia = [0.2, 0.3, 0.25, 0.01, 0, 0]
[[body]]
name = "hand"
parent = "base"
joint = "universal"
coordinates = ["b", "c"]
offset = [0.8, 0, 0.1]
mass = 1
center = [0.3, 0.1, 0.2]
inertia = [0.1, 0.12, 0.15, 0.01, 0.02, 0]
[[body]]
name = "finger"
parent = "hand"
joint = "prismatic"
axis = [1, 1, 0]
coordinates = "s"
offset = [0.2, 0, 0.1]
mass = 0.5
[[force]]
body = "finger"
point = [0.7, 0.1, 0.2]
force = ["F", 1, "-2*c_dot"]
torque = [0.1, "F", -0.2]
[[force]]
body = "hand"
torque = ["F*t/10", 0.3, "b"]
force = [1, 2, 3]
frame = "body"
"""
# a table, and the force (world), the torque and the point (body) that it describes
A, B, F, M = (symbol(name) for name in "abFM")
C, S = sympy.cos(A + B), sympy.sin(A + B)
CASES = {
    "world": ('point = [0.7, 0.2]\nforce = ["F", "-2*b"]', (F, -2 * B), 0, (0.7, 0.2)),
    "body": ('force = ["F", 2]\nframe = "body"', (C * F - 2 * S, S * F + 2 * C), 0, (0, 0)),
    "torque": ('torque = "M*cos(a)"', (0, 0), M * sympy.cos(A), (0, 0)),
}


def build(text: str) -> Any:
    return program.build(lagrange.derive(from_scene(parse(text, "arm.toml"))))


@pytest.mark.parametrize("what", CASES)
def test_generalized_force_agrees_with_the_jacobian(what: str) -> None:
    table, force, torque, (x, y) = CASES[what]
    at = {"a": 0.3, "b": -0.8, "a_dot": 0.4, "b_dot": 0.9, "F": 1.3, "M": 0.7, "t": 0.2}
    result, _ = ir.evaluate(build(f'{ARM}[[force]]\nbody = "lower"\n{table}\n')["tau"], at)
    point = (0.8 * sympy.cos(A) + C * x - S * y, 0.8 * sympy.sin(A) + S * x + C * y)
    for k, q in enumerate((A, B)):
        exact = sum(f * p.diff(q) for f, p in zip(force, point, strict=True)) + torque
        numbers = {symbol(name): value for name, value in at.items()}
        assert result[k] == pytest.approx(float(sympy.sympify(exact).subs(numbers)), rel=1e-13)


def test_forces_on_fixed_bodies_cost_nothing() -> None:
    fixed = '[[body]]\nname = "base"\njoint = "fixed"\nmass = 1\n'
    pushed = f'{ARM}{fixed}[[force]]\nbody = "base"\nforce = ["F", 1]\n'
    assert "tau" not in build(pushed) and "tau" not in build(ARM)


def test_spatial_forces_agree_with_both_references() -> None:
    system = from_scene(parse(SPACE, "space.toml"))
    rng = np.random.default_rng(1)
    functions = build(SPACE)
    jets = symbolic.reference_for(system)
    for _ in range(3):
        q, qd, u = rng.normal(size=4), rng.normal(size=4), rng.normal(size=1)
        names = [x.name for x in (*system.q, *system.qd, *system.u)]
        at = dict(zip(names, [*q, *qd, *u], strict=True)) | {"t": 0.4}
        result, _ = ir.evaluate(functions["tau"], at)
        assert result == pytest.approx(jets.evaluate("tau", q, qd, 0.4, u), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("text", [ARM, SPACE])
def test_check_agrees_by_virtual_work_of_point_masses(tmp_path: Path, text: str) -> None:
    if "[[force]]" not in text:
        for what in ("world", "body", "torque"):
            text += f'[[force]]\nbody = "lower"\n{CASES[what][0]}\n'
    system = from_scene(parse(text, "test.toml"))
    report = check(system, eomc.load(system, tmp_path))
    assert report.passed, report.table()
    assert any(row.name == "power of forces of bodies" and row.judged for row in report.results)
