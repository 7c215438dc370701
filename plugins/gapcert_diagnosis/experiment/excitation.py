"""Inputs that an experiment may play: from creeping to fast, within limits, in bands that follow the motion in the data."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gapcert.plugin import Array
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.thresholds import THRESHOLDS

BANDS = {"a slow swing": (0.08, 0.4), "a slow multisine": (0.2, 1.5), "a multisine": (0.3, 4.0)}
FAST = {"a fast multisine": (3.0, 12.0), "a very fast multisine": (12.0, 30.0)}
BACK = ("a slow swing", "a slow multisine", "a multisine", "a fast multisine", "steps", "slow steps", "switching")


def shapes(limits: Mapping[str, tuple[float, float]], seconds: float, measured: Dataset, seed: int) -> dict[str, Array]:
    """Name → u (T, nu): every input at once, each with phases and levels of its own; frequencies in units of the motion's."""
    period, count = measured.period, measured.samples(seconds)
    t, beat = np.arange(count) * period, _beat(measured)
    most = THRESHOLDS.fastest_input / period
    low, high = (np.array([pair[i] for pair in limits.values()]) for i in (0, 1))
    middle, half = (low + high) / 2, (high - low) / 2
    rest = np.clip(0.0, low, high)
    rng = np.random.default_rng(seed)

    def sines(band: tuple[float, float]) -> Array:
        top = min(band[1] * beat, most)
        frequencies = np.linspace(min(max(band[0] * beat, 1 / seconds), top), top, THRESHOLDS.multisine_lines)
        phases = rng.uniform(0, 2 * np.pi, (THRESHOLDS.multisine_lines, len(low)))
        waves = np.sin(2 * np.pi * frequencies[:, None, None] * t[:, None] + phases[:, None]).sum(axis=0)
        return np.asarray(waves / np.abs(waves).max(axis=0))

    def levels(hold: float) -> Array:
        each = max(1, round(hold / beat / period))
        drawn = rng.uniform(-1, 1, (-(-count // each), len(low)))
        return np.repeat(drawn, each, axis=0)[:count]

    def every(shape: Array) -> Array:
        return np.repeat(shape[:, None], len(low), axis=1)

    turn = min(10.0 * beat, most)
    unit = {name: sines(band) for name, band in {**BANDS, **FAST}.items()}
    unit |= {
        "steps": levels(0.4),
        "slow steps": levels(2.0),
        "switching": np.sign(levels(0.3)),
        "fast switching": np.sign(levels(0.06)),
    }
    unit["a chirp"] = every(np.sin(2 * np.pi * (0.1 * beat * t + (turn - 0.1 * beat) * t**2 / (2 * seconds))))
    unit["a creeping ramp"] = every(1 - 4 * np.abs((t / seconds + 0.25) % 1 - 0.5))
    unit |= {
        f"{name}, small": THRESHOLDS.small_input * unit[name]
        for name in ("a slow swing", "a multisine", "slow steps", "a creeping ramp")
    }
    # What drifts comes back: a double integrator ends at rest where it began.
    unit |= {f"{name}, there and back": _returning(unit[name]) for name in BACK}
    out = {name: middle + half * shape for name, shape in unit.items()}
    # One push, then nothing: what is left decays freely, four times.
    phase = (t % (seconds / 4)) / (seconds / 4)
    kick = np.where(phase < min(0.1, 0.25 / (beat * seconds / 4)), 1.0, 0.0) * np.where(
        (4 * t / seconds).astype(int) % 2, -1, 1
    )
    out["pulses and free decay"] = np.where(kick[:, None] > 0, high, np.where(kick[:, None] < 0, low, rest))
    own = next((u for u in measured.inputs if len(u) >= count), None)
    if own is not None:
        out["the input of the recording"] = np.clip(own[:count], low, high)
    return out


def _returning(shape: Array) -> Array:
    """The first quarter of a shape, then its opposite twice, then itself."""
    quarter = shape[: len(shape) // 4]
    return np.concatenate([quarter, -quarter, -quarter, quarter])


def _beat(measured: Dataset) -> float:
    """How often the quickest output crosses its mean upwards, in Hz."""
    rates = []
    for y in measured.outputs:
        swing = np.nan_to_num(y - np.nanmean(y, axis=0)) / np.maximum(measured.spread, 1e-300)
        # Only crossings from well below to well above: noise crosses all the time.
        level = np.where(swing > 0.3, 1, np.where(swing < -0.3, -1, 0))
        for column in level.T:
            marks = column[column != 0]
            rates.append(np.count_nonzero((marks[:-1] < 0) & (marks[1:] > 0)) / (len(y) * measured.period))
    return float(max(rates)) or 1 / (len(measured.outputs[0]) * measured.period)
