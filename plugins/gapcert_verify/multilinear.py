"""The form `multilinear` of a saved certificate, and a predictor of that kind, evaluated with outward-rounded intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gapcert.plugin import Array, Interval, Zone, cells, worst

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


def curvature(arrays: Arrays, zone: Zone, j: int, a: Array) -> Array:
    """(nx, cells between the nodes a): the stored curvature along axis j; ValueError unless slabs tile the axis."""
    if f"curvature.cuts{j}" not in arrays:
        return np.repeat(arrays["curvature"][:, j : j + 1], max(0, len(a) - 1), axis=1)
    cuts, slabs = arrays[f"curvature.cuts{j}"], arrays[f"curvature.slabs{j}"]
    tiled = (np.diff(cuts) > 0).all() and cuts[0] <= zone.low[j] and cuts[-1] >= zone.high[j]
    if not (tiled and slabs.shape == (len(arrays["lipschitz"]), len(cuts) - 1) and (slabs >= 0).all()):
        raise ValueError(f"the slabs of curvature do not tile axis {j}")
    return worst(a, cuts, slabs)
