"""How fast a network can change on a box: branch and bound over the gradient, proved in floating point.

Boxes of the inputs are split, or, where few gates are open, these. A node of the latter says of some neurons on which side s of
0 they are. That is a polytope: s(p + P(x − c)) + q ≥ 0 for each, with the floats of the bounds. A linear program proposes
numbers λ ≥ 0; the node is empty where Σλ(sp + q) + |ΣλsP|r < 0 in spite of rounding (Farkas), whatever the program did. The
gradient is bounded on the box with those gates as said; with no open gate left it is one vector.
"""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.plugin import Array, Emit, Event, Ints, UsageError, silent
from gapcert_networks.thresholds import THRESHOLDS

from .network import Network
from .network_cells import Cells, Held, middle
from .network_constant import gamma
from .network_slopes import PIECEWISE, TINY

CHUNK, DEEP = 256, 64  # boxes bounded together: one hidden layer, several


@final
@dataclass(frozen=True)
class LocalBound:
    """|y(x) − y(x′)| ≤ value·√(Σ_k units_k²(x_k − x′_k)²) for all x, x′ in the box [low, high], in real arithmetic.

    value is proved and rounded up; lower is below the norm of a gradient that occurs in the box. boxes: how many were bounded,
    with all gates free or some said.
    Where cells were asked for, `constants` (c₁, …, c_n) holds what is proved of each cell of a grid with the `edges` of every
    input: the same inequality for x, x′ in that cell.
    """

    value: float
    lower: float
    boxes: int
    low: Array
    high: Array
    units: Array
    edges: tuple[Array, ...] = ()
    constants: Array | None = None

    @property
    def gap(self) -> float:
        """value/lower − 1."""
        if self.lower > 0:
            return self.value / self.lower - 1
        return 0.0 if self.value == 0 else math.inf


def local_bound(
    network: Network,
    box: tuple[Sequence[float] | Array, Sequence[float] | Array],
    units: Sequence[float] | Array | None = None,
    *,
    tolerance: float = 0.01,
    budget: int = 1_000_000,
    seconds: float = math.inf,
    cells: int | Sequence[int] | None = None,
    emit: Emit = silent,
) -> LocalBound:
    """The constant of a network with one output on the box (low, high), to `gap` ≤ tolerance where boxes and seconds suffice.

    units s (n_in,), 1 by default: the norm of the inputs is √(Σ s_k² x_k²). cells: how many per input. Whenever the
    search ends, value is proved.
    """
    low, high, s = _checked(network, box, units)
    if not 0 <= tolerance < math.inf or budget < 1 or not seconds > 0:
        raise UsageError(
            f"network: found tolerance {tolerance}, budget {budget}, seconds {seconds}; expected a tolerance of 0 or more, "
            f"at least one box and some time; leave them out for 0.01 and a million boxes"
        )
    bounds = _cells_of(network, s)
    if not bounds.moves:
        value, lower, count = 0.0, 0.0, 0
    else:
        search = _Search(bounds, low, high, tolerance)
        value, lower, count = search.run(budget, time.monotonic() + seconds, emit)
    if cells is None:
        return LocalBound(value, lower, count, low, high, s)
    edges = _edges(low, high, cells)
    shape = tuple(len(e) - 1 for e in edges)
    index = np.stack(np.unravel_index(np.arange(math.prod(shape)), shape), axis=1)
    start = np.stack([e[i] for e, i in zip(edges, index.T, strict=True)], axis=1)
    end = np.stack([e[i + 1] for e, i in zip(edges, index.T, strict=True)], axis=1)
    each = np.zeros(len(start))
    if bounds.moves:
        # Neighbours along every input, so that few neurons vary on the boxes of a chunk.
        order = np.lexsort(tuple(index.T % 4) + tuple(index.T // 4))
        each[order] = np.minimum(_bounded(bounds, start[order], end[order])[0], value)
    return LocalBound(value, lower, count + len(start), low, high, s, edges, each.reshape(shape))


def _cells_of(network: Network, units: Array) -> Cells:
    if network.n_out != 1:
        raise UsageError(
            f"network: found {network.n_out} outputs; expected one for a constant on a box; give one network per row of "
            f"the last layer, and take the root of the sum of the squares"
        )
    weights, biases = list(network.weights), list(network.biases)
    names = [network.activation] * (len(weights) - 1)
    if network.output is not None or len(weights) == 1:
        names.append(network.output or "identity")
        weights.append(np.ones((1, 1)))
        biases.append(np.zeros(1))
    with np.errstate(over="ignore", invalid="ignore"):
        bounds = Cells(weights, biases, names, units)
    if not bounds.usable:
        raise UsageError(
            "network: its weights, biases or units are too far apart for floats; expected sizes near 1; rescale them"
        )
    return bounds


def _checked(
    network: Network, box: tuple[Sequence[float] | Array, Sequence[float] | Array], units: Sequence[float] | Array | None
) -> tuple[Array, Array, Array]:
    n = network.n_in
    try:
        low, high = (np.array(e, dtype=np.float64) for e in box)
    except (TypeError, ValueError):
        raise UsageError(f"network box: found {box!r}; expected (low, high) with {n} numbers each; give two rows") from None
    if low.shape != (n,) or high.shape != (n,):
        raise UsageError(f"network box: found shapes {low.shape} and {high.shape}; expected ({n},) each; give one per input")
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all() and max(-low.min(), high.max()) < 1e100):
        raise UsageError(
            f"network box: found {low.tolist()} to {high.tolist()}; expected low < high, finite and below 1e100, along every "
            f"input; leave out inputs that are constant"
        )
    s = np.ones(n) if units is None else np.array(units, dtype=np.float64)
    if s.shape != (n,) or not (np.isfinite(s).all() and (s > 0).all()) or s.max() > THRESHOLDS.apart * s.min():
        raise UsageError(
            f"network units: found {s.tolist()}; expected {n} positive numbers within {THRESHOLDS.apart:g} of each "
            "other; one per input"
        )
    return low, high, s


def _edges(low: Array, high: Array, cells: int | Sequence[int]) -> tuple[Array, ...]:
    counts = np.broadcast_to(np.asarray(cells), low.shape) if np.ndim(cells) == 0 else np.asarray(cells)
    if counts.shape != low.shape or counts.dtype.kind not in "iu" or (counts < 1).any():
        raise UsageError(f"network cells: found {cells}; expected one whole number above 0, or {len(low)} of them")
    edges = tuple(np.linspace(a, b, int(k) + 1) for a, b, k in zip(low, high, counts, strict=True))
    if any((np.diff(e) <= 0).any() for e in edges):
        raise UsageError(f"network cells: found {cells}; floats do not divide the box so often; ask for fewer")
    return edges


def _bounded(bounds: Cells, low: Array, high: Array) -> tuple[Array, Ints]:
    size = CHUNK if bounds.depth == 1 else DEEP
    parts = [
        bounds.within(low[a : a + size], high[a : a + size]).bounds(low[a : a + size], high[a : a + size])
        for a in range(0, len(low), size)
    ]
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


@final
class _Search:
    """Open boxes in the order of the tree, so that neighbours are bounded together; `done`: the largest bound of the others."""

    def __init__(self, bounds: Cells, low: Array, high: Array, tolerance: float) -> None:
        self.bounds, self.tolerance = bounds, tolerance
        self.low, self.high = low[None], high[None]
        self.upper, self.axis = bounds.bounds(self.low, self.high)
        self.lower, self.done, self.count = self._looked(low, high), 0.0, 1

    def _looked(self, low: Array, high: Array) -> float:
        """A large gradient norm: of random points, then near the best of them."""
        rng = np.random.default_rng(0)
        x = rng.uniform(low, high, (THRESHOLDS.climb_points, len(low)))
        best, at = 0.0, (low / 2 + high / 2)
        for i in range(THRESHOLDS.climb_rounds):
            found = self.bounds.attained(x)
            if found.max() > best:
                best, at = float(found.max()), x[found.argmax()]
            x = np.clip(at + rng.normal(size=(THRESHOLDS.climb_tries, len(low))) * (high - low) * 0.5 ** (i / 2 + 3), low, high)
        return best

    @property
    def value(self) -> float:
        return max(self.done, self.lower, float(self.upper.max(initial=0.0)))

    def run(self, budget: int, end: float, emit: Emit) -> tuple[float, float, int]:
        self._close()
        gates = _open_gates(self.bounds, self.low, self.high) if len(self.upper) else None
        tried = gates is None or gates > THRESHOLDS.most_gates
        share = (gates or 0) / self.bounds.n
        first = 0 if share <= THRESHOLDS.few_gates else THRESHOLDS.gate_boxes if share <= THRESHOLDS.some_gates else math.inf
        whole = self.low, self.high
        while len(self.upper):
            if self.count + 2 > budget or time.monotonic() > end:
                break
            if not tried and self.count >= first:
                tried = True
                self._by_gates(whole, budget, end, emit)
            else:
                self._split(budget, end)
                self._tell(budget, emit, self.value, self.lower, len(self.upper))
            self._close()
        # Where kinks of several layers meet, bounds of boxes may stay above the gradient.
        left = self.count + 2 <= budget and time.monotonic() <= end
        if left and not tried and self.value > self.lower * (1 + self.tolerance):
            self._by_gates(whole, budget, end, emit)
        return self.value, self.lower, self.count

    def _tell(self, budget: int, emit: Emit, value: float, lower: float, open_: int) -> None:
        told = {"done": self.count, "total": budget, "value": value, "lower": lower, "open": open_}
        emit(Event("progress", "network", told))

    def _by_gates(self, box: tuple[Array, Array], budget: int, end: float, emit: Emit) -> None:
        """Few gates tell them apart sooner than boxes do, if the inputs are many."""
        before, known, most = self.count, self.value, min(THRESHOLDS.gate_nodes, budget - self.count)

        def tell(value: float, lower: float, nodes: int, open_: int) -> bool:
            self.count = before + nodes
            self._tell(budget, emit, min(known, value), max(lower, self.lower), open_)
            return nodes + 2 <= most and time.monotonic() <= end

        value, self.lower, nodes = _by_patterns(self.bounds, *box, self.lower, self.tolerance, tell)
        self.count = before + nodes
        self.upper, self.done = np.minimum(self.upper, value), min(self.done, value)

    def _close(self) -> None:
        keep = self.upper > self.lower * (1 + self.tolerance)
        self.done = max(self.done, float(self.upper[~keep].max(initial=0.0)))
        self.low, self.high, self.upper, self.axis = self.low[keep], self.high[keep], self.upper[keep], self.axis[keep]

    def _split(self, budget: int, end: float) -> None:
        """The open boxes, or the worse half of many, become two each, chunk by chunk."""
        chosen = np.ones(len(self.upper), dtype=bool)
        if len(chosen) > THRESHOLDS.split_boxes:
            chosen = self.upper >= np.median(self.upper)
        size = (CHUNK if self.bounds.depth == 1 else DEEP) // 2
        rows = np.flatnonzero(chosen)[: max((budget - self.count) // 2, 1)]
        kept = np.ones(len(chosen), dtype=bool)
        at, made = [], []
        for a in range(0, len(rows), size):
            pick = rows[a : a + size]
            along, i = self.axis[pick], np.arange(len(pick))
            low, high = np.repeat(self.low[pick], 2, axis=0), np.repeat(self.high[pick], 2, axis=0)
            middle = self.low[pick, along] / 2 + self.high[pick, along] / 2
            inside = (middle > self.low[pick, along]) & (middle < self.high[pick, along])
            high[2 * i, along] = np.where(inside, middle, high[2 * i, along])
            low[2 * i + 1, along] = np.where(inside, middle, low[2 * i + 1, along])
            small = self.bounds.within(low, high)
            before = np.repeat(self.upper[pick], 2)
            upper, axis = small.bounds(low, high, self.lower * (1 + self.tolerance), before)
            upper = np.fmin(upper, before)
            # A box that floats cannot divide is closed as it is.
            self.done = max(self.done, float(upper[np.repeat(~inside, 2)].max(initial=0.0)))
            upper[np.repeat(~inside, 2)] = 0.0
            self.count += len(low)
            self.lower = max(self.lower, float(small.attained(low / 2 + high / 2).max()))
            kept[pick] = False
            at.append(np.repeat(pick, 2))
            made.append((low, high, upper, axis))
            if time.monotonic() > end:
                break
        where = np.argsort(np.concatenate([np.flatnonzero(kept), *at]), kind="stable")
        old = (self.low[kept], self.high[kept], self.upper[kept], self.axis[kept])
        parts = [np.concatenate([o, *(m[j] for m in made)])[where] for j, o in enumerate(old)]
        self.low, self.high, self.upper, self.axis = parts


def _open_gates(cells: Cells, low: Array, high: Array) -> int | None:
    """How many neurons have both slopes on the box (1, n), each, as far as their bounds tell; None where slopes are not two."""
    return _open(cells, low, high, _free(cells))[1] if all(name in PIECEWISE for name in cells.names) else None


def _by_patterns(
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
