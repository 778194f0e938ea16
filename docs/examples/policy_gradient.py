"""Policy gradient through the simulator: a small network learns to balance cart-poles, in JAX.

python docs/examples/policy_gradient.py        (pip install jax)

The gradient of the cost is exact, by the adjoints of all steps (analytic policy gradient), so a
few episodes suffice. The network is trained with parameters of the model drawn at random.
"""

import importlib
import sys
from pathlib import Path

import jax
import jax.numpy as jnp

import eomc

BATCH, PERIODS, EPISODES = 32, 60, 100
PERIOD = {"h": 0.01, "steps": 2}  # of control, two steps
RATE = 0.03  # of learning

jax.config.update("jax_enable_x64", True)
scene = Path(__file__).with_name("balance.toml")
folder = eomc.export(scene, "jax", Path("build") / "balance_jax")
sys.path.insert(0, str(folder.parent))
model = importlib.import_module(folder.name)


def policy(weights, q, qd):
    """Return the force: a network with one hidden layer, of the observations of a state."""
    observations = jnp.concatenate([q[..., :1], jnp.sin(q[..., 1:]), qd], axis=-1)
    hidden = jnp.tanh(observations @ weights["inner"] + weights["shift"])
    return 10 * jnp.tanh(hidden @ weights["outer"])


def simulate(weights, q, qd, p):
    """Return the states and forces of all control periods."""

    def advance(state, _):
        force = policy(weights, *state)
        state = model.step(*state, force, p, **PERIOD)
        return state, (*state, force)

    return jax.lax.scan(advance, (q, qd), None, PERIODS)[1]


def cost(weights, q, qd, p):
    """Return the mean cost of the episodes: distance of the tip from its target, and effort."""
    q, qd, force = simulate(weights, q, qd, p)
    distance = q[..., 0] ** 2 + 4 * (1 - jnp.cos(q[..., 1])) + 0.05 * (qd**2).sum(-1)
    return distance.mean() + 1e-3 * (force**2).mean()


def draw(key):
    """Draw states at rest or slow, and parameters within a tenth of the scene's."""
    keys = jax.random.split(key, 3)
    q = jax.random.uniform(keys[0], (BATCH, 2), minval=-0.3, maxval=0.3)
    qd = jax.random.uniform(keys[1], (BATCH, 2), minval=-0.3, maxval=0.3)
    spread = jax.random.uniform(keys[2], (BATCH, model.np), minval=0.9, maxval=1.1)
    return q, qd, model.defaults * spread


key = jax.random.key(0)
parts = jax.random.split(key, 2)
weights = {
    "inner": jax.random.normal(parts[0], (4, 16)) / 2,
    "shift": jnp.zeros(16),
    "outer": jax.random.normal(parts[1], (16, 1)) / 4,
}
mean = square = jax.tree.map(jnp.zeros_like, weights)


@jax.jit
def train(k, weights, mean, square):
    """Return weights and moments after a step of Adam, with a gradient of at most unit size."""
    gradient = jax.grad(cost)(weights, *draw(jax.random.key(k)))
    size = jnp.sqrt(sum((g**2).sum() for g in jax.tree.leaves(gradient)))
    gradient = jax.tree.map(lambda g: g / jnp.maximum(size, 1), gradient)
    mean = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, mean, gradient)
    square = jax.tree.map(lambda s, g: 0.999 * s + 0.001 * g**2, square, gradient)
    rate = RATE * jnp.sqrt(1 - 0.999**k) / (1 - 0.9**k)
    weights = jax.tree.map(
        lambda w, m, s: w - rate * m / (jnp.sqrt(s) + 1e-8), weights, mean, square
    )
    return weights, mean, square


test = draw(jax.random.key(1000))
first = cost(weights, *test)
for k in range(1, EPISODES + 1):
    weights, mean, square = train(k, weights, mean, square)
last = cost(weights, *test)

law = jax.jit(lambda q, qd: policy(weights, q, qd))
run = model.model.simulate(
    [0, 0.2], [0, 0], 0.01, 10, u=lambda t, q, qd: law(q, qd), control_period=0.02
)
print(f"cost {first:.2f} before and {last:.3f} after {EPISODES} episodes of {BATCH} cart-poles")
print(f"after {run.t[-1]:.0f} s x = {run.q[-1, 0]:.3f} m, theta = {run.q[-1, 1]:.4f} rad")
