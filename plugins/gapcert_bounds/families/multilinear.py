"""Interpolation between the nodes of a lattice: a predictor, and a band with what bounds of curvature allow it to miss."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert import Array, Domain, GapFunction, Interval, UsageError
from gapcert.plugin import GapFamily, GapProblem, Ints, Predictor, Samples, cells, cut, interpolate, ranges, rounding, slopes
from gapcert_bounds.thresholds import THRESHOLDS
from gapcert_functions import mean_value

_EPS = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)


@final
@dataclass(frozen=True, eq=False)
class MultilinearPredictor(Predictor):
    """p(z) = tensor product of linear interpolation between `values` (n_0, …, n_{nz−1}, nx) at the nodes `axes`.

    Along an axis with a single node p is constant; beyond the outer nodes it stays what it is there.
    """

    axes: tuple[Array, ...]
    values: Array
    kind: str = "multilinear"

    def __post_init__(self) -> None:
        if self.values.shape[:-1] != tuple(len(a) for a in self.axes) or any((np.diff(a) <= 0).any() for a in self.axes):
            raise UsageError(
                f"multilinear: values of shape {self.values.shape} for nodes {[len(a) for a in self.axes]}; give increasing "
                f"nodes for each axis, and one value per node and state"
            )

    @classmethod
    def fit(cls, samples: Samples, domain: Domain) -> MultilinearPredictor:
        """Least squares on the samples: up to three nodes per axis, the outer two at the ends of the domain's box; no more
        than an axis has different samples.
        """
        distinct = [len(np.unique(column)) for column in samples.z.T]
        for most in (3, 2):
            counts = [min(most, n) for n in distinct]
            if np.prod(counts) <= min(len(samples), THRESHOLDS.predictor_nodes):
                break
        else:
            raise UsageError(
                f"gap.predictor: multilinear needs {int(np.prod(counts))} nodes, and there are {len(samples)} samples when it "
                f"is fitted; use affine"
            )
        ends = zip(domain.low, domain.high, counts, samples.z.T, strict=True)
        axes = tuple(np.linspace(low, high, n) if n > 1 else z[:1].copy() for low, high, n, z in ends)
        size = int(np.prod(counts))
        pick = np.linspace(0, len(samples) - 1, min(len(samples), THRESHOLDS.predictor_samples)).astype(int)
        design = interpolate(axes, np.eye(size).reshape(*counts, size), samples.z[pick])
        values = np.linalg.lstsq(design, samples.r[pick], rcond=None)[0]
        return cls(axes, np.ascontiguousarray(values.reshape(*counts, -1)))

    def __call__(self, z: Array) -> Array:
        return interpolate(self.axes, self.values, z)

    def over(self, boxes: Interval) -> Interval:
        low, high = ranges(self.axes, self.values, boxes.lo, boxes.hi)
        return Interval(low - self._error, high + self._error)

    def jacobian_over(self, boxes: Interval) -> Interval:
        low, high = slopes(self.axes, self.values, boxes.lo, boxes.hi)
        sizes = np.array([np.diff(a).min(initial=np.inf) for a in self.axes])
        pad = 4 * self._error[:, None] / sizes
        return Interval(low - pad, high + pad)

    def curvature_over(self, boxes: Interval, axis: int) -> Interval:
        """0 where a closed box meets no node of the axis: along it p is straight between nodes."""
        a, z = self.axes[axis], boxes[:, axis]
        kinks = np.searchsorted(a, z.lo, "left") < np.searchsorted(a, z.hi, "right")
        most = np.broadcast_to(np.where(kinks & (len(a) > 1), np.inf, 0.0)[:, None], (len(boxes), self.values.shape[-1]))
        return Interval(-most, most)

    def cut(self, boxes: Interval) -> tuple[Ints, Interval]:
        """(starts, parts): boxes (n, nz) cut at the nodes, at most into eight parts each, and where those of each box begin."""
        return cut(self.axes, boxes, *cells(self.axes, boxes.lo, boxes.hi))[:2]

    def resolution(self, domain: Domain) -> Array:
        return self._error

    @property
    def _error(self) -> Array:
        largest = np.abs(self.values).max(axis=tuple(range(len(self.axes))))
        return np.asarray(rounding(len(self.axes)) * largest + np.finfo(float).tiny)

    def arrays(self) -> dict[str, Array]:
        return {**{f"axis{j}": a for j, a in enumerate(self.axes)}, "values": self.values}


def made(predictor: Any) -> Any:
    """What a family asks to be subtracted: for `multilinear`, what makes one of samples."""
    return MultilinearPredictor.fit if predictor == "multilinear" else predictor


@final
class MultilinearGap(GapFunction):
    """[l, u] = p + I g ± (Σ_j b_ij(z_j) + 2 e_i), I g interpolated between the nodes' remainders g (n_0, …, n_{nz−1}, nx).

    b_ij = min(H_ij / 2, 2 L_ij / (b − a)) (z_j − a)(b − z_j) between nodes a and b: what a function with |∂²_j| ≤ H_ij, or with
    |∂_j| ≤ L_ij, may differ by from the straight line; `curvature` has H (nx, cells) for each axis. Along an
    axis with one node a, b_ij = L_ij |z_j − a|.
    """

    predictor: Predictor

    family = "multilinear"

    def __init__(
        self,
        axes: tuple[Array, ...],
        g: Array,
        curvature: Sequence[Array],
        lipschitz: Array,
        resolution: Array,
        predictor: Predictor,
    ) -> None:
        self.curvature, self.lipschitz_values, self.resolution, self.predictor = curvature, lipschitz, resolution, predictor
        self.inner = MultilinearPredictor(axes, g)
        self._largest = np.abs(g).max(axis=tuple(range(len(axes))))
        self._misses = [_Miss(a, curvature[j], lipschitz[:, j]) for j, a in enumerate(axes)]

    def interval(self, z: Array) -> tuple[Array, Array]:
        p, g = self.predictor(z), self.inner(z)
        missed = np.zeros_like(p)
        for j, miss in enumerate(self._misses):
            missed += miss(z[:, j])
        pad = self._rounding(np.abs(p), missed)
        return p + g - missed - 2 * self.resolution - pad, p + g + missed + 2 * self.resolution + pad

    def interval_over(self, boxes: Interval) -> Interval:
        low, high = self.ends_over(boxes)
        return Interval(low.lo, high.hi)

    def ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        return self._ends(boxes, True)

    def remainder_ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        low, high = self._ends(boxes, False)
        pad = self.predictor.error_over(boxes)
        return Interval(low.lo - pad, low.hi + pad), Interval(high.lo - pad, high.hi + pad)

    def _ends(self, boxes: Interval, plus: bool) -> tuple[Interval, Interval]:
        """Of the band, or, without p, of what it has beyond."""
        starts, parts = self.inner.cut(boxes)
        p, missed = self.predictor.over(parts), np.zeros((len(parts), len(self.resolution)))
        both, slope = self.inner.over(parts), self.inner.jacobian_over(parts)
        if plus:
            both, slope = p + both, self.predictor.jacobian_over(parts) + slope
        bends = []
        for j, miss in enumerate(self._misses):
            missed += miss.over(parts.lo[:, j], parts.hi[:, j])
            bends.append(miss.slopes(parts.lo[:, j], parts.hi[:, j]))
        bend = Interval.stack(bends, axis=2)
        # For rounding here, for that of interpolated values at the box's points, and for the pad that `interval` adds there.
        pad = 3 * self._rounding(p.mag, missed)
        ends = []
        for k, sign in enumerate((-1.0, 1.0)):

            def value(z: Interval, k: int = k) -> Interval:
                at = self.interval(z.lo)[k] - (0.0 if plus else self.predictor(z.lo))
                return Interval(at - 2 * pad.max(axis=0), at + 2 * pad.max(axis=0))

            whole = both + Interval.hull(np.zeros_like(missed), sign * missed) + sign * 2 * self.resolution
            end = mean_value(parts, slope + bend * sign, value)
            end = Interval(np.maximum(end.lo, whole.lo - pad), np.minimum(end.hi, whole.hi + pad))
            ends.append(Interval(np.minimum.reduceat(end.lo, starts), np.maximum.reduceat(end.hi, starts)))
        return ends[0], ends[1]

    def _rounding(self, p: Array, missed: Array) -> Array:
        # Interpolated values err by (8 nz + 8) eps max |g|, what is missed by 8 eps of itself per axis, the sums by 6 eps.
        size = p + self._largest + missed + 2 * self.resolution
        return np.asarray((8 * len(self._misses) + 24) * _EPS * size + _TINY)

    def lipschitz(self, boxes: Interval) -> Array:
        slope = (self.predictor.jacobian_over(boxes) + self.inner.jacobian_over(boxes)).mag
        steep = np.stack([m.slope(boxes.lo[:, j], boxes.hi[:, j]) for j, m in enumerate(self._misses)], axis=2)
        # The pad follows |p|, whose share in it is below 1e-12.
        return np.asarray((slope + steep + 1e-12 * self.predictor.jacobian_over(boxes).mag) * (1 + 1e-12))

    def arrays(self) -> dict[str, Array]:
        axes = {f"axis{j}": a for j, a in enumerate(self.inner.axes)}
        axes |= {f"H{j}": h for j, h in enumerate(self.curvature)}
        own = {"g": self.inner.values.reshape(-1, len(self.resolution)), "L": self.lipschitz_values}
        return {**axes, **own, "e": self.resolution, **self.predictor.arrays()}

    @property
    def form(self) -> Mapping[str, Any]:
        return {"form": "multilinear", "predictor": self.predictor.kind}


@final
class _Miss:
    """b_ij along one axis: by how much g_i may leave the straight line between its nodes."""

    def __init__(self, nodes: Array, curvature: Array, constants: Array) -> None:
        self.nodes, self.constants = nodes, constants
        h = np.diff(nodes)
        self.factor = np.minimum(curvature / 2, 2 * constants[:, None] / h) if len(h) else np.zeros((len(constants), 0))
        self.top, self.steep = _Largest(self.factor * h**2 / 4), _Largest(self.factor * h)

    def __call__(self, z: Array) -> Array:
        """(n, nx) at z (n,)."""
        beyond = self._beyond(z, z)
        if len(self.nodes) < 2:
            return beyond
        k = self._cell(z)
        return np.asarray(self._part(k, z) + beyond)

    def over(self, low: Array, high: Array) -> Array:
        """The largest over [low, high], (n, nx)."""
        beyond = self._beyond(low, high)
        if len(self.nodes) < 2:
            return beyond
        first, last = self._cell(low), self._cell(high)
        middle = (self.nodes[1:] + self.nodes[:-1]) / 2
        most = np.maximum(
            self._part(first, np.clip(middle[first], low, high)), self._part(last, np.clip(middle[last], low, high))
        )
        between = last - first > 1
        most[between] = np.maximum(most[between], self.top(first[between] + 1, last[between] - 1))
        return np.asarray(most + beyond)

    def slopes(self, low: Array, high: Array) -> Interval:
        """Contains the slopes on [low, high], (n, nx)."""
        most = self.slope(low, high)
        if len(self.nodes) < 2:
            return Interval(-most, most)
        k = self._cell(low)
        a, b = self.nodes[k], self.nodes[k + 1]
        inside, pad = (low >= a) & (high <= b), 1e-12 * most
        ends = ((a + b - 2 * z)[:, None] * self.factor[:, k].T for z in (high, low))
        least, largest = (np.where(inside[:, None], end, side) for end, side in zip(ends, (-most, most), strict=True))
        return Interval(least - pad, largest + pad)

    def slope(self, low: Array, high: Array) -> Array:
        """A Lipschitz constant on [low, high], (n, nx)."""
        if len(self.nodes) < 2:
            return np.broadcast_to(self.constants, (len(low), len(self.constants)))
        out = self.steep(self._cell(low), self._cell(high))
        outside = (low < self.nodes[0]) | (high > self.nodes[-1])
        return np.asarray(np.where(outside[:, None], np.maximum(out, self.constants), out))

    def _cell(self, z: Array) -> Ints:
        # np.clip takes several times as long on few points.
        return np.asarray(np.minimum(np.maximum(np.searchsorted(self.nodes, z, "right") - 1, 0), len(self.nodes) - 2))

    def _part(self, k: Ints, z: Array) -> Array:
        a, b = self.nodes[k], self.nodes[k + 1]
        return np.asarray(self.factor[:, k].T * (np.maximum(z - a, 0) * np.maximum(b - z, 0))[:, None])

    def _beyond(self, low: Array, high: Array) -> Array:
        far = np.maximum(np.maximum(self.nodes[0] - low, high - self.nodes[-1]), 0)
        return np.asarray(far[:, None] * self.constants)


@final
class _Largest:
    """The largest of table[:, first … last], from maxima over 2^k neighbours: (n, nx)."""

    def __init__(self, table: Array) -> None:
        self.levels = [np.ascontiguousarray(table.T)]
        while len(self.levels[-1]) > 1 << (len(self.levels) - 1):
            step, top = 1 << (len(self.levels) - 1), self.levels[-1]
            self.levels.append(np.maximum(top[:-step], top[step:]))

    def __call__(self, first: Ints, last: Ints) -> Array:
        out = np.empty((len(first), self.levels[0].shape[1]))
        level = np.floor(np.log2(last - first + 1)).astype(np.intp)
        for k in np.unique(level):
            rows = level == k
            table = self.levels[k]
            out[rows] = np.maximum(table[first[rows]], table[last[rows] + 1 - (1 << int(k))])
        return out


@final
class Multilinear(GapFamily):
    """Family `multilinear`. `predictor`: "none", "affine", a Predictor without kinks, or an extended model."""

    name = "multilinear"
    routes = ("dominate",)
    lattice = True

    def __init__(self, predictor: Any = "affine") -> None:
        self.predictor = predictor

    def fit(self, problem: GapProblem) -> GapFunction:
        bound, axes = problem.lipschitz, problem.samples.lattice
        if axes is None or problem.domain.relations:
            raise UsageError("multilinear: the samples are no lattice on a box; use sampling: {kind: lattice, ...}")
        if bound.curvature is None:
            what = "the constants hold per cell" if bound.cells is not None else f"{bound.method} gives none"
            raise UsageError(
                f"multilinear: it needs bounds of curvature, and {what}; use lipschitz.residual: {{kind: gradient-elite, "
                f"curvature: true}}, interval if both sides are equations, or declared values with `curvature`"
            )
        if problem.predictor.kind == "multilinear":
            raise UsageError("multilinear: the predictor has kinks at its nodes, so the remainder has no curvature; use affine")
        if (problem.resolution > problem.arithmetic).any():
            raise UsageError(
                "multilinear: hidden state is drawn, and the curvature of a residual says nothing of the spread between "
                "hidden states; use family envelope"
            )
        counts = tuple(len(a) for a in axes)
        g = problem.remainder[-int(np.prod(counts)) :].reshape(*counts, -1)
        ends = zip(axes, problem.domain.low, problem.domain.high, strict=True)
        if any(len(a) > 1 and (a[0], a[-1]) != (low, high) for a, low, high in ends):
            raise UsageError("multilinear: the lattice does not reach to both ends of the domain along every axis")
        bends = [bound.bend(j, a) for j, a in enumerate(axes)]
        return MultilinearGap(axes, g, bends, bound.value, problem.remainder_resolution, problem.predictor)
