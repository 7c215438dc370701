"""The nominal map F = f + p about a point, and what bounds everything that its straight line leaves out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert import GapFunction, Interval, Model

Array = np.ndarray
CELLS = 4096


@final
@dataclass(frozen=True)
class Frame:
    """Coordinates ζ = (z − middle) / half of states and inputs, in which a box is [−1, 1]. nx of them are states."""

    middle: Array
    half: Array
    nx: int

    @classmethod
    def of(cls, low: Array, high: Array, nx: int) -> Frame:
        return cls((low + high) / 2, (high - low) / 2, nx)

    def into(self, z: Array) -> Array:
        return np.asarray((z - self.middle) / self.half)

    def out(self, zeta: Array) -> Array:
        return np.asarray(self.middle + self.half * zeta)

    @property
    def x(self) -> tuple[Array, Array]:
        """(middle, half) of the states alone."""
        return self.middle[: self.nx], self.half[: self.nx]

    @property
    def u(self) -> tuple[Array, Array]:
        """(middle, half) of the inputs alone."""
        return self.middle[self.nx :], self.half[self.nx :]


@final
@dataclass(frozen=True)
class Stages:
    """x⁺ = A x + B u + d + w with |w_i| ≤ c_i + Σ_j G_ij |z_j − centre_j| for z in [low, high], per stage, in a Frame.

    A (N+1, n, n), B (N+1, n, m), d and c (N+1, n), G (N+1, n, n+m), centre, low and high (N+1, n+m); the last is
    the terminal one.
    """

    A: Array
    B: Array
    d: Array
    c: Array
    G: Array
    centre: Array
    low: Array
    high: Array

    @property
    def horizon(self) -> int:
        return len(self.A) - 1


@final
class Nominal:
    """F = f + p with its slopes, and γ̄ of what is left; where no gap function is, F = f and γ̄ = 0. States are unwrapped."""

    def __init__(self, model: Model, gap: GapFunction | None) -> None:
        self.model, self.gap = model, gap
        self.predictor = None if gap is None else getattr(gap, "predictor", None)
        self.nx = model.nx

    def __call__(self, z: Array) -> Array:
        """F(z) up to rounding, (n, nz) → (n, nx)."""
        return self.enclosed(Interval.exact(z)).mid

    def enclosed(self, boxes: Interval) -> Interval:
        f = self.model.enclosure(boxes)
        return f if self.predictor is None else f + self.predictor.over(boxes)

    def slopes(self, boxes: Interval) -> Interval:
        """Contains ∂F/∂z over each box, (n, nx, nz)."""
        J = self.model.jacobian_enclosure(boxes)
        return J if self.predictor is None else J + self.predictor.jacobian_over(boxes)

    def left(self, boxes: Interval) -> Interval:
        """Contains r − p over each box, (n, nx)."""
        if self.gap is None:
            return Interval.exact(np.zeros((len(boxes), self.nx)))
        remainder: Callable[[Interval], Interval] | None = getattr(self.gap, "remainder_over", None)
        return self.gap.interval_over(boxes) if remainder is None else remainder(boxes)

    def straight(self, low: Array, high: Array, horizon: int, frame: Frame, constant: bool = False) -> Stages:
        """One straight line for a whole box, the same at all stages: its slope is the middle of ∂F/∂z over the box."""
        box = Interval(low[None], high[None])
        centre = box.mid
        slope = self.slopes(box).mid[0]
        cells = tiles(low, high)
        # Mean value form about each cell's own centre c: F(z) − F(ẑ) − J(z − ẑ) is that at c, plus (F′(cell) − J)(z − c).
        middle = Interval.exact(cells.mid)
        line = Interval.exact(slope)
        at = self.enclosed(middle) - self.enclosed(Interval.exact(centre)) - (line * (middle - centre)[:, None, :]).sum(-1)
        wrong = at + ((self.slopes(cells) - line) * (cells - middle)[:, None, :]).sum(-1) + self.left(cells)
        shift = (wrong.hi.max(axis=0) + wrong.lo.min(axis=0)) / 2
        bound = (wrong - shift).mag
        c, G = bound.max(axis=0), np.zeros((self.nx, len(low)))
        del constant
        value = self(centre)[0] + shift
        return _in_frame(frame, horizon, slope, value, c, G, centre[0], low, high)


def _in_frame(
    frame: Frame, horizon: int, slope: Array, value: Array, c: Array, G: Array, centre: Array, low: Array, high: Array
) -> Stages:
    n = frame.nx
    middle, half = frame.x
    J = slope * frame.half / half[:, None]
    zeta = frame.into(centre)
    d = (value - middle) / half - J @ zeta

    def repeated(a: Array) -> Array:
        return np.broadcast_to(a, (horizon + 1, *a.shape)).copy()

    parts = (J[:, :n], J[:, n:], d, c / half, G * frame.half / half[:, None], zeta, frame.into(low), frame.into(high))
    return Stages(*(repeated(p) for p in parts))


def tiles(low: Array, high: Array, budget: int = CELLS) -> Interval:
    """At most `budget` boxes that tile [low, high], as many along each axis."""
    count = max(1, int(budget ** (1 / len(low)) + 1e-9))
    edges = [np.linspace(a, b, count + 1) for a, b in zip(low, high, strict=True)]
    first = np.stack([g.ravel() for g in np.meshgrid(*(e[:-1] for e in edges), indexing="ij")], axis=1)
    last = np.stack([g.ravel() for g in np.meshgrid(*(e[1:] for e in edges), indexing="ij")], axis=1)
    return Interval(first, last)
