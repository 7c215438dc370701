"""Fields that bounds are attacked with: narrow bumps, coarse arithmetic, and laws that jump."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import numpy as np

from gapcert import Array, Backend, Interval, UsageError
from gapcert_bounds.testing.fields import Field, Waves


@final
class Bump(Field):
    """Waves plus height · max(0, 1 − Σ_j |z_j − centre_j| / radius) in every state: narrow, so that few pairs meet it.

    constants: those of the waves plus height / radius, at most; exact where the waves are flat.
    """

    def __init__(self, waves: Waves, height: float, radius: float, centre: Array) -> None:
        super().__init__(waves.nx, waves.nu, waves.half_width)
        self.waves, self.height, self.radius, self.centre = waves, height, radius, centre
        self.constants = np.nextafter(waves.constants + np.nextafter(abs(height) / radius, np.inf), np.inf)

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        z = np.hstack([x, u])
        hat = np.maximum(0.0, 1 - np.abs(z - self.centre).sum(axis=1) / self.radius)
        return np.asarray(self.waves(z) + self.height * hat[:, None])

    def enclosure(self, z: Interval) -> Interval:
        hat = (1.0 - abs(z - self.centre).sum(-1) / self.radius).maximum(0.0)
        return self.waves.enclosure(z) + hat[:, None] * self.height

    def jacobian_enclosure(self, z: Interval) -> Interval:
        near = abs(z - self.centre).sum(-1).lo <= self.radius
        side = (z - self.centre).sign() * (-self.height / self.radius)
        low, high = np.minimum(side.lo, 0.0), np.maximum(side.hi, 0.0)
        slope = Interval(np.where(near[:, None], low, 0.0), np.where(near[:, None], high, 0.0))
        return self.waves.jacobian_enclosure(z) + slope[:, None, :]


@final
class Coarse(Backend):
    """A field whose answers are rounded to multiples of `quantum`, as coarse arithmetic would: resolution quantum / 2."""

    def __init__(self, field: Field, quantum: float) -> None:
        self.states, self.inputs, self.period = field.states, field.inputs, field.period
        self.field, self.quantum = field, quantum

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        return np.asarray(np.round(self.field.step(x, u).x / self.quantum) * self.quantum)

    def resolution(self, magnitude: Array) -> Array:
        return np.asarray(self.quantum / 2 + self.field.resolution(magnitude))


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
