"""Energy-based swing-up of a cart-pole, then LQR.

python docs/examples/swing_up.py
"""

from pathlib import Path

import numpy as np
from scipy.linalg import solve_discrete_are

import eomc

PERIOD = 0.02
cartpole = eomc.load(Path(__file__).with_name("balance.toml"))

Phi, Gamma = cartpole.discretize([0, 0], [0, 0], u=[0], control_period=PERIOD)
Q, R = np.diag([10.0, 10.0, 1.0, 1.0]), np.array([[0.1]])
P = solve_discrete_are(Phi, Gamma, Q, R)
K = np.linalg.solve(R + Gamma.T @ P @ Gamma, Gamma.T @ P @ Phi)
SWING = cartpole.outputs.index("swing")


def law(t, q, qd):
    """Return the force: LQR near the upright position, otherwise a law that raises the energy."""
    angle = np.remainder(q[1] + np.pi, 2 * np.pi) - np.pi
    if abs(angle) < 0.4 and abs(qd[1]) < 3:
        return -K @ [q[0], angle, *qd]
    lacks = -cartpole.output(q, qd)[SWING]
    return [20 * lacks * qd[1] * np.cos(angle) - 2 * q[0] - qd[0]]


run = cartpole.simulate(q0=[0, np.pi - 0.01], u=law, control_period=PERIOD, duration=20)
up = run["tip_y"] > 0.99
print(f"upright from t = {run.t[np.flatnonzero(~up)[-1]]:.2f} s on")
print(
    f"|x| up to {np.abs(run.q[:, 0]).max():.2f} m, saturated {run.saturated.mean():.0%} of the time"
)
print(f"at the end the tip is at {run['tip_x'][-1]:.5f} m, {run['tip_y'][-1]:.5f} m")
