"""What was proved of a stored function, or stands behind it, proved or compared once more; or a witness against it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapcert.plugin import Array, Interval, on_curvature, ranges, rounding
from gapcert_functions import Band, Cones, Side, lift

from .evidence import BLOCK, Evidence, Part, another, distance
from .functions import sides, table
from .multilinear import curvature, nodes

_BATCH, _MOST = 8192, 4_000_000  # boxes beyond those of the first proof, which is repeated as it was, and in all


def dominates(e: Evidence) -> str:
    """ "" where branch and bound proves that both functions with their shifts contain the envelope on Z."""
    if on_curvature(e.data["form"]) and (text := follows(e)):
        return text
    cells, shifts = table(e.arrays, e.zone), e.arrays["gap.shifts"]
    if shifts.shape != (2, len(e.arrays["lipschitz"]), len(cells)) or not np.isfinite(shifts).all():
        return f"there are shifts of shape {shifts.shape} for {len(cells)} cells, or some are not finite"
    for k, q in enumerate(sides(e.data["form"], e.arrays, e.zone)):
        sign = 1 if k else -1
        for i, known in enumerate(shifts[k]):
            budget = min(int(e.arrays["gap.boxes"][k, i]) + _BATCH, _MOST)
            found = lift(Side(_parts(e, i, sign), q, i, sign), cells, e.zone, 0.0, budget, known)
            if not (found.shift <= known).all():
                c = int(np.argmax(found.shift - known))
                end = "above the lower" if sign < 0 else "below the upper"
                return f"state {i}: in cell {c} of the table the envelope was not proved to lie {end} function"
    return ""


def _parts(e: Evidence, i: int, sign: int) -> Sequence[Band | Cones]:
    if on_curvature(e.data["form"]):
        axes, whole = nodes(e.arrays, e.zone, "gap"), e.parts[0]
        counts = [len(a) for a in axes]
        g = whole.g[-int(np.prod(counts)) :, i].reshape(*counts)
        bends = [e.arrays[f"gap.H{j}"][i] for j in range(len(axes))]
        g, slack = g if sign > 0 else -g, float(whole.slack.hi[i])
        return [Band.of(whole.box, axes, g, bends, whole.constants[i], slack)]
    made = []
    for part in e.parts:
        ends = part.g[:, i].hi if sign > 0 else -part.g[:, i].lo
        made.append(Cones(part.box, part.z, ends, part.constants[i], float(part.slack.hi[i])))
    return made


def follows(e: Evidence) -> str:
    """ "" where nodes, remainders and constants of the stored function are those of samples, domain and certificate."""
    axes, (z, _r) = nodes(e.arrays, e.zone, "gap"), e.samples
    product = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    if not np.array_equal(z[-len(product) :], product):
        return "the nodes are not the last of the samples"
    if any(len(a) > 1 and (a[0], a[-1]) != (e.zone.low[j], e.zone.high[j]) for j, a in enumerate(axes)) or e.zone.relations:
        return "the nodes do not reach to both ends of Z, or Z is no box"
    g = e.parts[0].g[-len(product) :]
    if another(e, g):
        return "the stored values are not r − p at the nodes"
    for j, a in enumerate(axes):
        if not np.array_equal(e.arrays[f"gap.H{j}"], curvature(e.arrays, e.zone, j, a)):
            return f"the curvature of the function along axis {j} is not that of the certificate"
    same = {"gap.L": "lipschitz", "gap.e": "remainder.resolution"}
    other = [k for k, v in same.items() if not np.array_equal(e.arrays[k], e.arrays[v])]
    if other:
        return f"{other[0]} of the function is not that of the certificate"
    if (e.arrays["resolution"] > e.rounding).any() or e.data["predictor"] == "multilinear" or "cells.L" in e.arrays:
        return "curvature says nothing of drawn hidden state, of a predictor with kinks, or of cells"
    return ""


def bent(e: Evidence) -> str:
    """ "" unless second differences between neighbouring nodes refute the curvature, for certain."""
    axes, bends = nodes(e.arrays, e.zone, "gap"), e.arrays["curvature"]
    if bends.shape != e.arrays["lipschitz"].shape or not (bends >= 0).all():
        return "the curvature is negative, or no number"
    counts = [len(a) for a in axes]
    g = e.parts[0].g[-int(np.prod(counts)) :].reshape(*counts, len(bends))
    for j, a in enumerate(axes):
        if len(a) < 3:
            continue
        low, high = (np.moveaxis(side, j, 0) for side in (g.lo, g.hi))
        slope = (Interval(low[1:], high[1:]) - Interval(low[:-1], high[:-1])) / _beside(a, low.ndim)
        allowed = curvature(e.arrays, e.zone, j, a).T * np.diff(a)[:, None] / 2
        allowed = (allowed[1:] + allowed[:-1]).reshape(len(a) - 2, *(1,) * (low.ndim - 2), -1)
        shortest = np.diff(a).min()
        slack = 4 * e.arrays["remainder.resolution"] / shortest
        least = abs(slope[1:] - slope[:-1]).lo
        if (least > (allowed + slack) * (1 + 1e-9)).any():
            return f"second differences along axis {j} refute the curvature"
    return ""


def _beside(a: Array, dimensions: int) -> Interval:
    return (Interval.exact(a[1:]) - a[:-1]).reshape(-1, *(1,) * (dimensions - 1))


def exceeds(e: Evidence, i: int, gamma: float, budget: int = 400_000) -> str:
    """ "" where branch and bound proves that the envelope of state i stays within ±gamma on Z, else what stands against it.

    Over a box with centre c and half-widths h, u ≤ max p + min_k g_k + Σ_j L_j (|c_j − z_kj| + h_j) + J + 2 e, and l likewise.
    """
    for part in e.parts:
        if len(part.z) == 0 and e.zone.outside(part.box)[0]:
            continue
        if text := _exceeds(e, part, i, gamma, budget) if len(part.z) else "a cell that may meet Z has no sample, and no bound":
            return text
    return ""


def _exceeds(e: Evidence, part: Part, i: int, gamma: float, budget: int) -> str:
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
