"""A controller without cells: feedback to the middle of the set to stay in, with a box that it keeps and a tube of boxes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from pydantic import BaseModel, ConfigDict

from gapcert import Component, Controller, Goal, SynthesisProblem, UsageError
from gapcert.contracts.plugins import registry as components
from gapcert.contracts.plugins.registry import Registry
from gapcert.plugin import Synthesizer
from gapcert_cells import loading, write_saved

SPEC: dict[str, Any] = {
    "version": 1,
    "name": "held",
    "model": {
        "kind": "equations",
        "states": {"x": "m", "y": "m"},
        "inputs": {"u": "m/s", "v": "m/s"},
        "next": {"x": "x + h*u", "y": "y + h*v"},
        "period": "100 ms",
    },
    "domain": {"x": [0, 1], "y": [0, 1], "u": [-1, 1], "v": [-1, 1]},
    "sampling": {"kind": "adaptive", "budget": 200, "executor": "threads"},
    "lipschitz": {"residual": {"kind": "interval"}},
    "gap": {"kind": "envelope"},
    "certificate": {"claim": "deterministic"},
    "controller": {"kind": "feedback", "gain": 2.0, "goal": {"invariance": {"x": [0.1, 0.9], "y": [0.2, 0.6]}}},
    "closed_loop": {"steps": 40, "starts": 12, "policies": ["first"], "starts_from": "without_gamma"},
    "report": {"rerun": False},
}
SPEC["backend"] = SPEC["model"] | {"next": {"x": "x + 0.9*h*u + 0.02*y", "y": "y + h*v - 0.01*x"}}


class FeedbackConfig(BaseModel):
    """How fast it goes to the middle, in 1/s."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["feedback"] = "feedback"
    gain: float


@dataclass(frozen=True, eq=False)
class FeedbackController(Controller):
    """u = −gain (x − c): x⁺ − c ∈ a (x − c) ± γ with a = 1 − τ gain, so |x − c| ≤ r is kept where a r + γ ≤ r.

    A plan is N steps long, and made anew every third step only. Memory: the steps so far.
    """

    goal: Goal
    gain: float
    shrink: float
    gamma: np.ndarray
    radius: np.ndarray
    evidence: Mapping[str, Any]
    kind: str = "feedback"
    horizon: int = 6
    every: int = 3

    @property
    def centre(self) -> np.ndarray:
        return np.add(self.goal.stay.low, self.goal.stay.high) / 2

    @property
    def policies(self) -> tuple[Any, ...]:
        return ("first",)

    @property
    def resolution(self) -> int:
        return 24

    def contains(self, x: np.ndarray) -> np.ndarray:
        return np.asarray((np.abs(np.asarray(x) - self.centre) <= self.radius).all(axis=1))

    def act(self, x: np.ndarray, policy: Any, seed: int = 0, k: int = 0) -> np.ndarray:
        if not self.contains(x).all():
            raise UsageError("controller: a row is outside its domain; ask `contains` before `act`")
        return np.asarray(-self.gain * (np.asarray(x) - self.centre))

    def advance(self, x: np.ndarray, memory: np.ndarray) -> np.ndarray:
        return memory + 1

    def fallbacks(self, memory: np.ndarray) -> np.ndarray:
        return memory - memory // self.every

    def predicted(self, x: np.ndarray, memory: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        steps = self.horizon - (0 if memory is None else int(memory[0]) % self.every)
        power = self.shrink ** np.arange(steps + 1)[:, None]
        centre = self.centre + power * (x - self.centre)
        half = self.gamma * (1 - power) / (1 - self.shrink) * (1 + 1e-12)
        return centre, centre - half, centre + half

    def save(self, folder: Path) -> None:
        data = {"kind": self.kind, "goal": self.goal.to_data(), "evidence": dict(self.evidence), "gain": self.gain}
        write_saved(folder, data | {"shrink": self.shrink}, {"gamma": self.gamma, "radius": self.radius})

    @classmethod
    def load(cls, folder: Path) -> FeedbackController:
        with loading(folder) as (data, arrays):
            goal = Goal.from_data(data["goal"])
            return cls(goal, data["gain"], data["shrink"], arrays["gamma"], arrays["radius"], data["evidence"])


class Feedback(Synthesizer):
    """Of x⁺ ∈ x + τ u ± γ̄, γ̄ the supremum of γ on Z."""

    name = "feedback"

    def __init__(self, gain: float) -> None:
        self.gain = gain

    def synthesize(self, problem: SynthesisProblem) -> FeedbackController:
        stay, tau, n = problem.goal.stay, problem.model.period, problem.model.nx
        gamma = np.zeros(n) if problem.gap is None else problem.gap.gamma_over(problem.domain.interval)[0]
        half = np.subtract(stay.high, stay.low) / 2
        radius = np.minimum(half, np.asarray(problem.domain.inputs.high) / self.gain)
        told = dict(problem.basis)
        if (weak := gamma * (1 + 1e-9) > tau * self.gain * radius).any():
            i = int(np.argmax(weak))
            told["reason"] = f"γ of {stay.names[i]} is {gamma[i]:.3g}, and a step takes back {tau * self.gain * radius[i]:.3g}"
            radius = np.full(n, -1.0)
        told["domain_fraction"] = float(np.prod(np.maximum(radius, 0) / half))
        return FeedbackController(problem.goal, self.gain, 1 - tau * self.gain, gamma, radius, told)


FEEDBACK = Component(
    "synthesizer",
    "feedback",
    "feedback to the middle",
    "feedback:Feedback",
    "feedback:FeedbackConfig",
    controller="feedback:FeedbackController",
)


def declared(monkeypatch: pytest.MonkeyPatch, *more: Component) -> None:
    """As if plugins declared these too; a component of theirs takes the place of one with its name."""
    known = components.installed()
    whole = known.components | {(c.kind, c.name): c for c in more}
    made = Registry(whole.values(), (), known.manager)
    monkeypatch.setattr(components, "installed", lambda: made)
