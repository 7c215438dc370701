"""Plans that end in one of several boxes of states, at the horizon or before it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from .plans import Plan
from .program import LOOSE

if TYPE_CHECKING:
    from .controller import Engine

Array = np.ndarray


@final
@dataclass(frozen=True)
class Ends:
    """boxes (k, 2, n): [low, high] in the frame, the one that is wanted most first; F as in `Program`."""

    boxes: Array
    F: Array


@final
class Landing:
    """Plans of M steps from x with low + E_x s_M ≤ x̄_M ≤ high − E_x s_M for one of the boxes; M is the plan's `arrival`.

    Only bounds of rows differ between boxes and between numbers of steps, so that one program serves them all.
    """

    def __init__(self, engine: Engine, ends: Ends) -> None:
        self.engine, self.boxes, self.horizon = engine, ends.boxes, engine.program.N
        self.low, self.high = engine.program.limits()

    def begin(self, x: Array) -> Plan | None:
        """A plan of as many steps as there is one."""
        tried = (self._within(x, steps, None) for steps in range(self.horizon, 0, -1))
        return next((plan for plan in tried if plan is not None), None)

    def follow(self, x: Array, plan: Plan, age: int) -> Plan | None:
        """A new plan up to the horizon; where there is none, what is left of `plan` goes on."""
        return self._within(x, self.horizon, plan)

    def _within(self, x: Array, steps: int, guess: Plan | None) -> Plan | None:
        """To the first box that there is a plan of so many steps to."""
        p = self.engine.program
        after = np.arange(self.horizon + 1)[:, None] >= steps + ~p.driven
        low, high = np.where(after, -LOOSE, self.low), np.where(after, LOOSE, self.high)
        for box in self.boxes:
            low[steps, : p.n] = np.maximum(self.low[steps, : p.n], box[0])
            high[steps, : p.n] = np.minimum(self.high[steps, : p.n], box[1])
            p.bound(low, high)
            if (found := self.engine.solve(x, guess)) is not None:
                return replace(found, arrival=steps)
        return None
