"""Counter-based random numbers: pure functions of a seed and of the numbers of a row, for whole batches at once."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gapcert.numerics.arrays import Array

Keys = npt.NDArray[np.uint64]

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


def _mix(z: Keys) -> Keys:
    """The finaliser of SplitMix64 (Steele, Lea and Flood 2014): every input bit reaches every output bit."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def keys(seed: int, rows: Array) -> Keys:
    """One 64-bit key per row from the seed and the bits of that row (n, k) alone."""
    # −0.0 and 0.0 are one number, and must have one key.
    columns = np.ascontiguousarray(rows + 0.0, dtype=np.float64).view(np.uint64)
    key = np.full(len(columns), seed % 2**64, dtype=np.uint64)
    for j in range(columns.shape[1]):
        key = _mix(key * _GOLDEN + _mix(columns[:, j] + _GOLDEN))
    return key


def uniforms(key: Keys, count: int, skip: int = 0) -> Array:
    """(n, count) independent numbers, uniform on [0, 1), of each key; `skip` leaves out the first ones."""
    counter = np.arange(skip + 1, skip + count + 1, dtype=np.uint64) * _GOLDEN
    return np.asarray((_mix(key[:, None] + counter) >> np.uint64(11)) * 2.0**-53)


def normals(key: Keys, count: int, skip: int = 0) -> Array:
    """(n, count) independent standard normal numbers of each key (Box and Muller 1958), two uniform ones for each."""
    u = uniforms(key, 2 * count, skip)
    # 1 − u lies in (0, 1], so the logarithm is finite.
    return np.asarray(np.sqrt(-2 * np.log1p(-u[:, :count])) * np.cos(2 * np.pi * u[:, count:]))
