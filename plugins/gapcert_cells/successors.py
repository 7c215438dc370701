"""What a grid controller promises about one step: the cells in which it ends, per cell and input."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, ClassVar, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Bools, Ints


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

    def corners(self, cell: Ints, which: Ints) -> Ints:
        """(n, 2^axes): flat cells at the corners of the box of each pair, those outside the grid moved to its edge."""
        return corners(*self.ends(cell, which), self.counts, self.wraps)

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


def _narrow(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """As the smallest integers that hold them."""
    low, high = (int(values.min()), int(values.max())) if values.size else (0, 0)
    kind = np.result_type(np.min_scalar_type(low), np.min_scalar_type(high))
    return values.astype(kind if np.issubdtype(kind, np.integer) else np.int64)


def corners(first: Ints, last: Ints, counts: tuple[int, ...], wraps: tuple[bool, ...]) -> Ints:
    """(n, 2^axes): flat cells at the corners of boxes, from first to last (n, axes); those outside moved to the grid's edge."""
    ends = np.stack([first, last])
    for k, (n, round_) in enumerate(zip(counts, wraps, strict=True)):
        ends[:, :, k] = ends[:, :, k] % n if round_ else np.clip(ends[:, :, k], 0, n - 1)
    sides = product((0, 1), repeat=len(counts))
    return np.stack([np.ravel_multi_index([ends[s, :, k] for k, s in enumerate(side)], counts) for side in sides], axis=1)


def depths(winning: Bools, wraps: tuple[bool, ...]) -> npt.NDArray[np.int32]:
    """(cells,): how many cells away, along the axis where it is farthest, the nearest cell is that does not win; 0 for those.

    Beyond the grid nothing wins.
    """
    from scipy.ndimage import distance_transform_cdt

    field = winning
    for k, (n, round_) in enumerate(zip(winning.shape, wraps, strict=True)):
        widths = [(0, 0)] * winning.ndim
        widths[k] = (n, n) if round_ else (1, 1)
        field = np.pad(field, widths, mode="wrap" if round_ else "constant")
    if field.all():
        return np.full(winning.size, max(winning.shape), dtype=np.int32)
    found = distance_transform_cdt(field, metric="chessboard")
    inner = tuple(slice(n, 2 * n) if w else slice(1, n + 1) for n, w in zip(winning.shape, wraps, strict=True))
    return np.asarray(found[inner], dtype=np.int32).ravel()


def nearest_to_the_edge(
    corners: Callable[[Ints, Ints], Ints], cell: Ints, allowed: npt.NDArray[np.uint8], height: Array
) -> Ints:
    """(n,): of the allowed inputs of each cell the one with the greatest `height` at any of the `corners` of its successors.

    Ties go to the greatest mean over the corners, then to the first. height: whole numbers, per cell.
    """
    row, which = np.nonzero(allowed)
    heights = height[corners(cell[row], which)]
    top = heights.max(axis=1)
    score = np.full(allowed.shape, -np.inf)
    # The mean lies below the top by less than the range, so that it decides between equals only.
    score[row, which] = top + (heights.mean(axis=1) - top) / (1.0 + float(np.ptp(height)))
    return np.asarray(score.argmax(axis=1))
