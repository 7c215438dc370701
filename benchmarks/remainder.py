"""What a controller gains that takes f + p as its model, and an affine majorant of the rest: widths and means over a domain.

The pendulum of specs/pendulum.yaml against PyBullet, an envelope of about 300 samples with an affine predictor, and an envelope
of 300 samples in eight dimensions, a steep affine part with a small rest. Peers: the whole band, and the constant of the box.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"

import harness
import numpy as np

import gapcert as gc
from gapcert_bounds.testing.fields import Waves, gap_problem

SPEC = Path(__file__).resolve().parent.parent / "specs" / "pendulum.yaml"
ALONE = (
    "controller=null",
    "closed_loop=null",
    "report.html=false",
    "report.rerun=false",
    "expect=null",
    "certificate.attack=0",
)


def pendulum() -> tuple[gc.GapFunction, gc.Interval]:
    with tempfile.TemporaryDirectory() as folder:
        certificate = gc.run(SPEC, overrides=ALONE, out=folder).certificate
    assert certificate is not None
    return certificate.gap, certificate.domain.interval


def eight() -> tuple[gc.GapFunction, gc.Interval]:
    """Four states and four inputs; each axis matters half as much as the one before it."""
    rng, shape = np.random.default_rng(8), (4, 8)
    amplitude = 0.05 * rng.normal(size=shape) * 2.0 ** -np.arange(8)
    rest = Waves(amplitude, rng.uniform(0.5, 2, shape), rng.uniform(-3, 3, shape))
    p = gc.plugin.AffinePredictor(rng.normal(size=4), rng.normal(size=shape))
    z = rest.domain.draw(300, rng)
    plain = gap_problem(rest, (1,) * 8)
    problem = gc.plugin.GapProblem(
        gc.plugin.Samples(z, rest(z) + p(z)), rest.domain, plain.lipschitz, p, plain.resolution, "dominate"
    )
    return gc.registry().build("gap_family", "envelope").fit(problem), rest.domain.interval


def rows(case: str, gap: gc.GapFunction, box: gc.Interval, count: int) -> list[harness.Row]:
    whole, left = gap.interval_over(box).width[0], gap.remainder_over(box).width[0]
    found = [
        harness.row(case, f"width, state {i}", "unit of the state", left[i], whole[i], "the band with p")
        for i in range(len(left))
    ]
    z, zero = box.lo + np.random.default_rng(0).random((100_000, box.shape[1])) * box.width, np.zeros(box.shape[1])
    for name, bound in (("γ", gap.gamma_over), ("remainder", lambda b: gap.remainder_over(b).mag)):
        begin = time.process_time()
        c, a = gc.plugin.majorant_of(bound, box.lo[0], box.hi[0], zero, count)
        took, mean, flat = time.process_time() - begin, (c + np.abs(z) @ a.T).mean(axis=0), bound(box)[0]
        text = f"mean majorant of {name}, {count} cells in {took:.1f} s, state"
        found += [harness.row(case, f"{text} {i}", "unit of the state", mean[i], flat[i], "constant") for i in range(len(mean))]
    return found


def measure(options: argparse.Namespace) -> list[harness.Row]:
    count = 1000 if options.quick else 4096
    return rows("pendulum", *pendulum(), count) + rows("eight dimensions", *eight(), count)


if __name__ == "__main__":
    harness.main(measure, argparse.ArgumentParser(description=__doc__))
