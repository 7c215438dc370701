"""Multilinear interpolation on a lattice: values, their ranges over boxes, and slopes; nothing but numbers.

`axes` are the nodes of each axis, increasing; one node alone stands for a function that does not depend on that axis. `values`
has the nodes' values in C order, (n_0, …, n_{nz−1}, nx). Points beyond the outer nodes are moved to these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from gapcert.numerics.arrays import Array, Ints
from gapcert.numerics.intervals import Interval

Axes = Sequence[Array]

_BLOCK = 1 << 18  # entries of a working array, which a cache then holds
_EPS = float(np.finfo(np.float64).eps)


def worst(nodes: Array, cuts: Array, values: Array) -> Array:
    """(nx, cells between nodes): the largest of values (nx, slabs between cuts) over the slabs that a cell meets."""
    first = np.clip(np.searchsorted(cuts, nodes[:-1], "right") - 1, 0, len(cuts) - 2)
    last = np.maximum(np.clip(np.searchsorted(cuts, nodes[1:], "left") - 1, 0, len(cuts) - 2), first)
    found = [values[:, a : b + 1].max(axis=1) for a, b in zip(first, last, strict=True)]
    return np.stack(found, axis=1) if found else np.zeros((len(values), 0))


def rounding(nz: int) -> float:
    """Times the largest |value|: what an interpolated value may err by.

    Per axis, a position errs by 4 u, its complement by 5 u, and v (1 − t) + w t by 3 u more, of terms ≤ max |value|.
    """
    return (8 * nz + 8) * _EPS


def cells(axes: Axes, low: Array, high: Array, closed: bool = False) -> tuple[Ints, Ints]:
    """The first and the last cell of each axis that a box [low, high] (n, nz) meets; with `closed`, in its closure."""
    # A point on a node is in the cell above it, and so is a box that begins there; one that ends there stays below.
    first = _above(axes, low, "left" if closed else "right")
    last = _above(axes, high, "right" if closed else "left")
    return first, last if closed else np.maximum(last, first)


def _above(axes: Axes, z: Array, side: Literal["left", "right"] = "right") -> Ints:
    """(n, nz): the cells of points, the outer ones of those beyond; of those on a node the one above, or with `left` below."""
    # np.clip takes several times as long on few points.
    found = [np.maximum(np.minimum(np.searchsorted(a, z[:, j], side) - 1, len(a) - 2), 0) for j, a in enumerate(axes)]
    return np.stack(found, axis=1)


def cut(axes: Axes, boxes: Interval, first: Ints, last: Ints, most: int = 8) -> tuple[Ints, Interval, Ints, Ints]:
    """Boxes (n, nz) cut at the nodes between cells first … last of each axis, where that gives at most so many parts of one.

    (starts, parts, first, last): where the parts of each box begin, and each part's cells.
    """
    row, span = np.arange(len(boxes)), last - first + 1
    many = np.where(span.prod(axis=1, keepdims=True) <= most, span, 1)
    low, high, first, last = boxes.lo, boxes.hi, first.copy(), last.copy()
    for j, a in enumerate(axes):
        if not (count := many[row, j]).max(initial=1) > 1:
            continue
        own = np.repeat(np.arange(len(row)), count)
        row, low, high, first, last, several = row[own], low[own], high[own], first[own], last[own], count[own] > 1
        k = np.where(several, first[:, j] + np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count), 0)
        low[:, j] = np.where(several & (k > first[:, j]), a[k], low[:, j])
        high[:, j] = np.where(several & (k < last[:, j]), a[k + 1], high[:, j])
        first[:, j], last[:, j] = np.where(several, k, first[:, j]), np.where(several, k, last[:, j])
    return np.flatnonzero(np.diff(row, prepend=-1)), Interval(low, high), first, last


def joined(starts: Ints, parts: Interval) -> Interval:
    """The hull of the parts (m, …) of each box, which begin at `starts`."""
    return Interval(np.minimum.reduceat(parts.lo, starts), np.maximum.reduceat(parts.hi, starts))


def interpolate(axes: Axes, values: Array, z: Array) -> Array:
    """(n, nx) at points z (n, nz), by the same operations in any batch."""
    out = np.empty((len(z), values.shape[-1]))
    cell = _above(axes, z)
    for rows, window in _windows(axes, values, cell, cell, np.arange(len(z))):
        for j, a in enumerate(axes):
            t = _position(a, cell[rows, j], z[rows, j]).reshape(-1, *(1,) * (window.ndim - 2))
            window = window[:, 0] * (1 - t) + window[:, 1] * t if len(a) > 1 else window[:, 0]
        out[rows] = window
    return out


def ranges(axes: Axes, values: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """The least and the largest value over boxes (n, nz), each (n, nx): those of the boxes' corners and of nodes between."""
    out = np.empty((2, len(low), values.shape[-1]))

    def write(rows: Ints, window: Array, first: Ints, last: Ints) -> None:
        for j in range(len(axes)):
            window = _ends(axes[j], window, j, first, last, low[rows], high[rows])
        inner = tuple(range(1, window.ndim - 1))
        out[0, rows], out[1, rows] = window.min(axis=inner), window.max(axis=inner)

    _by_size(axes, values, *cells(axes, low, high), write)
    return out[0], out[1]


def highest(axes: Axes, values: Array, low: Array, high: Array, slope: Array) -> Array:
    """(n,): the largest of value − slope · (z − c) over boxes (n, nz) with middles c, slope (n, nz), for one state (…, 1): at a
    corner of what the nodes' planes cut a box into."""
    out = np.empty(len(low))
    middle = np.clip(low / 2 + high / 2, low, high)

    def write(rows: Ints, window: Array, first: Ints, last: Ints) -> None:
        for j, a in enumerate(axes):
            x, y = low[rows, j : j + 1], high[rows, j : j + 1]
            if len(a) < 2:
                # The middle is a float: between neighbours it is one of the ends.
                c = middle[rows, j : j + 1]
                steep = np.abs(slope[rows, j]) * np.maximum(y - c, c - x)[:, 0]
                window = window + steep.reshape(-1, *(1,) * (window.ndim - 1))
                continue
            window = _ends(a, window, j, first, last, low[rows], high[rows])
            inside = a[first[:, j : j + 1] + 1 + np.arange(window.shape[j + 1] - 2)]
            at = np.concatenate([x, inside, y], axis=1) - middle[rows, j : j + 1]
            shape = (len(rows), *(-1 if k == j else 1 for k in range(len(axes))), 1)
            window = window - (slope[rows, j : j + 1] * at).reshape(shape)
        out[rows] = window.reshape(len(rows), -1).max(axis=1)

    _by_size(axes, values, *cells(axes, low, high), write)
    return out


def slopes(axes: Axes, values: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """The least and the largest slope along each axis over closed boxes, (n, nx, nz)."""
    nz = len(axes)
    out = np.zeros((2, len(low), values.shape[-1], nz))

    def write(rows: Ints, window: Array, first: Ints, last: Ints) -> None:
        for j in (j for j in range(nz) if len(axes[j]) > 1):
            size = np.diff(axes[j])[first[:, j : j + 1] + np.arange(window.shape[j + 1] - 1)]
            part = np.diff(window, axis=j + 1) / size.reshape(len(rows), *(-1 if k == j else 1 for k in range(nz)), 1)
            for k in (k for k in range(nz) if k != j):
                part = _ends(axes[k], part, k, first, last, low[rows], high[rows])
            inner = tuple(range(1, part.ndim - 1))
            out[0, rows, :, j], out[1, rows, :, j] = part.min(axis=inner), part.max(axis=inner)

    _by_size(axes, values, *cells(axes, low, high, closed=True), write)
    return out[0], out[1]


def _by_size(axes: Axes, values: Array, first: Ints, last: Ints, write: Callable[[Ints, Array, Ints, Ints], None]) -> None:
    """Boxes that meet equally many cells along each axis are looked at together."""
    if not len(first):
        return
    _, group = np.unique(last - first, axis=0, return_inverse=True)
    order = np.argsort(group.reshape(-1), kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(group.reshape(-1)[order])) + 1):
        for some, window in _windows(axes, values, first, last, rows):
            write(some, window, first[some], last[some])


def _windows(axes: Axes, values: Array, first: Ints, last: Ints, rows: Ints) -> Iterator[tuple[Ints, Array]]:
    """(rows, nodes' values (n, m_0, …, nx)) block by block; all rows meet equally many cells."""
    if not len(rows):
        return
    size = [int(last[rows[0], j] - first[rows[0], j]) + 2 if len(a) > 1 else 1 for j, a in enumerate(axes)]
    strides = np.cumprod([1, *(len(a) for a in reversed(axes[1:]))])[::-1].astype(np.intp)
    offset = np.zeros((), dtype=np.intp)
    for m, stride in zip(size, strides, strict=True):
        offset = np.add.outer(offset, np.arange(m) * stride)
    flat, step = values.reshape(-1, values.shape[-1]), max(1, _BLOCK // (offset.size * values.shape[-1]))
    for a in range(0, len(rows), step):
        some = rows[a : a + step]
        yield some, flat[(first[some] @ strides).reshape(-1, *(1,) * len(size)) + offset]


def _position(nodes: Array, cell: Ints, x: Array) -> Array:
    """In [0, 1]: where x is in its cell."""
    if len(nodes) < 2:
        return np.zeros(len(x))
    a, b = nodes[cell], nodes[cell + 1]
    return np.asarray((np.minimum(np.maximum(x, a), b) - a) / (b - a))


def _ends(nodes: Array, window: Array, j: int, first: Ints, last: Ints, low: Array, high: Array) -> Array:
    """The values along axis j at the box's lower end, at the nodes inside, and at its upper end."""
    if len(nodes) < 2:
        return window
    shape = (-1, *(1,) * (window.ndim - 1))
    s = _position(nodes, first[:, j], low[:, j]).reshape(shape)
    t = _position(nodes, last[:, j], high[:, j]).reshape(shape)
    a, b, c, d = (window.take([m], axis=j + 1) for m in (0, 1, -2, -1))
    inside = window.take(range(1, window.shape[j + 1] - 1), axis=j + 1)
    return np.concatenate([a * (1 - s) + b * s, inside, c * (1 - t) + d * t], axis=j + 1)


def on_curvature(form: Mapping[str, Any]) -> bool:
    """Does a stored function rest on bounds of curvature: as a multilinear band, or as one that was lifted above it?"""
    return bool(form.get("target", form["form"]) == "multilinear")
