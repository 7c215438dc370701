"""What `verify` knows of cells by itself: which of them regions touch, and the greatest height over boxes of them."""

import itertools

import numpy as np
import pytest

import gapcert as gc
from gapcert.plugin import Box, Goal, Region
from gapcert_verify.controllers.cells import BEYOND, Axis, Cells, Heights, Level

AXES = (gc.StateSpec("p", "m"), gc.StateSpec("v", "m/s"))


def grid(*counts):
    axes = tuple(Axis(np.linspace(-1.0, 1.0, n + 1), False) for n in counts)
    index = np.array([*itertools.product(*map(range, counts))], dtype=np.int32)
    return Cells(None, (Level(axes, np.arange(len(index)), index),))


def test_no_cell_that_meets_what_is_avoided_is_kept():
    rng, cells = np.random.default_rng(3), grid(9, 7)
    low, high = (np.concatenate(part) for part in zip(*(level.boxes(slice(None)) for level in cells.levels), strict=True))
    for _ in range(50):
        a, b = np.sort(rng.uniform(-1, 1, (2, 2)), axis=0)
        stay = Box(AXES, (-1.0, -1.0), (1.0, 1.0))
        goal = Goal("invariance", stay, avoid=Region((Box(AXES, tuple(a.tolist()), tuple(b.tolist())),)))
        meets = ((low <= b) & (high >= a)).all(axis=1)
        inside = ((low >= a) & (high <= b)).all(axis=1)
        assert (meets & ~inside).any()
        assert np.array_equal(cells.kept(goal), ~meets)
        assert np.array_equal(cells.related(goal.avoid, touching=False), inside)


@pytest.mark.parametrize("wraps", [(False, False), (True, False), (False, True)])
def test_heights_over_boxes_are_those_of_all_their_cells(wraps):
    rng, counts = np.random.default_rng(8), (11, 6)
    height = rng.integers(0, 1000, counts).astype(np.int32)
    first = np.stack([rng.integers(0, n, 400) for n in counts], axis=1)
    last = first + np.stack([rng.integers(0, n, 400) for n in counts], axis=1)
    found = Heights(height, wraps).over(first, last)
    for a, b, top in zip(first, last, found.tolist(), strict=True):
        cells = [[*range(low, high + 1)] for low, high in zip(a, b, strict=True)]
        leaves = any(not w and high >= n for w, high, n in zip(wraps, b, counts, strict=True))
        around = [[k % n for k in part] for part, n in zip(cells, counts, strict=True)]
        assert top == (BEYOND if leaves else height[np.ix_(*around)].max())
