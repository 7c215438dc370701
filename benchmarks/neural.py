"""Family neural, route dominate: networks over the band, with shifts that are proved, on residuals of `curved` and on `Six`.

Peers: the envelope with the true constants and as many samples; the multilinear band of the same samples, which the networks
follow; training without the proof, timed in the same fit; and the evaluation of l and u by either. CPU seconds, one thread.
"""

from __future__ import annotations

import argparse
import os

os.environ["OMP_NUM_THREADS"] = "1"  # before anything loads a library that counts the cores

import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import curved
import harness
import numpy as np
import torch

from gapcert import AdaptiveSampling, GapFunction, LatticeSampling
from gapcert.plugin import GapProblem, LipschitzBound
from gapcert_bounds.families.envelope import Envelope
from gapcert_bounds.families.multilinear import Multilinear
from gapcert_bounds.testing.fields import Field
from gapcert_neural.banded import BandTraining
from gapcert_neural.family import Neural

SIZES, RATES = np.array([0.5, 0.3]), np.array([[1.2, 0.7, 0.5, 0.9, 0.3, 0.6], [0.4, 1.1, 0.8, 0.2, 1.0, 0.5]])


class Six(Field):
    """r = Σ_k a_k sin(p_k · z) on [−1, 1]⁶, two waves. sup |∂_j| = Σ_k a_k p_kj, at 0; |∂²_j| ≤ Σ_k a_k p_kj²."""

    def __init__(self) -> None:
        super().__init__(1, 5)
        self.constants = np.nextafter((SIZES @ RATES)[None], np.inf)
        self.curvature = np.nextafter((SIZES @ RATES**2)[None], np.inf)

    def _step(self, x: np.ndarray, u: np.ndarray, **options: object) -> np.ndarray:
        z = np.hstack([x, u])
        return sum(a * np.sin((z * p).sum(axis=1, keepdims=True)) for a, p in zip(SIZES, RATES, strict=True))

    jacobian_enclosure = curved.Solid.jacobian_enclosure
    enclosure = curved.Solid.enclosure


CASES = (
    ("smooth, 3-D", curved.Solid(), 8_000, {"hidden": (64,)}),
    ("wheels, 4-D", curved.Wheels(), 20_000, {"hidden": (128,), "cells": (6, 6, 6, 8)}),
    ("two waves, 6-D", Six(), 20_000, {"hidden": (64,), "cells": (4,) * 6}),
    ("two waves, 6-D, long proof", Six(), 20_000, {"hidden": (64,), "cells": (4,) * 6, "boxes": 1_500_000}),
)


def fitted(family: Neural, problem: GapProblem) -> tuple[GapFunction, float, float]:
    """The gap function, CPU seconds of its fit, and those of the training within."""
    seconds, run = [], BandTraining.run

    def timed(training: BandTraining) -> object:
        start = time.process_time()
        found = run(training)
        seconds.append(time.process_time() - start)
        return found

    BandTraining.run = timed
    try:
        start = time.process_time()
        gap = family.fit(problem)
        return gap, time.process_time() - start, sum(seconds)
    finally:
        BandTraining.run = run


def rows(quick: bool) -> Iterator[harness.Row]:
    many, few, steps = (100_000, 10_000, 1000) if quick else (1_000_000, 20_000, 2000)
    for case, field, budget, options in CASES[: 3 if quick else None]:
        true = LipschitzBound(field.constants, np.zeros_like(field.constants), "analytic", "exact", curvature=field.curvature)
        slabs = getattr(field, "slabs", None)
        bound = true if slabs is None else replace(true, slabs=slabs)
        cloud = curved.problem(field, AdaptiveSampling(budget), true)
        nodes = curved.problem(field, LatticeSampling(budget=budget), bound)
        envelope, band = Envelope("none").fit(cloud), Multilinear("none").fit(nodes)
        gap, whole, trained = fitted(Neural(steps=steps, device="cpu", **options), nodes)
        (ours, outside), (cones, missed), (table, _) = (
            curved.ratio(g, field, n) for g, n in ((gap, many), (envelope, few), (band, many))
        )
        hidden, cells = (" × ".join(str(n) for n in part) for part in (options["hidden"], gap.table.counts))
        what = f"{hidden} neurons, {cells} cells"
        counts = "×".join(str(len(a)) for a in nodes.samples.lattice or ())
        above, beside = f"envelope, {len(cloud.samples):,} samples", f"multilinear, {counts} nodes"
        yield harness.row(case, f"tightness of neural, {what}", "1", ours, cones, above)
        yield harness.row(case, f"tightness of neural, {what}", "1", ours, table, beside)
        if not case.endswith("long proof"):
            one, _ = curved.ratio(fitted(Neural(steps=steps, device="cpu", sides="one", **options), nodes)[0], field, many)
            yield harness.row(case, "tightness of neural, one network for γ", "1", one, ours, "two networks, for l and u")
        text = f"violations of l ≤ r ≤ u on {many:,} fresh points"
        yield harness.Row(case, text, "1", outside, missed, f"{above}, {few:,} points", None)
        yield harness.row(case, "fit, proof included", "s of CPU", whole, trained, "training alone, same fit")
        yield harness.Row(case, "boxes of the proofs of both sides", "1", float(gap.boxes.sum()), None, "", None)
        z = field.domain.draw(few, np.random.default_rng(3))
        for peer, name in ((envelope, above), (band, beside)):
            times = harness.alternate(partial(gap.interval, z), partial(peer.interval, z))
            yield harness.row(case, "l and u at one point of a batch", "µs of CPU", *(1e6 * t / few for t in times), name)


if __name__ == "__main__":
    torch.set_num_threads(1)
    harness.main(lambda options: list(rows(options.quick)), argparse.ArgumentParser(description=__doc__))
