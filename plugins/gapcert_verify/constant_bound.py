"""Does the envelope of a saved certificate stay below a constant? Proved by branch and bound, or a witness against it."""

from __future__ import annotations

import numpy as np

from gapcert.plugin import Array, Interval, ranges, rounding

from .evidence import BLOCK, Evidence, Part, distance
from .multilinear import nodes


def exceeds(e: Evidence, i: int, gamma: float) -> str:
    """ "" where branch and bound proves that the envelope of state i stays within ±gamma on Z, else what stands against it.

    Over a box with centre c and half-widths h, u ≤ max p + min_k g_k + Σ_j L_j (|c_j − z_kj| + h_j) + J + 2 e, and l likewise.
    """
    for part in e.parts:
        if len(part.z) == 0 and e.zone.outside(part.box)[0]:
            continue
        if text := _exceeds(e, part, i, gamma) if len(part.z) else "a cell that may meet Z has no sample, and no bound":
            return text
    return ""


def _exceeds(e: Evidence, part: Part, i: int, gamma: float, budget: int = 400_000) -> str:
    constants, kind = part.constants[i], e.data["predictor"]
    weight = constants + (np.abs(e.arrays["predictor.slope"][i]) if kind == "affine" else 0.0)
    if kind == "multilinear":
        weight = constants + np.ptp(e.arrays["predictor.values"][..., i]) / (part.box.hi - part.box.lo)[0]
    boxes, spent, rows = part.box, 0, max(1, BLOCK // len(part.z))
    while True:
        if (spent := spent + len(boxes)) > budget:
            return f"state {i}: γ ≤ {gamma:.6g} could not be decided with {budget} boxes"
        bound = np.concatenate([_largest(e, part, i, boxes[a : a + rows]) for a in range(0, len(boxes), rows)])
        # The stored value was rounded outwards by some ulp more than these intervals, or less.
        boxes = boxes[~(bound <= gamma * (1 + 1e-12))]
        if not len(boxes):
            return ""
        middle = Interval.exact(boxes.mid)
        at = np.concatenate([_smallest(e, part, i, middle[a : a + rows]) for a in range(0, len(boxes), rows)])
        # A point that a relation cuts off is no witness, and the box around it is looked at again until it leaves Z.
        at = np.where(e.zone.related(boxes.mid), at, -np.inf)
        if (at > gamma * (1 + 1e-12)).any():
            k = int(at.argmax())
            return f"state {i} at {boxes.mid[k].tolist()}: the envelope reaches {at[k]:.6g}, above γ = {gamma:.6g}"
        boxes = boxes.cut((weight * (boxes.hi - boxes.lo)).argmax(axis=1))
        boxes = boxes[~e.zone.outside(boxes)]


def _band(e: Evidence, part: Part, i: int, boxes: Interval) -> tuple[Interval, Interval]:
    """Over each box, p + max_k (g_k − d) − J − 2 e and p + min_k (g_k + d) + J + 2 e at its centre, and Σ_j L_j h_j wider."""
    d, g = distance(part.constants[i], boxes.mid, part.z), part.g[:, i]
    reach = (Interval.exact(boxes.rad) * Interval.exact(part.constants[i])).sum(-1) + part.slack[i]
    above, below, p = g[None, :] + d, g[None, :] - d, _over(e, i, boxes)
    high = Interval(above.lo.min(axis=1), above.hi.min(axis=1)) + reach + p
    return Interval(below.lo.max(axis=1), below.hi.max(axis=1)) - reach + p, high


def _largest(e: Evidence, part: Part, i: int, boxes: Interval) -> Array:
    low, high = _band(e, part, i, boxes)
    return np.asarray(np.maximum(-low.lo, high.hi))


def _smallest(e: Evidence, part: Part, i: int, points: Interval) -> Array:
    low, high = _band(e, part, i, points)
    return np.asarray(np.maximum(-low.hi, high.lo))


def _over(e: Evidence, i: int, boxes: Interval) -> Interval:
    total = Interval.exact(np.zeros(len(boxes)))
    if e.data["predictor"] == "multilinear":
        values = e.arrays["predictor.values"][..., i : i + 1]
        low, high = ranges(nodes(e.arrays, e.zone, "predictor"), values, boxes.lo, boxes.hi)
        pad = rounding(boxes.shape[1]) * np.abs(values).max()
        total = total + Interval(low[:, 0] - pad, high[:, 0] + pad)
    if e.data["predictor"] == "affine":
        total = total + (boxes * Interval.exact(e.arrays["predictor.slope"][i])).sum(-1)
        total = total + float(e.arrays["predictor.offset"][i])
    return total
