"""Invariance by blocks of cells: the domain and the inputs of cell by cell, however f is bounded."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import gapcert as gc
from gapcert import Box, Domain, GapFunction, Goal, GridController, Interval, Model, Region, StateSpec, SynthesisProblem
from gapcert_symbolic import lazy, lazy_kernels, runs, solvers
from gapcert_symbolic.abstraction import Axis, Windows
from gapcert_symbolic.bounds import Enclosed, Grown
from gapcert_symbolic.grid import Grid
from gapcert_symbolic.synthesizer import Symbolic

RANGES = {"omega": (-4.0, 4.0), "theta": (-np.pi, np.pi), "torque": (-6.0, 6.0)}


@pytest.fixture(autouse=True)
def _large_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """On small grids, too."""
    monkeypatch.setattr(lazy, "PARTS", 1)


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


PENDULUM = equations(omega="(2*torque - 0.3*omega - 9*sin(theta))/T", theta="omega/T")
RADII = equations(omega="(9*theta - 0.3*omega)/T", theta="omega/T")


class Opaque(Model):
    """A model that answers steps, and nothing else."""

    def __init__(self, model: Model) -> None:
        self.model, self.states, self.inputs, self.period = model, model.states, model.inputs, model.period

    def _step(self, x: np.ndarray, u: np.ndarray, **options: Any) -> np.ndarray:
        return self.model.step(x, u).x

    def fast_rollout(self, x0: np.ndarray, u: np.ndarray, **options: Any) -> gc.Step:
        return self.model.fast_rollout(x0, u, **options)

    def _unknown(self, *asked: Any) -> Any:
        raise gc.UsageError("opaque: nothing is known of the model but its steps")

    jacobian = enclosure = jacobian_enclosure = extend = equations = to_spec = sites = _unknown


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
    return SynthesisProblem(model, Rising(rate) if rate else None, domain, Goal("invariance", domain.states, avoid=Region(tuple(walls))))


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
            gap = np.zeros((2, *z.shape)) if problem.gap is None else problem.gap.interval(np.column_stack([z, np.tile(u, (len(z), 1))]))
            out += int((~controller.contains(after + gap[0 if low else 1])).sum())
    return out


CASES: dict[str, tuple[Callable[[], SynthesisProblem], dict[str, Any]]] = {
    "opaque": (lambda: asked(Opaque(PENDULUM)), {"growth": RADII}),
    "no gap": (lambda: asked(Opaque(PENDULUM), 0.0), {"growth": RADII}),
    "relations": (lambda: asked(Opaque(PENDULUM), 0.01, ("abs(torque + 2*omega) <= 9",)), {"growth": RADII}),
    "enclosed": (lambda: asked(PENDULUM), {"inputs": {"torque": 2}, "cells": {"omega": 40, "theta": 36}}),
}


@pytest.mark.parametrize("case", CASES)
def test_blocks_find_what_cells_do(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem, options = CASES[case][0](), CASES[case][1]
    sizes, call = set[int](), lazy.Windows.__call__

    def counted(self: lazy.Windows, corner: Any, size: Any, *given: Any) -> Any:
        sizes.update(size.tolist())
        return call(self, corner, size, *given)

    monkeypatch.setattr(lazy.Windows, "__call__", counted)
    blocks = made(problem, **options)
    assert sizes == {1, 4, 16}
    monkeypatch.setattr(lazy, "suits", lambda *given: False)
    cells = made(problem, **options)
    assert 0 < cells.evidence["winning_cells"] < 0.95 * len(cells.values)
    assert np.array_equal(blocks.values >= 0, cells.values >= 0)
    assert np.array_equal(blocks.bits, cells.bits)
    assert not escapes(problem, blocks)
