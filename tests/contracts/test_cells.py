"""Cells: a tree of cuts that tiles the domain, and which points and samples belong to which cell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gapcert as gc
from gapcert.contracts.systems.cells import Cells
from gapcert_bounds.testing.fields import Waves

DOMAIN = Waves.smooth().domain


def drawn(seed, cuts):
    """A random tree: cells of the cube, cut one after the other."""
    rng = np.random.default_rng(seed)
    boxes, slots = [(DOMAIN.low, DOMAIN.high)], [None]
    axis, cut, child = [], [], []
    for node in range(cuts):
        k, j = rng.integers(len(boxes)), rng.integers(3)
        (low, high), slot = boxes.pop(k), slots.pop(k)
        at = float(low[j] + (0.2 + 0.6 * rng.random()) * (high[j] - low[j]))
        axis.append(j)
        cut.append(at)
        child.append([0, 0])
        if slot is not None:
            child[slot[0]][slot[1]] = node
        below, above = high.copy(), low.copy()
        below[j] = above[j] = at
        boxes += [(low, below), (above, high)]
        slots += [(node, 0), (node, 1)]
    for number, slot in enumerate(slots):
        if slot is not None:
            child[slot[0]][slot[1]] = -1 - number
    tree = np.array(axis, dtype=np.intp), np.array(cut), np.array(child, dtype=np.intp).reshape(-1, 2)
    m = len(boxes)
    return Cells(DOMAIN.low, DOMAIN.high, *tree, np.ones((m, 2, 3)), np.zeros((m, 2)), np.zeros((1, 3))), boxes


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), cuts=st.integers(0, 25))
def test_cells_tile_and_points_have_one_cell(seed, cuts):
    cells, boxes = drawn(seed, cuts)
    assert np.array_equal(cells.boxes.lo, np.array([low for low, _ in boxes]))
    assert np.array_equal(cells.boxes.hi, np.array([high for _, high in boxes]))
    assert cells.volume.sum() == pytest.approx(1)
    rng = np.random.default_rng(seed)
    z = DOMAIN.draw(300, rng)
    z[:100, 0] = cells.boxes.lo[rng.integers(len(cells), size=100), 0]  # on faces
    at = cells.locate(z)
    inside = [(z >= low) & (z <= high) for low, high in boxes]
    assert all(inside[c][k].all() for k, c in enumerate(at))
    closures = cells.closures(z)
    for c, rows in enumerate(closures):
        assert set(rows) == set(np.flatnonzero(inside[c].all(axis=1)))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), cuts=st.integers(0, 25))
def test_boxes_meet_the_cells_of_all_their_points(seed, cuts):
    cells, _ = drawn(seed, cuts)
    rng = np.random.default_rng(seed)
    low = DOMAIN.draw(40, rng)
    high = np.minimum(low + rng.random(low.shape), 1.0)
    row, cell = cells.meeting(gc.Interval(low, high))
    met = set(zip(row.tolist(), cell.tolist(), strict=True))
    for t in (*rng.integers(0, 2, (20, 3)), *rng.random((40, 3))):
        assert set(enumerate(cells.locate(low + t * (high - low)).tolist())) <= met


def test_points_start_with_the_anchors_and_stay_within_the_budget():
    cells, _ = drawn(3, 10)
    constants = cells.constants.copy()
    constants[4] *= 50
    steep = replace(cells, constants=constants)
    r = np.ones((5, 2))
    z = steep.points(DOMAIN, r, 200)
    assert len(z) in (200, 201)
    assert np.array_equal(z[:1], steep.anchors)
    assert len(np.unique(z, axis=0)) == len(z)
    share = (steep.locate(z) == 4).mean()
    assert share > 3 * (cells.locate(cells.points(DOMAIN, r, 200)) == 4).mean() > 0
    assert len(steep.points(DOMAIN, r, -5)) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"child": np.array([[-1, -1]])}, "no tree"),
        ({"child": np.array([[0, -1]])}, "no tree"),
        ({"cut": np.array([1.5])}, "lies outside the box that it divides"),
        ({"jumps": np.array([[0.0, -1.0], [0.0, 0.0]])}, "jumps hold a negative"),
        ({"constants": np.full((2, 2, 3), np.nan)}, "constants hold a negative or non-finite"),
    ],
)
def test_what_is_no_tiling_is_refused(change, message):
    cells, _ = drawn(0, 1)
    with pytest.raises(gc.UsageError, match=message):
        replace(cells, **change)
