"""The scene, the draws and the comparison that tests of sweeps share."""

from __future__ import annotations

from typing import Any

import numpy as np

SCENE = """
eomc = 1
name = "sweep_pendulum"
[coordinates]
theta = { unit = "rad", start = 0.5 }
[parameters]
m = 1.0
l = 1.0
g = 9.81
[inputs]
torque = { signal = "sin(t)" }
[outputs]
height = "-l*cos(theta)"
[energy]
kinetic   = "m*l**2*theta_dot**2/2"
potential = "-m*g*l*cos(theta)"
[forces]
theta = "torque"
[run]
h        = 0.01
duration = 0.2
batch    = true
"""
DRAWS: dict[str, Any] = {"theta": {"uniform": [-3, 3]}, "m": {"normal": [2, 0.1]}}
SWEEP: dict[str, Any] = {"draws": DRAWS, "n": 1100, "threads": 1}


def are_equal(a: Any, b: Any) -> bool:
    return {*a.variables} == {*b.variables} and all(
        np.array_equal(a[name].values, b[name].values, equal_nan=True) for name in a.variables
    )
