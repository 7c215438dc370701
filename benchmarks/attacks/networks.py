"""Constants of networks, over everything and over boxes, against gradients found by a search uphill."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.special import expit

import gapcert_networks
from attacks import Attempt
from gapcert_lipsdp.lipsdp import LipSDP

POINTS = 20_000
CLIMBS = 40
SLOPES = {
    "arctan": lambda v: 1 / (1 + v * v),
    "leaky-relu": lambda v: np.where(v > 0, 1.0, 0.01),
    "relu": lambda v: np.where(v > 0, 1.0, 0.0),
    "sigmoid": lambda v: expit(v) * expit(-v),
    "softplus": expit,
    "tanh": lambda v: 1 / np.cosh(np.clip(v, -300, 300)) ** 2,
}
VALUES = {
    "arctan": np.arctan,
    "leaky-relu": lambda v: np.where(v > 0, v, 0.01 * v),
    "relu": lambda v: np.maximum(v, 0.0),
    "sigmoid": expit,
    "softplus": lambda v: np.logaddexp(0.0, v),
    "tanh": np.tanh,
}


def slopes(net: gapcert_networks.Network, x: np.ndarray, units: np.ndarray) -> np.ndarray:
    """‖∂y/∂x · diag(1/units)‖₂ at each point, by products of our own."""
    z, slope = x, np.broadcast_to(np.diag(1 / units), (len(x), net.n_in, net.n_in))
    for w, b in zip(net.weights[:-1], net.biases[:-1], strict=True):
        v = z @ w.T + b
        slope = SLOPES[net.activation](v)[:, :, None] * (w @ slope)
        z = VALUES[net.activation](v)
    return np.asarray(np.linalg.norm(net.weights[-1] @ slope, ord=2, axis=(1, 2)))


def attempt(rng: np.random.Generator, folder: Path, tries: int = POINTS) -> Attempt:
    sizes = (*rng.integers(1, 7, rng.integers(2, 5)).tolist(), 1)
    activation = str(rng.choice(sorted(SLOPES)))
    scale = float(10 ** rng.uniform(-1, 1))
    weights = [rng.normal(size=(o, i)) * scale * (rng.random((o, i)) < 0.8) for i, o in pairwise(sizes)]
    net = gapcert_networks.Network(tuple(weights), tuple(rng.normal(size=len(w)) for w in weights), activation)
    units, low = 10 ** rng.uniform(-1, 1, net.n_in), rng.normal(size=net.n_in)
    high = low + 10 ** rng.uniform(-2, 0.7, net.n_in)
    everywhere = LipSDP().bound(net, units).value
    here = gapcert_networks.local_bound(net, (low, high), units, budget=300, cells=2)
    x = low + (high - low) * rng.random((tries, net.n_in))
    best = x[np.argsort(-slopes(net, x, units))[:50]]
    for k in range(CLIMBS):
        moved = np.clip(best + (high - low) * 0.4 * 0.8**k * rng.normal(size=best.shape), low, high)
        best = np.where((slopes(net, moved, units) > slopes(net, best, units))[:, None], moved, best)
    x = np.concatenate([x, best])
    g = slopes(net, x, units) * (1 - 1e-12)
    cell = tuple(np.clip(np.searchsorted(e, x[:, k], "right") - 1, 0, len(e) - 2) for k, e in enumerate(here.edges))
    wrong = (g > here.value) | (g > everywhere) | (g > here.constants[cell])
    return Attempt("deterministic", len(x), int(wrong.sum()), case={"sizes": sizes, "activation": activation, "scale": scale})
