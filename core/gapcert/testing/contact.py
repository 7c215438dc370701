"""Residuals with a jump in them: contact, impact and sliding friction, as small as they can be."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import numpy as np

from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval
from gapcert.testing.fields import Field


def bounce(z: Array) -> Array:
    """A step that would end below the floor turns velocity round: a jump across a plane that is tilted to all axes."""
    speed = z[:, 1] + 0.3 * (0.3 * z[:, 2] - 1)
    height = z[:, 0] + 1 + 0.3 * speed
    turned = np.where(height < 0, -0.8, 1.0)
    return np.stack([turned * height - z[:, 0] - 1 - 0.3 * z[:, 1], turned * speed - z[:, 1]], axis=1)


def slide(z: Array) -> Array:
    """Coulomb friction by the sign of the velocity at the start of a step: a jump across the plane of no velocity."""
    change = 0.1 * (2 * z[:, 2] - np.sign(z[:, 1]))
    return np.stack([0.1 * change, change], axis=1)


def stick(z: Array) -> Array:
    """Coulomb friction that stops what it can stop within a step: kinks, and no jump."""
    free = z[:, 1] + 0.2 * z[:, 2]
    change = np.sign(free) * np.maximum(np.abs(free) - 0.1, 0.0) - z[:, 1]
    return np.stack([0.1 * change, change], axis=1)


def stop(z: Array) -> Array:
    """A wall that ends within the domain, and a steep slope that is none."""
    return np.stack([np.where((z[:, 0] > 0.5) & (z[:, 1] > 0.6), 1.0, 0.1 * z[:, 1]), np.tanh(20 * z[:, 2])], axis=1)


@final
class Contact(Field):
    """r(z) = law(z) on [−1, 1]³, two states and one input; a black box, and no constants bound it where it jumps."""

    def __init__(self, law: Callable[[Array], Array]) -> None:
        super().__init__(2, 1)
        self.law, self.constants = law, np.full((2, 3), np.inf)

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        return self.law(np.hstack([x, u]))

    def enclosure(self, z: Interval) -> Interval:
        raise UsageError("Contact: a black box; it has no enclosures")

    def jacobian_enclosure(self, z: Interval) -> Interval:
        raise UsageError("Contact: a black box; it has no enclosures")
