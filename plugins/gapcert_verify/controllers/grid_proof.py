"""A saved controller on cells proved once more: every input that it allows, of every cell that wins."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import final

import numpy as np

from gapcert.plugin import Array, Bools, Ints, Zone
from gapcert_verify.arithmetic import Range

from .cells import Cells, Heights, Level
from .games import NONE, Part
from .successors import Flow, Stored, Windows

PAIRS = 1 << 19  # of a cell and an input, at once
BATCH = 1 << 12  # pairs that are looked at part by part together
PARTS = 1 << 14  # of cells, at once
EACH = 1 << 12  # parts that cells are cut into, on average of a batch, at most
CORNER = 0.999  # of the way from the middle of a cell to a corner, where a step is tried


@final
@dataclass(frozen=True)
class Proof:
    """cells, their parts to be proved, and, in (x, u), the domain that the gap is known in. flow: None takes the successors
    that the controller has stored.

    tick: told how many of how many cells are done; begin: so many need not be looked at again.
    """

    cells: Cells
    parts: Sequence[Part]
    flow: Flow | None
    zone: Zone
    tick: Callable[[int, int], None] = field(default=lambda done, total: None)
    begin: int = 0

    def run(self) -> str:
        """ "" where all is proved, else the first pair that is not, and a step that refutes it where one was found."""
        total, done, step = self.cells.size, 0, max(1, PAIRS // len(self.points))
        heights = [self.cells.heights(p.height) for p in self.parts]
        for at, level in enumerate(self.cells.levels):
            windows: Windows | Stored | None = None
            for a in range(0, len(level.node), step):
                rows = np.arange(a, min(a + step, len(level.node)))
                done += len(rows)
                if done <= self.begin:
                    continue
                windows = windows or (Stored(self.cells, level) if self.flow is None else Windows(self.flow, level))
                if text := self._rows(windows, [h[at] for h in heights], rows):
                    return text
                self.tick(done, total)
        return ""

    @property
    def points(self) -> Array:
        return self.cells.controller.points

    def _rows(self, windows: Windows | Stored, heights: Sequence[Heights], rows: Ints) -> str:
        level = windows.level
        for part, height in zip(self.parts, heights, strict=True):
            own = rows[part.limit[level.node[rows]] != NONE]
            if not len(own):
                continue
            allowed = np.unpackbits(part.bits[level.node[own]], axis=1, count=len(self.points))
            cell, choice = np.nonzero(allowed)
            pairs = np.asarray(cell, dtype=np.int64), np.asarray(choice, dtype=np.int64)
            if text := self._outside(level, own, pairs):
                return text
            left = np.flatnonzero(height.over(*windows.of(own, pairs)) > part.limit[level.node[own[pairs[0]]]])
            for k in range(0, len(left), BATCH):
                some = left[k : k + BATCH]
                if text := self._settled(level, height, part, own[pairs[0][some]], pairs[1][some]):
                    return text
        return ""

    def _outside(self, level: Level, rows: Ints, pairs: tuple[Ints, Ints]) -> str:
        """The gap is known in Z alone: every pair has to keep its relations, for all states of the cell."""
        zone, nx = self.zone, len(level.axes)
        low, high = level.boxes(rows)
        for a, bound, relation in zip(zone.matrix, zone.bounds, zone.relations, strict=True):
            ends = np.maximum(a[:nx] * low, a[:nx] * high).sum(axis=1)[pairs[0]] + (self.points @ a[nx:])[pairs[1]]
            size = (
                np.abs(a[:nx] * np.maximum(np.abs(low), np.abs(high))).sum(axis=1).max()
                + np.abs(self.points * a[nx:]).sum(axis=1).max()
            )
            # Sums of products err by less than so many ulp of their size, and so may bounds that were moved.
            if (over := ends > bound + 1e-13 * (size + abs(bound))).any():
                k = int(np.argmax(over))
                return f"{self._named(level, rows[pairs[0][k]], pairs[1][k])} breaks {relation.text}"
        return ""

    def _settled(self, level: Level, height: Heights, part: Part, rows: Ints, which: Ints) -> str:
        """The parts of cells that may go wrong, halved until they go right."""
        if self.flow is None:
            return f"{self._named(level, rows[0], which[0])}{part.memory}: what it has stored of it leads where it must not"
        limit, flow = part.limit[level.node[rows]].astype(np.int64), self.flow
        if (bad := self._refuted(flow, level, height, rows, which, limit)) is not None:
            row, x, after = bad
            told = f"at {x.tolist()} it leads to {after.tolist()}, where the promise does not hold"
            return f"{self._named(level, rows[row], which[row])}{part.memory}: {told}"
        weight, spent, todo = self._weights(flow, level), 0, [(np.arange(len(rows)), *level.boxes(rows))]
        while todo:
            pair, low, high = todo.pop()
            wrong = ~self._right(flow, level, height, (low, high), rows[pair], which[pair], limit[pair])
            pair, low, high = pair[wrong], low[wrong], high[wrong]
            if (spent := spent + len(pair)) > EACH * len(rows):
                return f"{self._named(level, rows[pair[0]], which[pair[0]])}{part.memory}: it was not proved where it leads"
            j, at = np.argmax((high - low) * weight, axis=1), np.arange(len(pair))
            below, above = high.copy(), low.copy()
            below[at, j] = above[at, j] = (low / 2 + high / 2)[at, j]
            pair, low, high = np.tile(pair, 2), np.concatenate([low, above]), np.concatenate([below, high])
            todo += [(pair[a : a + PARTS], low[a : a + PARTS], high[a : a + PARTS]) for a in range(0, len(pair), PARTS)]
        return ""

    def _weights(self, flow: Flow, level: Level) -> Array:
        """(axes,): how many cells the successors move by per unit of each coordinate."""
        low, high = (np.array([[a.edges[end] for a in level.axes]]) for end in (0, -1))
        u = self.points[:1]
        columns = [
            Range(np.concatenate([low, u], axis=1)[:, j], np.concatenate([high, u], axis=1)[:, j])
            for j in range(len(level.axes) + u.shape[1])
        ]
        wide, nx = frozenset(range(len(level.axes))), len(level.axes)
        _, slopes = flow.model.tape.run(columns, flow.model.terms, wide)
        size, widths = np.zeros((nx, nx)), np.array([a.width for a in level.axes])
        for k, own in enumerate(slopes):
            for j, s in own.items():
                size[k, j] = float(np.nan_to_num(s.mag, nan=1e6, posinf=1e6).max())
        if flow.gap is not None and (more := flow.gap.slopes) is not None:
            size += more[:, :nx]
        out = (size / widths[:, None]).max(axis=0)
        return np.asarray(np.maximum(out, 1e-9 / widths))

    def _right(
        self, flow: Flow, level: Level, height: Heights, boxes: tuple[Array, Array], rows: Ints, which: Ints, limit: Ints
    ) -> Bools:
        """(n,): parts of cells, from boxes[0] to boxes[1], all of whose successors are low enough."""
        out = np.empty(len(rows), dtype=bool)
        for a in range(0, len(rows), 1 << 14):
            s = slice(a, a + (1 << 14))
            reached = flow.over(boxes[0][s], boxes[1][s], which[s])
            first, last = np.empty((2, len(reached[0].lo), len(level.axes)), dtype=np.int64)
            for k, (axis, x) in enumerate(zip(level.axes, reached, strict=True)):
                still, own = flow.still(k, which[s]), level.index[rows[s], k]
                first[:, k], last[:, k] = (np.where(still, own, end) for end in axis.touched(x))
            out[s] = height.over(first, last) <= limit[s]
        return out

    def _refuted(
        self, flow: Flow, level: Level, height: Heights, rows: Ints, which: Ints, limit: Ints
    ) -> tuple[int, Array, Array] | None:
        """(pair, x, after): a state of a cell, and one that a step certainly may lead to and must not."""
        low, high = level.boxes(rows)
        sides = np.stack(np.meshgrid(*[[0.0, -1.0, 1.0]] * len(level.axes), indexing="ij"), axis=-1).reshape(
            -1, len(level.axes)
        )
        for side in sides[np.argsort(np.abs(sides).sum(axis=1) % len(level.axes), kind="stable")][:33]:
            x = low / 2 + high / 2 + side * CORNER * (high - low) / 2
            for after in flow.certain(x, which):
                ends = [axis.touched(r) for axis, r in zip(level.axes, after, strict=True)]
                # Rounding leaves open which of two cells it is: it is the lowest.
                corners = (np.stack(corner, axis=1) for corner in itertools.product(*ends))
                bad = reduce(np.minimum, (height.over(c, c) for c in corners)) > limit
                if bad.any():
                    k = int(np.argmax(bad))
                    return k, x[k], np.array([r.lo[k] for r in after])
        return None

    def _named(self, level: Level, row: int, which: int) -> str:
        low, high = level.boxes(np.array([row]))
        box = ", ".join(f"[{a:.6g}, {b:.6g}]" for a, b in zip(low[0], high[0], strict=True))
        return f"cell {int(level.node[row])} ({box}) under {self.points[which].tolist()}"
