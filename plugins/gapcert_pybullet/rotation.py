"""Unit quaternions (x, y, z, w) as Bullet writes them; Bullet's own helpers of Python compute in single precision."""

from __future__ import annotations

from collections.abc import Sequence

Vector = tuple[float, float, float]
Turn = tuple[float, float, float, float]


def inverse(turn: Sequence[float]) -> Turn:
    """The turn back."""
    x, y, z, w = turn
    return -x, -y, -z, w


def product(a: Sequence[float], b: Sequence[float]) -> Turn:
    """First b, then a."""
    (x, y, z, w), (p, q, r, s) = a, b
    return (
        w * p + x * s + y * r - z * q,
        w * q - x * r + y * s + z * p,
        w * r + x * q - y * p + z * s,
        w * s - x * p - y * q - z * r,
    )


def rotated(turn: Sequence[float], v: Sequence[float]) -> Vector:
    """v turned: v + 2 w (n × v) + 2 n × (n × v) with n = (x, y, z)."""
    x, y, z, w = turn
    a, b, c = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return v[0] + w * a + y * c - z * b, v[1] + w * b + z * a - x * c, v[2] + w * c + x * b - y * a
