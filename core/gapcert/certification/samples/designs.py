"""Which points are sampled: a uniform grid, cells that are split where the certified band is loosest, or a lattice of nodes.

All keep to Z, and hold axes along which nothing changes at their middle: one cell is enough there. Further points are asked for
in rounds: all that the budget allows, or until the certified band is tight enough.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, final

import numpy as np

from gapcert.certification.samples.extremes import Extremes
from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.gaps.gap import GapFunction, GapProblem
from gapcert.contracts.gaps.lipschitz import LipschitzBound
from gapcert.contracts.gaps.predictor import Samples
from gapcert.contracts.plugins.registry import registry
from gapcert.contracts.systems.domain import Cover, Domain, Points
from gapcert.numerics.arrays import Array
from gapcert.numerics.constraint_zone import centres, edges
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval


class Sampling(ABC):
    """Which points are sampled: a first round, and, where constants are known, further ones.

    At most `budget` of them, where that is set, in chunks of `chunk`; fewer where the mean γ of the envelope comes down to
    `tightness` times the mean gap.
    """

    budget: int | None = None
    chunk: int
    tightness: float | None = None

    @abstractmethod
    def holding(self, held: Sequence[int]) -> Sampling:
        """With the held axes (by number) at their middle: one cell or node along each."""

    @abstractmethod
    def first(self, domain: Domain) -> Points | Cover:
        """The points of the first round."""

    def kept(self, domain: Domain) -> Extremes | None:
        """What is kept of the first round; None: every sample."""
        return None

    def further(
        self, domain: Domain, z: Array, r: Array, lipschitz: Array, bound: LipschitzBound | None = None
    ) -> Array | None:
        """The points of all later rounds (m, nz), given the first round and the constants; None where there are none."""
        return None


@final
@dataclass(frozen=True)
class GridSampling(Sampling):
    """All cell centres of a uniform grid: `counts` cells per axis.

    With `cells`, only the samples with the smallest and the largest r_i of so many coarse cells per axis are kept.
    """

    counts: tuple[int, ...]
    chunk: int = 100_000
    cells: tuple[int, ...] | None = None

    @classmethod
    def covering(cls, domain: Domain, states: float, inputs: float, chunk: int = 100_000) -> GridSampling:
        """The coarsest cubic grid whose Euclidean cover radius is at most εx in the states and εu in the inputs. Relations
        move points, which asks for a finer one: by at most a tenth more than needed.
        """
        axes = np.array([domain.nx, len(domain.low) - domain.nx])
        radii, finer = np.array([states, inputs]), np.ones(2)
        while True:
            cells = domain.width * np.repeat(np.sqrt(axes), axes) / np.repeat(2 * radii, axes)
            counts = tuple(max(1, int(np.ceil(c * f))) for c, f in zip(cells, np.repeat(finer, axes), strict=True))
            if not domain.relations:
                return cls(counts, chunk)
            short = np.array(Cover(domain, counts).radii()) > radii
            if not short.any():
                return cls(counts, chunk)
            finer = np.where(short, finer * 1.1, finer)

    @classmethod
    def spread(cls, domain: Domain) -> GridSampling:
        """About `spread_grid` points, evenly: where residuals have noise, no cell is known to be looser than another."""
        return cls((max(2, round(THRESHOLDS.spread_grid ** (1 / len(domain.low)))),) * len(domain.low))

    def holding(self, held: Sequence[int]) -> GridSampling:
        def one(counts: tuple[int, ...]) -> tuple[int, ...]:
            return tuple(1 if j in held else n for j, n in enumerate(counts))

        return replace(self, counts=one(self.counts), cells=None if self.cells is None else one(self.cells))

    def first(self, domain: Domain) -> Cover:
        if len(self.counts) != len(domain.low):
            raise UsageError(
                f"sampling.counts: {len(self.counts)} numbers for {len(domain.low)} axes; give one per state and input"
            )
        return Cover(domain, self.counts)

    def kept(self, domain: Domain) -> Extremes | None:
        if self.cells is None:
            return None
        if len(self.cells) != len(domain.low) or any(c > n for c, n in zip(self.cells, self.counts, strict=True)):
            found, most = list(self.cells), list(self.counts)
            raise UsageError(f"sampling.cells: found {found}; expected one number per axis, at most the grid's counts {most}")
        return Extremes(domain, self.cells)


@final
class _Cell(NamedTuple):
    """A box with centre and half-widths (nz,), and the sample that stands for it."""

    centre: Array
    half: Array
    sample: Array

    def cost(self, weight: Array) -> float:
        """Σ_j weight_j · (largest distance to the sample along axis j), times the volume."""
        return float(np.prod(self.half) * (weight @ (self.half + np.abs(self.sample - self.centre))))

    def thirds(self, domain: Domain, j: int) -> list[_Cell]:
        """The cell cut in three across axis j; the third that holds the sample keeps it.

        New samples lie at the centre, or are moved into Z. Thirds that do not meet Z are left out.
        """
        half = self.half.copy()
        half[j] /= 3
        middles = np.repeat(self.centre[None], 3, axis=0)
        middles[:, j] += 2 * half[j] * np.arange(-1, 2)
        if not domain.relations:
            return [_Cell(c, half, self.sample if k == 1 else c) for k, c in enumerate(middles)]
        own = 1 + int(np.clip(np.round((self.sample[j] - self.centre[j]) / (2 * half[j])), -1, 1))
        zone = domain.zone
        # A third that is left out by mistake costs tightness only, so rounding does not matter here.
        meets = (zone.dots(middles) - np.abs(zone.matrix) @ half <= zone.bounds).all(axis=1)
        rows = np.flatnonzero(meets & (np.arange(3) != own))
        low, high = np.maximum(middles - half, domain.low)[rows], np.minimum(middles + half, domain.high)[rows]
        thirds = [_Cell(middles[own], half, self.sample)]
        return thirds + [
            _Cell(middles[k], half, p) for k, p in zip(rows, domain.inside(middles[rows], Interval(low, high)), strict=True)
        ]


@final
@dataclass(frozen=True)
class AdaptiveSampling(Sampling):
    """Trisected cells: each cell is sampled at its centre, and cells where the certified band is loosest are split in three.

    A split keeps the sample for the child that holds it, so it costs two samples. The first round trisects every axis once
    (3^nz points), or samples the centre alone where the budget is smaller than that. With a `tightness` t further rounds end
    before the budget is spent where the envelope's mean γ is at most t times the mean gap, as the middle of the band has it.
    """

    budget: int = 300
    chunk: int = 100_000
    held: tuple[int, ...] = ()
    tightness: float | None = None

    def holding(self, held: Sequence[int]) -> AdaptiveSampling:
        return replace(self, held=tuple(held))

    def _counts(self, domain: Domain) -> tuple[int, ...]:
        n = 3 if 3 ** (len(domain.low) - len(self.held)) <= self.budget else 1
        return tuple(1 if j in self.held else n for j in range(len(domain.low)))

    def first(self, domain: Domain) -> Points:
        cover = Cover(domain, self._counts(domain))
        return Points(cover.chunk(0, len(cover)))

    def further(
        self, domain: Domain, z: Array, r: Array, lipschitz: Array, bound: LipschitzBound | None = None
    ) -> Array | None:
        """The points of all later rounds (m, nz), given the first round and the constants; None when the budget is spent.

        A cell with half-widths h leaves a band of about Σ_j L_ij h_j in state i; its cost is that, relative to the mean gap of
        the state and weighted by the cell's volume. The costliest cell is split along its costliest axis, until the budget is
        spent.
        """
        import heapq

        scale = np.abs(r).mean(axis=0)
        # Where the first round saw no gap at all, what the constants allow at the mean distance from the middle stands for it.
        scale = np.maximum(np.where(scale > 0, scale, lipschitz @ domain.width / 4), np.finfo(float).tiny)
        weight = (lipschitz / scale[:, None]).sum(axis=0)
        # A stable tie-break by age keeps the order, and so the points, independent of the heap's internals.
        heap = [(-c.cost(weight), k, c) for k, c in enumerate(_cells(domain, self._counts(domain), z))]
        heapq.heapify(heap)
        points: list[Array] = []
        age = len(heap)
        while len(z) + len(points) + 2 <= self.budget and weight.any():
            cell = heapq.heappop(heap)[2]
            j = int(np.argmax(weight * cell.half))
            for third in cell.thirds(domain, j):
                heapq.heappush(heap, (-third.cost(weight), age, third))
                age += 1
                if third.sample is not cell.sample:
                    points.append(third.sample)
        return np.array(points) if points else None


def _cells(domain: Domain, counts: tuple[int, ...], z: Array) -> list[_Cell]:
    """The cells of the first round: those that may meet Z, in the order of their samples z."""
    axes, half = domain.zone.axes, domain.width / (2 * np.array(counts))
    order = [*axes, *(j for j in range(len(counts)) if j not in axes)]
    index = np.empty((int(np.prod(counts)), len(counts)), dtype=np.int64)
    index[:, order] = np.stack(np.unravel_index(np.arange(len(index)), [counts[j] for j in order]), axis=1)
    columns = list(zip(domain.low, domain.high, counts, index.T, strict=True))
    low, high = (np.stack([edges(a, b, n)[k + up] for a, b, n, k in columns], axis=1) for up in (0, 1))
    middle = np.stack([centres(a, b, n)[k] for a, b, n, k in columns], axis=1)[~domain.outside(Interval(low, high))]
    return [_Cell(c, half, sample) for c, sample in zip(middle, z, strict=True)]


@final
@dataclass(frozen=True)
class LatticeSampling(Sampling):
    """The nodes of a lattice, from end to end of each axis: `counts` per axis, or as many as a `budget` of samples allows.

    With a budget, a coarse lattice comes first; the counts are chosen when the constants are known (`further`).
    """

    counts: tuple[int, ...] | None = None
    budget: int | None = None
    chunk: int = 100_000
    held: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if (self.counts is None) == (self.budget is None):
            raise UsageError("sampling: a lattice has either counts or a budget; give one of them")

    def holding(self, held: Sequence[int]) -> LatticeSampling:
        return replace(self, held=tuple(held))

    def first(self, domain: Domain) -> Points:
        if domain.relations:
            raise UsageError(
                f"sampling: a lattice needs a box, and '{domain.relations[0].text}' cuts it; use {{kind: adaptive, ...}} "
                f"and gap: {{kind: envelope}}"
            )
        free = len(domain.low) - len(self.held)
        n = next(n for n in (3, 2, 1) if n == 1 or 2 * n**free <= (self.budget or 0))
        counts = self.counts if self.counts is not None else (n,) * len(domain.low)
        if len(counts) != len(domain.low):
            raise UsageError(f"sampling.counts: {len(counts)} numbers for {len(domain.low)} axes; give one per state and input")
        return Points(_nodes(domain, [1 if j in self.held else n for j, n in enumerate(counts)]))

    def further(
        self, domain: Domain, z: Array, r: Array, lipschitz: Array, bound: LipschitzBound | None = None
    ) -> Array | None:
        """The lattice within the rest of the budget whose band is narrowest on the mean; None where counts were given.

        Along an axis whose nodes are h apart the band of state i is min(H_ij h² / 12, L_ij h / 3) wide on the mean, along one
        with a single node L_ij (width) / 4; each relative to the mean gap of the state. From one node per axis, that axis gets
        more whose gain is largest for the logarithm of what it costs. Where curvature is known by slabs, nodes are as dense
        as its third root, which makes the mean of H h² / 12 least.
        """
        if self.budget is None:
            return None
        scale = np.maximum(np.abs(r).mean(axis=0), np.finfo(float).tiny)[:, None]
        slope = lipschitz / scale
        counts, most = np.ones(len(domain.low), dtype=int), max(1, self.budget - len(z))
        free = [j for j in range(len(counts)) if j not in self.held]
        table = np.stack([_costs(domain.width[j], slope[:, j], _bends(bound, j), scale, most) for j in range(len(counts))])
        while True:
            best = (0.0, -1, 0)
            for j in free:
                room = most * int(counts[j]) // int(np.prod(counts))
                n = np.arange(counts[j] + 1, room + 1)
                gain = (table[j, counts[j] - 1] - table[j, n - 1]) / np.log(n / counts[j])
                if len(n) and gain.max() > best[0]:
                    best = (float(gain.max()), j, int(n[gain.argmax()]))
            if best[1] < 0:
                return _nodes(domain, counts.tolist(), [_bends(bound, j) for j in range(len(counts))], scale)
            counts[best[1]] = best[2]


Bends = tuple[Array, Array] | Array | None


def _bends(bound: LipschitzBound | None, j: int) -> Bends:
    """Curvature along an axis: (cuts, H (nx, slabs)), H (nx,), or None."""
    if bound is None or bound.slabs is None or (slab := bound.slabs[j]) is None:
        return None if bound is None or bound.curvature is None else bound.curvature[:, j]
    # Where a slab has no curvature, the constant serves: over its length as much as this curvature.
    return slab[0], np.where(np.isinf(slab[1]), 4 * bound.value[:, j : j + 1] / np.diff(slab[0]), slab[1])


def _costs(width: float, slope: Array, bends: Bends, scale: Array, most: int) -> Array:
    """(most,): Σ_i of the mean of what n = 1, 2, … nodes on an axis miss; slope (nx,) is relative to scale (nx, 1)."""
    h = width / np.arange(1, most)
    costs = slope[:, None] * h / 3
    if isinstance(bends, tuple):
        cuts, weight = bends[0], (bends[1] / scale).sum(axis=0)
        size, c = np.diff(cuts), np.arange(1, most)
        # As `_dense` has it: one cell per slab, then one more wherever H^(1/3) h is largest.
        order = np.argsort(-(np.cbrt(weight) * size)[:, None] / c, axis=None, kind="stable")
        falls = ((weight * size**3)[:, None] * (1 / c**2 - 1 / (c + 1) ** 2)).reshape(-1)[order]
        dense = (weight @ size**3 - np.append(0.0, np.cumsum(falls))) / (12 * width)
        # Fewer nodes than cuts are evenly spaced, and the largest curvature may hold between any of them.
        even = weight.max() * h**2 / 12
        bent = np.concatenate([even[: len(size) - 1], dense])[: len(h)]
        several = np.minimum(costs.sum(axis=0), bent)
    else:
        several = (costs if bends is None else np.minimum(costs, bends[:, None] / scale * h**2 / 12)).sum(axis=0)
    return np.concatenate([[float(slope.sum()) * width / 4], several])


def _nodes(domain: Domain, counts: Sequence[int], bends: Sequence[Bends] = (), scale: Array | None = None) -> Array:
    """(Π counts, nz) in C order; the outer nodes are the ends of the box, one node alone its middle."""
    axes = []
    for j, (low, high, n) in enumerate(zip(domain.low, domain.high, counts, strict=True)):
        slab = bends[j] if bends else None
        if n > 1 and isinstance(slab, tuple) and len(slab[0]) <= n:
            axes.append(_dense(low, high, n, slab[0], (slab[1] / (1.0 if scale is None else scale)).sum(axis=0)))
            continue
        a = np.linspace(low, high, n) if n > 1 else np.array([(low + high) / 2])
        a[-1] = high if n > 1 else a[-1]
        axes.append(a)
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def _dense(low: float, high: float, n: int, cuts: Array, weight: Array) -> Array:
    """n nodes from end to end, all cuts in between among them, evenly spaced between these: next to each other where
    weight^(1/3) is large.
    """
    inner = np.concatenate([[low], cuts[(cuts > low) & (cuts < high)], [high]])
    slab = np.clip(np.searchsorted(cuts, (inner[1:] + inner[:-1]) / 2, "right") - 1, 0, len(weight) - 1)
    share, cells = np.cbrt(weight[slab]) * np.diff(inner), np.ones(len(inner) - 1, dtype=int)
    for _ in range(n - 1 - len(cells)):
        cells[int(np.argmax(share / cells))] += 1
    parts = [np.linspace(a, b, m + 1)[:-1] for a, b, m in zip(inner[:-1], inner[1:], cells, strict=True)]
    return np.append(np.concatenate(parts), high)


def axes_of(z: Array) -> tuple[Array, ...]:
    """The nodes of each axis of a lattice."""
    return tuple(np.unique(column) for column in z.T)


def refined(problem: GapProblem, further: Array, tightness: float | None, query: Callable[[str, Array], Array]) -> Samples:
    """The problem's samples and those at `further` (m, nz), asked for round by round.

    With a `tightness` t it ends where the envelope's mean γ_i is at most t times the mean of |(l_i + u_i) / 2| in every state,
    or its gap is too small to be told from the resolution. Each round at least doubles the samples; points are taken in their
    order, so that a round is a pure function of the rounds before. Anchors of cells are in the first.
    """
    samples, start, cells = problem.samples, 0, problem.lipschitz.cells
    watch = _Watch(problem)
    if tightness is not None and cells is None and watch.tight(samples, samples, tightness):
        return samples
    least = 1 if cells is None else len(cells.anchors)
    for k, stop in enumerate(_ends(len(samples), least, len(further)) if tightness is not None else [len(further)]):
        part = further[start:stop]
        r = np.concatenate([samples.r, query(f"bound-{k + 1}", part)])
        taken = None if samples.taken is None else samples.taken + len(part)
        samples, start = Samples(np.concatenate([samples.z, part]), r, taken=taken), stop
        new = Samples(part, r[-len(part) :])
        if tightness is not None and stop < len(further) and watch.tight(samples, new, tightness):
            break
    return samples


def _ends(first: int, least: int, count: int) -> list[int]:
    """How many of the further samples there are after each round."""
    ratio = max(2.0, ((first + count) / first) ** (1 / THRESHOLDS.refinement_rounds))
    ends = first * ratio ** np.arange(1, THRESHOLDS.refinement_rounds + 1) - first
    return sorted({int(np.clip(e, min(least, count), count)) for e in ends} | {count})


class _Watch:
    """The envelope at fixed points, which costs no simulation. It is a minimum (u) and a maximum (l) over samples, so that a
    round looks at its own samples alone; with constants per cell, whose bands hold within a cell, at all of them.
    """

    def __init__(self, problem: GapProblem) -> None:
        self.problem = problem
        self.z = problem.domain.draw(THRESHOLDS.refinement_points, np.random.default_rng([problem.seed, 0x7167]))
        self.low: float | Array = -np.inf
        self.high: float | Array = np.inf

    def tight(self, samples: Samples, new: Samples, tightness: float) -> bool:
        alone = self.problem.lipschitz.cells is None
        problem = replace(self.problem, samples=new if alone else samples)
        gap: GapFunction = registry().build("gap_family", "envelope").fit(problem)
        low, high = gap.interval(self.z)
        if alone:
            low, high = np.maximum(low, self.low), np.minimum(high, self.high)
        self.low, self.high = low, high
        gamma, centre = np.maximum(np.abs(low), np.abs(high)).mean(axis=0), np.abs(low + high).mean(axis=0) / 2
        return bool(((gamma <= tightness * centre) | (gamma <= 10 * problem.arithmetic)).all())
