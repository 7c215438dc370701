"""Each check of SynthesizerContract catches the fault that is planted for it, and passes without it."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gapcert import Box, Controller, Goal, SynthesisProblem
from gapcert.plugin import Synthesizer
from gapcert_cells import GridController
from gapcert_cells.testing import Band, SynthesizerContract, rod_problem
from gapcert_symbolic.synthesizer import Symbolic

CALLS = itertools.count()


def symbolic() -> Symbolic:
    return Symbolic({"theta": 60, "omega": 60}, {"torque": 9})


class Clipping(Controller):
    """Moves a state outside the domain to its nearest winning cell, as a careless controller would."""

    kind = "clipping"

    def __init__(self, inner: GridController) -> None:
        self.inner, self.goal, self.evidence = inner, inner.goal, inner.evidence

    def contains(self, x: np.ndarray) -> np.ndarray:
        return self.inner.contains(x)

    def act(self, x: np.ndarray, policy: Any, seed: int = 0, k: int = 0) -> np.ndarray:
        centres = np.stack(np.meshgrid(*((e[1:] + e[:-1]) / 2 for e in self.inner.edges), indexing="ij"), axis=-1).reshape(
            -1, 2
        )
        wins = centres[self.inner.winning.ravel()]
        known = self.inner.contains(x)
        near = np.array(
            [p if ok else wins[np.nanargmin(np.append(np.abs(wins - p).sum(1), 1e9))] for p, ok in zip(x, known, strict=True)]
        )
        return self.inner.act(near, policy, seed, k)

    def draw(self, n: int, rng: np.random.Generator) -> np.ndarray:
        return self.inner.draw(n, rng)

    def save(self, folder: Path) -> None:
        self.inner.save(folder)


def no_gap(problem: SynthesisProblem) -> Controller:
    return symbolic().synthesize(replace(problem, gap=None))


def every_input(problem: SynthesisProblem) -> Controller:
    c = symbolic().synthesize(problem)
    bits = np.where((c.values >= 0)[:, None], np.packbits(np.ones(len(c.points), dtype=bool)), np.uint8(0))
    return replace(c, bits=bits)


def wide_goal(problem: SynthesisProblem) -> Controller:
    wide = replace(problem, goal=Goal("invariance", problem.domain.states))
    return replace(symbolic().synthesize(wide), goal=problem.goal)


def double_torque(problem: SynthesisProblem) -> Controller:
    c = symbolic().synthesize(problem)
    return replace(c, points=c.points * 2)


def clipping(problem: SynthesisProblem) -> Controller:
    return Clipping(symbolic().synthesize(problem))


def no_reason(problem: SynthesisProblem) -> Controller:
    c = symbolic().synthesize(problem)
    return replace(c, evidence={k: v for k, v in c.evidence.items() if k != "reason"})


def moody(problem: SynthesisProblem) -> Controller:
    c = symbolic().synthesize(problem)
    return replace(c, points=c.points * (1 - 0.01 * (next(CALLS) % 2)))


def inverted(problem: SynthesisProblem) -> Controller:
    gap = Band((-1.5e-4, -6e-5), (1.5e-4, 6e-5)) if problem.gap is None else None
    return symbolic().synthesize(replace(problem, gap=gap))


def numpy_evidence(problem: SynthesisProblem) -> Controller:
    c = symbolic().synthesize(problem)
    return replace(c, evidence=dict(c.evidence) | {"winning_cells": np.int64(3)})


def forgetful(problem: SynthesisProblem) -> Controller:
    return symbolic().synthesize(replace(problem, certificate=""))


class Sure(Clipping):
    """Says that the next state is the very one that f tells."""

    def tube(self, x: np.ndarray, u: np.ndarray, memory: Any = None) -> np.ndarray:
        return np.repeat(rod_problem().model.step(x[None], u[None]).x[:, :, None], 2, axis=2)


def sure(problem: SynthesisProblem) -> Controller:
    return Sure(symbolic().synthesize(problem))


def contract(solve: Callable[[SynthesisProblem], Controller]) -> SynthesizerContract:
    class Faulty(Synthesizer):
        name = "faulty"

        def synthesize(self, problem: SynthesisProblem) -> Controller:
            return solve(problem)

    class Checks(SynthesizerContract):
        def synthesizer(self) -> Synthesizer:
            return Faulty()

    return Checks()


FAULTS = {
    "test_invariance_is_sound": (no_gap, AssertionError),
    "test_reach_avoid_is_sound": (every_input, AssertionError),
    "test_domain_keeps_to_the_goal": (wide_goal, AssertionError),
    "test_inputs_keep_to_the_domain": (double_torque, AssertionError),
    "test_outside_is_an_error": (clipping, AssertionError),
    "test_nothing_wins_with_a_reason": (no_reason, AssertionError),
    "test_deterministic": (moody, AssertionError),
    "test_gap_shrinks_the_domain": (inverted, AssertionError),
    "test_saved_and_loaded": (numpy_evidence, TypeError),
    "test_says_what_it_rests_on": (forgetful, AssertionError),
    "test_steps_online": (sure, AssertionError),
}


def test_every_check_has_a_planted_fault() -> None:
    assert set(FAULTS) == {name for name in dir(SynthesizerContract) if name.startswith("test_")}


@pytest.mark.parametrize("check", FAULTS)
def test_planted_fault_is_caught(check: str) -> None:
    solve, error = FAULTS[check]
    with pytest.raises(error):
        getattr(contract(solve), check)()


class TestSymbolic(SynthesizerContract):
    def synthesizer(self) -> Synthesizer:
        return symbolic()


def test_contract_problem_is_what_it_says() -> None:
    problem = rod_problem()
    assert isinstance(problem.goal.stay, Box)
    assert problem.goal.stay.within(problem.domain.states)
