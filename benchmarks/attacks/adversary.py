"""Whoever chooses the gap against a controller: corners of [l, u], kept, alternating, at random or greedily, at edges."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

import gapcert as gc

MODES = ("kept", "alternating", "random", "greedy")
STARTS = 200


class Adversary(gc.System):
    """x⁺ = f(x, u) + d with d in [l, u](x, u). It remembers how often it was asked: no simulator, only an opponent."""

    def __init__(
        self, model: gc.Model, gap: gc.GapFunction, controller: gc.Controller, mode: str, rng: np.random.Generator
    ) -> None:
        self.states, self.inputs, self.period = model.states, model.inputs, model.period
        self.model, self.gap, self.controller, self.mode, self.rng, self.asked = model, gap, controller, mode, rng, 0
        self.corners = np.array(list(itertools.product((False, True), repeat=model.nx)))
        self.chosen = self.corners[rng.integers(len(self.corners))]
        # An automaton's controller and one on blocks of cells have edges too; a predictive one has none.
        self.edges = getattr(controller, "edges", getattr(getattr(controller, "grid", None), "edges", ()))

    def _step(self, x: np.ndarray, u: np.ndarray, **options: Any) -> np.ndarray:
        f = self.model.step(x, u).x
        low, high = self.gap.interval(np.hstack([x, u]))
        self.asked += 1
        if self.mode == "greedy":
            return self._greedy(f, low, high)
        corner = self.rng.random(f.shape) < 0.5 if self.mode == "random" else self.chosen
        corner = ~corner if self.mode == "alternating" and self.asked % 2 else corner
        return self._within(f + np.where(corner, high, low), f, low, high)

    def _within(self, after: np.ndarray, f: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Floats whose exact distance to f is within [l, u]: a sum that was rounded outwards goes back by one."""
        after = np.where(after - f > high, np.nextafter(after, -np.inf), after)
        return np.asarray(np.where(after - f < low, np.nextafter(after, np.inf), after))

    def _greedy(self, f: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Of all corners, and of these snapped to edges and the floats beside, one where the controller gives up; else any."""
        best = self._within(f + np.where(self.rng.random(f.shape) < 0.5, high, low), f, low, high)
        for corner in self.corners:
            tried = f + np.where(corner, high, low)
            for snap in (False, True):
                after = self._within(self._snapped(tried, f, low, high) if snap else tried, f, low, high)
                lost = ~self.controller.contains(after) & self.controller.contains(best)
                best = np.where(lost[:, None], after, best)
        return best

    def _snapped(self, tried: np.ndarray, f: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        out = tried.copy()
        for j, edges in enumerate(self.edges):
            near = edges[np.clip(np.searchsorted(edges, tried[:, j]) - self.rng.integers(0, 2, len(tried)), 0, len(edges) - 1)]
            near = near + self.rng.integers(-1, 2, len(near)) * np.spacing(near)
            fits = (near - f[:, j] >= low[:, j]) & (near - f[:, j] <= high[:, j])
            out[:, j] = np.where(fits, near, out[:, j])
        return out


def starts(controller: gc.Controller, n: int, rng: np.random.Generator) -> np.ndarray:
    """States of its domain; a third of them with coordinates on edges and the floats beside these."""
    x = controller.draw(n, rng)
    for j, edges in enumerate(getattr(controller, "edges", ())):
        rows = rng.random(len(x)) < 0.3
        x[rows, j] = rng.choice(edges, int(rows.sum()))
        x[rows, j] += rng.integers(-1, 2, int(rows.sum())) * np.spacing(x[rows, j])
    return np.asarray(x[controller.contains(x)])


def fought(
    model: gc.Model,
    gap: gc.GapFunction,
    controller: gc.Controller,
    wanted: int,
    steps: int,
    rng: np.random.Generator,
    runs: int = STARTS,
) -> tuple[int, int, dict[str, Any]]:
    """Steps made and runs that broke a promise, of at least `wanted` steps where they last; and the first break."""
    made, broken, first = 0, 0, dict[str, Any]()
    for k in range(100):
        mode = MODES[k % len(MODES)]
        x = starts(controller, runs, rng)
        if made >= wanted or not len(x):
            break
        trace = gc.closed_loop(
            Adversary(model, gap, controller, mode, rng),
            controller,
            x,
            steps,
            controller.policies[k // 4 % len(controller.policies)],
            seed=k,
        )
        lasted = np.isfinite(trace.u[..., 0]).sum(axis=1)
        wrong = trace.violation | trace.broken.any(axis=1)
        left = controller.left(x, controller.start(x)) if controller.goal.kind == "reach_avoid" else None
        if left is not None:
            wrong |= (left <= steps) & (~trace.reached | (lasted > left))
        made, broken = made + int(lasted.sum()), broken + int(wrong.sum())
        if wrong.any() and not first:
            row = int(np.argmax(wrong))
            first = {"mode": mode, "start": x[row].tolist(), "steps": int(lasted[row])}
    return made, broken, first
