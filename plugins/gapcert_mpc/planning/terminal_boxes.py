"""Plans that end in one of several boxes of states, at the horizon or before it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import final

import numpy as np

from gapcert import Array
from gapcert.plugin import Bools
from gapcert_mpc.thresholds import THRESHOLDS

from .design import Ends
from .engine import Engine
from .plans import Held, Plan


@final
class Landing:
    """Plans of M steps from x with low + E_x s_M ≤ x̄_M ≤ high − E_x s_M for one of the boxes; M is the plan's `arrival`.

    Only bounds of rows differ between boxes and between numbers of steps, so that one program serves them all.
    """

    def __init__(self, engine: Engine, ends: Ends) -> None:
        self.engine, self.boxes, self.horizon = engine, ends.boxes, engine.program.N
        self.low, self.high = engine.program.limits()

    def solve(self, x: Array, held: Held | None) -> Plan | None:
        """A plan of as many steps as there is one, to begin with; then up to the horizon, or what is left of `held` goes on."""
        if held is not None:
            return self._within(x, self.horizon, held.plan, np.ones(len(self.boxes), dtype=bool))
        for steps, low, high in reversed(list(self._reached(x))):
            near = np.asarray(((self.boxes[:, 0] <= high) & (self.boxes[:, 1] >= low)).all(axis=1))
            if near.any() and (made := self._within(x, steps, None, near)) is not None:
                return made
        return None

    def _reached(self, x: Array) -> Iterator[tuple[int, Array, Array]]:
        """(steps, low, high): boxes that hold x̄ of every plan from x, as far as there may be one; they only rule out."""
        p, n, spare = self.engine.program, len(x), 2 * self.engine.program.tolerance
        low, high = self.low + p.off, self.high - p.off
        a = b = x
        for k in range(self.horizon):
            A, B, u = p.stages.A[k], p.stages.B[k], slice(n, n + p.m)
            middle = (A @ (a + b) + B @ (low[k, u] + high[k, u])) / 2 + p.stages.d[k]
            wide = (np.abs(A) @ (b - a) + np.abs(B) @ (high[k, u] - low[k, u])) / 2 + np.abs(B).sum(axis=1) * spare + spare
            a, b = np.maximum(middle - wide, low[k + 1, :n] - spare), np.minimum(middle + wide, high[k + 1, :n] + spare)
            if (a > b).any():
                return
            yield k + 1, a, b

    def _within(self, x: Array, steps: int, guess: Plan | None, tried: Bools) -> Plan | None:
        """To the first of the boxes tried that there is a plan of so many steps to."""
        p = self.engine.program
        after = np.arange(self.horizon + 1)[:, None] >= steps + ~p.driven
        low, high = np.where(after, -THRESHOLDS.loose_bound, self.low), np.where(after, THRESHOLDS.loose_bound, self.high)
        for box in self.boxes[tried]:
            low[steps, : p.n] = np.maximum(self.low[steps, : p.n], box[0])
            high[steps, : p.n] = np.minimum(self.high[steps, : p.n], box[1])
            p.bound(low, high)
            if (found := self.engine.solve(x, guess)) is not None:
                return replace(found, arrival=steps)
        return None
