"""Faults of sensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, final

import numpy as np

import gapcert as gc
from gapcert import Array
from gapcert.plugin import EffectParameter, Extension, Memory, site_units
from gapcert_effects.thresholds import THRESHOLDS

from .experiments import CREEP, FAST, FREE_DECAY, PLACES, SECOND
from .law import Law, times

_FINEST = 1e-15  # of an output's unit: a resolution that rounds nothing


@final
class SensorBias(Law):
    """y shows y + b."""

    name = "sensor-bias"
    site = "output"
    parameters = (EffectParameter("bias", {"output": 1}, (-0.1, 0.1), -3.0, 3.0),)
    equation = "y + bias is seen"
    adds: ClassVar = {"output": "{y} + {bias}"}
    signature = "equilibria are shifted, and the motion about them is right only from a shifted place"
    experiment = PLACES
    amplitude = "bias"
    family = "tilt"
    equivalent: ClassVar = {"gravity-tilt": "at an angle that only gravity pulls back"}
    rivals: ClassVar = {"constant-force": PLACES, "gravity-tilt": PLACES, "sensor-scale": PLACES}


@final
class SensorScale(Law):
    """y shows s·y."""

    name = "sensor-scale"
    site = "output"
    parameters = (EffectParameter("scale", {}, (0.9, 1.1), -2e3, 2e3, off=1.0, plausible=(0.5, 2.0)),)
    equation = "scale·y is seen"
    adds: ClassVar = {"output": "{scale}*{y}"}
    signature = "free swings have the right frequency for another amplitude"
    experiment = FREE_DECAY
    amplitude = "scale"
    family = "gain"
    equivalent: ClassVar = {"input-gain": "where the motion is linear, and starts from rest"}
    rivals: ClassVar = {"input-gain": FREE_DECAY, "parameter": FREE_DECAY, "sensor-bias": PLACES}


@final
class SensorDelay(Law):
    """y shows the past, T seconds ago."""

    name = "sensor-delay"
    site = "output"
    parameters = (
        EffectParameter(
            "delay", {"period": 1}, (0.6, 2.0, 5.0), 0.0, THRESHOLDS.shown_periods, longest=THRESHOLDS.latest_output
        ),
    )
    equation = "y(t − delay) is seen"
    adds: ClassVar = {"output_delay": "{delay}"}
    signature = "this output comes late in all that it shows, whatever moves it"
    experiment = SECOND
    family = "late"
    equivalent: ClassVar = {"input-delay": "where every measured output comes equally late, and no other input acts"}
    rivals: ClassVar = {"input-delay": SECOND, "input-lag": FAST}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(t,) for t in times(self.parameters[0], scales, least=0.4)]


_BEHIND = "{time_constant}/{h}*(1 - exp(-{h}/max({time_constant}, 0.001*{h})))"
"""By how much of a steady slope per sub-step the reading falls back in one, over what it does in the end."""


@final
class SensorLag(Law):
    """z is seen, T·ż = y − z, from z = y on: exact for a y that is straight over each sub-step.

    With E = exp(−h/T) and c = T/h·(1 − E) the hidden state m = z − (1 − c)·y needs no later y: m⁺ = E·m + c·(1 − E)·y.
    """

    name = "sensor-lag"
    site = "output"
    parameters = (
        EffectParameter("time_constant", {"period": 1}, (1.0, 3.0), 0.0, float("inf"), longest=THRESHOLDS.slowest_sensor),
    )
    equation = "z is seen, time_constant·ż = y − z"
    signature = "this output arrives rounded, and what is fast in it smaller and late, whatever moves it"
    experiment = SECOND
    family = "late"
    equivalent: ClassVar = {"input-lag": "where the motion is linear, and one output is measured of what one input moves"}
    rivals: ClassVar = {"input-lag": SECOND, "sensor-delay": FAST, "input-delay": SECOND}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(t,) for t in times(self.parameters[0], scales, 0.3)]

    def extension(self, site: str, model: gc.Model) -> Extension:
        (own,), unit = self.named(site, model), site_units(model, self.site, site)["output"]
        kept, begun = (f"{own.name}_{end}" for end in ("reached", "begun"))
        c, left = (t.format(time_constant=own.name, h="{h}") for t in (_BEHIND, "exp(-{h}/max({time_constant}, 0.001*{h}))"))
        now = f"(1 - {begun})*{c}*{{y}} + {begun}*{kept}"
        memory = (Memory(kept, unit, f"({now})*{left} + {c}*(1 - {left})*{{y}}"), Memory(begun, "1", "1"))
        return Extension(self.name, site, (own,), output=f"{{y}} + {begun}*({kept} - {c}*{{y}})", memory=memory)


@final
class SensorQuantisation(Law):
    """y shows the nearest multiple of δ. Rounding has no slope that a fit could follow: `seen_in` reads δ off the values."""

    name = "sensor-quantisation"
    site = "output"
    parameters = (EffectParameter("resolution", {"output": 1}, (0.05, 0.2), 1e-3, 2.0, off=_FINEST),)
    equation = "resolution·round(y/resolution) is seen"
    adds: ClassVar = {"output": "{resolution}*round({y}/{resolution})"}
    signature = "values lie on a lattice, and slow motion comes in steps"
    experiment = CREEP
    family = "quantum"
    rivals: ClassVar = {"coulomb-friction": CREEP, "sensor-bias": PLACES}

    def seen_in(self, values: Array) -> dict[str, float] | None:
        step = _lattice(values)
        return None if step is None else {"resolution": step}


def _lattice(values: Array) -> float | None:
    """The step δ of values near multiples of δ (and an offset), or None; read off their distribution alone.

    |mean exp(2πi y/δ)| is 1 on a lattice, exp(−2π²σ²/δ²) under noise σ that is added to it, and about 1/√cells else.
    """
    y = values[np.isfinite(values)]
    if (step := _exact(y)) is not None:
        return step
    floor = float(np.sqrt(np.mean(np.diff(y, 4) ** 2) / 70)) if len(y) > 50 else 0.0
    reach = float(np.ptp(y)) if len(y) else 0.0
    if not (floor > 0 and reach > THRESHOLDS.lattice_coarsest * THRESHOLDS.lattice_finest * floor):
        return None
    cell = np.minimum(((y - y.min()) / reach * THRESHOLDS.lattice_cells).astype(int), THRESHOLDS.lattice_cells - 1)
    count = np.bincount(cell, minlength=THRESHOLDS.lattice_cells)
    levels = int(np.count_nonzero(count))
    if levels < THRESHOLDS.lattice_levels:
        return None
    weight = 1.0 / (levels * count[cell])
    frequency, found = _spectrum(y, weight, reach, floor)
    inside = (frequency >= max(THRESHOLDS.lattice_coarsest / reach, 1 / (THRESHOLDS.lattice_widest * floor))) & (
        frequency <= 1 / (THRESHOLDS.lattice_finest * floor)
    )
    peaks = np.where(inside, found, 0.0)
    # The largest of some thousand sums of `levels` random phases stays below 2.8/√levels.
    if peaks.max() < min(0.98, 0.1 + 2.8 / np.sqrt(levels)):
        return None
    first = int(np.argmax(peaks >= 0.9 * peaks.max()))
    while first + 1 < len(peaks) and peaks[first + 1] > peaks[first]:
        first += 1
    return _regressed(y, weight, 1 / float(frequency[first]))


def _exact(y: Array) -> float | None:
    """The step of a few values that come again and again, where all of them are whole multiples of it apart."""
    levels = np.unique(np.round(y, 12))
    if not 3 <= len(levels) <= len(y) / THRESHOLDS.lattice_repeats:
        return None
    apart = np.diff(levels)
    ratio = apart / apart.min()
    step = float(np.ptp(levels) / np.round(ratio).sum())
    coarse = step > THRESHOLDS.lattice_finest * float(np.sqrt(np.mean(np.diff(y, 4) ** 2) / 70))
    return step if coarse and np.abs(ratio - np.round(ratio)).max() < 1e-3 else None


def _spectrum(y: Array, weight: Array, reach: float, floor: float) -> tuple[Array, Array]:
    """(frequencies, |Σ w exp(2πi f y)|) by one transform of a fine histogram."""
    bins = int(min(THRESHOLDS.lattice_bins, np.ceil(reach / (0.2 * floor))))
    width = reach / bins
    at = np.minimum(((y - y.min()) / width).astype(int), bins - 1)
    total = np.bincount(at, weight, minlength=bins)
    return np.asarray(np.fft.rfftfreq(8 * bins, width)), np.asarray(np.abs(np.fft.rfft(total, 8 * bins)), dtype=np.float64)


def _regressed(y: Array, weight: Array, step: float) -> float:
    """The step that fits best once every value has its whole number."""
    for _ in range(4):
        phase = np.angle(np.sum(weight * np.exp(2j * np.pi * (y - y.mean()) / step)))
        origin = y.mean() + phase * step / (2 * np.pi)
        number = np.round((y - origin) / step)
        centred = number - np.sum(weight * number)
        step = float(np.sum(weight * centred * y) / np.sum(weight * centred * number))
    return step
