"""The pendulum of specs/models, on which engines agree to the last bits: its step in closed form, and what each must show."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gapcert import Box, Domain, System
from gapcert.testing import SystemContract

TAU = 0.005
HINGE = {
    "states": {"theta": "hinge.position", "omega": "hinge.velocity"},
    "inputs": {"torque": "hinge"},
    "period": "5 ms",
}


def query(n, nx=2, nu=1, seed=0, scale=1.0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-scale, scale, (n, nx)), rng.uniform(-1, 1, (n, nu))


def semi_implicit(x, u, tau=TAU, gravity=(0.0, -9.81), mass=1.0, damping=0.0, armature=0.0):
    """ω⁺ = ω + τ (u + m l/2 (g_z sin θ − g_x cos θ) − d ω)/(m l²/3 + a + τ d), θ⁺ = θ + τ ω⁺: damping is implicit; l = 1 m."""
    theta, omega = x.T
    torque = mass * 0.5 * (gravity[1] * np.sin(theta) - gravity[0] * np.cos(theta)) + u[:, 0] - damping * omega
    omega = omega + tau * torque / (mass / 3 + armature + tau * damping)
    return np.stack([theta + tau * omega, omega], axis=1)


class RodContract(SystemContract):
    """`pendulum(**options)` is an engine's, without any drag of its own."""

    pendulum: Callable[..., System]
    substeps = 3

    def system(self):
        return self.pendulum(substeps=self.substeps)

    def domain(self, system):
        return Domain(Box(system.states, (-3.0, -2.0), (3.0, 2.0)), Box(system.inputs, (-1.0,), (1.0,)))

    def test_it_is_semi_implicit_euler(self):
        x, u = query(500, scale=3.0)
        assert np.abs(self.pendulum().step(x, u).x - semi_implicit(x, u)).max() <= 1e-15

    def test_substeps_share_the_effort(self):
        x, u = query(50)
        expected = x
        for _ in range(10):
            expected = semi_implicit(expected, u, tau=TAU / 10)
        assert np.abs(self.pendulum(substeps=10).step(x, u).x - expected).max() <= 1e-15

    def test_forces_add_to_the_effort_of_their_substep(self):
        x, u = query(20)
        forces = np.zeros((20, 2, 1))
        forces[:, 1] = 1.0
        b = self.pendulum(substeps=2)
        assert b.coordinates == ("theta",)
        even = np.full((20, 2, 1), 0.25)
        assert b.step(x, 0 * u, forces=even).x.tobytes() == b.step(x, 0 * u + 0.25).x.tobytes()
        expected = semi_implicit(semi_implicit(x, u, tau=TAU / 2), u + 1, tau=TAU / 2)
        assert np.abs(b.step(x, u, forces=forces).x - expected).max() <= 1e-15
