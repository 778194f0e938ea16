"""A vector environment of gymnasium: a batch of cart-poles, observed by their outputs.

python docs/examples/vector_env.py     (pip install gymnasium)
"""

from pathlib import Path

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

import eomc

cartpole = eomc.load(Path(__file__).with_name("balance.toml"))


class CartPoles(VectorEnv):
    """Balance the pole; an episode ends if the angle exceeds 0.5 rad, and a new one begins."""

    def __init__(self, count):
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.num_envs, self.q, self.qd = count, np.zeros((count, 2)), np.zeros((count, 2))
        self.single_observation_space = Box(-np.inf, np.inf, (len(cartpole.outputs),), np.float64)
        self.single_action_space = Box(-10, 10, (1,), np.float64)
        self.observation_space = batch_space(self.single_observation_space, count)
        self.action_space = batch_space(self.single_action_space, count)

    def reset(self, *, seed=None, options=None, which=slice(None)):
        """Draw new initial states of all instances or of `which`; return their observations."""
        super().reset(seed=seed)
        new = self.np_random.uniform(-0.1, 0.1, (2, self.num_envs, 2))
        self.q[which], self.qd[which] = new[0][which], new[1][which]
        return cartpole.output(self.q, self.qd), {}

    def step(self, actions):
        """Simulate one control period with these forces; reset the poles that have fallen."""
        for _ in range(4):  # a control period of 20 ms
            failed = cartpole.step_batch(self.q, self.qd, 0.005, u=actions)
        over = (np.abs(self.q[:, 1]) > 0.5) | (failed > 0)
        last = cartpole.output(self.q, self.qd)
        seen = self.reset(which=over)[0] if over.any() else last
        return seen, 1.0 - over, over, np.zeros_like(over), {"final_obs": last, "_final_obs": over}


def falls(law, steps=250):
    """Return the mean number of falls in 5 s with a law from observations to forces."""
    observations, count = poles.reset(seed=1)[0], 0
    for _ in range(steps):
        observations, _, over, _, _ = poles.step(law(observations))
        count += over.sum()
    return count / poles.num_envs


poles = CartPoles(256)
poles.action_space.seed(1)
# the gains of lqr.py, in terms of the observations
feedback = np.array([[54.7, -63.4, 0.0, -9.9, 16.0, 0.0]]).T
print("observed:", *cartpole.outputs)
print(f"random forces: {falls(lambda seen: poles.action_space.sample()):.1f} falls of each in 5 s")
print(f"a feedback: {falls(lambda seen: -seen @ feedback):.1f} falls of each in 5 s")
