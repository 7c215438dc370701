"""The drive that turns commands into rates of joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.plugin import Array

from .config import FEEDBACK, DriveConfig


@final
@dataclass(frozen=True)
class Drive:
    """target (m,) = mixing (m, nu) · commands + yaw · heading + yaw_rate · turning rate; see DriveConfig."""

    elements: tuple[str, ...]
    mixing: Array
    yaw: Array
    yaw_rate: Array
    gain: float | None
    limit: float | None
    every: int

    @classmethod
    def of(cls, config: DriveConfig, inputs: Sequence[str]) -> Drive:
        """With the columns of `mixing` in the order of `inputs`."""

        def column(name: str) -> list[float]:
            return [row.get(name, 0.0) for row in config.elements.values()]

        mixing = np.array([column(name) for name in inputs]).reshape(len(inputs), -1).T
        yaw, rate = (np.array(column(name)) for name in FEEDBACK)
        return cls(tuple(config.elements), mixing, yaw, rate, config.gain, config.limit, config.every)

    @property
    def feeds_back(self) -> bool:
        return bool(self.yaw.any() or self.yaw_rate.any())

    def commands(self, u: Array) -> Array:
        """mixing · u, (n, nu) → (n, m), summed input by input: a matrix product's bits depend on the batch."""
        out = np.zeros((len(u), len(self.elements)))
        for j in range(u.shape[1]):
            out += u[:, j : j + 1] * self.mixing[:, j]
        return out

    def targets(self, command: Array, rotation: Sequence[Array | float], turning: Array | float) -> Array:
        """Rates (m,) or (n, m) from `command` = mixing · inputs of that shape, the base's rotation (w, x, y, z) and rate about
        the vertical: numbers, or n of each."""
        w, x, y, z = (np.asarray(part) for part in rotation)
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return np.asarray(command + self.yaw * heading[..., None] + self.yaw_rate * np.asarray(turning)[..., None])
