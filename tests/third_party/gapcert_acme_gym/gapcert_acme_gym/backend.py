"""Pendulum-v1, asked one transition at a time as a function of (state, action)."""

import gymnasium
import numpy as np

import gapcert as gc


class GymPendulum(gc.Backend):
    """x = (theta, omega), theta = 0 upright; u = torque. Gymnasium limits the torque to ±2 N·m and the speed to ±8 rad/s."""

    def __init__(self, gravity=10.0, period=0.05):
        self.states = (gc.StateSpec("theta", "rad", "angle"), gc.StateSpec("omega", "rad/s"))
        self.inputs = (gc.StateSpec("torque", "N*m"),)
        self.gravity, self.period = gravity, period
        self.parameters = (gc.Parameter("gravity", gravity, "m/s^2", low=0.0),)
        self.capabilities = frozenset({"parameters"})
        self._env = None

    @classmethod
    def from_config(cls, config, context):
        return cls(config.gravity, config.period)

    def _step(self, x, u, parameters=None):
        # The wrappers that `make` adds count steps and end the episode at the 200th: only the bare environment is a function
        # of its state. Its observation is single precision; its state is not.
        env = self._env = self._env or gymnasium.make("Pendulum-v1").unwrapped
        env.dt = self.period
        gravity = np.broadcast_to((parameters or {}).get("gravity", self.gravity), len(x))
        after = np.empty_like(x)
        for k, (state, action) in enumerate(zip(x, u, strict=True)):
            env.g, env.state = float(gravity[k]), state
            env.step(action)
            after[k] = env.state
        return after

    def __getstate__(self):
        return {**self.__dict__, "_env": None}

    def digest(self):
        return f"gymnasium {gymnasium.__version__} Pendulum-v1 {self.gravity!r} {self.period!r}"
