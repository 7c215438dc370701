"""Faults of sensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, final

import numpy as np
import numpy.typing as npt

import gapcert as gc
from gapcert_effects.thresholds import THRESHOLDS

from .shared.experiments import CREEP, FAST, FREE_DECAY, PLACES, SECOND
from .shared.lattice import lattice
from .shared.law import Law
from .shared.sites import spread

FINEST = 1e-15  # of an output's unit: a resolution that rounds nothing


@final
class SensorBias(Law):
    """y shows y + b."""

    name = "sensor-bias"
    site = "output"
    parameters = (gc.plugin.EffectParameter("bias", {"output": 1}, (-0.1, 0.1), -3.0, 3.0),)
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
    parameters = (gc.plugin.EffectParameter("scale", {}, (0.9, 1.1), -5.0, 5.0, off=1.0, plausible=(0.5, 2.0)),)
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
    parameters = (gc.plugin.EffectParameter("delay", {"time": 1}, (0.003, 0.02, 0.05), 0.0, THRESHOLDS.latest_output),)
    equation = "y(t − delay) is seen"
    adds: ClassVar = {"output_delay": "{delay}"}
    signature = "this output comes late in all that it shows, whatever moves it"
    experiment = SECOND
    family = "late"
    equivalent: ClassVar = {"input-delay": "where every measured output comes equally late, and no other input acts"}
    rivals: ClassVar = {"input-delay": SECOND, "input-lag": FAST}

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return [(t,) for t in spread(min(0.5 * scales["period"], 0.01), 0.9 * THRESHOLDS.latest_output, 8)]


@final
class SensorQuantisation(Law):
    """y shows the nearest multiple of δ. Rounding has no slope that a fit could follow: `seen_in` reads δ off the values."""

    name = "sensor-quantisation"
    site = "output"
    parameters = (gc.plugin.EffectParameter("resolution", {"output": 1}, (0.05, 0.2), 1e-3, 2.0, off=FINEST),)
    equation = "resolution·round(y/resolution) is seen"
    adds: ClassVar = {"output": "{resolution}*round({y}/{resolution})"}
    signature = "values lie on a lattice, and slow motion comes in steps"
    experiment = CREEP
    family = "quantum"
    rivals: ClassVar = {"coulomb-friction": CREEP, "sensor-bias": PLACES}

    def seen_in(self, values: npt.NDArray[np.float64]) -> dict[str, float] | None:
        step = lattice(values)
        return None if step is None else {"resolution": step}
