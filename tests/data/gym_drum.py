"""A user's environment: a drum on a brake that heats up; it is registered when it is imported."""

import gymnasium
import numpy as np


class Drum(gymnasium.Env):
    action_space = gymnasium.spaces.Box(-1, 1, (1,))
    observation_space = gymnasium.spaces.Box(-10, 10, (2,))

    def __init__(self, drag=0.5):
        self.drag = drag

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.condition = np.zeros(2)
        return self.condition, {}

    def step(self, action):
        rate, heat = self.condition
        self.condition = np.array([rate + 0.1 * (action[0] - self.drag * rate), heat + 0.1 * self.drag * rate**2])
        return self.condition, 0.0, bool(heat > 0.1), False, {}


gymnasium.register("Drum-v0", Drum, max_episode_steps=3)
