"""How far one input moves a state, beside γ."""

from __future__ import annotations

import numpy as np

from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Model
from gapcert.numerics.arrays import Array


def overpowered(gamma: Array, model: Model, domain: Domain, z: Array) -> list[float | None]:
    """Per state, the share of points where γ_i exceeds half the range of f_i over U's corners, or over what relations leave of
    the way there from the point's own input; None where f_i ignores u.
    """
    if not model.nu:
        return [None] * model.nx
    x, _ = domain.split(z)
    corners = np.stack(np.meshgrid(*zip(domain.inputs.low, domain.inputs.high, strict=True)), axis=-1).reshape(-1, model.nu)
    ends = [domain.reach(z, np.hstack([x, np.broadcast_to(c, (len(x), model.nu))])) for c in corners]
    images = np.stack([model.step(*domain.split(end)).x for end in ends])
    span = np.ptp(images, axis=0)
    # A range at rounding level means that the input does not reach the state within one step.
    moved = span.max(axis=0) > 1e-12 * np.maximum(np.abs(images).max(axis=(0, 1)), 1e-300)
    return [float((gamma[:, i] > span[:, i] / 2).mean()) if moved[i] else None for i in range(gamma.shape[1])]
