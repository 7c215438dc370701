"""Lipschitz constants proved from equations, by intervals: on the whole domain, and in convex cells.

Cells are cut where slopes differ, so that a steep part costs nothing elsewhere. Curvature is proved in slabs of each axis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from gapcert import Array, Domain, Interval, Model, UsageError
from gapcert.plugin import Cells, Ints, LipschitzBound, LipschitzEstimator, LipschitzProblem, ModelPredictor
from gapcert_bounds.thresholds import THRESHOLDS

from .cell_tree import Leaf, Tree


@final
class IntervalJacobian(LipschitzEstimator):
    """sup_Z |∂(f̂ − f − p)_i/∂z_j| by interval Jacobians over boxes that are bisected where the bound is loosest.

    Needs equations of both systems. `boxes` limits the bisection, which stops earlier when every bound is within a thousandth
    of a slope that occurs. With `cells` > 1 the domain is cut into up to so many cells where the bounds differ most, and each
    has constants of its own, proved in as many boxes once more. With `curvature`, second derivatives along each axis are
    bounded alike, on the whole domain and in up to `slabs` parts of the axis, ∞ where there may be a kink; in as many boxes per
    axis.
    """

    provenance = "interval"

    def __init__(self, boxes: int = 4096, cells: int = 1, curvature: bool = False, slabs: int = 8) -> None:
        if curvature and cells > 1:
            raise UsageError("lipschitz interval: curvature is that of the whole domain; use cells: 1, or leave it out")
        self.boxes, self.cells, self.curvature, self.slabs = boxes, cells, curvature, slabs

    def bound(self, problem: LipschitzProblem) -> LipschitzBound:
        whole, fhat = self._whole(problem), problem.white_box
        if self.curvature and fhat is not None:
            return _bent(problem, fhat, whole, self.slabs, self.boxes)
        return whole if self.cells == 1 else self._cut(problem, whole)

    def _cut(self, problem: LipschitzProblem, whole: LipschitzBound) -> LipschitzBound:
        fhat, axes = problem.white_box, tuple(j for j in range(len(problem.domain.low)) if j not in problem.held)
        if fhat is None or len(axes) > THRESHOLDS.cell_axes:
            raise UsageError(
                f"lipschitz interval: cells are cut along at most {THRESHOLDS.cell_axes} axes, found {len(axes)}; use cells: 1"
            )
        parts = self.boxes // self.cells
        made = _cells(_Slopes(problem.domain, lambda b: _slopes(fhat, problem, b).mag, whole.value, axes, parts), self.cells)
        if len(made) == 1:
            return whole
        return replace(whole, value=made.worst, method=f"interval ({len(made)} cells)", cells=made)

    def _whole(self, problem: LipschitzProblem) -> LipschitzBound:
        fhat = problem.white_box
        if fhat is None:
            raise UsageError(
                "lipschitz interval: the backend is a black box, and interval bounds need its equations; "
                "use wood-zhang or declared constants"
            )
        _refuse_wrap(fhat, problem)
        boxes = problem.domain.interval
        bound, lower = _slopes(fhat, problem, boxes).mag, _reached(fhat, problem, boxes)
        while len(boxes) < self.boxes:
            loose = np.where(bound > lower * (1 + 1e-3) + np.finfo(float).tiny, bound, 0.0)
            # A box is urgent where it holds an entry's largest bound, or nearly does; ∞ / ∞ would be NaN.
            loose = np.minimum(loose, np.finfo(float).max)
            urgency = (loose / np.maximum(loose.max(axis=0), np.finfo(float).tiny)).max(axis=(1, 2))
            if urgency.max() == 0:
                break
            count = min(self.boxes - len(boxes), max(1, len(boxes) // 2))
            order = np.argsort(-urgency, kind="stable")
            first, rest = order[:count], order[count:]
            urgent = boxes[first]
            parts = urgent.cut(((urgent.hi - urgent.lo) / problem.domain.width).argmax(axis=1))
            tighter = np.minimum(_slopes(fhat, problem, parts).mag, np.tile(bound[first], (2, 1, 1)))
            lower = np.maximum(lower, _reached(fhat, problem, parts))
            boxes, bound = Interval.concatenate([boxes[rest], parts]), np.concatenate([bound[rest], tighter])
        value = bound.max(axis=0)
        if not np.isfinite(value).all():
            i, j = np.argwhere(~np.isfinite(value))[0]
            names = [a.name for a in problem.domain.axes]
            raise UsageError(f"lipschitz interval: ∂{names[i]}/∂{names[j]} is unbounded on the domain; make the domain smaller")
        return LipschitzBound(value, lower, "interval", "interval", diagnostics={"boxes": len(boxes)})


def _refuse_wrap(fhat: Model, problem: LipschitzProblem) -> None:
    """A residual or predictor of angles that can reach ±π jumps there, whatever its derivative is."""
    parts = [ModelPredictor(fhat, problem.model)]
    if isinstance(problem.predictor, ModelPredictor):
        parts.append(problem.predictor)
    difference = np.max([p.over(problem.domain.interval).mag[0] for p in parts], axis=0)
    for state, size in zip(problem.model.states, difference, strict=True):
        if state.kind == "angle" and size >= np.pi:
            raise UsageError(
                f"lipschitz interval: the residual of angle '{state.name}' may reach {size:.3g} ≥ π, where it jumps; "
                f"make the domain smaller"
            )


def _slopes(fhat: Model, problem: LipschitzProblem, boxes: Interval) -> Interval:
    """∂(f̂ − f − p)/∂z over boxes, (n, nx, nz)."""
    return fhat.jacobian_enclosure(boxes) - problem.model.jacobian_enclosure(boxes) - problem.predictor.jacobian_over(boxes)


def _reached(fhat: Model, problem: LipschitzProblem, boxes: Interval) -> Array:
    """A slope that is proved to occur: the smallest |∂| that each centre's own enclosure allows, maximised over boxes."""
    return np.asarray(abs(_slopes(fhat, problem, Interval.exact(boxes.mid))).lo.max(axis=0))


@final
@dataclass(frozen=True)
class _Slopes:
    """What cells are cut by: `of` boxes (n, nz), bounds (n, nx, nz) of |∂g_i/∂z_j|; `everywhere` (nx, nz) holds on Z; `axes`
    that may be cut; a cell is looked at in about `parts` boxes."""

    domain: Domain
    of: Callable[[Interval], Array]
    everywhere: Array
    axes: tuple[int, ...]
    parts: int

    @property
    def counts(self) -> tuple[int, ...]:
        """Parts of a cell per axis: 2, 4 or 8, and 1 along axes that are not cut."""
        most = int(np.log2(max(1, self.parts)) / max(1, len(self.axes)))
        count = int(np.clip(2**most, 2, THRESHOLDS.finest_cut))
        return tuple(count if j in self.axes else 1 for j in range(len(self.domain.low)))

    @property
    def price(self) -> Array:
        """(nx, nz): what a constant adds to a band, all states alike: Σ_j L_ij width_j relative to that of the whole domain."""
        each = self.everywhere * self.domain.width
        return np.asarray(self.domain.width / np.maximum(each.sum(axis=1, keepdims=True), np.finfo(float).tiny))


@final
class _Patch:
    """A leaf, and bounds of the slopes in each of its parts (*counts, nx, nz), none above `known`."""

    def __init__(self, leaf: Leaf, slopes: _Slopes, known: Array) -> None:
        self.leaf, self.slopes = leaf, slopes
        counts = slopes.counts
        self.edges = [np.linspace(a, b, n + 1) for a, b, n in zip(leaf.low, leaf.high, counts, strict=True)]
        low, high = (np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1) for ends in self._ends)
        boxes = Interval(low.reshape(-1, len(counts)), high.reshape(-1, len(counts)))
        found = np.minimum(slopes.of(boxes), known)
        # Z and a cell are convex: between two points of both no slope is met in parts that do not meet Z.
        found[slopes.domain.outside(boxes)] = 0.0
        self.found = found.reshape(*counts, *known.shape)
        each = (self.found * slopes.price).sum(axis=(-2, -1))
        # What would be gained if every part were a cell.
        self.promise = float(np.prod(leaf.width / slopes.domain.width)) * (self._cost(self.found) - float(each.mean()))

    @property
    def _ends(self) -> tuple[list[Array], list[Array]]:
        return [e[:-1] for e in self.edges], [e[1:] for e in self.edges]

    @property
    def constants(self) -> Array:
        """(nx, nz): hold in the closed cell."""
        return _largest(self.found)

    def cuts(self) -> Iterator[tuple[int, float, Array, Array]]:
        """(axis, cut, constants of either half) of every cut between parts, the one that gains most first."""
        made, whole = [], self._cost(self.found)
        for j in self.slopes.axes:
            n = self.found.shape[j]
            for k in range(1, n):
                halves = np.split(self.found, [k], axis=j)
                left = k / n * self._cost(halves[0]) + (1 - k / n) * self._cost(halves[1])
                # Where no single cut gains anything, the middle of a wide axis comes first.
                wide = self.leaf.width[j] / self.slopes.domain.width[j]
                gain = float(np.round(1 - left / whole, 12)) if whole else 0.0
                if self.leaf.low[j] < self.edges[j][k] < self.leaf.high[j]:
                    made.append(((-gain, -wide, abs(2 * k - n), j, k), halves))
        for (_, _, _, j, k), (below, above) in sorted(made, key=lambda m: m[0]):
            yield j, float(self.edges[j][k]), _largest(below), _largest(above)

    def _cost(self, found: Array) -> float:
        return float((_largest(found) * self.slopes.price).sum())


def _cells(slopes: _Slopes, most: int) -> Cells:
    """At most so many cells, cut one by one where that promises most, with constants that are proved in each."""
    domain = slopes.domain
    tree = Tree(domain.low, domain.high)
    patches = [_Patch(tree.leaves[0], slopes, slopes.everywhere)]
    total, closed = float((slopes.everywhere * slopes.price).sum()), set[int]()
    while len(patches) < most:
        promises = [0.0 if id(p.leaf) in closed else p.promise for p in patches]
        if sum(promises) <= THRESHOLDS.cut_gain * total:
            break
        at = int(np.argmax(promises))
        patch = patches[at]
        for axis, cut, *known in patch.cuts():
            halves = patch.leaf.halves(axis, cut)
            if all(half.point(domain) is not None for half in halves):
                tree.replace(patch.leaf, axis, cut, halves)
                patches[at : at + 1] = [_Patch(half, slopes, own) for half, own in zip(halves, known, strict=True)]
                break
        else:
            closed.add(id(patch.leaf))
    constants = np.array([p.constants for p in patches])
    anchors = np.array([point for p in patches if (point := p.leaf.point(domain)) is not None])
    return Cells(domain.low, domain.high, *tree.cuts(), constants, np.zeros(constants.shape[:2]), anchors)


def _largest(found: Array) -> Array:
    return np.asarray(found.max(axis=tuple(range(found.ndim - 2))))


def _bent(problem: LipschitzProblem, fhat: Model, whole: LipschitzBound, slabs: int, most: int) -> LipschitzBound:
    """`whole` with |∂²g_i/∂z_j²| on Z and in up to so many slabs of every axis; about so many boxes per axis.

    ∞ in a slab that may hold a kink, and along axes that are held.
    """
    parts = max(THRESHOLDS.curvature_parts, 4 * slabs)
    domain, columns, cut = problem.domain, list[Array](), list[tuple[Array, Array] | None]()
    for j, (low, high) in enumerate(zip(domain.low, domain.high, strict=True)):
        if j in problem.held:
            columns.append(np.full(domain.nx, np.inf))
            cut.append(None)
            continue
        cuts, width = np.linspace(low, high, parts + 1), domain.width[j]
        slight = THRESHOLDS.slight_curvature * whole.value[:, j] / width + problem.resolution / width**2
        found = _Search(problem, fhat, j, cuts, slight).run(max(1, most // parts))
        cuts, found = merged(cuts, found, whole.value[:, j], slabs)
        columns.append(found.max(axis=1))
        cut.append((cuts, found) if len(cuts) > 2 else None)
    several = tuple(cut) if any(c is not None for c in cut) else None
    return replace(whole, curvature=np.stack(columns, axis=1), slabs=several)


def merged(cuts: Array, found: Array, slope: Array, slabs: int) -> tuple[Array, Array]:
    """Neighbouring parts put together to at most so many slabs, those that make Σ size H^(1/3) least, and to fewer where that
    loses little: with nodes as dense as H^(1/3), what an interpolation misses follows its cube."""
    n, size = found.shape[1], np.diff(cuts)
    # Where there is no curvature the constant serves.
    weight = np.where(np.isinf(found), 4 * slope[:, None] / size, found)
    weight = weight / np.maximum(weight.max(axis=1, keepdims=True), np.finfo(float).tiny)
    price = np.full((n + 1, n + 1), np.inf)  # of a slab from one cut to another
    for a in range(n):
        price[a, a + 1 :] = np.cbrt(np.maximum.accumulate(weight[:, a:], axis=1).sum(axis=0)) * (cuts[a + 1 :] - cuts[a])
    best, before = [price[0]], [np.zeros(n + 1, dtype=np.intp)]
    for _ in range(1, min(slabs, n)):
        total = best[-1][:, None] + price
        best.append(total.min(axis=0))
        before.append(total.argmin(axis=0))
    costs = np.array([b[n] for b in best])
    ends = [n]
    for k in reversed(range(int(np.argmax(costs <= costs.min() * (1 + THRESHOLDS.slab_cost))) + 1)):
        ends.append(int(before[k][ends[-1]]))
    ends = ends[::-1]
    return cuts[ends], np.maximum.reduceat(found, ends[:-1], axis=1)


class _Search:
    """Boxes of all slabs of axis j, bisected where they hold the largest bound of their slab."""

    def __init__(self, problem: LipschitzProblem, fhat: Model, j: int, cuts: Array, slight: Array) -> None:
        self.problem, self.fhat, self.j = problem, fhat, j
        domain, n = problem.domain, len(cuts) - 1
        low, high = (np.tile(end, (n, 1)) for end in (domain.low, domain.high))
        low[:, j], high[:, j] = cuts[:-1], cuts[1:]
        self.boxes, self.slab = Interval(low, high), np.arange(n)
        self.width = high[0] - low[0]
        self.bound = self._bend(self.boxes).mag
        self.reached = np.tile(slight, (n, 1))
        self._meet(self.boxes, self.slab)

    def run(self, most: int) -> Array:
        """(nx, slabs): the largest bound in each slab, of at most so many boxes."""
        while True:
            chosen = self._chosen(most)
            if not len(chosen):
                out = np.zeros(self.reached.shape)
                np.maximum.at(out, self.slab, self.bound)
                return out.T
            halves, bound = self._halved(chosen)
            keep = np.delete(np.arange(len(self.boxes)), chosen)
            slab = np.tile(self.slab[chosen], 2)
            self._meet(halves, slab)
            self.boxes = Interval.concatenate([self.boxes[keep], halves])
            self.bound = np.concatenate([self.bound[keep], bound])
            self.slab = np.concatenate([self.slab[keep], slab])

    def _bend(self, boxes: Interval) -> Interval:
        """∂²(f̂ − f − p)/∂z_j² over boxes, (n, nx)."""
        p, j = self.problem, self.j
        known = self.fhat.curvature_enclosure(boxes, j) - p.model.curvature_enclosure(boxes, j)
        return known - p.predictor.curvature_over(boxes, j)

    def _meet(self, boxes: Interval, slab: Ints) -> None:
        """Second derivatives that occur in the slabs for certain, at centres of boxes."""
        np.maximum.at(self.reached, slab, abs(self._bend(Interval.exact(boxes.mid))).lo)

    def _loose(self) -> Array:
        """(boxes, nx): bounds relative to the largest in their slab; 0 where they need not become smaller."""
        top = np.zeros(self.reached.shape)
        np.maximum.at(top, self.slab, self.bound)
        top, enough = top[self.slab], (self.reached * (1 + THRESHOLDS.curvature_near))[self.slab]
        share = np.divide(self.bound, top, out=np.ones_like(top), where=np.isfinite(top) & (top > 0))
        # Where one box of a slab has no bound, the others need none.
        share = np.where(np.isinf(top) & np.isfinite(self.bound), 0.0, share)
        return np.where(self.bound > enough, share, 0.0)

    def _chosen(self, most: int) -> Ints:
        """The most urgent boxes of each slab, half as many as it has, as long as it has room."""
        urgency = self._loose().max(axis=1)
        count = np.bincount(self.slab, minlength=len(self.reached))
        room = np.clip(most - count, 0, np.maximum(1, count // 2))
        order = np.lexsort((-urgency, self.slab))
        rank = np.arange(len(order)) - np.searchsorted(self.slab[order], self.slab[order])
        chosen: Ints = order[(rank < room[self.slab[order]]) & (urgency[order] > 0)]
        return chosen

    def _halved(self, chosen: Ints) -> tuple[Interval, Array]:
        """(halves, their bounds), each box cut along the axis that gains most; along its widest where none gains."""
        boxes, bound, loose = self.boxes[chosen], self.bound[chosen], self._loose()[chosen]
        best, rows = np.full(len(chosen), np.inf), np.arange(len(chosen))
        axis, values = np.zeros(len(chosen), dtype=np.intp), np.zeros((2, *bound.shape))
        for k in range(boxes.lo.shape[1]):
            found = np.minimum(self._bend(boxes.cut(np.full(len(rows), k))).mag.reshape(2, *bound.shape), bound)
            left = np.divide(found, bound, out=np.ones_like(found), where=np.isfinite(bound) & (bound > 0))
            left = np.where(np.isinf(bound) & np.isfinite(found), 0.0, left)
            cost = np.round((left.mean(axis=0) * loose).sum(axis=1), 9) - 1e-9 * (boxes.width / self.width)[:, k]
            better = cost < best
            best, axis, values = (
                np.where(better, cost, best),
                np.where(better, k, axis),
                np.where(better[:, None], found, values),
            )
        return boxes.cut(axis), values.reshape(-1, bound.shape[1])
