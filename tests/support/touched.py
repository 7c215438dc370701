"""The cells that windows touch, cut off at the grid's borders."""

from __future__ import annotations

import numpy as np

from gapcert.plugin import Ints
from gapcert_symbolic.cells.abstraction import Windows


def ends(windows: Windows, cell: Ints, which: Ints) -> tuple[Ints, Ints]:
    """First and last cell of each axis (n, axes), of pairs of a flat cell and an input; −1 and n are outside."""
    ends = np.stack(windows.successors.ends(cell, which))
    for k, (n, wraps) in enumerate(zip(windows.grid.counts, windows.grid.wraps, strict=True)):
        if not wraps:
            ends[:, :, k] = np.clip(ends[:, :, k], -1, n)
    return ends[0], ends[1]
