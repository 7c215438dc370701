"""A minimum without derivatives: quadratic response surfaces over rollouts, one per trajectory, so that it can be resampled."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.plugin import Array
from gapcert_diagnosis.thresholds import THRESHOLDS


@final
@dataclass(frozen=True)
class Surface:
    """c0 + c·d + ½ dᵀC d of d = z − centre per trajectory: coefficients (trajectories, terms), trusted within `radius`."""

    centre: Array
    radius: Array
    coefficients: Array

    @classmethod
    def of(cls, points: Array, scores: Array, centre: Array, radius: Array) -> Surface:
        """Least squares through points (k, p) with scores (k, trajectories)."""
        terms = _terms((points - centre) / radius)
        return cls(centre, radius, np.asarray(np.linalg.lstsq(terms, scores, rcond=None)[0].T, dtype=np.float64))

    def minimum(self, weights: Array | None = None) -> Array:
        """Of the mean surface (weights (trajectories,) or (r, trajectories)), within three radii: (p,) or (r, p)."""
        w = np.ones(len(self.coefficients)) if weights is None else weights
        mean = np.atleast_2d(w @ self.coefficients) / np.atleast_1d(w.sum(axis=-1))[:, None]
        out = np.stack([self._least(c) for c in mean])
        return np.asarray(self.centre + self.radius * (out[0] if w.ndim == 1 else out))

    def mean(self, point: Array) -> float:
        """What it tells of the mean at a point."""
        return float((_terms((point - self.centre)[None] / self.radius) @ self.coefficients.mean(axis=0))[0])

    def _least(self, c: Array) -> Array:
        p = len(self.centre)
        gradient, hessian = c[1 : 1 + p], np.zeros((p, p))
        for k, (i, j) in enumerate(itertools.combinations_with_replacement(range(p), 2)):
            hessian[i, j] += c[1 + p + k]
            hessian[j, i] += c[1 + p + k]
        values, vectors = np.linalg.eigh(hessian)
        slope = vectors.T @ gradient
        # Along a direction without a minimum, the way down is taken to the end of what was tried.
        step = np.where(
            values > THRESHOLDS.flat_curvature * max(np.abs(values).max(), 1e-300),
            -slope / np.where(values > 0, values, 1.0),
            -3.0 * np.sign(slope),
        )
        return np.asarray(np.clip(vectors @ np.clip(step, -3.0, 3.0), -3.0, 3.0))

    def bootstrap(self, seed: int) -> Array:
        """Minima (`resamples`, p) of surfaces whose trajectories are drawn again."""
        n = len(self.coefficients)
        drawn = np.random.default_rng(seed).multinomial(n, np.full(n, 1 / n), THRESHOLDS.resamples)
        return self.minimum(drawn.astype(np.float64))


def _terms(d: Array) -> Array:
    p = d.shape[1]
    squares = [d[:, i] * d[:, j] for i, j in itertools.combinations_with_replacement(range(p), 2)]
    return np.stack([np.ones(len(d)), *d.T, *squares], axis=1)


def design(p: int, *, lean: bool = False) -> Array:
    """Points (k, p) around 0 that fix a quadratic, the ends at ±1: 5, 9 or 15 and more; lean: as many as it has terms."""
    axes = np.concatenate([np.zeros((1, p)), np.eye(p), -np.eye(p)])
    if lean:
        pairs = [0.7 * (a + b) for a, b in itertools.combinations(np.eye(p), 2)]
        return np.concatenate([axes, *(pair[None] for pair in pairs)])
    if p == 1:
        return np.array([[-1.0], [-0.5], [0.0], [0.5], [1.0]])
    corners = np.array(list(itertools.product((-0.7, 0.7), repeat=p)))
    return np.concatenate([axes, corners])


def descend(
    evaluate: Callable[[Array], Array],
    start: Array,
    bounds: Sequence[tuple[float, float]],
    radius: float | Array,
    rounds: int,
    enough: float | None = None,
) -> tuple[Array, Surface]:
    """(the minimum, the last surface around it) of the mean of evaluate(z) (trajectories,), by shrinking surfaces.

    The radius halves while the minimum lies inside, down to about twice what resampling the trajectories moves it by. A surface
    whose minimum is worse than a point that made it (a dip, or chaos) is made again around that point, narrower, as often as
    there are rounds. enough: a start is near; surfaces have no more points than terms, and one that tells the mean at its
    minimum so well is the last.
    """
    low, high = (np.array(side) for side in zip(*bounds, strict=True))
    centre, size = np.clip(start, low, high), np.minimum(np.full(len(start), radius), THRESHOLDS.largest_radius)
    plan = design(len(start), lean=enough is not None)
    best, left = centre, rounds
    for _ in range(2 * rounds):
        points = np.clip(centre + plan * size, low, high)
        scores = np.stack([evaluate(z) for z in points])
        surface = Surface.of(points, scores, centre, size)
        new, tried = np.clip(surface.minimum(), low, high), scores.mean(axis=1)
        mean = float(evaluate(new).mean())
        if mean > tried.min() + THRESHOLDS.worse_centre:
            centre = best = points[tried.argmin()]
            size = np.maximum(size / THRESHOLDS.radius_shrink, THRESHOLDS.least_radius)
            continue
        left -= 1
        inside = (np.abs(new - centre) <= size).all()
        centre, best = (new, new) if inside else (np.clip(new, centre - 2 * size, centre + 2 * size), new)
        if left == 0 or (inside and enough is not None and abs(mean - surface.mean(new)) <= enough):
            break
        if inside:
            width = np.std(surface.bootstrap(0), axis=0)
            size = np.clip(np.maximum(size / THRESHOLDS.radius_shrink, 2 * width), THRESHOLDS.least_radius, size)
    return best, surface
