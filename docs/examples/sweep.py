"""Parameter study in a pool of processes: the largest initial angle that the LQR can balance.

python docs/examples/sweep.py
"""

from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

import eomc

K = np.array([-8.7, 63.4, -9.9, 16.0])  # of lqr.py


def caught(cartpole, mass, lean):
    """Return whether the pole of this mass is balanced from this initial angle."""
    run = cartpole.simulate(
        q0=[0, lean], u=lambda t, q, qd: [-K @ [*q, *qd]], control_period=0.02,
        params={"m_p": mass},
    )  # fmt: skip
    return run.status == "ok" and abs(run["tip_x"][-1]) < 0.3


def farthest(cartpole, mass):
    """Return the largest angle that is balanced, to a thousandth of a radian."""
    low, high = 0.0, 1.5
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (middle, high) if caught(cartpole, mass, middle) else (low, middle)
    return low


if __name__ == "__main__":
    cartpole = eomc.load(Path(__file__).with_name("balance.toml"))  # built once, in this process
    masses = np.linspace(0.1, 0.8, 8)
    with ProcessPoolExecutor() as pool:  # modules are pickled for other processes
        for mass, lean in zip(masses, pool.map(partial(farthest, cartpole), masses), strict=True):
            print(f"{mass:.1f} kg: up to {lean:.3f} rad")
