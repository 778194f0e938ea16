"""Gains of an LQR for the cart-pole at 1 kHz, as a header of C.

python gains.py balance.toml > gains.h        (SciPy solves the Riccati equation)
"""

import sys

import numpy as np
from scipy.linalg import expm, solve_discrete_are

import eomc

H = 0.001  # s
cartpole = eomc.load(sys.argv[1])

# x' = A x + B u at rest with the pole upright, then over one period with u held
A, B = cartpole.linearize([0.0, 0.0], [0.0, 0.0], u=[0.0])
both = expm(H * np.block([[A, B], [np.zeros((1, 5))]]))
Phi, Gamma = both[:4, :4], both[:4, 4:]

Q, R = np.diag([10.0, 10.0, 1.0, 1.0]), np.array([[0.1]])
P = solve_discrete_are(Phi, Gamma, Q * H, R * H)
K = np.linalg.solve(R * H + Gamma.T @ P @ Gamma, Gamma.T @ P @ Phi)
print(f"static const double K[4] = {{ {', '.join(f'{k:.17g}' for k in K[0])} }};")
