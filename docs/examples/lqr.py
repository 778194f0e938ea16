"""LQR of a cart-pole with a saturating motor and a control period of 20 ms.

python docs/examples/lqr.py        (SciPy solves the Riccati equation)
"""

from pathlib import Path

import numpy as np
from scipy.linalg import solve_discrete_are

import eomc

PERIOD = 0.02  # s, four steps
cartpole = eomc.load(Path(__file__).with_name("balance.toml"))

# x' = Phi x + Gamma u over one period, linearized at the upright position
q, qd, u = cartpole.equilibrium([0.0, 0.0], u=[0.0])
Phi, Gamma = cartpole.discretize(q, qd, u=u, control_period=PERIOD)

Q, R = np.diag([10.0, 10.0, 1.0, 1.0]), np.array([[0.1]])
P = solve_discrete_are(Phi, Gamma, Q, R)
K = np.linalg.solve(R + Gamma.T @ P @ Gamma, Gamma.T @ P @ Phi)

run = cartpole.simulate(
    q0=[0.0, 0.35], u=lambda t, q, qd: -K @ [*q, *qd], control_period=PERIOD, estimate=True
)
print("poles of the loop:", np.sort(np.abs(np.linalg.eigvals(Phi - Gamma @ K))).round(3))
print(f"force between {run['force'].min():.2f} and {run['force'].max():.2f} N,", end=" ")
print(f"saturated at {run.saturated.sum()} of {len(run)} rows")
print(f"at the end x = {run.q[-1, 0]:.5f} m, theta = {run.q[-1, 1]:.5f} rad")
print(f"exact to {run.error.q[-1].max():.1g}")
