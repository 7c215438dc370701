"""Minimum and maximum over the cones g_k ± Σ_j L_j |z_j − z_kj|: exact, vectorised, and without the cones that cannot win."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import numpy as np

from gapcert.plugin import Array, Ints
from gapcert_bounds.thresholds import THRESHOLDS

_BLOCK = 1 << 15  # entries of each working array: they stay in the second-level cache
_EPS = float(np.finfo(np.float64).eps)


@final
class Cones:
    """Calling it with z (n, nz) returns (lower, upper), each (n, nx):

    upper_i = min_k g_ki + Σ_j L_ij |z_j − z_kj|, lower_i = max_k g_ki − Σ_j L_ij |z_j − z_kj|.

    Each cone's value is computed by the same operations in any batch, and minima are exact, so the answer for a point does not
    depend on the batch, nor on the cones that were left out.
    """

    def __init__(self, z: Array, g: Array, lipschitz: Array) -> None:
        self._z, self._g, self._lipschitz = np.ascontiguousarray(z.T), np.ascontiguousarray(g.T), lipschitz
        self._largest, self._slopes = np.abs(g).max(axis=0), np.ascontiguousarray(lipschitz)[:, :, None]
        self._signed = np.stack([self._g, -self._g])

    def __call__(self, z: Array) -> tuple[Array, Array]:
        n, nx = len(z), len(self._g)
        lower, upper = np.empty((nx, n)), np.empty((nx, n))
        order, starts = self._groups(z)
        points = np.ascontiguousarray(z[order].T)
        for i in range(nx):
            for start, stop, near in self._candidates(i, points, starts):
                part = slice(start, stop)
                self._extremes(i, points[:, part], self._z[:, near], self._g[i, near], lower[i, part], upper[i, part])
        out = np.empty((n, nx)), np.empty((n, nx))
        out[0][order], out[1][order] = lower.T, upper.T
        return out

    def one_row(self, z: Array) -> tuple[Array, Array]:
        """(lower, upper), each (nx,), at one point z (nz,): to the same bits, for all states at once."""
        away = z[:, None] - self._z
        np.abs(away, out=away)
        # Along an axis that is not the last, sums are made in order.
        total = np.add.reduce(self._slopes * away, axis=1)
        # max g − t = −min (−g + t), without a rounding of its own.
        upper, lower = np.minimum.reduce(self._signed + total, axis=2)
        return -lower, upper

    def lowest(self, i: int, sign: int, z: Array) -> Ints:
        """(n,): the number of a cone of sign · g that is smallest at each point z (n, nz)."""
        (order, starts), own, every = self._groups(z), sign * self._g[i], np.arange(self._z.shape[1])
        points, out = np.ascontiguousarray(z[order].T), np.empty(len(z), dtype=np.intp)
        for start, stop, near in self._candidates(i, points, starts):
            rows = max(1, _BLOCK // max(1, len(every[near])))
            for a in range(start, stop, rows):
                part = slice(a, min(a + rows, stop))
                work = self._distance(i, points[:, part], self._z[:, near])
                work += own[near]
                out[order[part]] = every[near][work.argmin(axis=1)]
        return out

    def crest(self, i: int, sign: int, centre: Array, h: Array, slope: Array, worth: float = np.inf) -> Array:
        """(n,): above min_k sign · g_ki + Σ_j L_ij |z_j − z_kj| + slope · (z − centre) over boxes centre ± h, up to rounding.

        Any weighted mean of cones lies above their minimum, and is largest at a corner of the box that is known axis by axis.
        The cone that is smallest at that corner joins the mean, with the best weight, until it adds nothing. Of cones that are
        affine over the box, the best mean is as low as their minimum; where they bend along one axis alone, and the mean lies
        more than `worth` above what is reached, the box is cut in two there. Those in which they bend along several are wide:
        smaller ones from the caller tell more for the same time.
        """
        top, low, axis, place = self._means(i, sign, centre, h, slope)
        rows = np.flatnonzero((axis >= 0) & (top - low > worth))
        if not len(rows):
            return top
        c, bent, j = centre[rows], slope[rows], axis[rows]
        spare = 2 * _EPS * (np.abs(c) + h[rows])
        ends, own = np.stack([c - h[rows] - spare, c + h[rows] + spare]), np.arange(len(rows))
        below, above = ends.copy(), ends.copy()
        below[1, own, j] = above[0, own, j] = place[rows]
        low, high = np.concatenate([below, above], axis=1)
        middle = low / 2 + high / 2
        half, bent = np.maximum(high - middle, middle - low) * (1 + 2 * _EPS), np.tile(bent, (2, 1))
        parts = self._means(i, sign, middle, half, bent)[0] + (bent * (middle - np.tile(c, (2, 1)))).sum(axis=1)
        top[rows] = np.minimum(top[rows], parts.reshape(2, -1).max(axis=0))
        return top

    def _means(self, i: int, sign: int, centre: Array, h: Array, slope: Array) -> tuple[Array, Array, Ints, Array]:
        """`crest` without cuts, and what is reached; the axis along which alone cones of a mean of several bend, else −1, and
        the place.
        """

        def ends(rows: Ints, k: Ints) -> tuple[Array, Array]:
            # g, and per axis what the cone with its slope is at the lower and the upper end of the box.
            away = centre[rows] - self._z[:, k].T
            sides = [np.abs(away + s * h[rows]) * self._lipschitz[i] + s * slope[rows] * h[rows] for s in (-1, 1)]
            return sign * self._g[i, k], np.stack(sides)

        depth, place = np.zeros(centre.shape), np.zeros(centre.shape)

        def bend(rows: Ints, k: Ints) -> None:
            deep = (h[rows] - np.abs(centre[rows] - self._z[:, k].T)) * self._lipschitz[i]
            place[rows] = np.where(deep > depth[rows], self._z[:, k].T, place[rows])
            depth[rows] = np.maximum(depth[rows], deep)

        rows = np.arange(len(centre))
        first = self.lowest(i, sign, centre)
        g, at = ends(rows, first)
        top = g + at.max(axis=0).sum(axis=1)
        near, low = THRESHOLDS.mean_near * h @ self._lipschitz[i], np.full(len(rows), -np.inf)
        for step in range(THRESHOLDS.mean_cones):
            rise = at[1] - at[0]
            corner = np.where(rise == 0, (-1) ** step, np.sign(rise))
            k = self.lowest(i, sign, centre[rows] + corner * h[rows])
            other, there = ends(rows, k)
            reached = other + np.where(corner > 0, there[1], there[0]).sum(axis=1)
            low[rows] = np.maximum(low[rows], reached)
            more = reached < top[rows] - near[rows]
            rows, g, at, other, there, rise, k = (
                rows[more],
                g[more],
                at[:, more],
                other[more],
                there[:, more],
                rise[more],
                k[more],
            )
            if not len(rows):
                break
            bend(rows, first[rows])
            bend(rows, k)
            # The mean's largest value is convex and piecewise linear in the weight, with a kink where an axis turns.
            change = rise - (there[1] - there[0])
            kinks = np.clip(np.divide(rise, change, out=np.zeros_like(rise), where=change != 0), 0.0, 1.0)
            weights = np.concatenate([kinks.T, np.ones((1, len(rows)))])
            mixed = at + weights[:, None, :, None] * (there - at)
            best = (g + weights * (other - g) + mixed.max(axis=1).sum(axis=2)).argmin(axis=0)
            own = np.arange(len(rows))
            g, at = g + weights[best, own] * (other - g), np.moveaxis(mixed[best, :, own], 1, 0)
            top[rows] = np.minimum(top[rows], g + at.max(axis=0).sum(axis=1))
        axis, every = np.argmax(depth, axis=1), np.arange(len(centre))
        one = (depth > near[:, None]).sum(axis=1) == 1
        return np.asarray(top), low, np.where(one, axis, -1), place[every, axis]

    def _extremes(self, i: int, points: Array, z: Array, g: Array, lower: Array, upper: Array) -> None:
        """Write the extremes of state i over the given cones into lower and upper; points (nz, n), z (nz, K), g (K,)."""
        n, K = points.shape[1], len(g)
        rows = min(n, max(1, _BLOCK // max(1, K)))
        # NumPy's inner loops run along the last axis: the longer one. Memory is asked for once.
        along = rows <= K
        shape = (rows, K) if along else (K, rows)
        total, work = np.empty(shape), np.empty(shape)
        for start in range(0, n, rows):
            part, m = slice(start, start + rows), min(rows, n - start)
            s, w, own, axis = (total[:m], work[:m], g, 1) if along else (total[:, :m], work[:, :m], g[:, None], 0)
            self._distance(i, points[:, part], z, along, s, w)
            np.add(s, own, out=w).min(axis=axis, out=upper[part])
            np.subtract(own, s, out=w).max(axis=axis, out=lower[part])

    def _distance(
        self, i: int, points: Array, z: Array, along: bool = True, total: Array | None = None, work: Array | None = None
    ) -> Array:
        """Σ_j L_ij |z_j − z_kj| for all points and cones, (n, K), or (K, n) with `along` False; an axis with L_ij = 0 costs
        nothing."""
        shape = (points.shape[1], z.shape[1])
        total = np.empty(shape if along else shape[::-1]) if total is None else total
        work = np.empty_like(total) if work is None else work
        first = True
        for j in np.flatnonzero(self._lipschitz[i]):
            t = total if first else work
            np.subtract(*((points[j][:, None], z[j]) if along else (points[j], z[j][:, None])), out=t)
            np.abs(t, out=t)
            t *= self._lipschitz[i, j]
            if not first:
                total += t
            first = False
        if first:
            total[...] = 0.0
        return total

    def _groups(self, z: Array) -> tuple[Ints, Ints]:
        """An order of the points in which near ones are neighbours, and where each group of them starts (with the end).

        Of few points no groups are made, as nothing would be won.
        """
        if len(z) < THRESHOLDS.direct_points:
            return np.arange(len(z)), np.zeros(0, dtype=np.intp)
        low, width = z.min(axis=0), np.ptp(z, axis=0)
        weight = self._lipschitz * width
        total = weight.sum(axis=1, keepdims=True)
        weight = np.divide(weight, total, out=np.zeros_like(weight), where=total > 0).max(axis=0)
        counts = np.ones(z.shape[1], dtype=np.int64)
        target = min(len(z) // THRESHOLDS.grouped_points, 1 << 15)
        while counts.prod() < target and (weight / counts).max() > 0:
            counts[np.argmax(weight / counts)] *= 2
        cell = np.zeros(len(z), dtype=np.uint16)
        for j in np.flatnonzero(counts > 1):
            k = ((z[:, j] - low[j]) * (counts[j] / width[j])).astype(np.uint16)
            cell = (cell * np.uint16(counts[j]) + np.minimum(k, np.uint16(counts[j] - 1))).astype(np.uint16)
        order = np.argsort(cell, kind="stable")
        starts = np.flatnonzero(np.diff(cell[order], prepend=cell[order[0]] + 1)) if len(z) else np.zeros(0, dtype=np.intp)
        return order, np.append(starts, len(z))

    def _candidates(self, i: int, points: Array, starts: Ints) -> Iterator[tuple[int, int, Ints | slice]]:
        """Per group: its start and end, and the cones that can be extreme at one of its points; without groups, all of them.

        Over a group with centre c and half-widths h no cone moves by more than ρ = Σ_j L_j h_j, so one that lies 2 ρ above the
        smallest at c is nowhere smallest. The bound on rounding is generous: a cone too many costs time only.
        """
        if not len(starts):
            yield 0, points.shape[1], slice(None)
            return
        low, high = np.minimum.reduceat(points, starts[:-1], axis=1), np.maximum.reduceat(points, starts[:-1], axis=1)
        centres, half = (low + high) / 2, (high - low) / 2
        reach = 2 * self._lipschitz[i] @ half
        chunk = max(1, (1 << 21) // self._z.shape[1])
        for first in range(0, centres.shape[1], chunk):
            s = self._distance(i, centres[:, first : first + chunk], self._z)
            up, down = s + self._g[i], s - self._g[i]
            slack = (reach[first : first + chunk] + 1e-12 * (s.max(axis=1) + self._largest[i]))[:, None]
            near = (up <= up.min(axis=1, keepdims=True) + slack) | (down <= down.min(axis=1, keepdims=True) + slack)
            for k, row in enumerate(near):
                yield int(starts[first + k]), int(starts[first + k + 1]), np.flatnonzero(row)
