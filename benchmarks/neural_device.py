"""Steps of a training on a GPU against the CPU, where it takes one thread: wall seconds for a thousand.

Two hundred of a training of two thousand are timed, with the two looks at all points that fall among them. What is trained
follows a band (route dominate) or lies above the samples of a cover (route theorem1), on drawn targets: what a step costs does
not depend on them. Without a GPU the rows have no ratio.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import suppress

import harness
import numpy as np
import torch

from gapcert_neural.banded import BandTraining, Pool
from gapcert_neural.covered import SHAPES, CertifiedTraining, Covered, PaperTraining
from gapcert_neural.training import Plan, Training

WARM, TIMED, STEPS = 40, 200, 2000
NZ, NX, POINTS = 4, 2, 65_536
SIZES: tuple[tuple[str, tuple[int, ...]], ...] = (
    ("band", (64, 64)),
    ("band", (400, 400)),
    ("certified", (64,)),
    ("certified", (400,)),
    ("paper", (400,)),
    ("lbdn", (64, 64)),
    ("lbdn", (256, 256)),
    ("sll", (64, 64)),
)


class Done(Exception):
    """Enough steps have been timed."""


class Watch:
    """Whom a training tells how far it is; a GPU has done what it was asked for when it is asked to wait."""

    def __init__(self, device: str) -> None:
        self.wait = torch.cuda.synchronize if device == "cuda" else lambda: None
        self.start = self.seconds = 0.0

    def __call__(self, done: int, total: int, best: float) -> None:
        if done == WARM:
            self.wait()
            self.start = time.perf_counter()
        elif done == WARM + TIMED:
            self.wait()
            self.seconds = time.perf_counter() - self.start
            raise Done


def made(kind: str, hidden: tuple[int, ...], device: str, watch: Watch) -> Training:
    rng, plan = np.random.default_rng(0), Plan(hidden, "relu", STEPS, 0, device)
    z = rng.uniform(-1, 1, (POINTS, NZ))
    size = 1 + np.sin(3 * z[:, :NX]) ** 2 + rng.random((POINTS, NX))
    if kind == "band":
        cell = np.ravel_multi_index(((z + 1) * 3.999).astype(int).T, (8,) * NZ)
        pool = Pool.sorted(z, np.hstack([-size, size]), np.repeat([-1.0, 1.0], NX), cell)
        return BandTraining(plan, pool, None, watch)
    points = Covered(z, size, np.ones(NZ), 0.05, np.ones(NZ))
    if kind == "paper":
        return PaperTraining(plan, points, None, watch, np.full(NX, 3.0), 1e-4)
    return (SHAPES | {"certified": CertifiedTraining})[kind](plan, points, None, watch)


def seconds(kind: str, hidden: tuple[int, ...], device: str) -> float:
    """For a thousand steps."""
    watch = Watch(device)
    with suppress(Done):
        made(kind, hidden, device, watch).run()
    return 1000 * watch.seconds / TIMED


def rows(quick: bool) -> Iterator[harness.Row]:
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    for kind, hidden in SIZES[: 2 if quick else None]:
        case = f"{kind}, {' × '.join(map(str, hidden))} neurons"
        cpu = seconds(kind, hidden, "cpu")
        if gpu is None:
            yield harness.row(case, "1000 steps on cpu, one thread", "s", cpu, None, "no GPU here")
        else:
            own = seconds(kind, hidden, "cuda")
            yield harness.row(case, f"1000 steps on {gpu}", "s", own, cpu, "`device: cpu`, one thread of the same machine")


if __name__ == "__main__":
    harness.main(lambda options: list(rows(options.quick)), argparse.ArgumentParser(description=__doc__))
