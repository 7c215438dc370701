"""Affine models: windows in closed form give the same domain and the same inputs as tables do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gapcert import Box, Domain, Goal, Interval, Model, StateSpec, SynthesisProblem
from gapcert.testing.toys import Drift
from gapcert_cells.testing import Band, rod_problem
from gapcert_symbolic.cells.abstraction import windows
from gapcert_symbolic.cells.bounds import Enclosed
from gapcert_symbolic.cells.gaps import disturbance
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.solvers import affine, runs
from gapcert_symbolic.solvers.problem import Solution
from gapcert_symbolic.synthesizer import Symbolic


class Linear(Drift):
    """x⁺ = A x + B u + c on [−1, 1]ⁿ."""

    def __init__(self, slope: np.ndarray, offset: np.ndarray) -> None:
        super().__init__(len(slope))
        self.inputs = tuple(StateSpec(f"u{k}") for k in range(slope.shape[1] - len(slope)))
        self.slope, self.offset = slope, offset

    def _step(self, x: np.ndarray, u: np.ndarray, **options: object) -> np.ndarray:
        return np.hstack([x, u]) @ self.slope.T + self.offset

    def enclosure(self, z: Interval) -> Interval:
        return Interval.dot(z.reshape(len(z), 1, z.shape[1]), self.slope) + self.offset

    def jacobian_enclosure(self, z: Interval) -> Interval:
        return Interval.exact(np.broadcast_to(self.slope, (len(z), *self.slope.shape)))


class Paused(Linear):
    """x⁺ = x + u (A x + c), but in the states that are not `still`: x⁺ = A x + B u + c. Under u = 0 the still ones stay."""

    def __init__(self, slope: np.ndarray, offset: np.ndarray, still: np.ndarray) -> None:
        super().__init__(slope, offset)
        self.still, self.own = still, slope[:, : len(slope)]

    def _step(self, x: np.ndarray, u: np.ndarray, **options: object) -> np.ndarray:
        return np.where(self.still, x + u * (x @ self.own.T + self.offset), super()._step(x, u))

    def _mixed(self, still: Interval, others: Interval) -> Interval:
        which = self.still.reshape(-1, *(1,) * (still.lo.ndim - 2))
        return Interval(np.where(which, still.lo, others.lo), np.where(which, still.hi, others.hi))

    def enclosure(self, z: Interval) -> Interval:
        x, u = z[:, : len(self.own)], z[:, len(self.own) :]
        return self._mixed(x + (Interval.dot(x.reshape(len(z), 1, -1), self.own) + self.offset) * u, super().enclosure(z))

    def jacobian_enclosure(self, z: Interval) -> Interval:
        x, u = z[:, : len(self.own)], z[:, len(self.own) :]
        by_x = Interval.exact(np.eye(len(self.own))) + u.reshape(len(z), 1, 1) * Interval.exact(self.own)
        by_u = Interval.dot(x.reshape(len(z), 1, -1), self.own) + self.offset
        both = [np.concatenate([getattr(by_x, e), getattr(by_u, e)[:, :, None]], axis=2) for e in ("lo", "hi")]
        return self._mixed(Interval(*both), super().jacobian_enclosure(z))

    def unmoved(self, u: np.ndarray) -> np.ndarray:
        return (u == 0) & self.still


def by_tables(bound: Enclosed, grid: Grid, axes: tuple[np.ndarray, ...], gap: Band | None, safe: np.ndarray) -> Solution:
    paths = windows(bound, grid, axes, None if gap is None else disturbance(gap, grid, axes))
    values, bits = np.where(safe, 0, -1).astype(np.int32), paths.no_bits
    runs.invariance(1, paths.game, values, bits, *paths.rows)
    return Solution(values, bits, 1)


def textbook(found: affine.Maps, counts: tuple[int, ...], safe: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(alive, valid (cells, inputs)) from every window, looked at again until nothing changes."""
    index = np.indices(counts).reshape(len(counts), -1)
    # Shifts are summed in the order of the axes, as they are by what is tested.
    shift = sum(found.slope[:, :, d, None] * index[d] for d in range(len(counts)))
    first, last = (np.floor(end[:, :, None] + shift).astype(int) for end in (found.low, found.high))
    inside = ((first >= 0) & (last < np.array(counts)[:, None])).all(axis=1)
    alive = safe.copy()
    while True:
        whole = alive.reshape(counts)
        valid = np.zeros((len(alive), len(first)), dtype=bool)
        for i, j in zip(*np.nonzero(alive[:, None] & inside.T), strict=True):
            valid[i, j] = whole[tuple(slice(a, b + 1) for a, b in zip(first[j, :, i], last[j, :, i], strict=True))].all()
        if np.array_equal(valid.any(axis=1), alive):
            return alive, valid
        alive = valid.any(axis=1)


def random_maps(n: int, seed: int) -> tuple[affine.Maps, Grid, np.ndarray]:
    """Windows about the own cell, under 1 to 12 inputs, also where the last axis shifts another by nothing."""
    rng = np.random.default_rng(seed)
    counts, m = tuple(int(v) for v in rng.integers(2, {1: 80, 2: 16, 3: 7}[n], n)), int(rng.integers(1, 13))
    slope = rng.choice([1.0, 0.97, -1.0, 0.6], (m, n))[:, :, None] * np.eye(n)
    slope += rng.choice([0.0, 0.0, 0.1, -0.04], (m, n, n)) * (1 - np.eye(n))
    middle = (np.array(counts) - 1) / 2
    low = middle - slope @ middle + rng.uniform(-1.2, 1.0, (m, n))
    grid = Grid(Box(tuple(StateSpec(f"x{k}") for k in range(n)), (0.0,) * n, (1.0,) * n), counts)
    found = affine.Maps(slope, low, low + rng.uniform(0, 1.2, (m, n)), np.linalg.inv(slope), 1e-3)
    return found, grid, rng.random(grid.size) < 0.97


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_as_the_textbook_has_it(n: int, seed: int) -> None:
    found, grid, safe = random_maps(n, seed)
    alive, valid = textbook(found, grid.counts, safe)
    values, bits = affine.invariance(found, grid, safe)
    assert np.array_equal(values == 0, alive)
    assert np.array_equal(np.unpackbits(bits, axis=1, count=len(found.low)), valid)


def test_rows_that_are_left_out_are_missed() -> None:
    """A box about the image that is too small, as where the inverse errs by more than is allowed for."""
    wrong = 0
    for seed in range(10):
        found, grid, safe = random_maps(2, seed)
        alive = textbook(found, grid.counts, safe)[0]
        wrong += not np.array_equal(affine.invariance(found._replace(spare=-2.0), grid, safe)[0] == 0, alive)
    assert wrong > 0


def test_why_nothing_wins_is_told_of_the_cells_that_were_safe(monkeypatch: pytest.MonkeyPatch) -> None:
    model = Linear(np.array([[2.02, 0.1, 0.02], [-0.05, 2.08, 0.02]]), np.zeros(2))
    domain = Domain.of(model, {"x0": (-1.0, 1.0), "x1": (-1.0, 1.0), "u0": (-1.0, 1.0)})
    problem = SynthesisProblem(model, None, domain, Goal("invariance", domain.states))
    made = Symbolic({"x0": 30, "x1": 25}, {"u0": 3}).synthesize(problem)
    monkeypatch.setattr(affine, "maps", lambda *_: None)
    other = Symbolic({"x0": 30, "x1": 25}, {"u0": 3}).synthesize(problem)
    assert made.evidence["winning_cells"] == 0
    assert made.evidence["reason"] == other.evidence["reason"]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(1, 3), st.integers(0, 2**32 - 1), st.booleans())
def test_both_ways_agree(n: int, seed: int, with_gap: bool) -> None:
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.standard_normal((n, n)))
    slope = np.hstack(
        [turn @ np.diag(rng.uniform(0.6, 1.2, n)) @ turn.T * rng.choice([1, 1, -1]), rng.uniform(-0.4, 0.4, (n, 1))]
    )
    model = Linear(slope, rng.uniform(-0.02, 0.02, n))
    counts = tuple(int(v) for v in rng.integers(2, {1: 200, 2: 40, 3: 9}[n], n))
    grid = Grid(Box(model.states, (-1.0,) * n, (1.0,) * n), counts)
    axes = (np.linspace(-0.8, 1, int(rng.integers(2, 12))),)
    gap = Band((-0.003,) * n, (0.002,) * n) if with_gap else None
    bound, safe = Enclosed(model), rng.random(grid.size) < 0.97
    found = affine.maps(bound, grid, axes, None if gap is None else disturbance(gap, grid, axes), None)
    assert found is not None
    values, bits = affine.invariance(found, grid, safe.copy())
    other = by_tables(bound, grid, axes, gap, safe)
    # Slack for rounding differs: a window that ends within it of an edge may be a cell wider in one of them.
    exact = np.array_equal(values, other.values) and np.array_equal(bits, other.bits)
    assert exact or np.mean(values != other.values) < 1e-3


def paused(n: int, seed: int, gap: str) -> tuple[affine.Maps | None, Solution, Solution]:
    """Windows of a system that an input pauses, what they give in closed form, and what tables do."""
    rng = np.random.default_rng([seed, 7])
    slope = np.hstack([np.eye(n) + rng.uniform(-0.3, 0.3, (n, n)), rng.uniform(-0.4, 0.4, (n, 1))])
    model = Paused(slope, rng.uniform(-0.02, 0.02, n), (rng.random(n) < 0.7) | (np.arange(n) == rng.integers(n)))
    counts = tuple(int(v) for v in rng.integers(5, {1: 200, 2: 40, 3: 9}[n], n))
    grid = Grid(Box(model.states, (-1.0,) * n, (1.0,) * n), counts)
    axes = (np.array([-0.6, -0.1, 0.0, 0.3, 0.5])[rng.random(5) < 0.8],)
    axes = axes if 0.5 in axes[0] else (np.append(axes[0], 0.5),)
    band = {"none": None, "all": Band((-0.003,) * n, (0.002,) * n), "one": Band((0.0,) * (n - 1) + (-0.003,), (0.0,) * n)}[gap]
    bound, safe = Enclosed(model), rng.random(grid.size) < 0.97
    found = affine.maps(bound, grid, axes, None if band is None else disturbance(band, grid, axes), None)
    other = by_tables(bound, grid, axes, band, safe)
    return found, other if found is None else Solution(*affine.invariance(found, grid, safe.copy()), 1), other


@pytest.mark.exam
@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(1, 3), st.integers(0, 2**32 - 1), st.sampled_from(["none", "all", "one"]))
def test_both_ways_keep_what_an_input_leaves_where_it_is(n: int, seed: int, gap: str) -> None:
    found, made, other = paused(n, seed, gap)
    assert found is not None
    exact = np.array_equal(made.values, other.values) and np.array_equal(made.bits, other.bits)
    assert exact or np.mean(made.values != other.values) < 1e-3


@pytest.mark.exam
@pytest.mark.parametrize("claim", ["none", "all"])
def test_what_stays_is_not_guessed(claim: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Were fewer states told to stay, fewer cells would win; were those that move, cells would win that tables refute."""
    differ = []
    for seed in range(12):
        other = paused(2, seed, "none")[2].values
        with monkeypatch.context() as wrong:
            wrong.setattr(affine, "kept", lambda b, points, added: np.full((len(points), 2), claim == "all"))
            made = paused(2, seed, "none")[1].values
        differ.append(int((made == 0).sum() - (other == 0).sum()))
    assert max(differ) > 0 if claim == "all" else min(differ) < 0


def test_some_of_them_win_and_some_do_not() -> None:
    model = Linear(np.array([[1.02, 0.1, 0.02], [-0.05, 0.98, 0.1]]), np.zeros(2))
    grid, axes = Grid(Box(model.states, (-1.0, -1.0), (1.0, 1.0)), (90, 110)), (np.linspace(-1, 1, 9),)
    found = affine.maps(Enclosed(model), grid, axes, None, None)
    assert found is not None
    safe = np.ones(grid.size, dtype=bool)
    values, bits = affine.invariance(found, grid, safe.copy())
    other = by_tables(Enclosed(model), grid, axes, None, safe)
    assert 0.1 < (values == 0).mean() < 0.99
    assert np.array_equal(values, other.values)
    assert np.array_equal(bits, other.bits)


@pytest.mark.parametrize("change", ["angle", "gap", "inputs", "bent", "flat"])
def test_others_are_left_to_tables(change: str) -> None:
    slope = np.array([[1.0, 0.1, 0.1], [0.0, 0.0 if change == "flat" else 0.9, 0.1]])
    model: Model = rod_problem().model if change == "bent" else Linear(slope, np.zeros(2))
    states = (replace(model.states[0], kind="angle"), model.states[1]) if change == "angle" else model.states
    width = np.pi if change == "angle" else 0.2
    grid = Grid(Box(states, (-width, -0.2), (width, 0.2)), (8, 9))
    axes = (np.linspace(-1, 1, 100 if change == "inputs" else 5),)
    added = None
    if change == "gap":
        added = disturbance(Band((-0.1, -0.1), (0.1, 0.1)), grid, axes)
        added = replace(added, r=Interval(np.repeat(added.r.lo, 2, axis=0), np.repeat(added.r.hi, 2, axis=0)))
    assert affine.maps(Enclosed(model), grid, axes, added, None) is None


def test_a_synthesis_takes_it_where_it_may(monkeypatch: pytest.MonkeyPatch) -> None:
    model = Linear(np.array([[1.02, 0.1, 0.02], [-0.05, 0.98, 0.1]]), np.zeros(2))
    domain = Domain.of(model, {"x0": (-1.0, 1.0), "x1": (-1.0, 1.0), "u0": (-1.0, 1.0)})
    problem = SynthesisProblem(model, None, domain, Goal("invariance", domain.states))
    made = Symbolic({"x0": 60, "x1": 50}, {"u0": 5}).synthesize(problem)
    monkeypatch.setattr(affine, "maps", lambda *_: None)
    other = Symbolic({"x0": 60, "x1": 50}, {"u0": 5}).synthesize(problem)
    assert 0 < made.evidence["winning_cells"] == other.evidence["winning_cells"]
    assert np.array_equal(made.bits, other.bits)
    assert np.array_equal(made.values, other.values)


def test_what_was_promised_is_tabled_when_it_is_asked_for() -> None:
    model = Linear(np.array([[1.02, 0.1, 0.02], [-0.05, 0.98, 0.1]]), np.zeros(2))
    box = Box(model.states, (-1.0, -1.0), (1.0, 1.0))
    domain = Domain.of(model, {"x0": (-1.0, 1.0), "x1": (-1.0, 1.0), "u0": (-1.0, 1.0)})
    problem = SynthesisProblem(model, None, domain, Goal("invariance", box))
    made = Symbolic({"x0": 90, "x1": 110}, {"u0": 9}).synthesize(problem)
    assert callable(made.promised)
    x = made.draw(500, np.random.default_rng(0))
    for policy in made.policies:
        u = made.act(x, policy)
        after = model.step(x, u).x
        assert made.kept(x, u, after).all()
        assert made.contains(after).all()
        assert not made.kept(x, u, made.draw(500, np.random.default_rng(1))).all()
    assert "adversarial" in made.policies
