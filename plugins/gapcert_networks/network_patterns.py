"""The largest gradient of a network on a box where few gates are open: branch and bound over them instead of the inputs.

A node says of some neurons on which side s of 0 they are. That is a polytope: s(p + P(x − c)) + q ≥ 0 for each, with the floats
of the bounds. A linear program proposes numbers λ ≥ 0; the node is empty where Σλ(sp + q) + |ΣλsP|r < 0 in spite of rounding
(Farkas), whatever the program did. The gradient is bounded on the box with those gates as said; with no open gate left it is
one vector.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable

import numpy as np

from gapcert.plugin import Array

from .network_cells import Cells, Held, middle
from .network_slopes import PIECEWISE, TINY
from .positive_definite import gamma


def open_gates(cells: Cells, low: Array, high: Array) -> int | None:
    """How many neurons have both slopes on the box (1, n), each, as far as their bounds tell; None where slopes are not two."""
    return _open(cells, low, high, _free(cells))[1] if all(name in PIECEWISE for name in cells.names) else None


def by_patterns(
    cells: Cells, low: Array, high: Array, lower: float, tolerance: float, tell: Callable[[float, float, int, int], bool]
) -> tuple[float, float, int]:
    """(Above every gradient norm on the box, lower or a larger one that occurs, nodes bounded).

    It is told (what is proved so far, lower, nodes, open ones), and whether to go on.
    """
    free = _free(cells)
    heap = [(-float(cells.bounds(low, high)[0][0]), 0, free)]
    done, count = 0.0, 1
    while heap and -heap[0][0] > lower * (1 + tolerance):
        if not tell(max(done, -heap[0][0]), lower, count, len(heap)):
            break
        bound, _, held = heapq.heappop(heap)
        at, left = _open(cells, low, high, held)
        if not left:
            done = max(done, -bound)
            continue
        for side in (1, -1):
            child = [h.copy() for h in held]
            child[at[0]][at[1]] = side
            count += 1
            point = _occurs(cells, low, high, child)
            if point is None:
                continue
            lower = max(lower, float(cells.attained(point)[0]))
            upper = float(cells.bounds(low, high, held=child)[0][0])
            heapq.heappush(heap, (max(bound, -upper), count, child))
    return max([done, lower, *(-b for b, _, _ in heap[:1])]), lower, count


def _free(cells: Cells) -> Held:
    return [np.zeros((len(w), 1), dtype=np.int8) for w in cells.W]


def _open(cells: Cells, low: Array, high: Array, held: Held) -> tuple[tuple[int, int], int]:
    """(The open gate to decide, how many there are): of the first layer that has any, the one that moves the gradient most."""
    layers, back, at, count = cells.layers(low, high, held), cells.last, (0, 0), 0
    for i in range(cells.depth - 1, -1, -1):
        here = layers[i]
        moved = np.abs(back) * here.rho[:, 0]
        if (here.rho > 0).any():
            # Where nothing comes of it, any.
            size = moved * np.linalg.norm(here.F[:, 0], axis=1) + np.where(here.rho[:, 0] > 0, TINY, 0.0)
            at, count = (i, int(size.argmax())), count + int((here.rho > 0).sum())
        back = cells.W[i].T @ (here.alpha[:, 0] * back)
    return at, count


def _occurs(cells: Cells, low: Array, high: Array, held: Held) -> Array | None:
    """A point (1, n) of the node, as far inside as possible; None where there is none for certain."""
    layers = cells.layers(low, high, held)
    c, r = (v[:, 0] for v in middle(low, high))
    rows = [(np.flatnonzero(h[:, 0]), h[:, 0], here) for h, here in zip(held, layers, strict=True)]
    P = np.concatenate([h[j, None] * np.broadcast_to(here.P, (len(h), *here.P.shape[1:]))[j, 0] for j, h, here in rows])
    p = np.concatenate([h[j] * here.z[j, 0] for j, h, here in rows])
    q = np.concatenate([np.broadcast_to(here.q, here.z.shape)[j, 0] for j, _, here in rows])
    scale = np.abs(P) @ r + TINY
    from scipy.optimize import linprog

    found = linprog(
        [*np.zeros(len(c)), -1.0],
        A_ub=np.hstack([-P * r / scale[:, None], np.ones((len(P), 1))]),
        b_ub=(p + q) / scale,
        bounds=[(-1, 1)] * len(c) + [(None, 1)],
    )
    if found.status != 0 or found.x is None:
        return np.asarray(c[None])
    if found.x[-1] < 0:
        weight = np.maximum(-found.ineqlin.marginals, 0.0) / scale
        sizes = weight @ (np.abs(p) + q) + (weight @ np.abs(P)) @ r
        # What underflows is far below 1e-12, also times r.
        if weight @ (p + q) + np.abs(weight @ P) @ r + 4 * gamma(len(P) + len(c) + 8) * sizes < -1e-12:
            return None
    return np.asarray(np.clip(c + r * found.x[:-1], low, high))
