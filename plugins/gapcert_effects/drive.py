"""What lies between a drive and its coordinate: teeth, play, and wheels that slip."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, final

import gapcert as gc
from gapcert_effects.thresholds import THRESHOLDS

from .shared.experiments import FREE_DECAY, LEVELS, PLACES, SMALL_AND_LARGE
from .shared.law import Law
from .shared.sites import NEVER, driven, placed, spread, straight

_KEPT = "min(max({memory} - {f}, -{width}), {width})"


@final
class Cogging(Law):
    """f = A·sin(2π·q/p + φ): teeth and magnets."""

    name = "cogging"
    site = "coordinate"
    parameters = (
        gc.plugin.EffectParameter("amplitude", {"force": 1}, (0.1,), -3.0, 3.0),
        # A period that is wrong by p²/range is out of step at one end: slopes need steps far below that.
        gc.plugin.EffectParameter("period", {"position_range": 1}, (0.2,), 0.02, 1 / THRESHOLDS.min_turns, off=1.0, step=2e-4),
        gc.plugin.EffectParameter("phase", {"angle": 1}, (0.1,), -10.0, 10.0),
    )
    equation = "f = amplitude·sin(2π·q/period + phase)"
    adds: ClassVar = {"force": "{amplitude}*sin(2*pi*{q}/{period} + {phase})"}
    where = (placed,)
    signature = "slow motion is uneven in a pattern that belongs to places, and rest is preferred at some of them"
    experiment = "move slowly and evenly over the whole range: the pattern is that of the place, not of the time"
    amplitude = "amplitude"
    family = "cogging"
    rivals: ClassVar = {"cubic-spring": PLACES, "coulomb-friction": PLACES, "linear-spring": PLACES}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        """Periods half a turn apart at the ends of the range, so that one of them lies on the slope of every needle."""
        force, reach = 0.1 * scales["force"], scales["position_range"]
        turns = [THRESHOLDS.min_turns * 1.05 + 0.5 * k for k in range(round(2 * (THRESHOLDS.max_turns - THRESHOLDS.min_turns)))]
        return [(force, reach / n, phase) for n in turns for phase in (0.0, 0.5 * math.pi)]

    def canonical(self, values: Mapping[str, float]) -> dict[str, float]:
        """A positive amplitude, and a phase within half a turn."""
        phase = values["phase"] + (math.pi if values["amplitude"] < 0 else 0.0)
        turned = math.remainder(phase, 2 * math.pi)
        return {**values, "amplitude": abs(values["amplitude"]), "phase": turned}


@final
class Backlash(Law):
    """The applied force F reaches the coordinate as F′, which follows once they differ by w: F′⁺ = clip(F′, F ± w)."""

    name = "backlash"
    site = "coordinate"
    parameters = (gc.plugin.EffectParameter("width", {"force": 1}, (0.05, 0.3), 0.0, 3.0),)
    equation = "F′ follows the applied F at a distance of at most width"
    memory = gc.plugin.Memory("{width}_passed", "{force}", f"{{f}} + {_KEPT}")
    adds: ClassVar = {"force": _KEPT}
    where = (driven,)
    signature = "the response lags by a constant difference of the input, after every reversal anew, however slow it is"
    experiment = "reverse the input slowly and often, at small and at large amplitude, and hold it after each reversal"
    family = "play"
    stage = 1
    rivals: ClassVar = {
        "input-dead-zone": "reverse the input away from zero: play stays there, a dead zone does not",
        "input-lag": "reverse slowly, then fast: the width of the loop is that of play at any speed",
        "input-delay": "reverse slowly, then fast: the width of the loop is that of play at any speed",
        "coulomb-friction": FREE_DECAY,
    }

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(w * scales["force"],) for w in spread(0.02, 1.2, 9)]


@final
class WheelSlip(Law):
    """F′ = F_t·tanh(F/F_t): the ground takes small forces whole, and never more than the traction."""

    name = "wheel-slip"
    site = "coordinate"
    parameters = (gc.plugin.EffectParameter("traction", {"force_peak": 1}, (0.3, 0.8), 0.02, 5.0, off=NEVER),)
    equation = "F′ = traction·tanh(F/traction) of the applied F"
    adds: ClassVar = {"force": "{traction}*tanh({f}/{traction}) - {f}"}
    where = (driven, straight)
    signature = "hard acceleration and braking are weaker than commanded, gentle ones are right"
    experiment = SMALL_AND_LARGE
    family = "limit"
    stage = 2
    rivals: ClassVar = {"input-saturation": SMALL_AND_LARGE, "input-gain": LEVELS, "quadratic-drag": FREE_DECAY}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(t * scales["force_peak"],) for t in spread(0.05, 3.0, 10)]
