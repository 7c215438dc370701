"""What runs learn of the model's parameters: [low, high] of each over the steps, as a summary and as a figure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, System, pretty

Ends = Mapping[str, Array]


@final
@dataclass(frozen=True)
class Learned:
    """A parameter over the steps: [low, high] as one run knows it, and the hull of what all know, (steps + 1, 2) each, NaN
    where nothing is known. stated: its value in the model around which γ was found.
    """

    name: str
    unit: str
    run: Array
    hull: Array
    stated: float


def last(x: Array, ends: Array) -> tuple[Array, Array]:
    """([low, high] after the last step of each run (n, 2), is it refuted (n,)) of runs x (n, steps + 1, nx).

    Refuted: no value makes all steps of the run; [low, high] is what was known before that.
    """
    known = np.isfinite(ends).all(axis=2)
    steps = np.arange(ends.shape[1])
    end = np.where(known, steps, 0).max(axis=1)
    return ends[np.arange(len(ends)), end], np.isfinite(x).all(axis=2).sum(axis=1) - 1 > end


def summary(x: Array, learned: Ends) -> dict[str, Any]:
    """Per parameter: `first` and `last`, the hulls over all runs before and after them; `left`, the mean share of a run's range
    that it still holds possible after its last step; `refuted`, runs of which no value makes all steps.
    """
    out: dict[str, Any] = {}
    for name, ends in learned.items():
        begin, (end, refuted) = ends[:, 0], last(x, ends)
        out[name] = {
            "first": [float(begin[:, 0].min()), float(begin[:, 1].max())],
            "last": [float(end[:, 0].min()), float(end[:, 1].max())],
            "left": float((np.diff(end) / np.diff(begin)).mean()),
            "refuted": int(refuted.sum()),
        }
    return out


def figures(learned: Ends | None, model: System, row: int) -> tuple[Learned, ...]:
    """Of one run and of all, for the parameters of the model; none where nothing is learned."""
    stated = {p.name: p for p in model.parameters}
    out = []
    for name, ends in (learned or {}).items():
        least, most = (np.where(np.isfinite(v), v, far) for v, far in ((ends[..., 0], np.inf), (ends[..., 1], -np.inf)))
        hull = np.stack([least.min(axis=0), most.max(axis=0)], axis=1)
        hull[~np.isfinite(hull)] = np.nan
        p = stated[name]
        out.append(Learned(name, pretty(p.unit), ends[row], hull, float(p.value)))
    return tuple(out)
