"""No successor may ever lie outside the window of its cell and input; a centre evaluation or an inward rounding is caught."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import touched
from hypothesis import given, settings
from hypothesis import strategies as st

import gapcert_symbolic.cells.abstraction as abstraction
import gapcert_symbolic.cells.bounds as bounds
from gapcert import Box, GapFunction, Interval, Model, StateSpec
from gapcert.plugin import Extension
from gapcert.testing.toys import Drift
from gapcert_cells.testing import Rod
from gapcert_symbolic.cells.abstraction import Windows, windows
from gapcert_symbolic.cells.bounds import Enclosed, Nominal
from gapcert_symbolic.cells.gaps import disturbance
from gapcert_symbolic.cells.grid import Grid, View, combined


class Toy(Model):
    """Only what an abstraction needs."""

    period = 0.1

    def jacobian(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def extend(self, extensions: Sequence[Extension]) -> Model:
        raise NotImplementedError

    def equations(self) -> str:
        return ""

    def to_spec(self) -> dict[str, Any]:
        return {}

    def sites(self, kind: str) -> tuple[str, ...]:
        return ()


class Affine(Toy):
    """x⁺ = A x + B u + c."""

    def __init__(self, slope: np.ndarray, offset: np.ndarray) -> None:
        n = len(slope)
        self.states = tuple(StateSpec(f"x{i}") for i in range(n))
        self.inputs = tuple(StateSpec(f"u{i}") for i in range(slope.shape[1] - n))
        self.slope, self.offset = slope, offset

    def _step(self, x: np.ndarray, u: np.ndarray, **options: Any) -> np.ndarray:
        return np.hstack([x, u]) @ self.slope.T + self.offset

    def enclosure(self, z: Interval) -> Interval:
        return Interval.dot(z.reshape(len(z), 1, z.shape[1]), self.slope) + self.offset

    def jacobian_enclosure(self, z: Interval) -> Interval:
        return Interval.exact(np.broadcast_to(self.slope, (len(z), *self.slope.shape)))


class Cart(Toy):
    """x⁺ = x + 0.3 v cos h, h⁺ = h + 0.3 w: the effect of v depends on the state, and h goes round."""

    def __init__(self) -> None:
        self.states = (StateSpec("x", "m"), StateSpec("h", "rad", "angle"))
        self.inputs = (StateSpec("v", "m/s"), StateSpec("w", "rad/s"))

    def _step(self, x: np.ndarray, u: np.ndarray, **options: Any) -> np.ndarray:
        return x + 0.3 * np.stack([u[:, 0] * np.cos(x[:, 1]), u[:, 1]], axis=1)

    def enclosure(self, z: Interval) -> Interval:
        return Interval.stack([z[:, 0] + z[:, 2] * z[:, 1].cos() * 0.3, z[:, 1] + z[:, 3] * 0.3], axis=1)

    def jacobian_enclosure(self, z: Interval) -> Interval:
        one, zero = Interval.exact(np.ones(len(z))), Interval.exact(np.zeros(len(z)))
        rows = [
            [one, -(z[:, 2] * z[:, 1].sin() * 0.3), z[:, 1].cos() * 0.3, zero],
            [zero, one, zero, one * 0.3],
        ]
        return Interval.stack([Interval.stack(row, axis=1) for row in rows], axis=1)


class Tilted(GapFunction):
    """[−2 s, s] with s = scale (1 + Σ |z_j|): steep within a block of cells."""

    family = "tilted"

    def __init__(self, nx: int, scale: float) -> None:
        self.nx, self.scale = nx, scale

    def _size(self, z: Any) -> Any:
        return sum(abs(z[:, j : j + 1]) for j in range(1, z.shape[1])) + abs(z[:, :1]) + 1.0

    def interval(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s = self.scale * np.repeat(self._size(z), self.nx, axis=1)
        return -2 * s, s

    def interval_over(self, boxes: Interval) -> Interval:
        s = self._size(boxes) * self.scale
        return Interval(np.repeat(-(s.hi * 2), self.nx, axis=1), np.repeat(s.hi, self.nx, axis=1))

    def arrays(self) -> dict[str, np.ndarray]:
        return {}

    @property
    def form(self) -> Mapping[str, Any]:
        return {}

    def lipschitz(self, boxes: Interval) -> np.ndarray:
        return np.full((len(boxes), self.nx, boxes.shape[1]), 2 * self.scale)


class Centred(Tilted):
    """The planted fault: the gap at the centre of a box stands for the gap over it."""

    def interval_over(self, boxes: Interval) -> Interval:
        return Interval(*self.interval(boxes.mid))


def abstract(model: Model, gap: GapFunction | None, grid: Grid, axes: tuple[np.ndarray, ...], budget: int = 500) -> Windows:
    added = None if gap is None else disturbance(gap, grid, axes, budget)
    return windows(Enclosed(model), grid, axes, added)


def escapes(model: Model, gap: GapFunction | None, grid: Grid, axes: tuple[np.ndarray, ...], paths: Windows, seed: int) -> int:
    """How many of 4,000 sampled successors lie in a cell that their window leaves out."""
    rng, n = np.random.default_rng(seed), 4000
    points = combined(axes)
    cell, which = rng.integers(grid.size, size=n), rng.integers(len(points), size=n)
    low, high = (np.stack([c[i] for i in cell]) for c in grid.cells(0, grid.size))
    share = rng.random(low.shape)
    share = np.where(rng.random((n, 1)) < 0.5, np.round(share), share)
    x = np.where(share == 1, high, low + (high - low) * share)
    after = model.step(x, points[which]).x
    if gap is not None:
        ends = gap.interval(np.hstack([x, points[which]]))
        after = after + np.where(rng.random(after.shape) < 0.5, *ends)
    missed, ends = np.zeros(n, dtype=bool), touched.ends(paths, cell, which)
    for k, edges in enumerate(grid.edges):
        count, (first, last) = grid.counts[k], (end[:, k] for end in ends)
        y = after[:, k]
        if grid.wraps[k]:
            y = edges[0] + np.mod(y - edges[0], 2 * np.pi)
            index = np.clip(np.searchsorted(edges, y, "right") - 1, 0, count - 1)
            missed |= np.mod(index - first, count) > last - first
        else:
            index = np.searchsorted(edges, y, "right") - 1 - (y == edges[-1])
            missed |= (index < first) | (index > last)
    return int(missed.sum())


SMALL = st.floats(-1.5, 1.5, allow_nan=False).map(lambda v: round(v, 3))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(1, 3), st.integers(1, 2), st.data())
def test_affine_successors_stay_in_their_windows(n: int, m: int, data: st.DataObject) -> None:
    slope = np.array(data.draw(st.lists(st.lists(SMALL, min_size=n + m, max_size=n + m), min_size=n, max_size=n)))
    model = Affine(slope, np.array(data.draw(st.lists(SMALL, min_size=n, max_size=n))))
    counts = tuple(data.draw(st.lists(st.integers(1, 7), min_size=n, max_size=n)))
    low = data.draw(st.lists(st.floats(-5, 5), min_size=n, max_size=n))
    grid = Grid(Box(model.states, tuple(low), tuple(v + 1.3 for v in low)), counts)
    axes = tuple(np.linspace(-1, 0.7, data.draw(st.integers(2, 6))) for _ in range(m))
    gap = Tilted(n, data.draw(st.sampled_from([1e-4, 0.01])))
    for g in (None, gap):
        assert escapes(model, g, grid, axes, abstract(model, g, grid, axes), seed=n) == 0


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(1, 4), st.integers(1, 2), st.data())
def test_structure_loses_no_successor(n: int, m: int, data: st.DataObject) -> None:
    """Tables over the axes that matter: exact ones and zeros, almost such, and anything else."""
    entry = st.sampled_from([0.0, 0.0, 1.0, 1e-16, 1 + 1e-13, 1 - 2**-53, 0.37])
    slope = np.array(data.draw(st.lists(st.lists(entry, min_size=n + m, max_size=n + m), min_size=n, max_size=n)))
    model = Affine(slope, np.array(data.draw(st.lists(st.sampled_from([0.0, 0.25, 1 / 3]), min_size=n, max_size=n))))
    counts = tuple(data.draw(st.lists(st.integers(1, 6), min_size=n, max_size=n)))
    grid = Grid(Box(model.states, (-1.0,) * n, (1.0,) * n), counts)
    axes = tuple(np.linspace(-0.5, 0.5, data.draw(st.integers(2, 5))) for _ in range(m))
    paths = abstract(model, None, grid, axes)
    assert escapes(model, None, grid, axes, paths, seed=n) == 0
    rows = [axis.first.shape[0] for axis in paths.axes]
    inert = [np.isin(slope[k, :n] - np.eye(n)[k], [0.0, 1e-16, -(2**-53)]).all() for k in range(n)]
    assert all(size == 1 for size, free in zip(rows, inert, strict=True) if free)


def test_of_axes_that_share_a_table_each_moves_by_itself() -> None:
    """x⁺ = x/2 + u and y⁺ = y + 0.3 x + u depend on the same, and y⁺ counts from its own cell; so too under a gap."""
    model = Affine(np.array([[0.5, 0.0, 1.0], [0.3, 1.0, 1.0]]), np.zeros(2))
    grid, axes = Grid(Box(model.states, (-1.0, -1.0), (1.0, 1.0)), (9, 11)), (np.linspace(-0.3, 0.3, 4),)
    for gap in (None, Tilted(2, 1e-3)):
        paths = abstract(model, gap, grid, axes)
        assert escapes(model, gap, grid, axes, paths, seed=0) == 0
        assert [axis.moves for axis in paths.axes] == [False, gap is None]
        cells = np.arange(grid.size)
        first, last = touched.ends(paths, cells, np.zeros(grid.size, dtype=np.int64))
        assert (last - first <= 3).all()


CASES = [
    (Rod(0.05), Grid(Box(Rod().states, (-0.2, -0.3), (0.3, 0.3)), (17, 23)), (np.linspace(-1, 1, 9),)),
    (Rod(0.05), Grid(Box(Rod().states, (-np.pi, -3.0), (np.pi, 3.0)), (31, 19)), (np.linspace(-1, 1, 9),)),
    (Cart(), Grid(Box(Cart().states, (-1.0, -np.pi), (1.0, np.pi)), (20, 24)), (np.linspace(-1, 1, 7), np.linspace(-2, 2, 9))),
    (Cart(), Grid(Box(Cart().states, (-1.0, 0.5), (1.0, 2.0)), (20, 24)), (np.linspace(-1, 1, 21), np.linspace(-2, 2, 11))),
]


@pytest.mark.parametrize(("model", "grid", "axes"), CASES)
@pytest.mark.parametrize("scale", [None, 1e-3, 0.02])
def test_nonlinear_successors_stay_in_their_windows(
    model: Model, grid: Grid, axes: tuple[np.ndarray, ...], scale: float | None
) -> None:
    gap = None if scale is None else Tilted(2, scale)
    paths = abstract(model, gap, grid, axes)
    assert sum(escapes(model, gap, grid, axes, paths, seed) for seed in range(5)) == 0


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_states_that_move_share_evaluations_with_states_that_do_not(order: tuple[int, int]) -> None:
    """x⁺ = x/2 + u and y⁺ = y + 4x/5 + u hang on the same, and only the window of y is counted from the own cell."""
    slope = np.array([[0.5, 0.0, 1.0], [0.8, 1.0, 1.0]])[np.ix_(order, [*order, 2])]
    model, axes = Affine(slope, np.zeros(2)), (np.linspace(-0.5, 0.5, 5),)
    grid = Grid(Box(model.states, (-1.0, -1.0), (1.0, 1.0)), (16, 18))
    for gap in (None, Tilted(2, 1e-3)):
        paths = abstract(model, gap, grid, axes)
        assert [axis.moves for axis in paths.axes] == ([False, gap is None] if order[0] == 0 else [gap is None, False])
        assert sum(escapes(model, gap, grid, axes, paths, seed) for seed in range(3)) == 0


def test_gap_at_the_centre_is_caught() -> None:
    model, grid, axes = CASES[0]
    gap, fault = Tilted(2, 0.02), Centred(2, 0.02)
    assert escapes(model, gap, grid, axes, abstract(model, fault, grid, axes), 0) > 0


def still() -> tuple[Model, Grid, tuple[np.ndarray, ...]]:
    """With u = 0 nothing moves, so every box ends exactly on the edges of its cell."""
    model = Drift(2)
    return model, Grid(Box(model.states, (-1.0, 0.0), (1.0, 0.7)), (10, 7)), (np.linspace(-1, 1, 3), np.linspace(-1, 1, 3))


def test_edges_need_outward_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    model, grid, axes = still()
    assert escapes(model, None, grid, axes, abstract(model, None, grid, axes), 0) == 0
    exact = abstraction.touched
    monkeypatch.setattr(abstraction, "touched", lambda g, k, lo, hi, e, m: exact(g, k, lo + 1e-12, hi - 1e-12, e, m))
    assert escapes(model, None, grid, axes, abstract(model, None, grid, axes), 0) > 0


def test_one_ulp_inwards_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where boxes end exactly on edges: a bound that is rounded the wrong way, in place of the slack for rounding."""
    model, grid, axes = still()

    def wrong(self: Enclosed, low: np.ndarray, high: np.ndarray, u: np.ndarray, *_: object) -> Interval:
        inner = Interval(model.step(low, u).x, model.step(high, u).x)
        return Interval(np.nextafter(inner.lo, np.inf), np.nextafter(inner.hi, -np.inf))

    monkeypatch.setattr(abstraction, "EPS", 0.0)
    monkeypatch.setattr(Enclosed, "over", wrong)
    assert escapes(model, None, grid, axes, abstract(model, None, grid, axes), 0) > 0


@pytest.fixture(autouse=True)
def _groups(monkeypatch: pytest.MonkeyPatch) -> None:
    """These problems have few pairs; inputs share slopes all the same."""
    monkeypatch.setattr(bounds, "THRESHOLDS", replace(bounds.THRESHOLDS, single_pairs=0))


def grouped(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    """At most `size` groups per input, whatever they lose."""
    monkeypatch.setattr(Nominal, "coarsest", classmethod(lambda cls, m, g, axes, asked: cls.of_groups(m, g, axes, size, asked)))


def test_shared_slopes_are_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Taking one group of inputs at the value of its middle, without the slope, loses successors."""
    model, grid, axes = CASES[0]
    grouped(monkeypatch, 1)
    monkeypatch.setattr(Nominal, "direct", property(lambda self: True))
    assert escapes(model, None, grid, axes, windows(Enclosed(model), grid, axes, None), 0) > 0


def test_groups_lose_less_than_promised(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows from shared inputs contain those from one evaluation per input, and are at most one cell wider."""
    for model, grid, axes in CASES:
        pairs = np.indices((grid.size, len(axes[0]) * (len(axes[1]) if len(axes) > 1 else 1))).reshape(2, -1)
        shared = touched.ends(windows(Enclosed(model), grid, axes, None), *pairs)
        with monkeypatch.context() as patched:
            grouped(patched, 1000)
            direct = touched.ends(windows(Enclosed(model), grid, axes, None), *pairs)
        for k in range(len(grid.counts)):
            if not grid.wraps[k]:
                assert (shared[0][:, k] >= direct[0][:, k] - 1).all()
                assert (shared[1][:, k] <= direct[1][:, k] + 1).all()


def test_coarsest_shares_where_it_may() -> None:
    cases = ((Enclosed(model), View(grid, tuple(range(len(grid.counts)))), axes) for model, grid, axes in (CASES[0], CASES[2]))
    rod, cart = (Nominal.coarsest(*case) for case in cases)
    assert len(rod.middle) == 1
    # The effect of v changes within a cell by far more than a thousandth of it; that of w is the same everywhere.
    assert len(np.unique(cart.middle[:, 0])) == 7
