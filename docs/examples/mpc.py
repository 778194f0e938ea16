"""Model predictive control of a double pendulum on a cart, by CasADi and IPOPT.

python docs/examples/mpc.py        (pip install casadi)

Direct multiple shooting: RK4 of the symbolic accelerations, exact Hessians. The plant is the
compiled module of the same scene, with smaller steps and a heavier upper link.
"""

import importlib
import sys
from pathlib import Path

import casadi
import numpy as np

import eomc

SCENE = Path(__file__).with_name("cart_double_pendulum.toml")
PERIOD, HORIZON = 0.04, 25  # s, control periods
LIMIT, TRACK = 30.0, 0.8  # N, m
WEIGHTS = np.diag([10.0, 50.0, 50.0, 1.0, 1.0, 1.0])  # of x, a1, a2 and their velocities

folder = eomc.export(SCENE, "casadi", Path("build") / "cart_double_pendulum_casadi")
sys.path.insert(0, str(folder.parent))
model = importlib.import_module(folder.name)


def shooting_problem():
    """Return the solver of one horizon, whose parameter is the state at its start."""
    x, u = casadi.SX.sym("x", 2 * model.nq), casadi.SX.sym("u", model.nu)
    f = casadi.Function("f", [x, u], [model.ode(x, u)])
    k1 = f(x, u)
    k2 = f(x + PERIOD / 2 * k1, u)
    k3 = f(x + PERIOD / 2 * k2, u)
    k4 = f(x + PERIOD * k3, u)
    step = casadi.Function("step", [x, u], [x + PERIOD / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])

    X, U = casadi.MX.sym("X", 2 * model.nq, HORIZON + 1), casadi.MX.sym("U", model.nu, HORIZON)
    start = casadi.MX.sym("start", 2 * model.nq)
    cost = casadi.sumsqr(U) / 100
    for k in range(HORIZON + 1):
        weight = WEIGHTS if k < HORIZON else 20 * WEIGHTS
        cost += casadi.bilin(weight, X[:, k], X[:, k])
    defects = casadi.horzcat(X[:, 0] - start, X[:, 1:] - step.map(HORIZON)(X[:, :-1], U))
    problem = {
        "x": casadi.veccat(X, U),
        "p": start,
        "f": cost,
        "g": casadi.vec(defects),
    }
    options = {
        "ipopt.print_level": 0,
        "print_time": False,
        "ipopt.sb": "yes",
        "ipopt.max_iter": 100,
    }
    return casadi.nlpsol("solver", "ipopt", problem, options)


solver = shooting_problem()
states = np.full((HORIZON + 1, 2 * model.nq), np.inf)
states[:, 0] = TRACK  # the cart stays on its track
bounds = np.concatenate([states.ravel(), np.full(HORIZON * model.nu, LIMIT)])
guess, iterations, status = np.zeros(bounds.size), [], set()


def law(t, q, qd):
    """Return the first force of the best inputs over the horizon from a measured state."""
    global guess
    solution = solver(x0=guess, p=[*q, *qd], lbx=-bounds, ubx=bounds, lbg=0, ubg=0)
    guess = solution["x"].full().ravel()
    iterations.append(solver.stats()["iter_count"])
    status.add(solver.stats()["return_status"])
    return guess[states.size : states.size + model.nu]


plant = eomc.load(SCENE)
run = plant.simulate(u=law, control_period=PERIOD, params={"m2": 0.22})
print(f"{len(iterations)} problems of {bounds.size} variables: {', '.join(sorted(status))},")
print(f"{np.mean(iterations):.1f} iterations each, at most {max(iterations)}")
print(
    f"|x| up to {np.abs(run.q[:, 0]).max():.2f} m, force up to {np.abs(run['force']).max():.1f} N"
)
print(
    f"at the end x = {run.q[-1, 0]:.1g} m, a1 = {run.q[-1, 1]:.1g} rad, a2 = {run.q[-1, 2]:.1g} rad"
)
