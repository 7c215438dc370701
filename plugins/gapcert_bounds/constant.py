"""The smallest constant that samples and constants certify."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import GapFamily, GapFunction, GapProblem, Interval, supremum
from gapcert_bounds.envelope import Envelope

Array = npt.NDArray[np.float64]


@final
class ConstantGap(GapFunction):
    """γ_i on all of Z, and [−γ_i, γ_i]. value (nx,)."""

    family = "constant"

    def __init__(self, value: Array) -> None:
        self.value = value

    def interval(self, z: Array) -> tuple[Array, Array]:
        high = np.broadcast_to(self.value, (len(z), len(self.value))).copy()
        return -high, high

    def interval_over(self, boxes: Interval) -> Interval:
        return Interval(*self.interval(boxes.lo))

    def lipschitz(self, boxes: Interval) -> Array:
        return np.zeros((len(boxes.lo), len(self.value), boxes.lo.shape[1]))

    def arrays(self) -> dict[str, Array]:
        return {"gamma": self.value}

    @property
    def form(self) -> Mapping[str, Any]:
        return {"form": "constant"}


@final
class Constant(GapFamily):
    """Family `constant`. Route dominate: sup_Z max(|l_i|, |u_i|) of the envelope; theorem1: max_k |r_ki| + margin_i."""

    name = "constant"
    routes = ("dominate", "theorem1")
    extremes = True

    def __init__(self, predictor: Any = "none") -> None:
        self.predictor = predictor

    def fit(self, problem: GapProblem) -> ConstantGap:
        if problem.route == "theorem1":
            largest = np.abs(problem.samples.r).max(axis=0)
            return ConstantGap(np.asarray((Interval.exact(largest) + Interval.exact(problem.margin)).hi))
        upper, _ = supremum(Envelope().fit(problem), problem.domain)
        return ConstantGap(upper)
