"""The fixpoints on JAX give the same values and the same inputs as the compiled ones."""

from __future__ import annotations

import functools
import importlib.util
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gapcert import Box, Domain, Goal, MissingDependency, Region, StateSpec, SynthesisProblem
from gapcert.testing.toys import Drift
from gapcert_cells import Along, AutomatonController, GridController, automaton_of, read_hoa
from gapcert_cells.testing import Band, rod_problem, rod_reach_avoid
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.games import games
from gapcert_symbolic.games.games import Labels, product, solve
from gapcert_symbolic.solvers.problem import Play, Problem, Solution
from gapcert_symbolic.synthesizer import Symbolic

pytestmark = pytest.mark.needs("jax")

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
        axes.append(Along(on, moves, column, first.astype(np.int32), last.astype(np.int32)))
    return Windows(grid, tuple(axes), rng.random((grid.size, m)) < 0.9 if seed else None)


@pytest.mark.exam
@pytest.mark.parametrize(("counts", "wraps"), SHAPES, ids=[f"{len(s[0])}-D" for s in SHAPES])
def test_domains_values_and_inputs_are_equal(counts: tuple[int, ...], wraps: tuple[bool, ...]) -> None:
    shares = []
    for seed in (1, 2, 3) if len(counts) > 2 else (0,):
        windows, rng = drawn(seed, counts, wraps), np.random.default_rng(seed)
        safe, target = rng.random(windows.grid.size) < 0.99, rng.random(windows.grid.size) < 0.15
        compiled = Problem(functools.partial(drawn, seed, counts, wraps), safe)
        jax = replace(compiled, solver="jax")
        for ours, other in [
            (solve(jax), solve(compiled)),
            (solve(replace(jax, target=target)), solve(replace(compiled, target=target))),
            (games.recurrence(jax, target), games.recurrence(compiled, target)),
            (games.reach_and_stay(jax, safe & ~target), games.reach_and_stay(compiled, safe & ~target)),
        ]:
            assert np.array_equal(ours.values, other.values)
            assert np.array_equal(ours.bits, other.bits)
            assert ours.lasting == other.lasting
            shares.append(float((other.values >= 0).mean()))
    assert sum(0 < s < 1 for s in shares) >= len(shares) // 4


@pytest.mark.exam
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


AGAIN = """HOA: v1 States: 2 Start: 0 AP: 2 "a" "b" Acceptance: 1 Inf(0) --BODY--
State: 0 [!0] 0 [0] 1 State: 1 {0} [!0 & !1] 0 [0 & !1] 1 --END--"""
AUTOMATA = [automaton_of("F (a & F (b & X (F a)))"), automaton_of("!b U (a & X a)"), read_hoa(AGAIN)]


def labelled(windows: Windows, seed: int) -> Labels:
    """A third of the cells are inside the first region, one in thirty in the second; one in thirty may touch either."""
    rng, n = np.random.default_rng([seed, 1]), windows.grid.size
    must = (rng.random(n) < 0.3) + 2 * (rng.random(n) < 0.03)
    return Labels(must, must | np.where(rng.random(n) < 0.03, rng.integers(0, 4, n), 0))


def both(seed: int, shape: int) -> list[tuple[Solution, Solution]]:
    """Products with each automaton: on JAX, and compiled."""
    from gapcert_symbolic.solvers import dense

    windows = drawn(seed, *SHAPES[shape])
    safe, labels = np.random.default_rng(seed).random(windows.grid.size) < 0.99, labelled(windows, seed)
    return [(product(windows, safe, a, labels, dense.Positions), product(windows, safe, a, labels)) for a in AUTOMATA]


@pytest.mark.exam
@pytest.mark.parametrize("shape", [0, 1, 2])
def test_games_with_automata_are_equal(shape: int) -> None:
    shares, largest = [], 0
    for ours, other in [pair for seed in ((0,), (1, 2, 3), (1, 2, 3))[shape] for pair in both(seed, shape)]:
        assert np.array_equal(ours.values, other.values)
        assert np.array_equal(ours.bits, other.bits)
        assert ours.rounds == other.rounds
        shares.append(float((other.values >= 0).mean()))
        largest = max(largest, int(other.values.max()))
    assert sum(0 < s < 1 for s in shares) > len(shares) // 2
    assert largest > 1


@pytest.mark.parametrize("fault", ["nowhere", "readings"])
def test_a_reading_that_is_forgotten_is_noticed(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells that may lead nowhere, or into a state that has not won, must not be entered."""
    from gapcert_symbolic.solvers import dense

    class Careless(dense.Positions):
        def __init__(self, play: Play) -> None:
            leads = play.leads.copy()
            if fault == "nowhere":
                leads[:, :, -1] = False
            else:
                leads[:, :, 0] = False
            super().__init__(replace(play, leads=leads))

    monkeypatch.setattr(dense, "Positions", Careless)
    assert any((ours.values != other.values).any() for ours, other in both(0, 0))


def test_a_formula_is_solved_by_the_option() -> None:
    model = Drift(2)
    domain = Domain.of(model, {"x0": (0.0, 1.0), "x1": (0.0, 1.0), "u0": (-1.0, 1.0), "u1": (-1.0, 1.0)})
    boxes = {"a": ((0.04, 0.04), (0.43, 0.43)), "b": ((0.56, 0.04), (0.97, 0.48))}
    automaton = automaton_of("F (a & F b)")
    regions = tuple(Region((Box(model.states, *boxes[n]),)) for n in automaton.propositions)
    goal = Goal("automaton", domain.states, automaton=automaton, regions=regions)
    given = SynthesisProblem(model, Band((-0.005,) * 2, (0.005,) * 2), domain, goal)
    options: dict[str, Any] = {"cells": {"x0": 25, "x1": 25}, "inputs": {"u0": 3, "u1": 3}}
    ours, other = Symbolic(**options, solver="jax").synthesize(given), Symbolic(**options).synthesize(given)
    assert isinstance(ours, AutomatonController)
    assert isinstance(other, AutomatonController)
    assert ours.evidence["winning_cells"] > 0
    assert ours.evidence == other.evidence
    for a, b in zip(ours.parts, other.parts, strict=True):
        assert np.array_equal(a.values, b.values)
        assert np.array_equal(a.bits, b.bits)
