"""Constant gap functions: the smallest that samples and constants certify, and one that a person declares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, GapFamily, GapFunction, GapProblem, Interval, Pulse, UsageError, supremum
from gapcert_bounds.constants.declared_constants import named

from .envelope import Envelope
from .multilinear import made


@final
class ConstantGap(GapFunction):
    """γ_i on all of Z, and [−γ_i, γ_i]. value (nx,)."""

    def __init__(self, value: Array, family: str = "constant") -> None:
        if not np.isfinite(value).all():
            raise UsageError(f"gap: γ = {value.tolist()} is no bound: it is beyond what floats hold; narrow the domain")
        self.value, self.family = value, family

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
        self.predictor = made(predictor)

    def fit(self, problem: GapProblem) -> ConstantGap:
        if problem.route == "theorem1":
            largest = np.abs(problem.samples.r).max(axis=0)
            return ConstantGap(np.asarray((Interval.exact(largest) + Interval.exact(problem.margin)).hi))
        upper, _ = supremum(Envelope().fit(problem), problem.domain, pulse=Pulse(problem.emit, "fit", unit="boxes"))
        return ConstantGap(upper)


@final
class Declared(GapFamily):
    """Family `declared`: γ_i is what a person says, by name of the state and in its unit. Nothing is fitted."""

    name = "declared"
    routes = ("declared",)

    def __init__(self, gamma: Mapping[str, float]) -> None:
        self.gamma = gamma

    def fit(self, problem: GapProblem) -> ConstantGap:
        return self.stated([a.name for a in problem.domain.states.axes])

    def stated(self, states: Sequence[str]) -> ConstantGap:
        gamma = named(self.gamma, list(states), "gap.gamma", "state")
        return ConstantGap(np.array(list(gamma.values()), dtype=np.float64), self.name)
