"""What a person declares (a symmetry, constants, curvature, γ) held against the equations of both systems and against samples.

A contradiction is refused, with what was declared and what was found; on what stays open the claim rests, in words.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gapcert.certification.refutation import contradiction
from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.gaps.gap import GapFunction, GapProblem
from gapcert.contracts.gaps.lipschitz import LipschitzProblem, Residual, Symmetry
from gapcert.contracts.gaps.predictor import AffinePredictor, Samples
from gapcert.numerics.arrays import Array, Ints
from gapcert.numerics.constraint_zone import Zone
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval

_SPARE = 1e-9  # relative: a constant that is declared as it is, is not hunted down to its last digit
_WEIGHTS = {0: {0: 1}, 1: {1: 1, 0: -1}, 2: {1: 1, 0: -2, -1: 1}}  # of g(z + s t), by order and s
_FOUND = ("|f̂ − f|", "the change of f̂ − f", "the second difference of f̂ − f")


def hunt(zone: Zone, excess: Callable[[Interval], Array], look: Callable[[Array, Ints], None]) -> bool:
    """Is `excess` (n, m) of boxes proved to be at most 0 on the zone? Where it may be positive they are bisected.

    The largest, and of these the smallest boxes, come first, and look(z, columns) raises what it finds at their middles, each
    suspected for one column. False where the budget ends before, or a model encloses nothing.
    """
    low, width = np.array([zone.low]), np.subtract(zone.high, zone.low)
    boxes, spent, narrow = Interval(low, np.array([zone.high])), 0, False
    try:
        over = excess(boxes)
    except UsageError:
        return False
    while (hot := (over > 0).any(axis=1)).any() and spent <= THRESHOLDS.hunt_boxes:
        boxes, over = boxes[hot], over[hot]
        order = np.lexsort((np.log2((boxes.hi - boxes.lo) / width).sum(axis=1), -over.max(axis=1)))
        first, rest = np.split(order, [THRESHOLDS.hunt_batch])
        inside = first[zone.contains(boxes[first].mid)]
        look(boxes[inside].mid, over[inside].argmax(axis=1))
        halves, left = _halved(boxes[first], over[first], width, excess)
        spent += len(halves) * len(width)
        wide = ((halves.hi - halves.lo) / width).max(axis=1) > THRESHOLDS.hunt_width
        narrow |= bool((left[~wide] > 0).any())
        keep = wide & ~zone.outside(halves)
        boxes, over = Interval.concatenate([boxes[rest], halves[keep]]), np.concatenate([over[rest], left[keep]])
    return not (narrow or hot.any())


def _halved(boxes: Interval, over: Array, width: Array, excess: Callable[[Interval], Array]) -> tuple[Interval, Array]:
    """Both halves of each box, cut along the axis that leaves least, and what they leave."""
    parent, least, axis = np.tile(over, (2, 1)), np.full(len(boxes), np.inf), np.zeros(len(boxes), dtype=np.intp)
    best = parent
    for j, share in enumerate(((boxes.hi - boxes.lo) / width).T):
        found = np.minimum(excess(boxes.cut(np.full(len(boxes), j))), parent)
        part = np.where(np.isinf(parent), np.isinf(found), np.nan_to_num(found) / np.clip(parent, 1e-300, 1e300))
        cost = np.clip(part, 0, 1).reshape(2, *over.shape).sum(axis=(0, 2)) - _SPARE * share
        better = (cost < least) & (share > THRESHOLDS.hunt_width)
        least, axis = np.where(better, cost, least), np.where(better, j, axis)
        best = np.where(np.tile(better, 2)[:, None], found, best)
    return boxes.cut(axis), best


def _held(asked: LipschitzProblem, zone: Zone, axes: Sequence[int], order: int, most: Array, where: str) -> bool:
    """Is |∂ᵏg_i/∂z_jᵏ| ≤ most_ij, k = 0, 1, 2, proved along these axes, but for what e hides? False for engines.

    UsageError with z and a step t where |g(z)|, |g(z + t) − g(z)| or |g(z + t) − 2 g(z) + g(z − t)| is larger than that allows.
    """
    f, p, each, width = asked.model, asked.predictor, np.asarray(axes), np.subtract(zone.high, zone.low)
    if (fhat := asked.white_box) is None:
        return False
    residual, e = Residual(fhat, f), asked.resolution + p.resolution(asked.domain)
    enough = (most * (1 + _SPARE) + 2 * order * e[:, None] / width**order / len(each))[:, each]

    def excess(boxes: Interval) -> Array:
        if order == 2:
            three = [
                (fhat.curvature_enclosure(boxes, j), f.curvature_enclosure(boxes, j), p.curvature_over(boxes, j)) for j in axes
            ]
            known = Interval.stack([a - b - c for a, b, c in three], axis=-1)
        else:
            known = fhat.jacobian_enclosure(boxes) - f.jacobian_enclosure(boxes) - p.jacobian_over(boxes)
        if order == 0:  # by the mean value, in which what f̂ and f share cancels
            centre = Interval.exact(boxes.mid)
            moved = (known * (boxes - centre).reshape(len(boxes), 1, -1)).sum(-1)
            known = (fhat.enclosure(centre) - f.enclosure(centre) - p.over(centre) + moved).reshape(len(boxes), -1, 1)
        return np.asarray(((known[:, :, each] if order == 1 else known).mag - enough).reshape(len(boxes), -1))

    def look(z: Array, column: Ints) -> None:
        i, j, halves = column // len(each), each[column % len(each)], 0.5 ** np.arange(THRESHOLDS.hunt_steps)
        t = width[j][:, None] * np.concatenate([halves, -halves])
        total, inside = np.zeros((*t.shape, len(most))), np.ones(t.shape, dtype=bool)
        for s, weight in _WEIGHTS[order].items():
            at = (z[:, None] + s * t[:, :, None] * (np.arange(z.shape[1]) == j[:, None])[:, None]).reshape(-1, z.shape[1])
            inside &= zone.contains(at).reshape(t.shape)
            at = np.clip(at, zone.low, zone.high)
            total += weight * (residual(at) - p(at)).reshape(total.shape)
        found = np.abs(total)[np.arange(len(z)), :, i]
        allowed = most[i, j][:, None] * np.abs(t) ** order * (1 + _SPARE) + 4 * min(order, 1) * e[i][:, None]
        if (over := np.where(inside, found - allowed, -1.0)).max(initial=0.0) > 0:
            k, m = np.unravel_index(int(np.argmax(over)), over.shape)
            names = [a.name for a in asked.domain.axes]
            step = f", within {abs(t[k, m]):.6g} along {names[j[k]]}" if order else ""
            raise UsageError(
                f"{where}: {_FOUND[order]} of {names[i[k]]} is {found[k, m]:.6g} at (x, u) = {z[k].tolist()}{step}, and the "
                f"declaration allows {allowed[k, m]:.6g}; declare what holds, or mend the system"
            )

    return hunt(zone, excess, look)


def symmetric(asked: LipschitzProblem, symmetry: Symmetry) -> Symmetry:
    """The symmetry, `proved` where the equations prove it; UsageError where they lead to a pair that contradicts it."""
    zero = np.zeros((asked.domain.nx, len(asked.domain.low)))
    return replace(symmetry, proved=_held(asked, asked.domain.zone, symmetry.axes, 1, zero, "symmetries.translation"))


def declared(problem: GapProblem, gap: GapFunction, residual: Residual, assumed: bool) -> None:
    """UsageError where equations contradict a declared γ (`assumed`: the largest of it), declared constants, or a declared
    curvature in one of its slabs.
    """
    bound, zone, nz = problem.lipschitz, problem.domain.zone, len(problem.domain.low)
    p = AffinePredictor.none(problem.domain.nx, nz) if assumed else problem.predictor
    asked = LipschitzProblem(problem.domain, p, problem.resolution, lambda _, z: residual(z), residual.model, residual.backend)
    if assumed:
        _held(asked, zone, [0], 0, np.repeat(gap.gamma_over(problem.domain.interval).T, nz, axis=1), "gap: γ")
    if assumed or bound.provenance != "declared" or bound.cells is not None:
        return
    axes = [j for j in range(nz) if problem.symmetry is None or j not in problem.symmetry.axes]
    _held(asked, zone, axes, 1, bound.value, "lipschitz: constants")
    for j in axes:
        slabs = bound.slabs and bound.slabs[j]
        cuts = slabs[0] if slabs else np.array([zone.low[j], zone.high[j]])
        for low, high, most in zip(cuts[:-1].tolist(), cuts[1:].tolist(), bound.bend(j, cuts).T, strict=True):
            ends = [(*side[:j], end, *side[j + 1 :]) for side, end in ((zone.low, low), (zone.high, high))]
            if np.isfinite(most).all():
                every = np.broadcast_to(most[:, None], bound.value.shape)
                _held(asked, replace(zone, low=ends[0], high=ends[1]), [j], 2, every, "lipschitz: curvature")


def by_audit(problem: GapProblem, z: Array, r: Array, most: int = 16_000_000) -> dict[str, Any] | None:
    """A point of the audit and a sample, of `most` such pairs, that contradict declared constants or a declared symmetry."""
    if problem.lipschitz.provenance != "declared" and problem.symmetry is None:
        return None
    own, count = problem.samples, min(most // len(z) + 1, len(problem.samples))
    pick = np.linspace(0, len(own) - 1, count).astype(int)
    both = Samples(np.concatenate([own.z[pick], z]), np.concatenate([own.r[pick], r]))
    return contradiction(replace(problem, samples=both), len(both), np.arange(len(pick)), noise=4)
