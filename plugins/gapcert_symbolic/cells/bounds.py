"""f over cells: what bounds it, on which cells and inputs it depends, and for which inputs it is asked at once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, final

import numpy as np

from gapcert import Array, Interval, Model, UsageError
from gapcert.plugin import Bools, Ints
from gapcert_functions import mean_value
from gapcert_symbolic.thresholds import THRESHOLDS

from .grid import Blocks, Grid, View, combined, flat

CHUNK = 8192  # rows whose columns fit into a cache
ROWS = 20_000
ROUNDING = 64 * float(np.finfo(np.float64).eps)  # of a slope, relative


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


@final
@dataclass(frozen=True)
class Part:
    """f_k(x, u) = [x_k] + g(x_on, u_used), up to `leak`: with x_k where it `moves`, and k not in `on` then.

    on: axes of the grid. inputs: which ones matter.
    """

    on: tuple[int, ...]
    moves: bool
    inputs: tuple[bool, ...]
    leak: float

    def rows(self, grid: Grid) -> int:
        return math.prod(grid.counts[d] for d in self.on)


def structure(bound: Bound, grid: Grid, axes: tuple[Array, ...]) -> list[Part]:
    """One part per axis of the grid.

    With J over the hull of all cells and inputs, replacing x_j by another value of the grid changes f_k by |J_kj| w_j at most
    (mean-value theorem), w_j the width of the grid, and moving x_k by d changes f_k by d ± |J_kk − 1| w_k. Where that is below
    `axis_leak` cells, the sum of it over all such axes is the leak. What rests on a bound in floating point may rest on slopes
    in it, too, of models that tell which are constant; all others count. One that says nothing of its derivatives is asked at
    points.
    """
    model, z = bound.model, _hull(grid, axes)
    nx = len(model.states)
    if isinstance(bound, Grown) and (known := model.constant_slopes()) is not None:
        return _parts(grid, nx, *_told(known, z.width[0]))
    try:
        slope, widths = model.jacobian_enclosure(z)[0], z.width[0]
        with np.errstate(invalid="ignore"):
            change = slope.mag * widths
            along = (slope[range(nx), range(nx)] - 1.0).mag * widths[:nx]
    except UsageError:
        change, along = _seen(model, z)
    return _parts(grid, nx, change, along)


def inferred(model: Model, grid: Grid, axes: tuple[Array, ...]) -> bool:
    """Is what the successors depend on known from points alone, since the model tells nothing of its derivatives?"""
    if model.constant_slopes() is not None:
        return False
    try:
        model.jacobian_enclosure(_hull(grid, axes))
    except UsageError:
        return True
    return False


def _hull(grid: Grid, axes: tuple[Array, ...]) -> Interval:
    low, high = grid.hull
    least, most = (np.array([end(a) for a in axes]) for end in (np.min, np.max))
    return Interval(np.concatenate([low, least])[None], np.concatenate([high, most])[None])


def _told(slope: Array, widths: Array) -> tuple[Array, Array]:
    """As `_seen`, from slopes that are constant, with what they may err by rounding; what varies may change anything."""
    nx, size = len(slope), np.where(np.isnan(slope), np.inf, np.abs(slope))
    own = np.where(np.isnan(np.diagonal(slope)), np.inf, np.abs(np.diagonal(slope) - 1))
    with np.errstate(invalid="ignore"):
        return size * (1 + ROUNDING) * widths, (own + ROUNDING) * widths[:nx]


def _seen(model: Model, z: Interval) -> tuple[Array, Array]:
    """The largest |Δf_k| (nx, nz) where one coordinate changes, and |Δf_k − Δx_k| (nx,), of pairs of random points of a box."""
    rng, nz, nx = np.random.default_rng(0x57A7), z.shape[1], len(model.states)
    a, b = (z.lo + z.width * rng.random((THRESHOLDS.structure_pairs, nz)) for _ in range(2))
    others = [a.copy() for _ in range(nz)]
    for j, other in enumerate(others):
        other[:, j] = b[:, j]
    points = np.concatenate([a, *others])
    after = model.fast_rollout(points[:, :nx], points[:, None, nx:]).x[:, 1].reshape(nz + 1, THRESHOLDS.structure_pairs, nx)
    moved = after[1:] - after[0]
    along = np.abs(np.diagonal(moved[:nx], axis1=0, axis2=2) - (b - a)[:, :nx]).max(axis=0)
    return np.abs(moved).max(axis=1).T, along


def _parts(grid: Grid, nx: int, change: Array, along: Array) -> list[Part]:
    found = []
    for k, state in enumerate(grid.states):
        still, own = change[state], float(along[state])
        limit = THRESHOLDS.axis_leak * float(grid.widths[k])
        on = tuple(d for d, j in enumerate(grid.states) if d != k and not still[j] <= limit)
        moves = own <= limit
        if not moves and not still[state] <= limit:
            on = tuple(sorted((*on, k)))
        uses = tuple(not v <= limit for v in still[nx:])
        small = [still[j] for d, j in enumerate(grid.states) if d != k and d not in on]
        small += [own if moves else still[state]] if k not in on else []
        small += [v for v, used in zip(still[nx:], uses, strict=True) if not used]
        found.append(Part(on, moves, uses, 2 * float(sum(small))))
    return found


@final
@dataclass(frozen=True)
class Nominal:
    """f over cells at one input value v per group of inputs, and the slope that carries it to the group's other inputs.

    f(x, u) ∈ f(x, v) + J_u (u − v), with J_u the Jacobian over the cell and the group (mean-value theorem in u alone).
    middle, low, high (groups, nu): v and the hull of the group. of (m,), offset (m, nu): group of each input and u − v.
    axes: those whose successors are asked for.
    """

    bound: Bound
    view: View
    middle: Array
    low: Array
    high: Array
    of: Ints
    offset: Array
    axes: tuple[int, ...]

    @classmethod
    def of_groups(
        cls, bound: Bound, view: View, axes: tuple[Array, ...], size: int, asked: tuple[int, ...] | None = None
    ) -> Nominal:
        """At most `size` groups per input."""
        blocks = [Blocks.cut(len(a), min(len(a), size)) for a in axes]
        ends = [(a[b.starts[:-1]], a[b.starts[1:] - 1]) for a, b in zip(axes, blocks, strict=True)]
        low, high = (combined(e) for e in zip(*ends, strict=True))
        middle, of = low + (high - low) / 2, flat(blocks)
        asked = tuple(range(len(view.whole.states))) if asked is None else asked
        return cls(bound, view, middle, low, high, of, combined(axes) - middle[of], asked)

    @classmethod
    def coarsest(cls, bound: Bound, view: View, axes: tuple[Array, ...], asked: tuple[int, ...] | None = None) -> Nominal:
        """As few groups as lose at most a thousandth of a cell anywhere; none where there are few pairs."""
        many = view.size * math.prod(len(a) for a in axes) > THRESHOLDS.single_pairs
        size = 1 if bound.groups and many else max(len(a) for a in axes)
        while not (found := cls.of_groups(bound, view, axes, size, asked)).tight():
            size *= 2
        return found

    @property
    def direct(self) -> bool:
        """Is every input its own group?"""
        return len(self.middle) == len(self.of)

    def tight(self) -> bool:
        step = max(1, ROWS // len(self.middle))
        return self.direct or all(self._loss(k, k + step) <= THRESHOLDS.shared_change for k in range(0, self.view.size, step))

    def _loss(self, start: int, stop: int) -> float:
        # Two Jacobians in the interval differ by at most its width; the farthest input is half a group away.
        slope = self.slopes(start, stop)[:, :, [self.view.whole.states[k] for k in self.axes]]
        with np.errstate(invalid="ignore"):
            loss = ((slope.hi - slope.lo) * (self.high - self.middle)[:, None, :]).sum(-1)
            loss = loss / self.view.whole.widths[list(self.axes)]
        return float(loss.max()) if np.isfinite(loss).all() else np.inf

    def over(self, start: int, stop: int) -> Interval:
        """f over cells start … stop − 1 at each group's v: (cells, groups, nx)."""
        (low, high), m = self.view.cells(start, stop), len(self.middle)
        n, nx = low.shape
        box = self.bound.over(np.repeat(low, m, axis=0), np.repeat(high, m, axis=0), self.middle, np.tile(np.arange(m), n))
        return box.reshape(n, m, nx)

    def slopes(self, start: int, stop: int) -> Interval:
        """J_u over cells start … stop − 1 and each group: (cells, groups, nx, nu)."""
        (low, high), (m, nu) = self.view.cells(start, stop), self.low.shape
        n, nx = low.shape
        z = Interval(
            np.concatenate([np.repeat(low, m, axis=0), np.tile(self.low, (n, 1))], axis=1),
            np.concatenate([np.repeat(high, m, axis=0), np.tile(self.high, (n, 1))], axis=1),
        )
        return self.bound.model.jacobian_enclosure(z)[:, :, nx:].reshape(n, m, nx, nu)
