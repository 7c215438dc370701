"""Unit quaternions (w, x, y, z) and rotation vectors, element by element, so that no row's bits depend on its neighbours."""

from __future__ import annotations

import numpy as np

from gapcert import Array


def to_vector(rotation: Array) -> Array:
    """(n, 4) → (n, 3): axis times angle in [0, π]; the length of the quaternion does not matter."""
    w, x, y, z = rotation.T
    sign = np.where(w < 0, -1.0, 1.0)
    norm = np.sqrt(x * x + y * y + z * z)
    angle = 2 * np.arctan2(norm, np.abs(w))
    scale = sign * np.divide(angle, norm, out=np.full_like(norm, 2.0), where=norm > 0)
    return np.stack([scale * x, scale * y, scale * z], axis=1)


def from_vector(vector: Array) -> Array:
    """(n, 3) → (n, 4) with w ≥ 0 up to an angle of π."""
    x, y, z = vector.T
    angle = np.sqrt(x * x + y * y + z * z)
    scale = np.divide(np.sin(angle / 2), angle, out=np.full_like(angle, 0.5), where=angle > 0)
    return np.stack([np.cos(angle / 2), scale * x, scale * y, scale * z], axis=1)
