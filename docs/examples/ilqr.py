"""Swing-up of a cart-pole by iLQR: the best inputs, and a feedback along the motion.

python docs/examples/ilqr.py        (NumPy only)

Each iteration linearizes the steps along a motion in one call, solves a linear-quadratic problem
backwards (Riccati recursion), and simulates its law with a line search. Limits of the force as in
Tassa, Mansard, Todorov, Control-limited differential dynamic programming, ICRA 2014.
"""

from pathlib import Path

import numpy as np

import eomc

PERIOD, DURATION = 0.03, 2.4  # s
Q = np.diag([0.1, 0.2, 0.05, 0.05]) * PERIOD  # weights of x, theta and their velocities
END = np.diag([200.0, 400.0, 40.0, 40.0])
R = np.array([[0.02]]) * PERIOD
TARGET = np.zeros(4)
START = [0.0, np.pi], [0.0, 0.0]  # hanging at rest

cartpole = eomc.load(Path(__file__).with_name("balance.toml"))
periods = round(DURATION / PERIOD)
LIMIT = 9.5  # N, of the computed force; the motor saturates at 10 N


def simulate(law, **how):
    """Return states (n + 1, 4) and forces (n, 1) of a motion under the law(k, x)."""

    def force(t, q, qd):
        return np.clip(law(round(t / PERIOD), np.concatenate([q, qd])), -LIMIT, LIMIT)

    run = cartpole.simulate(
        *START, u=force, control_period=PERIOD, duration=DURATION, h=PERIOD / 6, every=6, **how
    )
    return np.hstack([run.q, run.qd]), run["force"][:-1, None]


def cost(x, u):
    """Return the sum of weighted squares, with the end of the motion."""
    d = x - TARGET
    running = np.einsum("ki,ij,kj", d[:-1], Q, d[:-1]) + np.einsum("ki,ij,kj", u, R, u)
    return (running + d[-1] @ END @ d[-1]) / 2


def along(x, u, gains, changes=0.0):
    """Return the law that follows a motion (x, u) by feedback, with changed inputs."""
    wanted = u + changes
    return lambda k, at: wanted[k] + gains[k] @ (at - x[k])


def improve(x, u, damping):
    """Return changes (n, 1) of the inputs and gains (n, 1, 4), by a Riccati recursion."""
    q, qd = np.split(x[:-1], 2, axis=1)
    Phi, Gamma = cartpole.discretize(q, qd, PERIOD / 6, u=u, control_period=PERIOD)
    changes, gains = np.empty_like(u), np.empty((periods, 1, 4))
    by_x, by_xx = END @ (x[-1] - TARGET), END  # derivatives of the cost of the rest of the motion
    for k in reversed(range(periods)):
        A, B = Phi[k], Gamma[k]
        by_u, by_uu, by_ux = R @ u[k] + B.T @ by_x, R + B.T @ by_xx @ B, B.T @ by_xx @ A
        damped = by_uu + damping * np.eye(1)
        change, K = -np.linalg.solve(damped, by_u), -np.linalg.solve(damped, by_ux)
        free = np.abs(u[k] + change) < LIMIT  # an input at its limit has no feedback
        change, K = np.clip(u[k] + change, -LIMIT, LIMIT) - u[k], K * free
        by_x = Q @ (x[k] - TARGET) + A.T @ by_x
        by_x += K.T @ (by_uu @ change + by_u) + by_ux.T @ change
        by_xx = Q + A.T @ by_xx @ A + K.T @ by_uu @ K + K.T @ by_ux + by_ux.T @ K
        changes[k], gains[k] = change, K
    return changes, gains


x, u = simulate(lambda k, x: [3 * np.sin(3 * k * PERIOD)])
best, damping, iterations = cost(x, u), 1e-3, 0
while damping < 1e6 and iterations < 200:
    iterations += 1
    changes, gains = improve(x, u, damping)
    for size in 0.5 ** np.arange(8):
        new = simulate(along(x, u, gains, size * changes))
        if (value := cost(*new)) < best:
            break
    else:
        damping *= 10
        continue
    converged = best - value < 1e-4 * best
    (x, u), best, damping = new, value, max(damping / 5, 1e-6)
    if converged:
        break

print(f"{iterations} iterations, cost {best:.3f}, force up to {np.abs(u).max():.2f} N")
print(f"at the end x = {x[-1, 0]:.4f} m, theta = {x[-1, 1]:.4f} rad, speed {x[-1, 3]:.4f} rad/s")
# the same law with a pole that is a tenth heavier: the feedback keeps the motion
changed, _ = simulate(along(x, u, gains), params={"m_p": 0.33})
open_loop, _ = simulate(along(x, u, 0 * gains), params={"m_p": 0.33})
print(
    f"heavier pole: theta = {changed[-1, 1]:.3f} rad, without feedback {open_loop[-1, 1]:.3f} rad"
)
