"""The form `multilinear` of a saved certificate, and a predictor of that kind, evaluated with outward-rounded intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gapcert.plugin import Array, Interval, Zone, cells, cut, joined, ranges, rounding, slopes, worst

Arrays = Mapping[str, Array]
_BLOCK = 1 << 18  # entries of a working array, which a cache then holds


def nodes(arrays: Arrays, zone: Zone, prefix: str) -> list[Array]:
    """The axes that are stored under `prefix`; ValueError unless each has increasing, finite nodes."""
    axes = [np.asarray(arrays[f"{prefix}.axis{j}"], dtype=np.float64) for j in range(len(zone.low))]
    if not all(a.ndim == 1 and len(a) and np.isfinite(a).all() and (np.diff(a) > 0).all() for a in axes):
        raise ValueError(f"the nodes of {prefix} are not increasing")
    return axes


def predicted(arrays: Arrays, zone: Zone, z: Array) -> Interval:
    """p(z) of a multilinear predictor."""
    return interpolated(nodes(arrays, zone, "predictor"), Interval.exact(arrays["predictor.values"]), z)


def interpolated(axes: Sequence[Array], values: Interval, z: Array) -> Interval:
    """(n, nx): between the nodes' values (n_0, …, nx), at points z."""
    if values.shape[:-1] != tuple(len(a) for a in axes):
        raise ValueError(f"values of shape {values.shape} for {[len(a) for a in axes]} nodes")
    step = max(1, _BLOCK // (2 ** len(axes) * values.shape[-1]))
    parts = [_block(axes, values, z[a : a + step]) for a in range(0, len(z), step)]
    return Interval.concatenate(parts) if parts else Interval.exact(np.zeros((0, values.shape[-1])))


def _block(axes: Sequence[Array], values: Interval, z: Array) -> Interval:
    cell, _ = cells(axes, z, z)
    nz = len(axes)
    at = []
    for j, a in enumerate(axes):
        beside = np.arange(min(2, len(a)))
        at.append((cell[:, j : j + 1] + beside).reshape(len(z), *(-1 if k == j else 1 for k in range(nz))))
    window = Interval(values.lo[tuple(at)], values.hi[tuple(at)])
    for j, a in enumerate(axes):
        if len(a) < 2:
            window = window[:, 0]
            continue
        low, high = a[cell[:, j]], a[cell[:, j] + 1]
        t = (Interval.exact(np.clip(z[:, j], low, high)) - low) / (Interval.exact(high) - low)
        t = t.reshape(-1, *(1,) * (len(window.shape) - 2))
        window = window[:, 0] + t * (window[:, 1] - window[:, 0])
    return window


def band(arrays: Arrays, zone: Zone, z: Array, p: Interval, g: Interval) -> tuple[Interval, Interval]:
    """(l, u) = p + interpolated g ∓ (Σ_j what curvature or slope along axis j allow + 2 e); g: at the nodes, in C order."""
    axes = nodes(arrays, zone, "gap")
    counts = [len(a) for a in axes]
    inner = interpolated(axes, g.reshape(*counts, g.shape[-1]), z) + p
    width = Interval.exact(arrays["remainder.resolution"]) * 2.0 + _allowed(arrays, zone, axes, z)
    return inner - width, inner + width


def _allowed(arrays: Arrays, zone: Zone, axes: Sequence[Array], z: Array) -> Interval:
    """Σ_j min(H_ij / 2, 2 L_ij / h) (z_j − a)(b − z_j) in [a, b]; L_ij |z_j − a| along an axis with one node, and beyond."""
    cell, _ = cells(axes, z, z)
    constants = arrays["lipschitz"]
    total = Interval.exact(np.zeros((len(z), len(constants))))
    for j, a in enumerate(axes):
        inside = np.clip(z[:, j], a[0], a[-1])
        total = total + abs(Interval.exact(z[:, j]) - inside)[:, None] * Interval.exact(constants[:, j])
        if len(a) < 2:
            continue
        low, high = a[cell[:, j]], a[cell[:, j] + 1]
        steep = Interval.exact(2 * constants[:, j]) / (Interval.exact(high) - low)[:, None]
        bend = curvature(arrays, zone, j, a)[:, cell[:, j]].T
        bent = Interval.exact(np.where(np.isinf(bend), np.finfo(float).max, bend) / 2)
        product = (Interval.exact(inside) - low) * (Interval.exact(high) - inside)
        total = total + steep.minimum(bent) * product[:, None]
    return total


def over(arrays: Arrays, zone: Zone, g: Interval, boxes: Interval) -> Interval:
    """Contains [l − p, u − p] over boxes (n, nz), which are cut at the nodes: of each part the range of what lies between the
    nodes' values, with the most that curvature, or slopes, allow it to miss; or, where that is less, the band at its middle and
    what slopes add to it.
    """
    axes = nodes(arrays, zone, "gap")
    counts, nx = [len(a) for a in axes], len(arrays["resolution"])
    own = g[-int(np.prod(counts)) :]
    grid = own.reshape(*counts, nx)
    starts, parts, *_ = cut(axes, boxes, *cells(axes, boxes.lo, boxes.hi))
    pad = rounding(len(axes)) * float(g.mag.max())
    low, high = ranges(axes, grid.lo, parts.lo, parts.hi)[0] - pad, ranges(axes, grid.hi, parts.lo, parts.hi)[1] + pad
    wide = (Interval.exact(arrays["remainder.resolution"]) * 2.0 + _missed(arrays, zone, axes, parts)).hi
    flat = Interval(low, high) + Interval(-wide, wide)
    c = parts.mid
    ends = band(arrays, zone, c, Interval.exact(np.zeros((len(c), nx))), own)
    moves = [(slope * (parts - c)[:, None]).sum(-1) for slope in _slopes(arrays, zone, axes, grid, parts)]
    below, above = (end + move for end, move in zip(ends, moves, strict=True))
    return joined(starts, Interval(np.maximum(flat.lo, below.lo), np.minimum(flat.hi, above.hi)))


def _slopes(arrays: Arrays, zone: Zone, axes: Sequence[Array], g: Interval, boxes: Interval) -> tuple[Interval, Interval]:
    """Contain the slopes of l − p and of u − p over boxes, (n, nx, nz): those of g between its nodes ∓ those of what is missed,
    min(H_ij / 2, 2 L_ij / h) (a + b − 2 z_j).
    """
    constants, bends = arrays["lipschitz"], list[Interval]()
    for j, a in enumerate(axes):
        most, z = np.tile(constants[:, j], (len(boxes), 1)), boxes[:, j]
        bends.append(Interval(-most, most))
        if len(a) > 1:
            k = np.clip(np.searchsorted(a, z.lo, "right") - 1, 0, len(a) - 2)
            alone = (z.lo >= a[k]) & (z.hi <= a[k + 1])
            h = Interval.exact(a[1:]) - a[:-1]
            bend = np.minimum(curvature(arrays, zone, j, a), np.finfo(float).max)
            least = (Interval.exact(2 * constants[:, j : j + 1]) / h).minimum(Interval.exact(bend / 2))
            turned = least[:, k] * (Interval.exact(a[k]) + a[k + 1] - z * 2.0)
            most = np.maximum(most, (least * h).hi.max(axis=1))
            bends[j] = Interval(np.where(alone, turned.lo, -most.T).T, np.where(alone, turned.hi, most.T).T)
    low, high = slopes(axes, g.mid, boxes.lo, boxes.hi)
    least_h = np.array([np.diff(a).min(initial=np.inf) for a in axes])
    pad = 2 * (float(g.rad.max()) + 2 * rounding(len(axes)) * float(g.mag.max())) / least_h
    between, bent = Interval(low - pad, high + pad), Interval.stack(bends, axis=2)
    return between - bent, between + bent


def _missed(arrays: Arrays, zone: Zone, axes: Sequence[Array], boxes: Interval) -> Interval:
    """Σ_j max over the box of min(H_ij / 2, 2 L_ij / h) (z_j − a)(b − z_j); L_ij |z_j − a| along an axis with one node."""
    constants = arrays["lipschitz"]
    total = Interval.exact(np.zeros((len(boxes), len(constants))))
    for j, a in enumerate(axes):
        z = boxes[:, j]
        beyond = np.maximum(np.maximum(a[0] - z.lo, z.hi - a[-1]), 0.0)
        total = total + Interval.exact(constants[:, j]) * Interval.around(beyond, 0.0)[:, None]
        if len(a) < 2:
            continue
        # At most h² / 4 of each interval that the box touches, and what the ends allow where it is one alone.
        first = np.clip(np.searchsorted(a, z.lo, "right") - 1, 0, len(a) - 2)
        last = np.maximum(np.clip(np.searchsorted(a, z.hi, "left") - 1, 0, len(a) - 2), first)
        h = Interval.exact(a[1:]) - a[:-1]
        steep = Interval.exact(2 * constants[:, j : j + 1]) / h
        bend = curvature(arrays, zone, j, a)
        least = steep.minimum(Interval.exact(np.where(np.isinf(bend), np.finfo(float).max, bend) / 2))
        whole = (least * (h * h) * 0.25).hi
        reach = np.array([whole[:, p : q + 1].max(axis=1) for p, q in zip(first, last, strict=True)]).reshape(len(boxes), -1)
        inside = Interval(np.clip(z.lo, a[first], a[first + 1]), np.clip(z.hi, a[first], a[first + 1]))
        part = (inside - a[first]).hi * 1.0, (Interval.exact(a[first + 1]) - inside).hi
        alone = (least[:, first] * Interval.exact(part[0]) * Interval.exact(part[1])).hi.T
        total = total + Interval.exact(np.where((first == last)[:, None], np.minimum(alone, reach), reach))
    return total


def curvature(arrays: Arrays, zone: Zone, j: int, a: Array) -> Array:
    """(nx, cells between the nodes a): the stored curvature along axis j; ValueError unless slabs tile the axis."""
    if f"curvature.cuts{j}" not in arrays:
        return np.repeat(arrays["curvature"][:, j : j + 1], max(0, len(a) - 1), axis=1)
    cuts, slabs = arrays[f"curvature.cuts{j}"], arrays[f"curvature.slabs{j}"]
    tiled = (np.diff(cuts) > 0).all() and cuts[0] <= zone.low[j] and cuts[-1] >= zone.high[j]
    if not (tiled and slabs.shape == (len(arrays["lipschitz"]), len(cuts) - 1) and (slabs >= 0).all()):
        raise ValueError(f"the slabs of curvature do not tile axis {j}")
    return worst(a, cuts, slabs)
