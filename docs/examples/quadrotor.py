"""LQR of a quadrotor whose attitude is a unit quaternion: 12 states in place of 14.

python docs/examples/quadrotor.py        (SciPy solves the Riccati equation)
"""

from pathlib import Path

import numpy as np
from scipy.linalg import solve_discrete_are

import eomc

PERIOD = 0.02  # s, four steps
quadrotor = eomc.load(Path(__file__).parents[2] / "scenes" / "quadrotor.toml")

# z' = Phi z + Gamma u for the variations z = T^T (x - x0) that preserve the norm of the quaternion
q0, qd0, u0 = quadrotor.equilibrium()
T = quadrotor.tangent(q0, qd0)
Phi, Gamma = quadrotor.discretize(q0, qd0, u=u0, control_period=PERIOD)
Phi, Gamma = T.T @ Phi @ T, T.T @ Gamma
Q, R = T.T @ np.diag([4, 4, 4, 1, 1, 1, 1, 1, 1, 1, 0.02, 0.02, 0.02, 0.02]) @ T, 0.5 * np.eye(4)
P = solve_discrete_are(Phi, Gamma, Q, R)
K = np.linalg.solve(R + Gamma.T @ P @ Gamma, Gamma.T @ P @ Phi) @ T.T


def law(t, q, qd):
    """Return the thrusts, held constant over a period."""
    sign = np.where(q[3] < 0, [1, 1, 1, -1, -1, -1, -1], 1)  # q and -q are the same attitude
    return u0 - K @ np.concatenate([sign * q - q0, sign * qd])


tilt = np.radians(80)
start = [1.0, -1.0, 2.0, np.cos(tilt / 2), np.sin(tilt / 2), 0.0, 0.0]
run = quadrotor.simulate(q0=start, u=law, control_period=PERIOD, estimate=True)
print(f"{T.shape[1]} states; at the end {run.q[-1].round(4) + 0.0}")
print(f"the quaternion's length is 1 within {abs(run.constraints['unit']).max():.1g}", end=", ")
print(f"the run is exact to {run.error.q[-1].max():.1g}")
