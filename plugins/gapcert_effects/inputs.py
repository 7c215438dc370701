"""Faults on the way of an input, in the order of that way, from delay to limit."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import ClassVar, final

import numpy as np

import gapcert as gc
from gapcert.plugin import EffectParameter, Extension, Memory, site_units
from gapcert_effects.thresholds import THRESHOLDS

from .experiments import BOTH_WAYS, FAST, FREE_DECAY, LEVELS, REVERSALS, SECOND, SMALL_AND_LARGE
from .law import NEVER, Law, graded, spread, times


def _lagging(target: str) -> tuple[str, str]:
    """(mean over a sub-step, end) of ż = (target − z)/time_constant from z = memory, exact for a constant target."""
    # The bound only keeps the exponent finite where the time is zero; there the share time/h of the mean is zero.
    decay = "exp(-{h}/max({time_constant}, 0.001*{h}))"
    share = f"(1 - {decay})*{{time_constant}}/{{h}}"
    return f"{{memory}}*{share} + {target}*(1 - {share})", f"{{memory}}*{decay} + {target}*(1 - {decay})"


def _kept(text: str) -> str:
    """Its placeholders pass one more round of formatting."""
    return text.replace("{", "{{").replace("}", "}}")


def _edge(name: str) -> EffectParameter:
    return EffectParameter(name, {"input_peak": 1}, (0.05, 0.3), -0.6, 1.0)


def _time_constant(*starts: float, name: str = "time_constant") -> EffectParameter:
    return EffectParameter(name, {"period": 1}, starts, 0.0, float("inf"), longest=THRESHOLDS.slowest_lag)


_RATE = EffectParameter("rate", {"input_rate": 1, "time": -1}, (0.3, 1.5), 1e-4, 1e5, off=NEVER)
_MOVED = "min(max({u} - {memory}, -{rate}*{h}), {rate}*{h})"
"""By how much a ramp of limited rate comes nearer in a sub-step."""
_ARRIVED, _DRAINED = _lagging("{u}"), _lagging("abs({u})")


@final
class InputDelay(Law):
    """u acts T seconds late, as its exact mean over each period."""

    name = "input-delay"
    site = "input"
    parameters = (
        EffectParameter(
            "delay", {"period": 1}, (0.6, 2.0, 5.0), 0.0, THRESHOLDS.latest_periods, longest=THRESHOLDS.latest_input
        ),
    )
    equation = "u(t − delay) acts"
    adds: ClassVar = {"delay": "{delay}"}
    signature = "the response to fast inputs lags, the response to slow ones is right"
    experiment = FAST
    family = "late"
    stage = 10
    equivalent: ClassVar = {"sensor-delay": "where every measured output comes equally late, and no other input acts"}
    rivals: ClassVar = {"input-lag": FAST, "sensor-delay": SECOND, "input-rate-limit": SMALL_AND_LARGE, "backlash": FAST}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(t,) for t in times(self.parameters[0], scales)]


class _TwoEdges(Law):
    """What forms of the dead zone with an edge for each direction share."""

    variant_of = "input-dead-zone"
    site = "input"
    experiment = SMALL_AND_LARGE
    family = "dead-zone"
    stage = 20
    contains: ClassVar = {"input-dead-zone": {"minus": "width", "plus": "width"}}
    rivals: ClassVar = {"input-offset": SMALL_AND_LARGE, "input-nonlinearity": LEVELS, "backlash": REVERSALS}


@final
class UnevenDeadZone(_TwoEdges):
    """u acts as u − clip(u, −w₋, w₊); an edge below zero lies on the other side of it."""

    name = "input-dead-zone-uneven"
    parameters = (_edge("minus"), _edge("plus"))
    equation = "u − clip(u, −minus, plus) acts"
    adds: ClassVar = {"input": "{u} - min(max({u}, -{minus}), {plus})"}
    signature = "small inputs do nothing, in one direction up to a larger one than in the other"

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        edges, sides = spread(0.05, 1.0, 5), ((1.0, 1.0), (1.0, 0.3), (0.3, 1.0), (1.0, 0.0), (0.0, 1.0))
        return [(a * w * scales["input"], b * w * scales["input"]) for w, (a, b) in itertools.product(edges, sides)]


@final
class BentDeadZone(_TwoEdges):
    """u acts as max(u − w₊, 0) + ratio·min(u + w₋, 0): beyond its edges a valve may open more in one direction."""

    name = "input-dead-zone-bent"
    parameters = (_edge("minus"), _edge("plus"), EffectParameter("ratio", {}, (0.6, 1.6), 0.05, 20.0, off=1.0))
    equation = "max(u − plus, 0) + ratio·min(u + minus, 0) acts"
    adds: ClassVar = {"input": "max({u} - {plus}, 0) + {ratio}*min({u} + {minus}, 0)"}
    signature = "small inputs do nothing, and larger ones act more strongly in one direction than in the other"

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(*edges, ratio) for edges in UnevenDeadZone().grid(scales)[::2] for ratio in (0.6, 1.6)]


@final
class InputDeadZone(Law):
    """u acts as u − clip(u, ±w)."""

    name = "input-dead-zone"
    site = "input"
    parameters = (EffectParameter("width", {"input_peak": 1}, (0.05, 0.3), 0.0, 1.0),)
    equation = "u − clip(u, ±width) acts"
    adds: ClassVar = {"input": "{u} - min(max({u}, -{width}), {width})"}
    signature = "small inputs do nothing, large ones act weaker by a constant"
    experiment = SMALL_AND_LARGE
    family = "dead-zone"
    stage = 20
    variants = (UnevenDeadZone, BentDeadZone)
    rivals: ClassVar = {"coulomb-friction": FREE_DECAY, "input-gain": LEVELS, "backlash": REVERSALS}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(w * scales["input"],) for w in spread(0.02, 1.2, 9)]


_STRAIGHT: Mapping[str, Mapping[str, str]] = {
    name: {} for name in ("input-nonlinearity", "input-gain", "input-offset", "input-dead-zone", "input-saturation")
}


@final
class InputCurve(Law):
    """u acts as u + c(u), c straight between knots over the range of the data, and constant outside of it."""

    name = "input-curve"
    variant_of = "input-nonlinearity"
    site = "input"
    parameters = tuple(
        EffectParameter(f"at_{k + 1}", {"input_peak": 1}, (0.03, 0.2), -3.0, 3.0) for k in range(THRESHOLDS.knots)
    )
    equation = f"u + c(u) acts, c straight between its values at {THRESHOLDS.knots} places"
    signature = "every level of the input acts as its own one, at any speed and from either side"
    experiment = LEVELS
    family = "curve"
    stage = 35
    contains: ClassVar = _STRAIGHT
    rivals: ClassVar = {"input-dead-zone": LEVELS, "input-saturation": LEVELS, "input-gain": LEVELS, "supply-sag": LEVELS}
    reach = 1.0

    def __init__(self) -> None:
        self.knots = np.linspace(-1, 1, len(self.parameters))

    def scaled(self, scales: Mapping[str, float]) -> InputCurve:
        """Knots, as shares of the peak, as far apart on either side of zero, where both are used, and over the range."""
        made, half = InputCurve(), len(self.knots) // 2
        low, high, made.reach = (scales[f"input_{end}"] for end in ("low", "high", "peak"))
        # An input that does not change has no range of its own.
        low, high = (low, high) if high - low > THRESHOLDS.little_used * made.reach else (-made.reach, made.reach)
        both = np.concatenate([np.linspace(low, 0, half, endpoint=False), np.linspace(0, high, half + 1)])
        used = min(-low, high) > THRESHOLDS.little_used * made.reach
        made.knots = np.round((both if used else np.linspace(low, high, len(self.knots))) / made.reach, 4)
        return made

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        """Curves that bend as valves and amplifiers do, on either side or on both."""
        x = self.knots
        bent = (x**2 - x, x**3 - x, np.sign(x) * np.sqrt(np.abs(x)) - x, -np.clip(x, -0.3, 0.3), np.clip(x, -0.5, 0.5) - x)
        some = [part for c in bent for part in (c, c * (x > 0), c * (x < 0)) if np.any(part)]
        return [tuple((0.5 * sign * scales["input_peak"] * c).tolist()) for c in some for sign in (1, -1)]

    def extension(self, site: str, model: gc.Model) -> Extension:
        """With the peak as a number of its own; the knots x are shares of it.

        c = (c₁ + cₙ)/2 + Σ (sₖ − sₖ₋₁)/2·|u − xₖ| of the slopes s between knots, 0 beyond: each knot names u only once.
        """
        own, places = self.named(site, model), self.knots.tolist()
        names = [p.name for p in own]
        peak = gc.Parameter(f"{names[0].removesuffix(self.parameters[0].name)}peak", self.reach, own[0].unit)
        gaps = zip(itertools.pairwise(names), itertools.pairwise(places), strict=True)
        slopes = ["0", *(f"({d} - {c})/{round(y - x, 15)!r}" for (c, d), (x, y) in gaps), "0"]
        bends = zip(itertools.pairwise(slopes), places, strict=True)
        text = "".join(f" + ({after} - {before})*abs({{u}}/{peak.name} - {x!r})/2" for (before, after), x in bends)
        return Extension(self.name, site, (*own, peak), input=f"{{u}} + ({names[0]} + {names[-1]})/2{text}")


@final
class InputNonlinearity(Law):
    """u acts as u + a·u² + b·u³."""

    name = "input-nonlinearity"
    site = "input"
    parameters = (
        EffectParameter("square", {"input_peak": -1}, (0.03, 0.2), -3.0, 3.0),
        EffectParameter("cube", {"input_peak": -2}, (0.03, 0.2), -3.0, 3.0),
    )
    equation = "u + square·u² + cube·u³ acts"
    adds: ClassVar = {"input": "{u} + {square}*{u}**2 + {cube}*{u}**3"}
    signature = "every level of the input acts as its own one, at any speed and from either side"
    experiment = LEVELS
    family = "curve"
    stage = 35
    variants = (InputCurve,)
    rivals: ClassVar = {"input-dead-zone": LEVELS, "input-saturation": LEVELS, "input-gain": LEVELS, "supply-sag": LEVELS}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        one, two = (p.scale(scales) for p in self.parameters)
        shapes = ((0.3, 0), (-0.3, 0), (0, 0.3), (0, -0.3), (0.2, 0.2), (0.2, -0.2), (-0.2, 0.2), (-0.2, -0.2))
        return [(a * one, b * two) for a, b in shapes]


_FOLLOWED = "{u} + min(max({memory} - {u}, -{width}), {width})"


@final
class InputHysteresis(Law):
    """u acts as w, which follows once the two differ by r: w⁺ = clip(w, u ± r)."""

    name = "input-hysteresis"
    site = "input"
    parameters = (EffectParameter("width", {"input_peak": 1}, (0.03, 0.2), 0.0, 1.0),)
    equation = "w acts, which follows u at a distance of at most width"
    memory = Memory("{width}_followed", "{input}", _FOLLOWED)
    adds: ClassVar = {"input": _FOLLOWED}
    signature = "a level acts otherwise when it is come to from above than from below, however slowly"
    experiment = REVERSALS
    family = "play"
    stage = 30
    equivalent: ClassVar = {"backlash": "where one input is the force at one coordinate"}
    rivals: ClassVar = {
        "input-dead-zone": REVERSALS,
        "input-nonlinearity": REVERSALS,
        "input-lag": FAST,
        "input-delay": FAST,
        "coulomb-friction": FREE_DECAY,
    }

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(w * scales["input"],) for w in spread(0.02, 0.9, 9)]


def _rates(scales: Mapping[str, float]) -> tuple[float, ...]:
    """From what the input never comes to, a fifth of its mean rate or ten ramps in all the data, to its fastest change."""
    slow = min(0.2 * scales["input_rate"], 10 * scales["input_peak"] / scales["duration"])
    return graded(slow, max(0.9 * scales["input_rate_peak"], 2 * slow))


@final
class InputRateLimit(Law):
    """u acts as r, |ṙ| ≤ R, as the exact mean of its ramp over each sub-step: r + δ·(1 − |δ|/(2Rh)), δ = clip(u − r, ±Rh)."""

    name = "input-rate-limit"
    site = "input"
    parameters = (_RATE,)
    equation = "r acts, ṙ = ±rate until r = u"
    memory = Memory("{rate}_reached", "{input}", f"{{memory}} + {_MOVED}")
    adds: ClassVar = {"input": f"{{memory}} + ({_MOVED})*(1 - abs({_MOVED})/(2*{{rate}}*{{h}}))"}
    signature = "steps become ramps, and fast large inputs come out as smaller triangles"
    experiment = SMALL_AND_LARGE
    family = "late"
    stage = 40
    rivals: ClassVar = {"input-lag": SMALL_AND_LARGE, "input-delay": SMALL_AND_LARGE, "input-saturation": FAST}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(rate,) for rate in _rates(scales)]


@final
class InputRateLimitedLag(Law):
    """u acts as r, ṙ = clip((u − r)/T, ±R), as its exact mean over each sub-step: ramp, then lag.

    The ramp takes clip(|u − r|/R − T, 0, h). A first-order servo with a rate limit: R → ∞ leaves the lag, T = 0 the rate limit.
    """

    name = "input-rate-limited-lag"
    site = "input"
    parameters = (_RATE, _time_constant(2.0, 5.0))
    equation = "r acts, ṙ = clip((u − r)/time_constant, ±rate)"
    signature = "large steps become ramps with a rounded end, small ones arrive rounded"
    experiment = SMALL_AND_LARGE
    family = "late"
    stage = 45
    contains: ClassVar = {"input-rate-limit": {"rate": "rate"}, "input-lag": {"time_constant": "time_constant"}}
    rivals: ClassVar = {"input-rate-limit": SMALL_AND_LARGE, "input-lag": SMALL_AND_LARGE, "input-delay": FAST}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        """With a lag of some share of the time in which the largest input is reached."""
        return [(r, share * scales["input_peak"] / r) for r in _rates(scales)[1::3] for share in (0.06, 0.25, 0.8)]

    def extension(self, site: str, model: gc.Model) -> Extension:
        rate, time = (p.name for p in self.named(site, model))
        unit = site_units(model, self.site, site)["input"]
        r = f"{rate.removesuffix('_rate')}_reached"
        gap = f"({{u}} - {r})"
        ramp = f"min(max(abs({gap})/{rate} - {time}, 0), {{h}})"
        # As in `_lagging`: where the time is zero, nothing is left after the ramp.
        decay = f"exp(({ramp} - {{h}})/max({time}, 0.001*{{h}}))"
        left = f"({gap} - {rate}*sign({gap})*{ramp})"
        # ∫(u − r) = (u − r)·ramp − ½·rate·ramp² on the ramp, time·left·(1 − decay) after it.
        share = f"{time}*(1 - {decay})"
        behind = f"{gap}*({ramp} + {share}) - {rate}*sign({gap})*{ramp}*({ramp}/2 + {share})"
        memory = (Memory(r, unit, f"{{u}} - {left}*{decay}"),)
        return Extension(self.name, site, self.named(site, model), input=f"{{u}} - ({behind})/{{h}}", memory=memory)


@final
class SecondOrderLag(Law):
    """u acts as s, ṡ = (r − s)/T₂, ṙ = (u − r)/T₁: two lags, each by its mean over a sub-step."""

    name = "input-lag-second-order"
    variant_of = "input-lag"
    site = "input"
    parameters = (_time_constant(2.0, 10.0), _time_constant(1.0, 5.0, name="second"))
    equation = "s acts, second·ṡ = r − s, time_constant·ṙ = u − r"
    signature = "steps arrive rounded at both ends, and fast inputs come out much smaller and late"
    experiment = FAST
    family = "late"
    stage = 50
    contains: ClassVar = {"input-lag": {"time_constant": "time_constant"}}
    rivals: ClassVar = {"input-delay": FAST, "input-rate-limit": SMALL_AND_LARGE, "sensor-delay": FAST}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(t, share * t) for t in times(self.parameters[0], scales, 0.2) for share in (0.3, 1.0)]

    def canonical(self, values: Mapping[str, float]) -> dict[str, float]:
        """The longer one first."""
        return dict(zip(values, sorted(values.values(), reverse=True), strict=True))

    def extension(self, site: str, model: gc.Model) -> Extension:
        own, unit = self.named(site, model), site_units(model, self.site, site)["input"]
        names, target, kept = [f"{p.name}_reached" for p in own], "{u}", []
        for p, name in zip(own, names, strict=True):
            mean, end = (t.format(memory=name, time_constant=p.name, h="{h}") for t in _lagging(f"({_kept(target)})"))
            kept.append(Memory(name, unit, end))
            target = mean
        return Extension(self.name, site, own, input=target, memory=tuple(kept))


@final
class InputLag(Law):
    """u acts as r, ṙ = (u − r)/T, as its exact mean over each sub-step."""

    name = "input-lag"
    site = "input"
    parameters = (_time_constant(1.0, 3.0, 10.0),)
    equation = "r acts, time_constant·ṙ = u − r"
    memory = Memory("{time_constant}_reached", "{input}", _ARRIVED[1])
    adds: ClassVar = {"input": _ARRIVED[0]}
    signature = "steps arrive rounded, and fast inputs come out smaller and late"
    experiment = FAST
    family = "late"
    stage = 50
    variants = (SecondOrderLag,)
    equivalent: ClassVar = {"sensor-lag": "where the motion is linear, and one output is measured of what one input moves"}
    rivals: ClassVar = {
        "input-delay": FAST,
        "input-rate-limit": SMALL_AND_LARGE,
        "sensor-delay": FAST,
        "sensor-lag": SECOND,
        "backlash": FREE_DECAY,
    }

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(t,) for t in times(self.parameters[0], scales, 0.3)]


@final
class SupplySag(Law):
    """u acts as u·(1 − k·p), T·ṗ = |u| − p: a supply whose voltage falls under load, as its exact mean over each sub-step."""

    name = "supply-sag"
    site = "input"
    parameters = (
        EffectParameter("sag", {"input": -1}, (0.1, 0.3), -0.5, 1.0, plausible=(0.0, float("inf"))),
        EffectParameter("time_constant", {"time": 1}, (0.1, 0.5, 2.0), 0.01, float("inf"), off=1.0, longest=1.0),
    )
    equation = "u·(1 − sag·p) acts, time_constant·ṗ = |u| − p"
    memory = Memory("{sag}_drained", "{input}", _DRAINED[1])
    adds: ClassVar = {"input": f"{{u}}*(1 - {{sag}}*({_DRAINED[0]}))"}
    signature = "the gain falls while the input is large, and recovers while it is small"
    experiment = "hold a large input for seconds, then a small one: the gain falls, and comes back"
    amplitude = "sag"
    family = "sag"
    stage = 60
    rivals: ClassVar = {"input-gain": LEVELS, "input-saturation": SMALL_AND_LARGE, "input-lag": FAST}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        """Also time constants of a few samples, and of a log's own length: longer ones show no more than a decline."""
        sag, time_constant = self.parameters
        times = {*time_constant.starts, *(s * scales["period"] for s in (5, 20)), *(s * scales["duration"] for s in (0.2, 0.7))}
        low, high = time_constant.bounds(scales)
        return [(s * sag.scale(scales), t) for s in sag.starts for t in sorted(times) if low < t < high]


@final
class InputGain(Law):
    """u acts as g·u."""

    name = "input-gain"
    site = "input"
    parameters = (EffectParameter("gain", {}, (0.8, 1.25), -2e3, 2e3, off=1.0, plausible=(0.3, 3.0)),)
    equation = "gain·u acts"
    adds: ClassVar = {"input": "{gain}*{u}"}
    signature = "the response to every input level is wrong by the same factor"
    experiment = LEVELS
    amplitude = "gain"
    family = "gain"
    stage = 70
    equivalent: ClassVar = {
        "parameter": "where only one mass resists the input",
        "sensor-scale": "where the motion is linear, and starts from rest",
    }
    rivals: ClassVar = {
        "constant-force": LEVELS,
        "input-offset": LEVELS,
        "parameter": FREE_DECAY,
        "sensor-scale": FREE_DECAY,
        "input-saturation": SMALL_AND_LARGE,
        "input-dead-zone": SMALL_AND_LARGE,
    }


@final
class InputOffset(Law):
    """u acts as u + b."""

    name = "input-offset"
    site = "input"
    parameters = (EffectParameter("offset", {"input": 1}, (-0.1, 0.1), -3.0, 3.0),)
    equation = "u + offset acts"
    adds: ClassVar = {"input": "{u} + {offset}"}
    signature = "at input zero the motion is driven"
    experiment = LEVELS
    amplitude = "offset"
    family = "constant"
    stage = 75
    equivalent: ClassVar = {"constant-force": "where one input is the force at one coordinate"}
    rivals: ClassVar = {"constant-force": LEVELS, "input-gain": LEVELS, "coulomb-friction": BOTH_WAYS}


def _level(high: float) -> EffectParameter:
    return EffectParameter("level", {"input_peak": 1}, (0.3, 0.8), 0.002, high, off=NEVER)


@final
class SoftSaturation(Law):
    """u acts as L·tanh(u/L)."""

    name = "input-saturation-soft"
    variant_of = "input-saturation"
    site = "input"
    parameters = (_level(10.0),)
    equation = "level·tanh(u/level) acts"
    adds: ClassVar = {"input": "{level}*tanh({u}/{level})"}
    signature = "small inputs act as they should, larger ones ever weaker"
    experiment = SMALL_AND_LARGE
    family = "limit"
    stage = 80
    rivals: ClassVar = {"input-gain": SMALL_AND_LARGE, "input-rate-limit": FAST, "quadratic-drag": FREE_DECAY}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(level,) for level in spread(0.2 * scales["input"], 3.0 * scales["input_peak"], 12)]


@final
class RoundedSaturation(Law):
    """u acts as u/(1 + |u/L|ᵖ)^(1/p), which comes to clip(u, ±L) as p grows."""

    name = "input-saturation-rounded"
    variant_of = "input-saturation"
    site = "input"
    parameters = (_level(10.0), EffectParameter("sharpness", {}, (3.0, 6.0), 0.7, 40.0, off=2.0))
    equation = "u/(1 + |u/level|^sharpness)^(1/sharpness) acts"
    adds: ClassVar = {"input": "{u}/(1 + abs({u}/{level})**{sharpness})**(1/{sharpness})"}
    signature = "small inputs act as they should, larger ones ever weaker, more or less abruptly"
    experiment = SMALL_AND_LARGE
    family = "limit"
    stage = 80
    contains: ClassVar = {"input-saturation": {"level": "level"}}
    rivals: ClassVar = {"input-gain": SMALL_AND_LARGE, "input-rate-limit": FAST, "quadratic-drag": FREE_DECAY}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        levels = spread(0.2 * scales["input"], 2.0 * scales["input_peak"], 8)
        return list(itertools.product(levels, (1.2, 2.5, 6.0)))


@final
class InputSaturation(Law):
    """u acts as clip(u, ±L)."""

    name = "input-saturation"
    site = "input"
    parameters = (_level(1.0),)
    equation = "clip(u, ±level) acts"
    adds: ClassVar = {"input": "min(max({u}, -{level}), {level})"}
    signature = "small inputs act as they should, large ones all alike"
    experiment = SMALL_AND_LARGE
    family = "limit"
    stage = 80
    variants = (SoftSaturation, RoundedSaturation)
    equivalent: ClassVar = {"wheel-slip": "where one input is the force that the ground takes"}
    rivals: ClassVar = {
        "input-gain": SMALL_AND_LARGE,
        "wheel-slip": SMALL_AND_LARGE,
        "input-rate-limit": FAST,
        "quadratic-drag": FREE_DECAY,
    }

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        """Down to a fifth of the root mean square: feedback may ask once for far more than it ever gets."""
        return [(level,) for level in spread(0.2 * scales["input"], 0.97 * scales["input_peak"], 12)]
