"""The form `multilinear` of a saved certificate, and a predictor of that kind, evaluated with outward-rounded intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from gapcert.plugin import Array, Interval, cells, worst

if TYPE_CHECKING:
    from .evidence import Evidence

_BLOCK = 1 << 18  # entries of a working array, which a cache then holds


def nodes(e: Evidence, prefix: str) -> list[Array]:
    """The axes that are stored under `prefix`; ValueError unless each has increasing, finite nodes."""
    axes = [np.asarray(e.arrays[f"{prefix}.axis{j}"], dtype=np.float64) for j in range(len(e.zone.low))]
    if not all(a.ndim == 1 and len(a) and np.isfinite(a).all() and (np.diff(a) > 0).all() for a in axes):
        raise ValueError(f"the nodes of {prefix} are not increasing")
    return axes


def predicted(e: Evidence, z: Array) -> Interval:
    """p(z) of a multilinear predictor."""
    return interpolated(nodes(e, "predictor"), Interval.exact(e.arrays["predictor.values"]), z)


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


def band(e: Evidence, z: Array, p: Interval, g: Interval) -> tuple[Interval, Interval]:
    """(l, u) = p + interpolated g ∓ (Σ_j what curvature or slope along axis j allow + 2 e); g: at the nodes, in C order."""
    axes = nodes(e, "gap")
    counts = [len(a) for a in axes]
    inner = interpolated(axes, g.reshape(*counts, g.shape[-1]), z) + p
    width = Interval.exact(e.arrays["remainder.resolution"]) * 2.0 + _allowed(e, axes, z)
    return inner - width, inner + width


def _allowed(e: Evidence, axes: Sequence[Array], z: Array) -> Interval:
    """Σ_j min(H_ij / 2, 2 L_ij / h) (z_j − a)(b − z_j) in [a, b]; L_ij |z_j − a| along an axis with one node, and beyond."""
    cell, _ = cells(axes, z, z)
    constants = e.arrays["lipschitz"]
    total = Interval.exact(np.zeros((len(z), len(constants))))
    for j, a in enumerate(axes):
        inside = np.clip(z[:, j], a[0], a[-1])
        total = total + abs(Interval.exact(z[:, j]) - inside)[:, None] * Interval.exact(constants[:, j])
        if len(a) < 2:
            continue
        low, high = a[cell[:, j]], a[cell[:, j] + 1]
        steep = Interval.exact(2 * constants[:, j]) / (Interval.exact(high) - low)[:, None]
        curvature = _curvature(e, j, a)[:, cell[:, j]].T
        bent = Interval.exact(np.where(np.isinf(curvature), np.finfo(float).max, curvature) / 2)
        product = (Interval.exact(inside) - low) * (Interval.exact(high) - inside)
        total = total + steep.minimum(bent) * product[:, None]
    return total


def follows(e: Evidence) -> str:
    """ "" where nodes, remainders and constants of the stored function are those of samples, domain and certificate."""
    from .evidence import another

    axes, (z, _r) = nodes(e, "gap"), e.samples
    product = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    if not np.array_equal(z[-len(product) :], product):
        return "the nodes are not the last of the samples"
    if any(len(a) > 1 and (a[0], a[-1]) != (e.zone.low[j], e.zone.high[j]) for j, a in enumerate(axes)) or e.zone.relations:
        return "the nodes do not reach to both ends of Z, or Z is no box"
    g = e.parts[0].g[-len(product) :]
    if another(e, g):
        return "the stored values are not r − p at the nodes"
    for j, a in enumerate(axes):
        if not np.array_equal(e.arrays[f"gap.H{j}"], _curvature(e, j, a)):
            return f"the curvature of the function along axis {j} is not that of the certificate"
    same = {"gap.L": "lipschitz", "gap.e": "remainder.resolution"}
    other = [k for k, v in same.items() if not np.array_equal(e.arrays[k], e.arrays[v])]
    if other:
        return f"{other[0]} of the function is not that of the certificate"
    if (e.arrays["resolution"] > e.rounding).any() or e.data["predictor"] == "multilinear" or "cells.L" in e.arrays:
        return "curvature says nothing of drawn hidden state, of a predictor with kinks, or of cells"
    return ""


def bent(e: Evidence) -> str:
    """ "" unless second differences between neighbouring nodes refute the curvature, for certain."""
    axes, curvature = nodes(e, "gap"), e.arrays["curvature"]
    if curvature.shape != e.arrays["lipschitz"].shape or not (curvature >= 0).all():
        return "the curvature is negative, or no number"
    counts = [len(a) for a in axes]
    g = e.parts[0].g[-int(np.prod(counts)) :].reshape(*counts, len(curvature))
    for j, a in enumerate(axes):
        if len(a) < 3:
            continue
        low, high = (np.moveaxis(side, j, 0) for side in (g.lo, g.hi))
        slope = (Interval(low[1:], high[1:]) - Interval(low[:-1], high[:-1])) / _beside(a, low.ndim)
        allowed = _curvature(e, j, a).T * np.diff(a)[:, None] / 2
        allowed = (allowed[1:] + allowed[:-1]).reshape(len(a) - 2, *(1,) * (low.ndim - 2), -1)
        shortest = np.diff(a).min()
        slack = 4 * e.arrays["remainder.resolution"] / shortest
        least = abs(slope[1:] - slope[:-1]).lo
        if (least > (allowed + slack) * (1 + 1e-9)).any():
            return f"second differences along axis {j} refute the curvature"
    return ""


def _curvature(e: Evidence, j: int, a: Array) -> Array:
    """(nx, cells between the nodes a): the stored curvature along axis j; ValueError unless slabs tile the axis."""
    if f"curvature.cuts{j}" not in e.arrays:
        return np.repeat(e.arrays["curvature"][:, j : j + 1], max(0, len(a) - 1), axis=1)
    cuts, slabs = e.arrays[f"curvature.cuts{j}"], e.arrays[f"curvature.slabs{j}"]
    tiled = (np.diff(cuts) > 0).all() and cuts[0] <= e.zone.low[j] and cuts[-1] >= e.zone.high[j]
    if not (tiled and slabs.shape == (len(e.arrays["lipschitz"]), len(cuts) - 1) and (slabs >= 0).all()):
        raise ValueError(f"the slabs of curvature do not tile axis {j}")
    return worst(a, cuts, slabs)


def _beside(a: Array, dimensions: int) -> Interval:
    return (Interval.exact(a[1:]) - a[:-1]).reshape(-1, *(1,) * (dimensions - 1))
