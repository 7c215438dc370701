"""The fixpoints on JAX give the same values and the same inputs as the compiled ones."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import pytest

from gapcert import Box, Goal, GridController, MissingDependency, Region, StateSpec, UsageError, automaton_of
from gapcert.testing.synthesis import Band, rod_problem, rod_reach_avoid
from gapcert_symbolic import dense, games, solvers
from gapcert_symbolic.abstraction import Axis, Windows
from gapcert_symbolic.grid import Grid
from gapcert_symbolic.synthesizer import Symbolic

pytest.importorskip("jax")
TURN = 2 * np.pi
SHAPES = [((23, 17), (True, False)), ((9, 8, 7), (False, True, False)), ((5, 4, 3, 4), (False, False, True, False))]


def drawn(seed: int, counts: tuple[int, ...], wraps: tuple[bool, ...]) -> Windows:
    """Windows of a few cells around the own one, or anywhere. The tables of all seeds have one shape: each is compiled for."""
    rng, m = np.random.default_rng(seed), 11
    states = tuple(StateSpec(f"x{k}", "rad", "angle") if w else StateSpec(f"x{k}") for k, w in enumerate(wraps))
    grid = Grid(Box(states, (0.0,) * len(counts), tuple(TURN if w else 1.0 for w in wraps)), counts)
    axes = []
    for k, n in enumerate(counts):
        moves = k == 0 or k % 4 != 2
        on = tuple(d for d in range(len(counts)) if d == k + 1 or (d == k and not moves))
        column = np.concatenate([[3], rng.integers(4, size=m - 1)])
        size = int(np.prod([counts[d] for d in on])), 4
        first = rng.integers(-2, 2, size) if moves else rng.integers(-1, n + 1, size)
        first = first % n if wraps[k] else first
        last = first + rng.integers(0, min(3, n), size)
        axes.append(Axis(on, moves, column, first.astype(np.int32), last.astype(np.int32)))
    return Windows(grid, tuple(axes), rng.random((grid.size, m)) < 0.9 if seed else None)


@pytest.mark.parametrize(("counts", "wraps"), SHAPES, ids=[f"{len(s[0])}-D" for s in SHAPES])
def test_domains_values_and_inputs_are_equal(counts: tuple[int, ...], wraps: tuple[bool, ...]) -> None:
    shares = []
    for seed in (1, 2, 3) if len(counts) > 2 else (0,):
        windows, rng = drawn(seed, counts, wraps), np.random.default_rng(seed)
        safe, target = rng.random(windows.grid.size) < 0.99, rng.random(windows.grid.size) < 0.15
        for ours, other in [
            (dense.invariance(windows, safe), solvers.invariance(windows, safe)),
            (dense.reach_avoid(windows, safe, target), solvers.reach_avoid(windows, safe, target)),
            (games.recurrence(windows, safe, target, dense), games.recurrence(windows, safe, target)),
            (games.reach_and_stay(windows, safe, safe & ~target, dense), games.reach_and_stay(windows, safe, safe & ~target)),
        ]:
            assert np.array_equal(ours.values, other.values)
            assert np.array_equal(ours.bits, other.bits)
            shares.append(float((other.values >= 0).mean()))
    assert sum(0 < s < 1 for s in shares) >= len(shares) // 4


@pytest.mark.parametrize("kind", ["invariance", "reach_avoid"])
def test_the_option_solves_the_same_game(kind: str) -> None:
    problem = rod_problem(None if kind == "invariance" else rod_reach_avoid(), Band((-1e-4, -1e-3), (1e-4, 1e-3)))
    options: dict[str, Any] = {"cells": {"theta": 40, "omega": 50}, "inputs": {"torque": 9}}
    ours, other = Symbolic(**options, solver="jax").synthesize(problem), Symbolic(**options).synthesize(problem)
    assert isinstance(ours, GridController)
    assert isinstance(other, GridController)
    assert 0 < ours.evidence["winning_fraction"] < 1
    assert np.array_equal(ours.values, other.values)
    assert np.array_equal(ours.bits, other.bits)


def test_without_jax_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = rod_problem()
    made = Symbolic({"theta": 4, "omega": 4}, {"torque": 3}, solver="jax")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingDependency, match=r"needs jax.*pip install 'gapcert\[jax\]'"):
        made.check(problem.model, problem.domain, problem.goal)


def test_goals_with_an_automaton_are_refused() -> None:
    problem = rod_problem()
    region = Region((Box(problem.model.states, (0.05, -0.1), (0.15, 0.1)),))
    goal = Goal("automaton", problem.goal.stay, automaton=automaton_of("F left"), regions=(region,))
    with pytest.raises(UsageError, match=r"controller\.solver: jax solves no game with an automaton"):
        Symbolic({"theta": 4, "omega": 4}, {"torque": 3}, solver="jax").check(problem.model, problem.domain, goal)
