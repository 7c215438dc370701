"""Things that happen once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, final

import gapcert as gc
from gapcert_effects.thresholds import THRESHOLDS

from .shared.experiments import BOTH_WAYS
from .shared.law import Law


@final
class ExternalPush(Law):
    """f = F for t₀ ≤ t < t₀ + T, as its exact mean over each sub-step, so that t₀ and T have slopes."""

    name = "external-push"
    site = "coordinate"
    parameters = (
        gc.plugin.EffectParameter("force", {"force": 1}, (-0.5, 0.5), -30.0, 30.0),
        gc.plugin.EffectParameter("time", {"time": 1}, (1.0,), float("-inf"), float("inf"), step=0.02),
        gc.plugin.EffectParameter("duration", {"time": 1}, (0.1, 0.4), 1e-3, 10.0, off=1.0, step=0.05),
    )
    equation = "f = force while time ≤ t < time + duration"
    adds: ClassVar = {"force": "{force}*max(0, min({t} + {h}, {time} + {duration}) - max({t}, {time}))/{h}"}
    signature = "the error starts at one moment, and only what follows from it remains afterwards"
    experiment = "repeat the same run: a push does not come back, a law does"
    amplitude = "force"
    family = "push"
    rivals: ClassVar = {"constant-force": BOTH_WAYS, "coulomb-friction": "repeat the same run: a push does not come back"}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        """Side by side over the whole recording, each as long as its distance to the next."""
        width = max(0.1, scales["duration"] / THRESHOLDS.push_starts)
        count = max(1, int(scales["duration"] / width))
        return [(0.5 * scales["force"], scales["start"] + k * width, width) for k in range(count)]
