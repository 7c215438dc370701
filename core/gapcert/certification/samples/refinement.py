"""Further samples in rounds: all that the budget allows, or until the certified band is tight enough."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.gaps.gap import GapFunction, GapProblem
from gapcert.contracts.gaps.predictor import Samples
from gapcert.contracts.plugins.registry import registry
from gapcert.numerics.arrays import Array


def refined(problem: GapProblem, further: Array, tightness: float | None, query: Callable[[str, Array], Array]) -> Samples:
    """The problem's samples and those at `further` (m, nz), asked for round by round.

    With a `tightness` t it ends where the envelope's mean γ_i is at most t times the mean of |(l_i + u_i) / 2| in every state,
    or its gap is too small to be told from the resolution. Each round at least doubles the samples; points are taken in their
    order, so that a round is a pure function of the rounds before. Anchors of cells are in the first.
    """
    samples, start, cells = problem.samples, 0, problem.lipschitz.cells
    watch = _Watch(problem)
    if tightness is not None and cells is None and watch.tight(samples, samples, tightness):
        return samples
    least = 1 if cells is None else len(cells.anchors)
    for k, stop in enumerate(_ends(len(samples), least, len(further)) if tightness is not None else [len(further)]):
        part = further[start:stop]
        r = np.concatenate([samples.r, query(f"bound-{k + 1}", part)])
        taken = None if samples.taken is None else samples.taken + len(part)
        samples, start = Samples(np.concatenate([samples.z, part]), r, taken=taken), stop
        new = Samples(part, r[-len(part) :])
        if tightness is not None and stop < len(further) and watch.tight(samples, new, tightness):
            break
    return samples


def _ends(first: int, least: int, count: int) -> list[int]:
    """How many of the further samples there are after each round."""
    ratio = max(2.0, ((first + count) / first) ** (1 / THRESHOLDS.refinement_rounds))
    ends = first * ratio ** np.arange(1, THRESHOLDS.refinement_rounds + 1) - first
    return sorted({int(np.clip(e, min(least, count), count)) for e in ends} | {count})


class _Watch:
    """The envelope at fixed points, which costs no simulation. It is a minimum (u) and a maximum (l) over samples, so that a
    round looks at its own samples alone; with constants per cell, whose bands hold within a cell, at all of them.
    """

    def __init__(self, problem: GapProblem) -> None:
        self.problem, self.z = (
            problem,
            problem.domain.draw(THRESHOLDS.refinement_points, np.random.default_rng([problem.seed, 0x7167])),
        )
        self.low: float | Array = -np.inf
        self.high: float | Array = np.inf

    def tight(self, samples: Samples, new: Samples, tightness: float) -> bool:
        alone = self.problem.lipschitz.cells is None
        problem = replace(self.problem, samples=new if alone else samples)
        gap: GapFunction = registry().build("gap_family", "envelope").fit(problem)
        low, high = gap.interval(self.z)
        if alone:
            low, high = np.maximum(low, self.low), np.minimum(high, self.high)
        self.low, self.high = low, high
        gamma, centre = np.maximum(np.abs(low), np.abs(high)).mean(axis=0), np.abs(low + high).mean(axis=0) / 2
        return bool(((gamma <= tightness * centre) | (gamma <= 10 * problem.arithmetic)).all())
