"""Invariance by blocks of cells: the domain and the inputs of cell by cell, however f is bounded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import touched

import gapcert as gc
from gapcert import Box, Domain, GapFunction, Goal, Interval, Model, Region, StateSpec, SynthesisProblem
from gapcert.testing.toys import Opaque
from gapcert_cells import Along, GridController
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.cells.bounds import Enclosed, Grown
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.kernels import lazy_kernels
from gapcert_symbolic.solvers import lazy, runs
from gapcert_symbolic.solvers.problem import Dynamics, Problem
from gapcert_symbolic.synthesizer import Symbolic

RANGES = {"omega": (-4.0, 4.0), "theta": (-np.pi, np.pi), "torque": (-6.0, 6.0)}


@pytest.fixture(autouse=True)
def _large_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """On small grids, too."""
    monkeypatch.setattr(lazy, "THRESHOLDS", replace(lazy.THRESHOLDS, first_blocks=1))


def equations(**derivative: str) -> Model:
    """A pendulum over 0.1 s by RK4, whose states all depend on all; or how far two of its trajectories get apart."""
    registry = gc.registry()
    config = {
        "kind": "equations",
        "states": {"omega": 1, "theta": {"unit": "rad", "kind": "angle"}},
        "inputs": {"torque": 1},
        "parameters": {"T": "1 s"},
        "derivative": derivative,
        "integrator": "rk4",
        "period": "100 ms",
    }
    return registry.build("model", "equations", registry.config("model", "equations")(**config))


@cache
def pendulum() -> Model:
    return equations(omega="(2*torque - 0.3*omega - 9*sin(theta))/T", theta="omega/T")


@cache
def radii() -> Model:
    return equations(omega="(9*theta - 0.3*omega)/T", theta="omega/T")


class Rising(GapFunction):
    """±(rate + rate |omega|) for each state."""

    family = "rising"

    def __init__(self, rate: float) -> None:
        self.rate = rate

    def interval(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        size = np.repeat(self.rate + self.rate * np.abs(z[:, :1]), 2, axis=1)
        return -size, size

    def interval_over(self, boxes: Interval) -> Interval:
        size = np.repeat(self.rate + self.rate * boxes.mag[:, :1], 2, axis=1) * (1 + 1e-12)
        return Interval(-size, size)

    def arrays(self) -> dict[str, np.ndarray]:
        return {"rate": np.array([self.rate])}

    @property
    def form(self) -> dict[str, Any]:
        return {"form": "rising"}

    def lipschitz(self, boxes: Interval) -> np.ndarray:
        slope = np.zeros((len(boxes), 2, 3))
        slope[:, :, 0] = self.rate
        return slope


def asked(model: Model, rate: float = 0.01, relations: tuple[str, ...] = ()) -> SynthesisProblem:
    """To be kept off two walls, where `theta` wraps."""
    domain = Domain.of(model, RANGES, relations)
    walls = [Box(model.states, (1.0, 0.5), (2.5, 1.4)), Box(model.states, (-1.2, -0.3), (-0.2, 0.4))]
    return SynthesisProblem(
        model, Rising(rate) if rate else None, domain, Goal("invariance", domain.states, avoid=Region(tuple(walls)))
    )


def made(problem: SynthesisProblem, **options: Any) -> GridController:
    given = {"cells": {"omega": 62, "theta": 60}, "inputs": {"torque": 5}, "threads": 1, **options}
    controller = Symbolic(**given).synthesize(problem)
    assert isinstance(controller, GridController)
    return controller


def escapes(problem: SynthesisProblem, controller: GridController) -> int:
    """How many of 20,000 random winning states a valid input leads out, at the worst of the gap."""
    rng = np.random.default_rng(5)
    x = rng.uniform([-4, -np.pi], [4, np.pi], (20_000, 2))
    x = x[controller.contains(x)]
    valid, out = controller.allowed(controller.cells(x)).astype(bool), 0
    for j, u in enumerate(controller.points):
        z = x[valid[:, j]]
        after = problem.model.fast_rollout(z, np.tile(u, (len(z), 1, 1))).x[:, 1]
        for low in (True, False):
            gap = (
                np.zeros((2, *z.shape))
                if problem.gap is None
                else problem.gap.interval(np.column_stack([z, np.tile(u, (len(z), 1))]))
            )
            out += int((~controller.contains(after + gap[0 if low else 1])).sum())
    return out


CASES: dict[str, Callable[[], tuple[SynthesisProblem, dict[str, Any]]]] = {
    "opaque": lambda: (asked(Opaque(pendulum())), {"growth": radii()}),
    "no gap": lambda: (asked(Opaque(pendulum()), 0.0), {"growth": radii()}),
    "relations": lambda: (asked(Opaque(pendulum()), 0.01, ("abs(torque + 2*omega) <= 9",)), {"growth": radii()}),
    "enclosed": lambda: (asked(pendulum()), {"inputs": {"torque": 2}, "cells": {"omega": 40, "theta": 36}}),
}


@pytest.mark.exam
@pytest.mark.parametrize("case", CASES)
def test_blocks_find_what_cells_do(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem, options = CASES[case]()
    sizes, call = set[int](), lazy.BlockWindows.__call__

    def counted(self: lazy.BlockWindows, corner: Any, size: Any, *given: Any) -> Any:
        sizes.update(size.tolist())
        return call(self, corner, size, *given)

    monkeypatch.setattr(lazy.BlockWindows, "__call__", counted)
    blocks = made(problem, **options)
    assert sizes == {1, 4, 16}
    monkeypatch.setattr(lazy, "suits", lambda *given: False)
    cells = made(problem, **options)
    assert 0 < cells.evidence["winning_cells"] < 0.95 * len(cells.values)
    assert np.array_equal(blocks.values >= 0, cells.values >= 0)
    assert np.array_equal(blocks.bits, cells.bits)
    assert not escapes(problem, blocks)


def _centred(self: lazy.BlockWindows, corner: Any, size: Any, block: Any, which: Any) -> Any:
    """A fault: a block is judged by the cell in its middle."""
    middle = np.minimum(corner + size[:, None] // 2, np.array(self.grid.counts) - 1).astype(np.int32)
    return CALL(self, middle, np.ones_like(size), block, which)


def _inwards(*given: Any, **options: Any) -> Any:
    """A fault: what a cell is touched in part is left out."""
    first, last = TOUCHED(*given, **options)
    return first + 1, np.maximum(first + 1, last - 1)


CALL, TOUCHED = lazy.BlockWindows.__call__, lazy.touched


@pytest.mark.parametrize("fault", ["centre", "inwards", "gap"])
def test_faults_let_states_escape(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = asked(Opaque(pendulum()), 0.03)
    if fault == "centre":
        monkeypatch.setattr(lazy.BlockWindows, "__call__", _centred)
        # Parts go beyond the whole then, and cells are asked one by one.
        assert not escapes(problem, made(problem, growth=radii()))
        monkeypatch.setattr(lazy_kernels, "nested", lambda *given: True)
    elif fault == "inwards":
        monkeypatch.setattr(lazy, "touched", _inwards)
        monkeypatch.setattr(lazy_kernels, "nested", lambda *given: True)
    else:
        monkeypatch.setattr(lazy.BlockWindows, "_gap", lambda self, *given: Interval(np.zeros((1, 2)), np.zeros((1, 2))))
    assert escapes(problem, made(problem, growth=radii()))


def test_a_bound_that_does_not_grow_is_one_of_cells() -> None:
    """Declared for radii up to that of a cell, it tells nothing of blocks: each cell is asked for."""
    problem = asked(Opaque(pendulum()))
    grid = Grid(problem.goal.stay, (62, 60))
    half = grid.widths / 2
    bound, axes = Grown(problem.model, Still(radii(), half), half * 1e-10), (np.linspace(-6, 6, 5),)
    assert lazy.suits(bound, grid, axes)
    dynamics = Dynamics(bound, grid, axes, None, None)
    assert lazy.solve(Problem(cache(list), np.ones(grid.size, dtype=bool), dynamics=dynamics)) is None
    one, other = (made(problem, growth=radius) for radius in (radii(), Still(radii(), half)))
    assert np.array_equal(one.values >= 0, other.values >= 0)
    assert np.array_equal(one.bits, other.bits)


class Still(Opaque):
    """Radii of cells, whatever is asked for."""

    def __init__(self, model: Model, half: np.ndarray) -> None:
        super().__init__(model)
        self.half = half * (1 + 1e-9)

    def fast_rollout(self, x0: np.ndarray, u: np.ndarray, **options: Any) -> gc.plugin.Step:
        return self.model.fast_rollout(np.tile(self.half, (len(x0), 1)), u)


def test_steps_are_held_against_the_windows_of_cells() -> None:
    problem = asked(Opaque(pendulum()))
    controller = made(problem, growth=radii())
    assert callable(controller.promised)
    assert "adversarial" in controller.policies
    x = controller.draw(500, np.random.default_rng(0))
    for policy in controller.policies:
        u = controller.act(x, policy)
        after = problem.model.fast_rollout(x, u[:, None]).x[:, 1]
        assert controller.kept(x, u, after).all()
        assert controller.contains(after).all()
        assert not controller.kept(x, u, x[::-1]).all()


def drawn(n: int, seed: int) -> tuple[Windows, np.ndarray]:
    """Windows of cells that drift with their index, on axes that wrap or not, where inputs may not be allowed; safe cells."""
    rng = np.random.default_rng(seed)
    counts, m, axes = (
        tuple(int(v) for v in rng.integers(*{1: (17, 80), 2: (9, 30), 3: (5, 12)}[n], n)),
        int(rng.integers(1, 12)),
        [],
    )
    at, every = np.indices(counts).reshape(n, -1), tuple(range(n))
    wraps = rng.random(n) < 0.4
    for k, count in enumerate(counts):
        slope, shift = rng.uniform(-0.3, 0.3, n) + (np.arange(n) == k), rng.uniform(-3, 3, m)
        middle = (slope @ (at - np.array(counts)[:, None] / 2))[:, None] + count / 2 + shift
        first = np.floor(middle - rng.uniform(0, 2, m))
        last = first + rng.integers(0, 4, first.shape)
        if wraps[k]:
            last = np.minimum(last - first, count - 1) + first % count
            first = first % count
        else:
            first, last = (np.clip(end, -1, count) for end in (first, last))
        axes.append(Along(every, False, np.arange(m), first.astype(np.int32), last.astype(np.int32)))
    kinds = ["angle" if w else "real" for w in wraps]
    states = tuple(StateSpec(f"x{k}", "rad", kind) for k, kind in enumerate(kinds))
    box = Box(states, tuple(-np.pi if w else 0.0 for w in wraps), tuple(np.pi if w else 1.0 for w in wraps))
    allowed = rng.random((at.shape[1], m)) < 0.9 if rng.random() < 0.5 else None
    return Windows(Grid(box, counts), tuple(axes), allowed), rng.random(at.shape[1]) < 0.97


def hulls(windows: Windows) -> lazy.Ask:
    """The window of a block: all that those of its cells touch."""
    counts, wraps = np.array(windows.grid.counts), windows.grid.wraps

    def ask(corner: np.ndarray, size: np.ndarray, block: np.ndarray, which: np.ndarray) -> Any:
        first, last = np.empty((2, len(block), len(counts)), dtype=np.int32)
        for p, (i, j) in enumerate(zip(block, which, strict=True)):
            part = np.ix_(*(range(c, min(c + size[i], n)) for c, n in zip(corner[i], counts, strict=True)))
            cell = np.arange(windows.grid.size).reshape(counts)[part].ravel()
            ends = touched.ends(windows, cell, np.full(len(cell), j))
            first[p], last[p] = ends[0].min(axis=0), ends[1].max(axis=0)
            for k in np.flatnonzero(wraps & (last[p] - first[p] >= counts)):
                first[p, k], last[p, k] = 0, counts[k] - 1
        return first, last

    return ask


@pytest.mark.exam
@pytest.mark.parametrize("n", [1, 2, 3])
def test_drawn_windows(n: int) -> None:
    some = 0
    for seed in range(12 if n == 1 else 6):
        windows, safe = drawn(n, seed)
        alive, bits = np.where(safe, 0, -1).astype(np.int32), windows.no_bits
        runs.invariance(1, windows.game, alive, bits, *windows.rows)
        found, nested = lazy.invariance(hulls(windows), windows.grid, safe, windows.inputs, windows.allowed)
        assert nested
        assert np.array_equal(found.values, alive)
        assert np.array_equal(found.bits, bits)
        some += 0 < (alive == 0).sum() < safe.sum()
    assert some >= 2


def test_groups_of_inputs_are_asked_together() -> None:
    """Where one slope carries f to all inputs, tables take less than blocks."""
    grid = Grid(asked(pendulum()).goal.stay, (62, 60))
    near, far = (np.linspace(-1e-3, 1e-3, 9),), (np.linspace(-6, 6, 2),)
    assert not lazy.suits(Enclosed(pendulum()), grid, near)
    assert lazy.suits(Grown(pendulum(), radii(), grid.widths * 1e-10), grid, near)
    assert lazy.suits(Enclosed(pendulum()), grid, far)
