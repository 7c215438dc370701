"""What bounds the successors of a cell: the model's own enclosures, or a growth bound that is declared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, final

import numpy as np

from gapcert import Interval, Model, UsageError

from .grid import Array


class Bound(Protocol):
    """Contains f(x, u) for every x of a cell."""

    @property
    def model(self) -> Model: ...

    @property
    def groups(self) -> bool:
        """May the slope of the model carry a bound from one input to others?"""
        ...

    def over(self, low: Array, high: Array, u: Array) -> Interval:
        """low, high (n, nx), u (n, nu) → (n, nx)."""
        ...


@final
@dataclass(frozen=True)
class Enclosed:
    """The model's own enclosure ∩ f(c, u) ± sup |∂f/∂x| · r, both rounded outwards."""

    model: Model
    groups: bool = True

    def over(self, low: Array, high: Array, u: Array) -> Interval:
        nx = low.shape[1]
        z = Interval(np.concatenate([low, u], axis=1), np.concatenate([high, u], axis=1))
        cell = z[:, :nx]
        centre = cell.mid
        growth = self.model.jacobian_enclosure(z)[:, :, :nx] * (cell - centre).reshape(len(low), 1, nx)
        at = self.model.enclosure(Interval.exact(np.concatenate([centre, u], axis=1)))
        return self.model.enclosure(z).intersect(growth.sum(-1) + at)


@final
@dataclass(frozen=True)
class Grown:
    """f(c, u) ± (ρ(r + z, u) + z), computed in floating point, with ρ a model of radii and r half a cell (G. Reissig et al.,
    IEEE TAC 62(4), 2017). ρ is taken on trust; z (nx,) stands for rounding, as SCOTS 0.2 has it.
    """

    model: Model
    radius: Model
    spare: Array
    groups: bool = False

    def __post_init__(self) -> None:
        for part in ("states", "inputs"):
            mine, theirs = (tuple(s.name for s in getattr(m, part)) for m in (self.model, self.radius))
            if mine != theirs:
                raise UsageError(
                    f"controller.growth: its model has the {part} {', '.join(theirs)}; expected {', '.join(mine)}, "
                    f"each standing for a radius"
                )

    def over(self, low: Array, high: Array, u: Array) -> Interval:
        middle = self.model.step((low + high) / 2, u).x
        radius = self.radius.step((high - low) / 2 + self.spare, u).x + self.spare
        return Interval(middle - radius, middle + radius)
