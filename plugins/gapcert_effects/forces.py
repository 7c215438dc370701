"""Forces at a coordinate that are no friction: springs, couplings, weight, what a drive does to its force, and pushes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, final

import numpy as np

import gapcert as gc
from gapcert.plugin import Array, EffectParameter, Extension, Memory
from gapcert_effects.thresholds import THRESHOLDS

from .experiments import BOTH_WAYS, FREE_DECAY, LEVELS, PLACES, REVERSALS, SHAKE_AND_HOLD, SMALL_AND_LARGE, VARY_SPEED
from .law import NEVER, Law, carries, driven, linked, moves, neighbour, placed, spread, straight, tilts, wheels


@final
class ConstantForce(Law):
    """f = F."""

    name = "constant-force"
    parameters = (EffectParameter("force", {"force": 1}, (-0.1, 0.1), -3.0, 3.0),)
    equation = "f = force"
    adds: ClassVar = {"force": "{force}"}
    signature = "equilibria are shifted, whatever the direction of motion"
    experiment = BOTH_WAYS
    amplitude = "force"
    family = "constant"
    equivalent: ClassVar = {
        "input-offset": "where one input is the force at one coordinate",
        "gravity-tilt": "at a coordinate that moves along a line, and carries nothing that swings",
    }
    rivals: ClassVar = {
        "viscous-friction": BOTH_WAYS,
        "coulomb-friction": BOTH_WAYS,
        "asymmetric-coulomb-friction": BOTH_WAYS,
        "quadratic-drag": BOTH_WAYS,
        "gravity-tilt": FREE_DECAY,
        "input-gain": LEVELS,
        "sensor-bias": PLACES,
    }


@final
class GravityTilt(Law):
    """Gravity turned by φ: what rests on q feels q − φ; along a line all masses feel 9.80665·sin φ."""

    name = "gravity-tilt"
    parameters = (EffectParameter("angle", {"angle": 1}, (-0.1, 0.1), -0.8, 0.8, plausible=(-0.3, 0.3)),)
    equation = "weight(q − angle) instead of weight(q); along a line + mass·9.80665·sin(angle)"
    adds: ClassVar = {"tilt": "{angle}"}
    where = (tilts,)
    signature = "the equilibrium is turned, and swings about it are not"
    experiment = FREE_DECAY
    amplitude = "angle"
    family = "tilt"
    equivalent: ClassVar = {
        "sensor-bias": "at an angle that only gravity pulls back",
        "constant-force": "at a coordinate that moves along a line, and carries nothing that swings",
    }
    rivals: ClassVar = {"constant-force": FREE_DECAY, "sensor-bias": PLACES, "linear-spring": PLACES}


@final
class Payload(Law):
    """A point mass at the coordinate's point p(q): M + m·JᵀJ, its weight and its centrifugal force, with J = ∂p/∂q."""

    name = "payload"
    parameters = (EffectParameter("mass", {"mass": 1}, (0.03, 0.2, 0.6), 0.0, 10.0),)
    equation = "M + mass·JᵀJ, force + mass·Jᵀ·(gravity − J̇·v), J = ∂point/∂q"
    adds: ClassVar = {"payload": "{mass}"}
    where = (carries,)
    signature = "it is slower and heavier, by an inertia and a weight that belong together"
    experiment = SHAKE_AND_HOLD
    family = "payload"
    equivalent: ClassVar = {"parameter": "along a level line, where the model has one mass"}
    rivals: ClassVar = {"parameter": SHAKE_AND_HOLD, "input-gain": FREE_DECAY, "linear-spring": SHAKE_AND_HOLD}


@final
class LinearSpring(Law):
    """f = −k·q."""

    name = "linear-spring"
    parameters = (
        EffectParameter("stiffness", {"force": 1, "position": -1}, (0.03, 0.3), -30.0, 30.0, plausible=(0.0, float("inf"))),
    )
    equation = "f = −stiffness·q"
    adds: ClassVar = {"force": "-{stiffness}*{q}"}
    where = (placed,)
    signature = "the frequency of oscillations is wrong, and more force is needed the farther out it is held"
    experiment = PLACES
    amplitude = "stiffness"
    family = "spring"
    rivals: ClassVar = {"cubic-spring": PLACES, "constant-force": PLACES, "parameter": SHAKE_AND_HOLD, "gravity-tilt": PLACES}


@final
class CubicSpring(Law):
    """f = −k·q³: hardening for k > 0, softening for k < 0."""

    name = "cubic-spring"
    parameters = (EffectParameter("stiffness", {"force": 1, "position": -3}, (0.03, 0.3), -30.0, 30.0),)
    equation = "f = −stiffness·q³"
    adds: ClassVar = {"force": "-{stiffness}*{q}**3"}
    where = (placed,)
    signature = "the frequency of oscillations changes with their amplitude"
    experiment = PLACES
    amplitude = "stiffness"
    family = "cubic"
    rivals: ClassVar = {"linear-spring": PLACES, "quadratic-drag": PLACES, "cogging": PLACES}


@final
class JointCoupling(Law):
    """f = −c·v_other: what moves the neighbouring coordinate also drags at this one."""

    name = "joint-coupling"
    parameters = (EffectParameter("coefficient", {"force": 1, "velocity": -1}, (-0.1, 0.1), -30.0, 30.0),)
    equation = "f = −coefficient·v of the next coordinate of the same unit (of the one before, at the last)"
    signature = "the coordinate is pushed when its neighbour moves, whatever it does itself"
    experiment = "move the neighbouring coordinate alone, fast and slowly, while this one is held by its drive"
    where = (neighbour,)
    amplitude = "coefficient"
    family = "coupling"
    rivals: ClassVar = {"viscous-friction": VARY_SPEED, "parameter": FREE_DECAY, "constant-force": BOTH_WAYS}

    def extension(self, site: str, model: gc.Model) -> Extension:
        (c,) = self.named(site, model)
        return Extension(self.name, site, (c,), force=f"-{c.name}*{neighbour(site, model)}_dot")


# A period that is wrong by p²/range is out of step at one end: slopes need steps far below that.
_PERIOD = EffectParameter(
    "period", {"position_range": 1}, (0.2,), 1 / THRESHOLDS.finest_turns, 1 / THRESHOLDS.min_turns, off=1.0, step=2e-4
)
_WAVES = tuple(
    EffectParameter(f"{name}_{k}", dimension, starts, low, high)
    for k in (1, 2, 3)
    for name, dimension, starts, low, high in (
        ("amplitude", {"force": 1}, (0.1 / k,), -3.0, 3.0),
        ("phase", {"angle": 1}, (0.1,), -10.0, 10.0),
    )
)


def _map(order: str) -> str:
    """Three waves, of which the k-th has k·order periods in one of the parameter."""
    waves = (f"{{amplitude_{k}}}*sin({k}*{order}*2*pi*{{q}}/{{period}} + {{phase_{k}}})" for k in (1, 2, 3))
    return " + ".join(waves)


class _Map(Law):
    """What forms of cogging share that repeat themselves with more than one wave."""

    variant_of = "cogging"
    parameters = (_PERIOD, *_WAVES)
    where = (placed, moves)
    signature = "slow motion is uneven in a pattern of places, which repeats itself and is no plain wave"
    experiment = "move slowly and evenly over the whole range: the pattern is that of the place, not of the time"
    family = "cogging"
    rivals: ClassVar = {"cubic-spring": PLACES, "coulomb-friction": PLACES, "linear-spring": PLACES}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        """Few and long periods, half a turn apart at the ends of the range: of short ones the strongest wave is found first."""
        waves = [p.starts[0] * p.scale(scales) for p in _WAVES]
        return [(scales["position_range"] / (1.05 * THRESHOLDS.min_turns + 0.5 * k), *waves) for k in range(11)]

    def canonical(self, values: Mapping[str, float]) -> dict[str, float]:
        """Positive amplitudes, and phases within half a turn."""
        out = dict(values)
        for k in (1, 2, 3):
            wave = {"amplitude": values[f"amplitude_{k}"], "phase": values[f"phase_{k}"]}
            out |= {f"{n}_{k}": v for n, v in _turned(wave).items()}
        return out


@final
class CoggingOvertones(_Map):
    """f = Σ Aₖ·sin(2πk·q/p + φₖ), k = 1, 2, 3."""

    name = "cogging-overtones"
    equation = "f = Σ amplitude_k·sin(2π·k·q/period + phase_k), k = 1, 2, 3"
    adds: ClassVar = {"force": _map("1")}
    contains: ClassVar = {"cogging": {"period": "period", "amplitude_1": "amplitude", "phase_1": "phase"}}


@final
class CoggingHalves(_Map):
    """f = Σ Aₖ·sin(πk·q/p + φₖ), k = 1, 2, 3: the second wave, which may be the strongest, has the period p."""

    name = "cogging-halves"
    equation = "f = Σ amplitude_k·sin(π·k·q/period + phase_k), k = 1, 2, 3"
    adds: ClassVar = {"force": _map("0.5")}
    contains: ClassVar = {"cogging": {"period": "period", "amplitude_2": "amplitude", "phase_2": "phase"}}


@final
class Cogging(Law):
    """f = A·sin(2π·q/p + φ): teeth and magnets."""

    name = "cogging"
    parameters = (
        EffectParameter("amplitude", {"force": 1}, (0.1,), -3.0, 3.0),
        _PERIOD,
        EffectParameter("phase", {"angle": 1}, (0.1,), -10.0, 10.0),
    )
    equation = "f = amplitude·sin(2π·q/period + phase)"
    adds: ClassVar = {"force": "{amplitude}*sin(2*pi*{q}/{period} + {phase})"}
    where = (placed, moves)
    signature = "slow motion is uneven in a pattern that belongs to places, and rest is preferred at some of them"
    experiment = "move slowly and evenly over the whole range: the pattern is that of the place, not of the time"
    amplitude = "amplitude"
    family = "cogging"
    variants = (CoggingOvertones, CoggingHalves)
    rivals: ClassVar = {"cubic-spring": PLACES, "coulomb-friction": PLACES, "linear-spring": PLACES}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        """Periods half a turn apart at the ends of the range, so that one of them lies on the slope of every needle."""
        force, reach = 0.1 * scales["force"], scales["position_range"]
        turns = [THRESHOLDS.min_turns * 1.05 + 0.5 * k for k in range(round(2 * (THRESHOLDS.max_turns - THRESHOLDS.min_turns)))]
        return [(force, reach / n, phase) for n in turns for phase in _PHASES]

    def suggested(self, place: Array, force: Array) -> list[tuple[float, ...]]:
        """The periods beyond these at which parts of the data agree, as far as their samples lie close enough.

        With F the sum of force·exp(2πi·place/period) over each of some parts, |Σ F|² is Σ |F|² where their phases are chance,
        and as many times that as there are parts where they are one.
        """
        if len(place) < THRESHOLDS.agreeing_parts or not np.isfinite(force).all():
            return []
        turns, power, chance = _periodogram(place, force)
        stride = 2 * float(np.quantile(np.abs(np.diff(place)), 0.9))
        tried = (turns > THRESHOLDS.max_turns) & (turns * stride < np.ptp(place)) & (turns < THRESHOLDS.finest_turns)
        agreed = np.where(tried, power / np.maximum(chance, 1e-300), 0.0)
        found: list[float] = []
        while len(found) < THRESHOLDS.outstanding and agreed.max() > THRESHOLDS.agreeing:
            found.append(float(turns[np.argmax(agreed)]))
            agreed[np.abs(turns - found[-1]) < 2.0] = 0.0
        size, reach = float(np.sqrt(2.0) * np.std(force)), float(np.ptp(place))
        return [(size, reach / (n + d), phase) for n in found for d in _BESIDE for phase in _PHASES]

    def canonical(self, values: Mapping[str, float]) -> dict[str, float]:
        """A positive amplitude, and a phase within half a turn."""
        return {**values, **_turned(values)}


def _turned(wave: Mapping[str, float]) -> dict[str, float]:
    phase = wave["phase"] + (math.pi if wave["amplitude"] < 0 else 0.0)
    return {"amplitude": abs(wave["amplitude"]), "phase": math.remainder(phase, 2 * math.pi)}


_PHASES = (0.0, 0.5 * math.pi)
_BESIDE = (-1.0, -0.25, 0.0, 0.25, 1.0)  # periods over the range: side lobes are one apart


def _periodogram(place: Array, force: Array) -> tuple[Array, Array, Array]:
    """Periods over the range, an eighth apart; |Σ F|² and Σ |F|² over parts of the data, in the order of time."""
    parts, bins, n = THRESHOLDS.agreeing_parts, 4 * THRESHOLDS.finest_turns, len(place)
    at = np.minimum(((place - place.min()) / np.ptp(place) * bins).astype(np.intp), bins - 1)
    sums = np.bincount(np.arange(n) * parts // n * bins + at, force - force.mean(), minlength=parts * bins)
    each = np.fft.rfft(sums.reshape(parts, bins), 8 * bins, axis=1)
    return np.arange(each.shape[1]) / 8, np.abs(each.sum(axis=0)) ** 2, np.sum(np.abs(each) ** 2, axis=0)


_KEPT = "min(max({memory} - {f}, -{width}), {width})"


@final
class Backlash(Law):
    """The applied force F reaches the coordinate as F′, which follows once they differ by w: F′⁺ = clip(F′, F ± w)."""

    name = "backlash"
    parameters = (EffectParameter("width", {"force": 1}, (0.05, 0.3), 0.0, 3.0),)
    equation = "F′ follows the applied F at a distance of at most width"
    memory = Memory("{width}_passed", "{force}", f"{{f}} + {_KEPT}")
    adds: ClassVar = {"force": _KEPT}
    where = (linked,)
    equivalent: ClassVar = {"input-hysteresis": "where one input is the force at one coordinate"}
    signature = "the response lags by a constant difference of the input, after every reversal anew, however slow it is"
    experiment = "reverse the input slowly and often, at small and at large amplitude, and hold it after each reversal"
    family = "play"
    stage = 1
    rivals: ClassVar = {
        "input-dead-zone": REVERSALS,
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
    parameters = (EffectParameter("traction", {"force_peak": 1}, (0.3, 0.8), 0.02, 5.0, off=NEVER),)
    equation = "F′ = traction·tanh(F/traction) of the applied F"
    adds: ClassVar = {"force": "{traction}*tanh({f}/{traction}) - {f}"}
    where = (driven, straight, moves)
    signature = "hard acceleration and braking are weaker than commanded, gentle ones are right"
    experiment = SMALL_AND_LARGE
    family = "limit"
    stage = 2
    equivalent: ClassVar = {"input-saturation": "where one input is the force that the ground takes"}
    rivals: ClassVar = {"input-saturation": SMALL_AND_LARGE, "input-gain": LEVELS, "quadratic-drag": FREE_DECAY}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(t * scales["force_peak"],) for t in spread(0.05, 3.0, 10)]


class _Slip(Law):
    """A base that rolls along its heading also moves sideways, by `sideways` of its speed `{v}` and rate of turning `{w}`."""

    name = "side-slip"
    sideways: ClassVar[str]
    where = (wheels,)
    signature = "paths are right while the base drives straight, and bend too much or too little in turns"
    experiment = "drive circles of several radii at several speeds, in both directions"
    family = "slip"

    def extension(self, site: str, model: gc.Model) -> Extension:
        (number,), rates = self.named(site, model), model.text()["derivative"]
        y, heading = wheels(site, model) or (site, site)
        ahead = f"(({rates[site]})*cos({heading}) + ({rates[y]})*sin({heading}))"
        aside = self.sideways.format(number=number.name, v=ahead, w=f"({rates[heading]})")
        forces = {site: f"-({aside})*sin({heading})", y: f"({aside})*cos({heading})"}
        return Extension(self.name, site, (number,), forces=forces)


@final
class ShiftedAxle(_Slip):
    """Sideways d·ω: the point that the log follows lies d ahead of the axle about which the base turns."""

    name = "side-slip-of-a-shifted-axle"
    variant_of = "side-slip"
    parameters = (EffectParameter("ahead", {"velocity": 1}, (-0.02, 0.02), -1.0, 1.0),)
    equation = "sideways speed ahead·ω"
    sideways = "{number}*{w}"
    amplitude = "ahead"


@final
class SideSlip(_Slip):
    """Sideways −c·v·|v|·ω: tyres slip by an angle in proportion to the acceleration across them, v·ω."""

    parameters = (
        EffectParameter("compliance", {"force": -1, "time": 1}, (-0.1, 0.1), -3.0, 3.0, plausible=(0.0, float("inf"))),
    )
    equation = "sideways speed −compliance·v·|v|·ω"
    sideways = "-{number}*{v}*abs({v})*{w}"
    amplitude = "compliance"
    variants = (ShiftedAxle,)
    rivals: ClassVar = {"input-gain": LEVELS, "sensor-bias": PLACES}


@final
class ExternalPush(Law):
    """f = F for t₀ ≤ t < t₀ + T, as its exact mean over each sub-step, so that t₀ and T have slopes."""

    name = "external-push"
    parameters = (
        EffectParameter("force", {"force": 1}, (-0.5, 0.5), -30.0, 30.0),
        EffectParameter("time", {"time": 1}, (1.0,), float("-inf"), float("inf"), step=0.02),
        EffectParameter("duration", {"time": 1}, (0.1, 0.4), 1e-3, float("inf"), off=1.0, step=0.05, longest=1.0),
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
