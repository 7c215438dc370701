"""Affine majorants: the least c + Σ_j A_j |z_j − centre_j| above bounds over the cells of a box, by a linear program."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gapcert.numerics.arrays import Array, Ints
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval
from gapcert.thresholds import THRESHOLDS

_EPS = float(np.finfo(np.float64).eps)

Bound = Callable[[Interval], Array]


def majorant(bounds: Array, low: Array, high: Array, centre: Array, mean: Array | None = None) -> tuple[Array, Array]:
    """(c, A), c (nx,), A (nx, nz) ≥ 0: c_i + Σ_j A_ij |z_j − centre_j| ≥ bounds_ki for every z of every cell [low_k, high_k].

    bounds (m, nx), low and high (m, nz); the cells tile a box. Over a cell the sum is least at d_kj = min |z_j − centre_j|, so
    the one with the least mean over the box solves a linear program: min c_i + Σ_j A_ij E_j subject to c_i + Σ_j A_ij d_kj ≥
    bounds_ki, where E_j is the mean of |z_j − centre_j| over the box, or `mean` (nz,). c is then taken from A with outward
    rounding, so that nothing rests on the solver, and raised by what a sum of nz + 1 floats may lose. The mean is never above
    that of the constant max_k bounds_ki, up to that rounding. A bound of ∞ gives c_i = ∞.

    UsageError where shapes differ or a number is missing.
    """
    m, nz = low.shape
    fits = bounds.ndim == 2 and (len(bounds), high.shape, centre.shape) == (m, (m, nz), (nz,)) and m > 0
    if not fits or np.isnan(bounds).any() or not (low <= high).all():
        raise UsageError(
            f"majorant: found bounds {bounds.shape}, low {low.shape}, high {high.shape} and centre {centre.shape}; give "
            f"one row of bounds for each cell, (m, nx), cells (m, nz) with low <= high, and a centre (nz,)"
        )
    near, e = _near(low, high, centre), _mean(low.min(axis=0), high.max(axis=0), centre) if mean is None else mean
    lines = [_line(b, near, e) for b in bounds.T]
    c, a = np.array([c for c, _ in lines]), np.array([a for _, a in lines])
    far = np.maximum(np.abs(low - centre), np.abs(high - centre)).max(axis=0)
    return _raised(c, a @ far, nz), a


def majorant_of(
    bound: Bound, low: Array, high: Array, centre: Array, count: int = THRESHOLDS.majorant_cells, mean: Array | None = None
) -> tuple[Array, Array]:
    """(c, A) as `majorant` has them, over the box [low, high]; bound, centre and mean as for `cells_of`.

    Each of the nx functions has cells of its own, count / nx at most: where they depend on different axes, cells that suit all
    are many.
    """
    found, nx = [], bound(Interval(low[None], high[None])).shape[1]
    for i in range(nx):

        def one(boxes: Interval, i: int = i) -> Array:
            return bound(boxes)[:, i : i + 1]

        cells, bounds = cells_of(one, low, high, centre, count // nx, mean)
        found.append(majorant(bounds, cells.lo, cells.hi, centre, mean))
    return np.concatenate([c for c, _ in found]), np.concatenate([a for _, a in found])


def cells_of(
    bound: Bound, low: Array, high: Array, centre: Array, count: int = THRESHOLDS.majorant_cells, mean: Array | None = None
) -> tuple[Interval, Array]:
    """(cells (m, nz), bounds (m, nx)) that tile the box [low, high] for `majorant`, about `count` cells at most.

    bound: boxes (n, nz) → (n, nx), above a function over each. In rounds, the majorant of the cells so far is found, and the
    cells on whose bounds it rests are cut along the axis that lowers these most, in two, or in three around the centre. It ends
    early where that no longer pays. centre and mean as for `majorant`.
    """
    cells = Interval(low[None], high[None])
    bounds, e = bound(cells), _mean(low, high, centre) if mean is None else mean
    rates, mark, reached = np.zeros((bounds.shape[1], len(low))), THRESHOLDS.least_cut, np.inf
    while len(cells) + 2 <= count:
        near, top = _near(cells.lo, cells.hi, centre), _tame(bounds)
        unit = np.maximum(top.max(axis=0), np.finfo(float).tiny)
        lines = [_line(b, near, e) for b in top.T]
        if len(cells) >= 4 * mark:
            now = float(sum((c + a @ e) / u for (c, a), u in zip(lines, unit, strict=True)))
            if now > (1 - THRESHOLDS.majorant_gain) * reached:
                break
            mark, reached = len(cells), now
        slopes = np.array([a for _, a in lines])
        left = (top - near @ slopes.T) / unit
        slack = left.max(axis=0) - left
        tried = np.argsort((slack - _gains(rates, cells)).min(axis=1), kind="stable")[: THRESHOLDS.cut_tried]
        rates = (rates + _rates(bound, cells[tried], bounds[tried], centre, slopes / unit[:, None], unit)) / 2
        # What may bind and gains much comes first: of the cells that bind, small ones can gain little.
        worth = _gains(rates, cells) - slack
        chosen = np.argsort(-worth.max(axis=1), kind="stable")
        chosen = chosen[: min(max(THRESHOLDS.least_cut, len(cells) // THRESHOLDS.cut_share), (count - len(cells)) // 2)]
        chosen = chosen[worth[chosen].max(axis=1) > 1e-6]
        if not len(chosen):
            break
        axis = (rates[worth[chosen].argmax(axis=1)] * cells.width[chosen]).argmax(axis=1)
        parts, parent = _cut(cells[chosen], axis, centre)
        finer = np.minimum(bound(parts), bounds[chosen][parent])
        kept = np.setdiff1d(np.arange(len(cells)), chosen)
        cells, bounds = Interval.concatenate([cells[kept], parts]), np.concatenate([bounds[kept], finer])
    return cells, bounds


def majorants(bound: Bound, lipschitz: Bound, boxes: Interval, total: int) -> tuple[Array, Array]:
    """(c, A), (n, nx) and (n, nx, nz), of a function below `bound` with slopes below `lipschitz` (n, nx, nz): the better of
    `majorant` and of these slopes, per box and function; the centre is 0. total: cells in all boxes.
    """
    centre, count = np.zeros(boxes.shape[1]), total // max(1, len(boxes))
    c, a = _steep(bound, lipschitz(boxes), boxes)
    for k, (low, high) in enumerate(zip(boxes.lo, boxes.hi, strict=True)):
        level, slope = majorant_of(bound, low, high, centre, count)
        e = _mean(low, high, centre)
        better = level + slope @ e <= c[k] + a[k] @ e
        c[k], a[k] = np.where(better, level, c[k]), np.where(better[:, None], slope, a[k])
    return c, a


def _steep(bound: Bound, slopes: Array, boxes: Interval) -> tuple[Array, Array]:
    """From the point z′ of each box that is next to 0: γ(z) ≤ γ(z′) + Σ_j L_j (|z_j| − |z′_j|), for |z_j − z′_j| is that."""
    known = np.isfinite(slopes).all(axis=2)
    a, point = np.where(np.isfinite(slopes), slopes, 0.0), np.clip(0.0, boxes.lo, boxes.hi)
    away = (Interval.exact(a) * Interval.exact(np.abs(point))[:, None, :]).sum(-1)
    c = np.maximum((Interval.exact(bound(Interval.exact(point))) - away).hi, 0.0)
    raised = _raised(c, (a * boxes.mag[:, None, :]).sum(axis=2), boxes.shape[1])
    return np.where(known, raised, np.inf), a


def _raised(c: Array, most: Array, nz: int) -> Array:
    """c with what a sum of nz + 1 terms, `most` without c at most, may round by."""
    return np.asarray(c + 4 * (nz + 2) * _EPS * (c + most))


def _line(bounds: Array, near: Array, mean: Array) -> tuple[float, Array]:
    """(c, a (nz,)): the program for one function, bounds (m,); or the constant."""
    from scipy.optimize import linprog

    top, a = max(float(bounds.max()), 0.0), np.zeros(near.shape[1])
    reach = near.max(axis=0)
    used = np.flatnonzero(reach > 0)
    if not (0 < top < np.inf) or not len(used):
        return top, a
    rows = np.column_stack([np.ones(len(near)), near[:, used] / reach[used]])
    # An axis that costs nothing would take any slope.
    cost = np.append(1.0, np.maximum(mean[used] / reach[used], 1e-6))
    found = linprog(cost, A_ub=-rows, b_ub=-bounds / top, method="highs")
    if found.x is None:
        return top, a
    a[used] = np.maximum(found.x[1:], 0.0) * (top / reach[used])
    c = max(float((Interval.exact(bounds) - (Interval.exact(near) * Interval.exact(a)).sum(-1)).hi.max()), 0.0)
    return (c, a) if c + a @ mean < top else (top, np.zeros(len(a)))


def _near(low: Array, high: Array, centre: Array) -> Array:
    """(m, nz): min |z_j − centre_j| over each cell, rounded down."""
    away = np.maximum(low - centre, centre - high)
    return np.asarray(np.maximum(np.nextafter(away, -np.inf), 0.0))


def _mean(low: Array, high: Array, centre: Array) -> Array:
    """(nz,): the mean of |z_j − centre_j| over a box."""
    at = np.clip(centre, low, high)
    width = high - low
    inside = ((at - low) ** 2 + (high - at) ** 2) / np.where(width > 0, 2 * width, 1.0)
    return np.asarray(inside + np.abs(centre - at))


def _tame(bounds: Array) -> Array:
    """Infinite bounds as large ones, which say where to cut."""
    most = np.where(np.isfinite(bounds), bounds, 0.0).max(axis=0)
    return np.asarray(np.minimum(bounds, 1e3 * np.maximum(most, 1.0)))


def _gains(rates: Array, cells: Interval) -> Array:
    """(m, nx): what a cut of each cell is expected to gain."""
    return np.asarray((rates[None] * cells.width[:, None, :]).max(axis=2))


def _rates(bound: Bound, cells: Interval, bounds: Array, centre: Array, slopes: Array, unit: Array) -> Array:
    """(nx, nz): by how much a cut lowers what bounds have above the slopes (nx, nz), per width of the cell, on average."""
    n, nz = cells.shape
    row, axis = np.repeat(np.arange(n), nz), np.tile(np.arange(nz), n)
    able = cells.width[row, axis] > 0
    row, axis = row[able], axis[able]
    out = np.zeros((nz, len(unit)))
    if not len(row):
        return out.T
    parts, parent = _cut(cells[row], axis, centre)
    finer = np.minimum(bound(parts), bounds[row][parent])
    left = _tame(np.concatenate([bounds, finer])) / unit
    both = Interval.concatenate([cells, parts])
    left -= _near(both.lo, both.hi, centre) @ slopes.T
    own, rest = left[:n], left[n:]
    each = np.zeros((len(row), len(unit)))
    np.add.at(each, parent, rest)
    drop = own[row] - each / np.bincount(parent)[:, None]
    np.add.at(out, axis, np.maximum(drop, 0.0) / cells.width[row, axis][:, None])
    return np.asarray(out.T / n)


def _cut(cells: Interval, axis: Ints, centre: Array) -> tuple[Interval, Ints]:
    """(parts, parent): each cell cut along its axis, in two at the middle, or in three where the centre lies inside: the
    centre's part has half of the length on either side.
    """
    rows = np.arange(len(cells))
    low, high, at = cells.lo[rows, axis], cells.hi[rows, axis], centre[axis]
    middle, around = low + (high - low) / 2, (low < at) & (at < high)
    first = np.where(around, low + (at - low) / 2, middle)
    second = np.where(around, at + (high - at) / 2, middle)
    parts, parents = [], []
    for a, b, some in ((low, first, rows), (first, second, rows[around]), (second, high, rows)):
        lo, hi = cells.lo[some].copy(), cells.hi[some].copy()
        lo[np.arange(len(some)), axis[some]], hi[np.arange(len(some)), axis[some]] = a[some], b[some]
        parts.append(Interval(lo, hi))
        parents.append(some)
    return Interval.concatenate(parts), np.concatenate(parents)
