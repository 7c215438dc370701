"""What a state, an input or an output is: its name, its unit, and how two of its values differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, final

import numpy as np

from gapcert.numerics.arrays import Array


@final
@dataclass(frozen=True)
class StateSpec:
    """Name, unit and kind of one state, input or output.

    `angle` lives on the circle (period 2π); `quaternion` occupies four columns (w, x, y, z) and its differences three
    (a rotation vector).
    """

    name: str
    unit: str = "1"
    kind: Literal["real", "angle", "quaternion"] = "real"

    @property
    def size(self) -> int:
        return 4 if self.kind == "quaternion" else 1

    def difference(self, a: Array, b: Array) -> Array:
        """a − b in this state's geometry: real a − b; angle in [−π, π]; quaternion (…, 4) → rotation vector (…, 3)."""
        if self.kind == "quaternion":
            return _rotation_vector(a, b)
        d = np.asarray(a - b, dtype=np.float64)
        if self.kind == "angle":
            # round(d / 2π) = 0 leaves d untouched, so small differences keep every bit.
            d = d - 2 * np.pi * np.round(d / (2 * np.pi))
        return d


def _rotation_vector(a: Array, b: Array) -> Array:
    """log(a ⊗ b⁻¹) of unit quaternions, shape (…, 4) → (…, 3)."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], -b[..., 1:]
    w = aw * bw - np.sum(av * bv, axis=-1, keepdims=True)
    v = aw * bv + bw * av + cross(av, bv)
    v = np.where(w < 0, -v, v)
    norm = np.linalg.norm(v, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(norm, np.abs(w))
    scale = np.divide(angle, norm, out=np.full_like(norm, 2.0), where=norm > 0)
    return np.asarray(v * scale)


def cross(a: Array, b: Array) -> Array:
    """a × b of vectors (…, 3); numpy's own takes five times as long for few of them."""
    (ax, ay, az), (bx, by, bz) = ([v[..., k] for k in range(3)] for v in (a, b))
    out = np.empty(np.shape(a))
    out[..., 0], out[..., 1], out[..., 2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return out


def rotated(q: Array, rotation: Array) -> Array:
    """exp(rotation) ⊗ q for quaternions (n, 4) and rotation vectors (n, 3)."""
    angle = np.linalg.norm(rotation, axis=1, keepdims=True)
    w, v = np.cos(angle / 2), np.sinc(angle / (2 * np.pi)) * rotation / 2
    qw, qv = q[:, :1], q[:, 1:]
    out = np.hstack([w * qw - (v * qv).sum(axis=1, keepdims=True), w * qv + qw * v + cross(v, qv)])
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def difference(specs: Sequence[StateSpec], a: Array, b: Array) -> Array:
    """a − b column by column, each in its own geometry; a, b (…, Σ size)."""
    kinds = {s.kind for s in specs}
    if "quaternion" not in kinds:
        d = np.asarray(a - b, dtype=np.float64)
        # Nearly always no angle has gone around.
        if "angle" in kinds and not np.abs(d).max(initial=0.0) < np.pi:
            angles = [i for i, s in enumerate(specs) if s.kind == "angle"]
            d[..., angles] = specs[angles[0]].difference(d[..., angles], np.zeros(()))
        return d
    parts, column = [], 0
    for s in specs:
        part = slice(column, column + s.size)
        d = s.difference(a[..., part], b[..., part])
        parts.append(d)
        column += s.size
    return np.concatenate(parts, axis=-1)
