"""Where rollouts start: a body that floats is where the first samples of its flight put it, and moves as they do."""

from __future__ import annotations

import numpy as np

from gapcert.plugin import Array, difference, rotated
from gapcert_diagnosis.native.candidates import CONTACT, tried
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_engines import NativeModel

_PAIRS = (("position", "velocity"), ("rotation", "rate"))


def flying(model: NativeModel, stated: NativeModel) -> NativeModel:
    """The model with the contacts of the stated one: what differs in contacts alone has one and the same flight."""
    return model.restated({p.name: p.value for p in stated.parameters if p.name in CONTACT})


def settled(model: NativeModel, sigma: Array, seen: Array, u: Array) -> Array:
    """Starts (n, nx) of motions seen (n, T, nx), NaN beyond their ends, under u (n, T − 1, nu); sigma (G,): noise floors.

    A velocity from a filter is late, and one from a single sample is noisy. While a body flies, a wrong start shows in its
    place as an error that grows evenly: a line through the differences from the model's rollout is the error of the start,
    weighed against the velocity that was measured. As many samples count as tell the slope best, by their own misfit: an impact
    spoils it. Where a rollout with other contacts goes another way, or where no line fits, the start is the measured one.
    """
    groups = {g.output.name: (g, float(s)) for g, s in zip(model.groups, sigma, strict=True)}
    pairs = [(groups[a], groups[b]) for a, b in _PAIRS if a in groups and b in groups]
    start = seen[:, 0].copy()
    if not pairs:
        return start
    other = {p.name: values[0] for p in model.parameters if p.name in CONTACT and (values := tried(p))}
    rolled, touched = (m.rollout(start, u).x for m in (model, model.restated(other)))
    aloft = np.all([g.error(rolled, touched) <= THRESHOLDS.same_flight * s for g, s in groups.values()], axis=0)
    aloft = np.logical_and.accumulate(aloft, axis=1)
    now, moved = model.turned(start, back=False), np.zeros(len(start), dtype=bool)
    for (place, noise), (speed, spread) in pairs:
        columns = list(place.columns)
        with np.errstate(invalid="ignore"):
            off = difference(place.specs, seen[..., columns], rolled[..., columns])
        off[~aloft] = np.nan
        offset, slope = (noise * a for a in _line(model.period, off / noise, noise / spread))
        now[:, columns] = rotated(now[:, columns], offset) if place.specs[0].kind == "quaternion" else now[:, columns] + offset
        now[:, list(speed.columns)] += slope
        moved |= (offset != 0).any(axis=1)
    start[moved] = model.turned(now[moved], back=True)
    return start


def _line(period: float, off: Array, ratio: float) -> tuple[Array, Array]:
    """Offset and slope (n, 3) of the line with which each row of `off` (n, T, 3) begins, in noise floors; 0 where none does.

    1 / ratio: noise of the slope that was measured, which is 0.
    """
    t = period * np.arange(off.shape[1])
    n, t1, t2 = (np.cumsum(a)[:, None] for a in (np.ones_like(t), t, t**2))
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        y0, y1 = np.cumsum(off, axis=1), np.cumsum(t[:, None] * off, axis=1)
        wide = np.maximum(t2 - t1**2 / n, 1e-300)
        slope = (y1 - t1 / n * y0) / wide
        square = np.cumsum(off**2, axis=1) - y0**2 / n - wide * slope**2
        misfit = np.sum(square, axis=-1) / np.maximum(n[:, 0] - 2, 1)
        variance = np.maximum(misfit, 1.0) / wide[:, 0]
    variance[:, : THRESHOLDS.line_samples - 1] = np.inf
    variance[~(misfit <= THRESHOLDS.line_misfit**2)] = np.inf
    rows, best = np.arange(len(off)), np.argmin(variance, axis=1)
    found = np.isfinite(variance[rows, best])[:, None]
    b = np.where(found, slope[rows, best] / (1 + variance[rows, best] * ratio**2)[:, None], 0.0)
    return np.where(found, (y0[rows, best] - t1[best] * b) / n[best], 0.0), b
