"""What a controller foresees along one of its runs: the tubes of its predictions, at a few moments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from gapcert.policies import Policy
from gapcert.region import turned
from gapcert.system import Array

if TYPE_CHECKING:
    from gapcert.control import Controller

MOMENTS = 4


@final
@dataclass(frozen=True)
class Foreseen:
    """At `step` of a run: rows k of centre, low and high (N + 1, nx) are about step + k."""

    step: int
    centre: Array
    low: Array
    high: Array

    def kept(self, trace: Array) -> tuple[int, int]:
        """Of the later states of a run (steps + 1, nx), as far as it went: how many lie in the tube, and how many there are."""
        then = trace[self.step + 1 : self.step + len(self.low)]
        then = then[np.isfinite(then).all(axis=1)]
        low, high = self.low[1 : len(then) + 1], self.high[1 : len(then) + 1]
        return int(((then >= low) & (then <= high)).all(axis=1).sum()), len(then)


def foreseen(controller: Controller, x: Array, policy: Policy) -> tuple[Foreseen, ...]:
    """What it foresaw along a run x (steps + 1, nx), which is answered again up to the last moment; none where it foresees
    nothing. Each moment stands where what the one before has foreseen ends.
    """
    out: list[Foreseen] = []
    made, wanted = int(np.isfinite(x).all(axis=1).sum()), 0
    memory = controller.start(x[:1])
    for k in range(made):
        row = x[k : k + 1]
        memory = controller.advance(row, memory) if k else memory
        if len(out) == MOMENTS or controller.over(row, memory)[0] or not controller.keeps(row, memory)[0]:
            break
        controller.respond(row, memory, policy, k=k)
        if k < wanted:
            continue
        if (found := controller.predicted(x[k], memory)) is None:
            break
        # Angles as the picture has them: in the range of the set to stay in.
        shift = turned(controller.goal.stay, row)[0] - x[k]
        out.append(Foreseen(k, *(np.asarray(part) + shift for part in found)))
        wanted = k + max(1, len(found[0]) - 1)
    return tuple(out)
