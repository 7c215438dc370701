"""Faults on the way of an input, in the order of that way: delay, dead zone, rate, lag, supply, gain, offset, limit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, final

import gapcert as gc
from gapcert.plugin import EffectParameter, Extension, Memory, site_units
from gapcert_effects.thresholds import THRESHOLDS

from .experiments import BOTH_WAYS, FAST, FREE_DECAY, LEVELS, SECOND, SMALL_AND_LARGE
from .law import NEVER, Law, spread


def _lagging(target: str) -> tuple[str, str]:
    """(mean over a sub-step, end) of ż = (target − z)/time_constant from z = memory, exact for a constant target."""
    # The bound only keeps the exponent finite where the time is zero; there the share time/h of the mean is zero.
    decay = "exp(-{h}/max({time_constant}, 0.001*{h}))"
    share = f"(1 - {decay})*{{time_constant}}/{{h}}"
    return f"{{memory}}*{share} + {target}*(1 - {share})", f"{{memory}}*{decay} + {target}*(1 - {decay})"


_MOVED = "min(max({u} - {memory}, -{rate}*{h}), {rate}*{h})"
"""By how much a ramp of limited rate comes nearer in a sub-step."""
_ARRIVED, _DRAINED = _lagging("{u}"), _lagging("abs({u})")


@final
class InputDelay(Law):
    """u acts T seconds late, as its exact mean over each period."""

    name = "input-delay"
    site = "input"
    parameters = (EffectParameter("delay", {"time": 1}, (0.003, 0.02, 0.05), 0.0, THRESHOLDS.latest_input),)
    equation = "u(t − delay) acts"
    adds: ClassVar = {"delay": "{delay}"}
    signature = "the response to fast inputs lags, the response to slow ones is right"
    experiment = FAST
    family = "late"
    stage = 10
    equivalent: ClassVar = {"sensor-delay": "where every measured output comes equally late, and no other input acts"}
    rivals: ClassVar = {"input-lag": FAST, "sensor-delay": SECOND, "input-rate-limit": SMALL_AND_LARGE, "backlash": FAST}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(t,) for t in spread(min(0.5 * scales["period"], 0.01), 0.9 * THRESHOLDS.latest_input, 8)]


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
    rivals: ClassVar = {
        "coulomb-friction": FREE_DECAY,
        "input-gain": LEVELS,
        "backlash": "reverse the input away from zero: play stays there, a dead zone does not",
    }

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(w * scales["input"],) for w in spread(0.02, 1.2, 9)]


@final
class InputRateLimit(Law):
    """u acts as r, |ṙ| ≤ R, as the exact mean of its ramp over each sub-step: r + δ·(1 − |δ|/(2Rh)), δ = clip(u − r, ±Rh)."""

    name = "input-rate-limit"
    site = "input"
    parameters = (EffectParameter("rate", {"input": 1, "time": -1}, (2.0, 20.0), 0.02, 2e4, off=NEVER),)
    equation = "r acts, ṙ = ±rate until r = u"
    memory = Memory("{rate}_reached", "{input}", f"{{memory}} + {_MOVED}")
    adds: ClassVar = {"input": f"{{memory}} + ({_MOVED})*(1 - abs({_MOVED})/(2*{{rate}}*{{h}}))"}
    signature = "steps become ramps, and fast large inputs come out as smaller triangles"
    experiment = SMALL_AND_LARGE
    family = "late"
    stage = 40
    rivals: ClassVar = {"input-lag": SMALL_AND_LARGE, "input-delay": SMALL_AND_LARGE, "input-saturation": FAST}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        """From a ramp of 2 s to one that takes two samples, for the largest input."""
        return [(r * scales["input_peak"],) for r in spread(0.5, max(5.0, 0.5 / scales["period"]), 12)]


@final
class InputRateLimitedLag(Law):
    """u acts as r, ṙ = clip((u − r)/T, ±R), as its exact mean over each sub-step: ramp, then lag.

    The ramp takes clip(|u − r|/R − T, 0, h). A first-order servo with a rate limit: R → ∞ leaves the lag, T = 0 the rate limit.
    """

    name = "input-rate-limited-lag"
    site = "input"
    parameters = (
        EffectParameter("rate", {"input": 1, "time": -1}, (2.0, 10.0), 0.02, 2e4, off=NEVER),
        EffectParameter("time_constant", {"time": 1}, (0.01, 0.05), 0.0, THRESHOLDS.slowest_lag),
    )
    equation = "r acts, ṙ = clip((u − r)/time_constant, ±rate)"
    signature = "large steps become ramps with a rounded end, small ones arrive rounded"
    experiment = SMALL_AND_LARGE
    family = "late"
    stage = 45
    contains: ClassVar = {"input-rate-limit": {"rate": "rate"}, "input-lag": {"time_constant": "time_constant"}}
    rivals: ClassVar = {"input-rate-limit": SMALL_AND_LARGE, "input-lag": SMALL_AND_LARGE, "input-delay": FAST}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        """Ramps of the largest input in 1 s and less, with a lag of some share of that time."""
        return [(r * scales["input_peak"], share / r) for r in (1.0, 4.0, 16.0) for share in (0.06, 0.25, 0.8)]

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
class InputLag(Law):
    """u acts as r, ṙ = (u − r)/T, as its exact mean over each sub-step."""

    name = "input-lag"
    site = "input"
    parameters = (EffectParameter("time_constant", {"time": 1}, (0.005, 0.03, 0.1), 0.0, THRESHOLDS.slowest_lag),)
    equation = "r acts, time_constant·ṙ = u − r"
    memory = Memory("{time_constant}_reached", "{input}", _ARRIVED[1])
    adds: ClassVar = {"input": _ARRIVED[0]}
    signature = "steps arrive rounded, and fast inputs come out smaller and late"
    experiment = FAST
    family = "late"
    stage = 50
    rivals: ClassVar = {"input-delay": FAST, "input-rate-limit": SMALL_AND_LARGE, "sensor-delay": FAST, "backlash": FREE_DECAY}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(t,) for t in spread(min(0.5 * scales["period"], 0.01), 0.7, 8)]


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
        """Also time constants of a log's own length: of those that are longer, it shows no more than a decline."""
        sag, time_constant = self.parameters
        times = {*time_constant.starts, *(s * scales["duration"] for s in (0.2, 0.7))}
        low, high = time_constant.bounds(scales)
        return [(s * sag.scale(scales), t) for s in sag.starts for t in sorted(times) if low < t < high]


@final
class InputGain(Law):
    """u acts as g·u."""

    name = "input-gain"
    site = "input"
    parameters = (EffectParameter("gain", {}, (0.8, 1.25), -5.0, 5.0, off=1.0, plausible=(0.3, 3.0)),)
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


@final
class InputSaturation(Law):
    """u acts as clip(u, ±L)."""

    name = "input-saturation"
    site = "input"
    parameters = (EffectParameter("level", {"input_peak": 1}, (0.3, 0.8), 0.002, 1.0, off=NEVER),)
    equation = "clip(u, ±level) acts"
    adds: ClassVar = {"input": "min(max({u}, -{level}), {level})"}
    signature = "small inputs act as they should, large ones all alike"
    experiment = SMALL_AND_LARGE
    family = "limit"
    stage = 80
    rivals: ClassVar = {
        "input-gain": SMALL_AND_LARGE,
        "wheel-slip": SMALL_AND_LARGE,
        "input-rate-limit": FAST,
        "quadratic-drag": FREE_DECAY,
    }

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        """Down to a fifth of the root mean square: feedback may ask once for far more than it ever gets."""
        return [(level,) for level in spread(0.2 * scales["input"], 0.97 * scales["input_peak"], 12)]
