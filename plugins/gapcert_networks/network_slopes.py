"""Activations over intervals: enclosures of their slopes, and of their values between two lines; imports nothing that fits.

Slopes are those almost everywhere: a kink takes no side, and where a pre-activation is constant its gradient is 0.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gapcert.plugin import Array

EPS = float(np.finfo(np.float64).eps)
TINY = float(np.finfo(np.float64).tiny)
PAD = 64 * EPS  # above the error of every expression below where it is at most 1, with library functions within 4 ulp

# Slopes below and above 0 of what is linear on either side.
PIECEWISE = {"relu": (0.0, 1.0), "leaky-relu": (0.01, 1.0), "identity": (1.0, 1.0)}
# Bounds on |σ″| and |σ‴|: tanh 4/√27, 2; arctan √27/8, 2; sigmoid 1/√108, 1/8; softplus 1/4, 1/√108.
CURVED = {"tanh": (0.77, 2.0), "arctan": (0.65, 2.0), "sigmoid": (0.0963, 0.125), "softplus": (0.25, 0.0963)}


def gates(name: str, z: Array, r: Array) -> tuple[Array, Array | None, Array]:
    """(α, β, ρ), 0 ≤ α ≤ 1: |σ′(v) − α − β(v − z)| ≤ ρ for |v − z| ≤ r; β None where it is 0 everywhere."""
    if name in PIECEWISE:
        below, above = PIECEWISE[name]
        down, up = z + r <= 0, z - r >= 0
        middle = (below + above) / 2
        alpha = np.where(up, above, np.where(down, below, middle))
        return alpha, None, np.where(up | down | (below == above), 0.0, (above - middle) * (1 + 2 * EPS))
    low, high = slopes(name, z, r)
    alpha, rho = (low + high) / 2, (high - low) / 2 + PAD
    slope, bend = _derivatives(name, z)
    # Taylor: σ′(v) = σ′(z) + σ″(z)(v − z) + ½σ‴(ξ)(v − z)².
    quadratic = 0.5 * CURVED[name][1] * r * r * (1 + PAD) + PAD * (1 + r)
    near = quadratic < rho
    return np.where(near, np.clip(slope, 0.0, 1.0), alpha), np.where(near, bend, 0.0), np.where(near, quadratic, rho)


def lines(name: str, z: Array, r: Array, between: tuple[Array, Array] | None = None) -> tuple[Array, Array, Array]:
    """(α, μ, δ), 0 ≤ α ≤ 1: |σ(v) − αv − μ| ≤ δ for |v − z| ≤ r. between: `slopes` of the same, where they are known."""
    if name in PIECEWISE:
        below, above = PIECEWISE[name]
        low, high = z - r, z + r
        up, down = np.maximum(high, 0.0), np.maximum(-low, 0.0)
        # The chord's slope; on one side of 0 alone, that side's.
        alpha = np.clip((above * up + below * down) / (up + down + TINY), below, above)
        # σ(v) − αv is convex, 0 at 0, and largest at an end.
        most = np.maximum((above - alpha) * up, (alpha - below) * down)
        return alpha, most / 2, most / 2 * (1 + PAD) + np.where(most > 0, TINY, 0.0)
    low, high = between or slopes(name, z, r)
    alpha, delta = (low + high) / 2, ((high - low) / 2 + PAD) * r
    quadratic = 0.5 * CURVED[name][0] * r * r + PAD * r
    near = quadratic < delta
    alpha = np.where(near, np.clip(_derivatives(name, z)[0], 0.0, 1.0), alpha)
    value = VALUES[name](z)
    # σ(z) and μ round relative to what they add.
    delta = np.where(near, quadratic, delta) * (1 + PAD) + PAD * (1 + np.abs(z))
    return alpha, value - alpha * z, delta


VALUES: dict[str, Callable[[Array], Array]] = {
    "identity": np.positive,
    "leaky-relu": lambda v: np.maximum(v, 0.01 * v),
    "relu": lambda v: np.maximum(v, 0.0),
    "tanh": np.tanh,
    "arctan": np.arctan,
    "sigmoid": lambda v: 0.5 + 0.5 * np.tanh(0.5 * v),
    "softplus": lambda v: np.logaddexp(0.0, v),
}


def _derivatives(name: str, v: Array) -> tuple[Array, Array]:
    """(σ′, σ″), each within PAD."""
    if name == "tanh":
        t = np.tanh(v)
        return (1 - t) * (1 + t), -2 * t * (1 - t) * (1 + t)
    if name == "arctan":
        near = np.clip(v, -1e100, 1e100)  # both are below PAD further out
        slope = 1 / (1 + near * near)
        return slope, -2 * near * slope * slope
    s = VALUES["sigmoid"](v)
    return (s * (1 - s), s * (1 - s) * (1 - 2 * s)) if name == "sigmoid" else (s, s * (1 - s))


def slopes(name: str, z: Array, r: Array) -> tuple[Array, Array]:
    """(least, most): every difference quotient of σ between two points of [z − r, z + r] lies between them.

    Where the ends are floats, only a difference of 0 rounds to 0, so no kink inside is missed.
    """
    low, high = z - r, z + r
    if name in PIECEWISE:
        below, above = PIECEWISE[name]
        return np.where(low >= 0, above, below), np.where(high <= 0, below, above)
    # σ′ falls with |v|, or rises with v (softplus).
    if name == "softplus":
        ends = _derivatives(name, low)[0], _derivatives(name, high)[0]
    else:
        far, near = np.maximum(np.abs(low), np.abs(high)), np.clip(0.0, low, high)
        ends = _derivatives(name, far)[0], _derivatives(name, near)[0]
    return np.clip(ends[0] - PAD, 0.0, 1.0), np.clip(ends[1] + PAD, 0.0, 1.0)
