"""Gaps that depend on many coordinates: narrow blocks where they change, suprema where tables have no room for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import touched

import gapcert_symbolic.cells.gaps as gaps
from gapcert import Array, Box, GapFunction, Interval
from gapcert.testing.toys import Drift
from gapcert_report.words.words import suprema
from gapcert_symbolic.cells.abstraction import Windows, windows
from gapcert_symbolic.cells.bounds import Enclosed
from gapcert_symbolic.cells.gaps import disturbance
from gapcert_symbolic.cells.grid import Grid, combined, share

GRID = Grid(Box(Drift(2).states, (-1.0, -1.0), (1.0, 1.0)), (20, 24))
AXES = (np.linspace(-0.5, 0.5, 7), np.linspace(-0.5, 0.5, 5))


class Slanted(GapFunction):
    """u = a · |z| + 0.01 for every state, l = −u / 2."""

    family = "slanted"

    def __init__(self, *slope: float) -> None:
        self.slope = np.array(slope)

    def interval(self, z: Array) -> tuple[Array, Array]:
        high = np.repeat(np.abs(z) @ self.slope[:, None] + 0.01, 2, axis=1)
        return -high / 2, high

    def interval_over(self, boxes: Interval) -> Interval:
        return Interval(*self.interval(boxes.mag)) * (1 + 1e-12)

    def lipschitz(self, boxes: Interval) -> Array:
        return np.broadcast_to(self.slope * (1 + 1e-12), (len(boxes), 2, len(self.slope)))

    def arrays(self) -> dict[str, Array]:
        return {}

    @property
    def form(self) -> Mapping[str, Any]:
        return {}


def made(gap: GapFunction, budget: int = 100_000) -> Windows:
    return windows(Enclosed(Drift(2)), GRID, AXES, disturbance(gap, GRID, AXES, budget))


def escapes(gap: GapFunction, paths: Windows, n: int = 20_000) -> int:
    """How many sampled successors, under the ends of the gap, lie in a cell that their window leaves out."""
    rng, points = np.random.default_rng(1), combined(AXES)
    cell, which = rng.integers(GRID.size, size=n), rng.integers(len(points), size=n)
    low, high = GRID.boxes(cell)
    x = low + (high - low) * rng.random(low.shape)
    ends = gap.interval(np.hstack([x, points[which]]))
    after = Drift(2).step(x, points[which]).x + np.where(rng.random(x.shape) < 0.5, *ends)
    first, last = touched.ends(paths, cell, which)
    index = np.stack([np.searchsorted(e, a, "right") - 1 for e, a in zip(GRID.edges, after.T, strict=True)], axis=1)
    return int(((index < first) | (index > last)).any(axis=1).sum())


def sizes(paths: Windows) -> int:
    return sum(axis.first.size for axis in paths.axes)


STEEP = Slanted(0.3, 0.02, 0.2, 0.01)


def test_coordinates_that_cost_least_go_first(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = made(STEEP)
    assert [axis.on for axis in whole.axes] == [(0, 1), (0, 1)]
    assert "suprema" not in whole.told
    last = sizes(whole)
    pairs = np.indices((GRID.size, 35)).reshape(2, -1)
    for entries in (21_000, 3_000, 50):
        monkeypatch.setattr(gaps, "THRESHOLDS", replace(gaps.THRESHOLDS, window_entries=entries))
        short = made(STEEP)
        assert escapes(STEEP, short) == 0
        assert sizes(short) < last
        last = sizes(short)
        ends = touched.ends(whole, *pairs), touched.ends(short, *pairs)
        assert (ends[1][0] <= ends[0][0]).all()
        assert (ends[1][1] >= ends[0][1]).all()
        if entries == 21_000:
            # The second input changes the gap least; beyond it, nothing had to go.
            assert short.told["suprema"] == {"x0": {"over": ["u1"], "cells": pytest.approx(0.03, rel=0.1)}}


def test_a_supremum_left_out_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    """The planted fault: of the blocks that share an entry the smallest one counts."""
    monkeypatch.setattr(gaps, "THRESHOLDS", replace(gaps.THRESHOLDS, window_entries=50))
    assert escapes(STEEP, made(STEEP)) == 0

    def smallest(self: Any) -> Array:
        along = tuple(d + 1 for d in self.dropped)
        return np.broadcast_to(self.ends.min(axis=along, keepdims=True), self.ends.shape)

    monkeypatch.setattr(gaps._Cut, "least", property(smallest))
    assert escapes(STEEP, made(STEEP)) > 0


def test_what_costs_nothing_lengthens_no_table() -> None:
    faint = Slanted(1e-13, 1e-13, 1e-13, 1e-13)
    assert disturbance(faint, GRID, AXES).r.shape[:2] == (1, 1)
    assert sizes(made(faint)) == sizes(made(Slanted(0.0, 0.0, 0.0, 0.0)))
    one = made(Slanted(1e-13, 0.2, 0.0, 0.0))
    assert [axis.on for axis in one.axes] == [(1,), (1,)]
    assert escapes(faint, made(faint)) == 0


def test_f_is_asked_on_its_own_axes_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    over = Enclosed.over

    def counted(self: Enclosed, low: Array, *given: Array) -> Interval:
        asked.append(len(low))
        return over(self, low, *given)

    monkeypatch.setattr(Enclosed, "over", counted)
    assert sizes(made(STEEP)) == 2 * GRID.size * 35
    assert sum(asked) < 100


def test_blocks_are_narrow_where_the_gap_changes() -> None:
    added = disturbance(Slanted(0.3, 0.03, 0.0, 0.0), GRID, AXES, 100)
    counts = [len(b) for b in (*added.blocks, *added.inputs)]
    assert counts[0] > 2 * counts[1] > 2
    assert counts[2:] == [1, 1]
    assert escapes(STEEP, made(STEEP, 60)) == 0
    # As narrow as possible would be wider: equal blocks.
    assert share((100, 100), 100, [10.0, 0.1]) == (100, 1)


def test_the_report_says_what_was_done() -> None:
    told = {"blocks": {"x": 5, "u": 7}, "suprema": {"x": {"over": ["y", "u"], "cells": 0.25}}}
    assert suprema(told) == (
        "γ was bounded over blocks, 5 of x × 7 of u. In the windows of x it counts by its supremum over y and u: "
        "0.25 cells wider on average."
    )
