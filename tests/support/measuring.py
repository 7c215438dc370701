"""Recordings of a drift with a ripple, whose noise is the same within a trajectory and differs from one to the next."""

import numpy as np

import gapcert as gc
from gapcert.testing.toys import Drift, ripple

RANGES = {"x0": (-1.0, 1.0), "u0": (-2.0, 2.0)}
STEPS, PERIOD = 20, 0.1


def trajectory(rng, noise=0.01, steps=STEPS):
    """x⁺ = x + τ u + ripple, with a noise whose size is that of its whole trajectory."""
    x, u, out = rng.uniform(-0.8, 0.8), rng.uniform(-1, 1), []
    size = noise * rng.exponential()
    for _ in range(steps + 1):
        u = float(np.clip(u + rng.normal(scale=0.3) - x, -2, 2))
        out.append((x, u))
        z = np.array([[x, u]])
        x = float(x + PERIOD * u + ripple(z)[0, 0] + size * rng.normal())
    values = np.array(out)
    return gc.Trajectory(PERIOD * np.arange(steps + 1), {"x0": values[:, 0], "u0": values[:, 1]})


def recording(n, seed=0, steps=STEPS):
    rng = np.random.default_rng(seed)
    return gc.Recording(tuple(trajectory(rng, steps=steps) for _ in range(n)))


def calibrated(n=90, data=0, **options):
    model = Drift(1)
    return gc.calibrate_recording(model, recording(n, data), gc.Domain.of(model, RANGES), **{"violation": 0.05} | options)
