"""What bounds the successors of a cell: the model's enclosures and Jacobian, or a growth bound that is declared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, final

import numpy as np

from gapcert import Array, Interval, Model, UsageError
from gapcert.plugin import Bools, Ints
from gapcert_functions import mean_value

CHUNK = 8192  # rows whose columns fit into a cache


class Bound(Protocol):
    """Contains f(x, u) for every x of a cell."""

    @property
    def model(self) -> Model: ...

    @property
    def groups(self) -> bool:
        """May the slope of the model carry a bound from one input to others?"""
        ...

    def over(self, low: Array, high: Array, u: Array, which: Ints | None = None, spread: Array | None = None) -> Interval:
        """low, high (n, nx), u (m, nu) and which of these for each (n,), by default row for row → (n, nx). spread (n, nx): what
        `spread` told of each.
        """
        ...

    def spread(self, half: Array, u: Array) -> Array | None:
        """(n, m, nx), where all cells of half widths (n, nx) at most go so far at most from what becomes of their centres under
        inputs u (m, nu); None where each cell is bounded by itself.
        """
        ...

    def unmoved(self, u: Array) -> Bools:
        """(n, nx): states that inputs leave exactly where they are, and so in the same cell."""
        ...


@final
@dataclass(frozen=True)
class Enclosed:
    """The model's own enclosure ∩ what its Jacobian over the cell proves: f at the corner where a component is largest, or
    smallest, along states in which it is monotone, and the mean-value form along the others. All of it is rounded outwards.

    Where f is affine, or monotone in each state, the box is exact. f(c, u) ± sup |∂f/∂x| · r, the growth bound that follows
    from the Jacobian, contains it.
    """

    model: Model
    groups: bool = True

    def over(self, low: Array, high: Array, u: Array, which: Ints | None = None, spread: Array | None = None) -> Interval:
        u = u if which is None else u[which]
        z = Interval(np.concatenate([low, u], axis=1), np.concatenate([high, u], axis=1))
        slope = self.model.jacobian_enclosure(z)[:, :, : low.shape[1]]
        return mean_value(z, slope, self.model.enclosure).intersect(self.model.enclosure(z))

    def spread(self, half: Array, u: Array) -> None:
        return None

    def unmoved(self, u: Array) -> Bools:
        return self.model.unmoved(u)


@final
@dataclass(frozen=True)
class Grown:
    """f(c, u) ± (ρ(r + z, u) + z), computed in floating point, with ρ a model of radii and r half a cell, or half a block of
    cells (G. Reissig et al., IEEE TAC 62(4), 2017). ρ is taken on trust; z (nx,) stands for rounding, as SCOTS 0.2 has it, or
    for errors of measurement. r is that of the widest cell that is asked for.
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

    def over(self, low: Array, high: Array, u: Array, which: Ints | None = None, spread: Array | None = None) -> Interval:
        centre, which = (low + high) / 2, np.arange(len(u)) if which is None else which
        if spread is None:
            spread = self.spread(((high - low) / 2).max(axis=0)[None], u)[0, which]
        parts = [slice(k, k + CHUNK) for k in range(0, len(which), CHUNK)]
        middle = np.concatenate([_step(self.model, centre[s], u.take(which[s], axis=0)) for s in parts])
        return Interval(middle - spread, middle + spread)

    def spread(self, half: Array, u: Array) -> Array:
        """ρ(r + z, u) + z."""
        n, m = len(half), len(u)
        after = _step(self.radius, np.repeat(half + self.spare, m, axis=0), np.tile(u, (n, 1)))
        return np.asarray((after + self.spare).reshape(n, m, -1))

    def unmoved(self, u: Array) -> Bools:
        return np.zeros((len(u), len(self.spare)), dtype=bool)


def _step(model: Model, x: Array, u: Array) -> Array:
    """f(x, u), within rounding."""
    return np.asarray(model.fast_rollout(x, u[:, None]).x[:, 1])
