"""Reach-and-stay as the co-Büchi game it is: outside the target finitely often, against every memoryless strategy."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gapcert import Box, Domain, Goal, Interval, Model, Region, StateSpec, SynthesisProblem, closed_loop
from gapcert.contracts.controllers.policies import POLICIES
from gapcert.testing.toys import Drift
from gapcert_cells import Along, GridController, Successors
from gapcert_cells.testing import Band
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.games import games
from gapcert_symbolic.games.games import solve
from gapcert_symbolic.solvers.problem import Problem, Solution
from gapcert_symbolic.synthesizer import Symbolic

TURN = 2 * np.pi


def drawn(n: int, m: int, rng: np.random.Generator) -> Windows:
    """Windows near the own cell or anywhere, a few of them beyond the grid."""
    wraps = rng.random() < 0.5
    axis = StateSpec("x", "rad", "angle") if wraps else StateSpec("x")
    grid = Grid(Box((axis,), (0.0,), (TURN if wraps else 1.0,)), (n,))
    near = np.clip(np.arange(n)[:, None] + rng.integers(-2, 2, (n, m)), 0, n - 1)
    first = np.where(rng.random((n, m)) < 0.5, near, rng.integers(0, n, (n, m)))
    last = first + rng.integers(0, 3, (n, m))
    allowed = rng.random((n, m)) < 0.9 if rng.random() < 0.5 else None
    tables = first.astype(np.int32), last.astype(np.int32)
    return Windows(grid, (Along((0,), False, np.arange(m), *tables),), allowed)


def successors(windows: Windows) -> list[list[frozenset[int] | None]]:
    """Per cell and input where it may lead; None beyond the grid, or where the input is not allowed."""
    n, wraps = windows.grid.size, windows.grid.wraps[0]
    first, last = windows.axes[0].first, windows.axes[0].last

    def of(i: int, j: int) -> frozenset[int] | None:
        cells = range(first[i, j], last[i, j] + 1)
        some = windows.allowed is None or windows.allowed[i, j]
        return frozenset(c % n for c in cells) if some and (wraps or cells[-1] < n) else None

    return [[of(i, j) for j in range(windows.inputs)] for i in range(n)]


def doomed(chosen: list[frozenset[int] | None], safe: np.ndarray, target: np.ndarray) -> set[int]:
    """Cells from which, under a strategy, a run may leave what is safe or be outside the target again and again."""
    n = len(chosen)
    lead = np.zeros((n, n), dtype=bool)
    for i, after in enumerate(chosen):
        lead[i, list(after or ())] = True
    for k in range(n):
        lead |= lead[:, k : k + 1] & lead[k]
    bad = ~safe | np.array([after is None for after in chosen]) | (lead.diagonal() & ~target)
    return set(np.flatnonzero(bad | (lead & bad).any(axis=1)).tolist())


def by_strategies(windows: Windows, safe: np.ndarray, target: np.ndarray) -> np.ndarray:
    """What any memoryless strategy wins: no others are needed."""
    after, n = successors(windows), windows.grid.size
    lost = set(range(n))
    for strategy in itertools.product(range(windows.inputs), repeat=n):
        lost &= doomed([after[i][j] for i, j in enumerate(strategy)], safe, target)
    return np.array([i not in lost for i in range(n)])


def by_sets(windows: Windows, safe: np.ndarray, target: np.ndarray) -> np.ndarray:
    """μX. νY. Pre(X) ∪ (target ∩ Pre(X ∪ Y)), by the letter."""
    after, cells = successors(windows), set(np.flatnonzero(safe).tolist())

    def pre(good: set[int]) -> set[int]:
        return {i for i in cells if any(a is not None and a <= good for a in after[i])}

    inside, x = set(np.flatnonzero(target).tolist()), set[int]()
    while True:
        y = cells
        while (fewer := pre(x) | (inside & pre(x | y))) != y:
            y = fewer
        if y == x:
            return np.array([i in x for i in range(windows.grid.size)])
        x = y


def stayed(windows: Windows, safe: np.ndarray, target: np.ndarray) -> Solution:
    return games.reach_and_stay(Problem(lambda: windows, safe), target)


def kept_alone(windows: Windows, safe: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Values where the target must not be left any more once it is kept; they are fewer."""
    kept = solve(Problem(lambda: windows, safe & target))
    return solve(Problem(lambda: windows, safe, kept.values >= 0)).values


def test_wins_what_some_strategy_wins() -> None:
    rng, more = np.random.default_rng(4), 0
    for _ in range(250):
        n = int(rng.integers(3, 8))
        windows, safe, target = drawn(n, int(rng.integers(1, 3)), rng), rng.random(n) < 0.97, rng.random(n) < 0.7
        found = stayed(windows, safe, target).values >= 0
        assert np.array_equal(found, by_strategies(windows, safe, target))
        more += bool(found.sum() > (kept_alone(windows, safe, target) >= 0).sum())
    assert more >= 3


def held(windows: Windows, safe: np.ndarray, target: np.ndarray, found: Solution) -> bool:
    """No kept input leads to a greater value, nor to an equal one but from a lasting value, whose cells are in the target."""
    after, bits = successors(windows), np.unpackbits(found.bits, axis=1, count=windows.inputs).astype(bool)
    for i in np.flatnonzero(found.values >= 0):
        lasts = found.values[i] in found.lasting
        most = found.values[i] if lasts else found.values[i] - 1
        kept = [after[i][j] for j in np.flatnonzero(bits[i])]
        if not safe[i] or (lasts and not target[i]) or not kept:
            return False
        if not all(a is not None and found.values[list(a)].min() >= 0 and found.values[list(a)].max() <= most for a in kept):
            return False
    return True


def test_many_games_are_those_of_the_formula_and_every_kept_input_keeps_the_promise() -> None:
    rng, more, ranks = np.random.default_rng(5), 0, 0
    for _ in range(300):
        n = int(rng.integers(5, 40))
        windows, safe, target = drawn(n, int(rng.integers(1, 4)), rng), rng.random(n) < 0.97, rng.random(n) < 0.7
        found, before = stayed(windows, safe, target), kept_alone(windows, safe, target)
        assert np.array_equal(found.values >= 0, by_sets(windows, safe, target))
        assert held(windows, safe, target, found)
        # The steps to where the target can be kept for ever are what they were.
        assert np.array_equal(found.values[before >= 0], before[before >= 0])
        more += bool((found.values >= 0).sum() > (before >= 0).sum())
        ranks = max(ranks, len(found.lasting))
    assert more > 40
    assert ranks >= 3


def test_one_input_more_breaks_the_promise() -> None:
    """Planted fault: in cells of a lasting value, all inputs that lead anywhere into the domain."""
    rng, broken = np.random.default_rng(6), 0
    for _ in range(100):
        windows, safe, target = drawn(20, 3, rng), np.ones(20, dtype=bool), rng.random(20) < 0.6
        found = stayed(windows, safe, target)
        won = found.values >= 0
        every = games.leading(windows, won, won & np.isin(found.values, found.lasting))
        broken += not held(windows, safe, target, Solution(found.values, found.bits | every, found.rounds, found.lasting))
    assert broken > 20


class Gusts(Band):
    """Up to x = 0.17 the gap is far wider than that part; beyond, it is small."""

    def __init__(self) -> None:
        super().__init__((-0.01,), (0.01,))

    def interval(self, z: Any) -> tuple[Any, Any]:
        near = z[:, :1] <= 0.17
        return np.where(near, -0.0999, -0.01), np.where(near, 0.15, 0.01)

    def interval_over(self, boxes: Interval) -> Interval:
        return Interval(*self.interval(boxes.lo))

    def lipschitz(self, boxes: Interval) -> Any:
        return np.full((len(boxes), 1, 2), [1.0, 0.0])


class Blown(Drift):
    """The drift with gusts: at each step what `gust` says of (step, run), from 0 to 1, between the ends of the gap."""

    def __init__(self, gust: Callable[[int, int], Any]) -> None:
        super().__init__(1)
        self.gust, self.k = gust, 0

    def _step(self, x: Any, u: Any, **options: Any) -> Any:
        low, high = Gusts().interval(np.hstack([x, u]))
        self.k += 1
        return super()._step(x, u) + low + (high - low) * np.reshape(self.gust(self.k, len(x)), (-1, 1))


def box(model: Model, low: float, high: float) -> Box:
    return Box(model.states, (low,), (high,))


@cache
def gusty(cells: int = 50, refine: int = 0) -> GridController:
    """On the left the target can neither be kept nor left for certain, on the right it can be kept."""
    model = Drift(1)
    domain = Domain.of(model, {"x0": (0.0, 1.0), "u0": (-1.0, 1.0)})
    target = Region((box(model, 0.0, 0.2), box(model, 0.8, 1.0)))
    problem = SynthesisProblem(model, Gusts(), domain, Goal("reach_and_stay", domain.states, target))
    made = Symbolic({"x0": cells}, {"u0": 9}, refine=refine).synthesize(problem)
    assert isinstance(made, GridController)
    return made


def test_a_part_of_the_target_that_gusts_may_blow_out_of_wins() -> None:
    controller = gusty()
    assert (controller.values >= 0).all()
    assert len(controller.lasting) == 2
    assert (controller.values[:7] == controller.lasting[1]).all()
    # Each input that is kept there may lead back to where it was given.
    windows = controller.successors
    assert isinstance(windows, Successors)
    cell, which = np.nonzero(controller.allowed(np.arange(7)))
    assert windows.contain(cell, which, cell).all()


@pytest.mark.exam
@pytest.mark.parametrize("refine", [0, 3])
@pytest.mark.parametrize("policy", POLICIES)
def test_runs_are_outside_the_target_as_often_as_their_value_says_at_most(policy: Any, refine: int) -> None:
    controller = gusty(12 if refine else 50, refine)
    x = np.vstack([controller.draw(40, np.random.default_rng(0)), np.linspace(0.0, 0.2, 11)[:, None]])
    rng = np.random.default_rng(1)
    ways: list[Callable[[int, int], Any]] = [
        lambda k, n: rng.random(n),
        lambda k, n: np.full(n, 0.0),
        lambda k, n: np.full(n, 1.0),
        # Where it is until step 30, and then away.
        lambda k, n: np.full(n, 0.4 if k < 30 else 1.0),
        lambda k, n: rng.integers(0, 2, n),
    ]
    for gust in ways:
        trace = closed_loop(Blown(gust), controller, x, 60, policy)
        assert not trace.violation.any()
        assert not trace.broken.any()
        inside = np.stack([controller.goal.visited(trace.x[:, k]) for k in range(61)], axis=1)
        assert ((~inside).sum(axis=1) <= controller.value(x)).all()
        assert inside[:, -1].all()


def test_halved_cells_win_as_the_fine_grid_and_last_where_it_does() -> None:
    ours, fine = gusty(12, 2), gusty(48)
    assert np.array_equal(ours.winning, fine.winning)
    assert len(ours.lasting) > 1
    assert 0 < ours.evidence["levels"][0]["winning_fraction"] < ours.evidence["winning_fraction"]


def test_a_run_that_goes_back_up_is_a_violation(tmp_path: Path) -> None:
    """Nobody promised that it may be blown from the right to the left, or that one may go on for ever between."""
    controller = gusty()
    x, u = np.array([[0.9], [0.5], [0.05], [0.05]]), np.array([[0.0], [1.0], [1.0], [1.0]])
    then = np.array([[0.1], [0.5], [0.05], [0.25]])
    assert controller.kept(x, u, then).tolist() == [False, False, True, True]
    memory = controller.start(x)
    assert memory.tolist() == [2, 1, 1, 1]
    assert controller.keeps(then, controller.advance(then, memory)).tolist() == [False, True, True, True]
    assert controller.counted(x, memory).tolist() == [True, False, True, True]
    controller.save(tmp_path)
    loaded = GridController.load(tmp_path)
    assert loaded.lasting == controller.lasting
    assert loaded.digest() == controller.digest()
    assert loaded.kept(x, u, then).tolist() == [False, False, True, True]
