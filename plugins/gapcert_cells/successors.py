"""What a grid controller promises about one step: the cells in which it ends, per cell and input; of cells that are all alike,
or halved along every axis, some of them again, which makes a tree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Bools, Ints

GROWTH = "The successors of cells are bounded by the growth bound that is declared, in floating point; nothing proves it."
SEEN = (
    "On which states and inputs the model's successors depend was inferred from random pairs of points per axis, as the model "
    "encloses no derivatives; a dependence that none of them shows is missed."
)
"""What a controller may rest on, in the words of its `assumptions`."""


@final
@dataclass(frozen=True, eq=False)
class Along:
    """One axis of the grid: successors lie in cells first … last, both included, by rows and columns.

    A row is a cell of the product of the axes `on`, in C order; column (m,) is that of each input. Where it `moves`, indices
    count from the cell's own. row: of each cell, where there are rows for some cells only.
    """

    on: tuple[int, ...]
    moves: bool
    column: npt.NDArray[Any]
    first: npt.NDArray[Any]
    last: npt.NDArray[Any]
    row: npt.NDArray[Any] | None = None

    def rows(self, index: Sequence[Ints], counts: tuple[int, ...], number: Ints | None = None) -> Any:
        """(n,), or 0: the rows of cells with these indices; number (n,): which of the cells with a `row` they are."""
        if self.row is not None and number is not None:
            return self.row[number]
        return np.ravel_multi_index([index[d] for d in self.on], [counts[d] for d in self.on]) if self.on else 0


@final
@dataclass(frozen=True, eq=False)
class Successors:
    """The box of cells of every pair of a cell and an input. On an axis that `wraps`, indices count modulo its count."""

    counts: tuple[int, ...]
    wraps: tuple[bool, ...]
    axes: tuple[Along, ...]

    KEPT: ClassVar[int] = 2**28

    def unless_large(self) -> Successors | None:
        """None where the tables take more than KEPT bytes."""
        return self if sum(a.first.nbytes + a.last.nbytes for a in self.axes) <= self.KEPT else None

    def ends(self, cell: Ints, which: Ints, number: Ints | None = None) -> tuple[Ints, Ints]:
        """First and last cell of each axis (n, axes), of pairs of a flat cell and an input; not brought into the grid.

        number (n,): which of the cells it is, where axes have a `row` for each of some.
        """
        index = np.unravel_index(cell, self.counts)
        ends = np.empty((2, len(cell), len(self.axes)), dtype=np.int64)
        for k, axis in enumerate(self.axes):
            row = axis.rows(index, self.counts, number)
            for end, table in zip(ends, (axis.first, axis.last), strict=True):
                end[:, k] = (index[k] if axis.moves else 0) + table[row, axis.column[which]].astype(np.int64)
        return ends[0], ends[1]

    def contain(self, cell: Ints, which: Ints, after: Ints, number: Ints | None = None) -> Bools:
        """(n,): is the flat cell `after` one that the pair promises? −1, outside the grid, never is."""
        first, last = self.ends(cell, which, number)
        inside = after >= 0
        index = np.stack(np.unravel_index(np.maximum(after, 0), self.counts), axis=1)
        for k, (n, wraps) in enumerate(zip(self.counts, self.wraps, strict=True)):
            beyond = index[:, k] - first[:, k]
            beyond = beyond % n if wraps else beyond
            inside &= (beyond >= 0) & (beyond <= last[:, k] - first[:, k])
        return np.asarray(inside)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """As few bytes as the numbers allow; `from_arrays` is its inverse."""
        out: dict[str, npt.NDArray[Any]] = {"promised_moves": np.array([a.moves for a in self.axes])}
        for k, a in enumerate(self.axes):
            width = a.last.astype(np.int64) - a.first
            parts = {"on": np.array(a.on, dtype=np.int64), "column": a.column, "first": a.first, "width": width}
            parts |= {} if a.row is None else {"row": a.row}
            out |= {f"promised{k}_{name}": _narrow(part) for name, part in parts.items()}
        return out

    @classmethod
    def from_arrays(cls, counts: tuple[int, ...], wraps: tuple[bool, ...], arrays: Any) -> Successors | None:
        """None where there are none."""
        if "promised_moves" not in arrays:
            return None
        axes = []
        for k, moves in enumerate(arrays["promised_moves"].tolist()):
            on, column, first, width = (arrays[f"promised{k}_{name}"] for name in ("on", "column", "first", "width"))
            first, row = first.astype(np.int32), arrays.get(f"promised{k}_row")
            last = first + width.astype(np.int32)
            axes.append(Along(tuple(on.tolist()), bool(moves), column.astype(np.int64), first, last, row))
        return cls(counts, wraps, tuple(axes))


@final
@dataclass(frozen=True, eq=False)
class Splits:
    """counts: cells per axis of level 0, whose cells are the first nodes, in C order. Each further level has twice as many.

    first (nodes,): of a node that is split the first of its 2^axes children, which follow one another in C order; 0 where it is
    whole. Nodes are numbered level by level. A place is a cell of the finest level, by its flat number.
    """

    counts: tuple[int, ...]
    levels: int
    first: npt.NDArray[Any]

    PAINTED: ClassVar[int] = 2**26
    """Finest cells, at most, for which an adversarial policy measures depths one by one."""

    @property
    def finest(self) -> tuple[int, ...]:
        return self.at_level(self.levels)

    def at_level(self, level: int) -> tuple[int, ...]:
        """Cells per axis."""
        return tuple(n << level for n in self.counts)

    @cached_property
    def sides(self) -> Ints:
        """(2^axes, axes): the halves that each child is in, 0 or 1."""
        return np.indices((2,) * len(self.counts)).reshape(len(self.counts), -1).T

    @cached_property
    def starts(self) -> tuple[int, ...]:
        """The first node of each level, and the number of nodes."""
        out = [0, int(np.prod(self.counts, dtype=np.int64))]
        for _ in range(self.levels):
            out.append(out[-1] + len(self.sides) * int(np.count_nonzero(self.first[out[-2] : out[-1]])))
        return tuple(out)

    def level(self, node: Ints) -> Ints:
        """(n,): the level of each node."""
        return np.asarray(np.searchsorted(self.starts[1:-1], node, side="right"))

    @cached_property
    def index(self) -> npt.NDArray[np.int32]:
        """(nodes, axes): each node's place along the axes, on the grid of its own level."""
        out = np.empty((len(self.first), len(self.counts)), dtype=np.int32)
        out[: self.starts[1]] = np.stack(np.unravel_index(np.arange(self.starts[1]), self.counts), axis=1)
        split = np.flatnonzero(self.first)
        for low, high in zip(self.starts[:-2], self.starts[1:-1], strict=True):
            part = split[(split >= low) & (split < high)]
            out[self.first[part][:, None] + np.arange(len(self.sides))] = 2 * out[part][:, None] + self.sides
        return out

    def nodes(self, place: Ints) -> Ints:
        """(n,): the whole node that each place lies in; −1 stays −1."""
        index = np.unravel_index(np.maximum(place, 0), self.finest)
        node = np.asarray(np.ravel_multi_index([i >> self.levels for i in index], self.counts))
        for shift in range(self.levels)[::-1]:
            child = np.zeros(len(node), dtype=np.int64)
            for i in index:
                child = 2 * child + ((i >> shift) & 1)
            first = self.first[node]
            node = np.where(first > 0, first + child, node)
        return np.where(place < 0, -1, node)

    def painted(self) -> Ints:
        """(places,): the node of every place."""
        size, part = math.prod(self.finest), 1 << 20
        return np.concatenate([self.nodes(np.arange(k, min(k + part, size))) for k in range(0, size, part)])

    def ends(self, node: Ints) -> tuple[Ints, Ints]:
        """First place of each axis, and the one after the last (n, axes)."""
        shift, index = (self.levels - self.level(node))[:, None], self.index[node].astype(np.int64)
        return index << shift, (index + 1) << shift

    def shares(self) -> Array:
        """(nodes,): the part of the box that each node takes."""
        return np.asarray(0.5 ** (len(self.counts) * self.level(np.arange(len(self.first)))) / self.starts[1])


@final
@dataclass(frozen=True, eq=False)
class SuccessorsByLevel:
    """What a step from a node promises, on the grid of the node's own level; read as `Successors` are, with places after it."""

    splits: Splits
    levels: tuple[Successors, ...]

    def unless_large(self) -> SuccessorsByLevel | None:
        """None where the tables take more than `Successors.KEPT` bytes."""
        return self if sum(a.first.nbytes + a.last.nbytes for s in self.levels for a in s.axes) <= Successors.KEPT else None

    def contain(self, cell: Ints, which: Ints, after: Ints) -> Bools:
        """(n,): may a step from the node end in the place `after`? −1, outside the grid, never may."""
        out, index = np.zeros(len(cell), dtype=bool), np.unravel_index(np.maximum(after, 0), self.splits.finest)
        for k, rows, own, number in self._by_level(cell):
            there = np.ravel_multi_index([i[rows] >> (self.splits.levels - k) for i in index], self.splits.at_level(k))
            out[rows] = self.levels[k].contain(own, which[rows], np.where(after[rows] < 0, -1, there), number)
        return out

    def ends(self, node: Ints, which: Ints) -> tuple[Ints, Ints]:
        """First and last place of each axis (n, axes), of pairs of a node and an input; not brought into the grid."""
        out = np.empty((2, len(node), len(self.splits.counts)), dtype=np.int64)
        for k, rows, own, number in self._by_level(node):
            shift = self.splits.levels - k
            low, last = self.levels[k].ends(own, which[rows], number)
            out[0, rows], out[1, rows] = low << shift, ((last + 1) << shift) - 1
        return out[0], out[1]

    def _by_level(self, cell: Ints) -> list[tuple[int, Ints, Ints, Ints]]:
        """Of each level that occurs the rows, the flat cells on its grid, and their numbers among its nodes."""
        level, out = self.splits.level(cell), list[tuple[int, Ints, Ints, Ints]]()
        for k in np.unique(level).tolist():
            rows = np.flatnonzero(level == k)
            own = np.ravel_multi_index(tuple(self.splits.index[cell[rows]].T), self.splits.at_level(k))
            out.append((k, rows, np.asarray(own), cell[rows] - self.splits.starts[k]))
        return out

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """As those of `Successors`, with the level in front."""
        return {f"level{k}_{name}": a for k, made in enumerate(self.levels) for name, a in made.arrays().items()}

    @classmethod
    def from_arrays(
        cls, splits: Splits, wraps: tuple[bool, ...], arrays: Mapping[str, npt.NDArray[Any]]
    ) -> SuccessorsByLevel | None:
        """Inverse of `arrays`; None where there are none."""
        made = []
        for k in range(splits.levels + 1):
            head = f"level{k}_"
            own = {name.removeprefix(head): array for name, array in arrays.items() if name.startswith(head)}
            made.append(Successors.from_arrays(splits.at_level(k), wraps, own))
        whole = tuple(s for s in made if s is not None)
        return cls(splits, whole) if len(whole) == len(made) else None


def _narrow(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """As the smallest integers that hold them."""
    low, high = (int(values.min()), int(values.max())) if values.size else (0, 0)
    kind = np.result_type(np.min_scalar_type(low), np.min_scalar_type(high))
    return values.astype(kind if np.issubdtype(kind, np.integer) else np.int64)
