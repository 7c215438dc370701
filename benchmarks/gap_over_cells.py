"""How far each family's bound of its band over a cell lies beyond what the band takes in it, and what that costs per cell.

Random cells of width η along the three axes of [−1, 1]³ (two states, one input); all families are fitted to the same smooth
residual. What the band takes is searched for: corners, random points, steps of falling size. Then a network alone, 4-400-1,
with values of 0.1 to 0.3, its last two inputs exact, beside what is often used instead: its value at the centre, a Lipschitz
constant times the radius, the ranges of its layers, and the mean-value form about the centre.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator

import gapcert_networks

os.environ["OMP_NUM_THREADS"] = "1"

import harness
import numpy as np

import gapcert as gc
from gapcert_bounds.testing.excess import excess
from gapcert_bounds.testing.fields import Waves, gap_problem
from gapcert_calibrate.route import CalibratedGap

ETAS, NETWORK_ETAS, STEPS = (0.1, 0.05, 0.025), (0.05, 0.01), 120
FUNCTIONS = ("1", "sin(2*x0)", "cos(2*x0)", "sin(2*x1)", "cos(2*x1)", "sin(2*u0)", "cos(2*u0)", "abs(x0)*abs(u0)")
Bound = Callable[[gc.Interval], np.ndarray]


def component(name: str, **options: object) -> gc.plugin.GapFamily:
    made: gc.plugin.GapFamily = gc.registry().get("gap_family", name).load()(**options)
    return made


def families() -> Iterator[tuple[str, gc.GapFunction]]:
    field = Waves.smooth()
    cover, plain, affine = (
        gap_problem(field, (16,) * 3, route="theorem1"),
        gap_problem(field, (6,) * 3),
        gap_problem(field, (6,) * 3, affine=True),
    )
    envelope = component("envelope", predictor="none").fit(plain)
    yield "constant", component("constant").fit(plain)
    yield "envelope", envelope
    yield "envelope, affine predictor", component("envelope").fit(affine)
    yield "envelope, calibrated inwards", CalibratedGap(envelope, np.array([0.01, -0.005]), np.zeros(2))
    yield "multilinear", component("multilinear", predictor="none").fit(plain)
    yield "multilinear, affine predictor", component("multilinear").fit(affine)
    basis = {"functions": list(FUNCTIONS), "cells": [4, 4, 4]}
    yield "basis, theorem 1", component("basis", functions=list(FUNCTIONS)).fit(cover)
    yield "basis, dominating", component("basis", **basis).fit(plain)
    yield "basis, dominating, affine predictor", component("basis", **basis, predictor="affine").fit(affine)
    network = {"hidden": [32], "steps": 300}
    yield "network, theorem 1", component("neural", **network).fit(cover)
    yield "network, dominating", component("neural", **network, cells=[4, 4, 4]).fit(plain)
    yield "network, dominating, affine predictor", component("neural", **network, cells=[4, 4, 4]).fit(affine)


def cells(n: int, eta: float, nz: int) -> gc.Interval:
    low = np.random.default_rng(1).random((n, nz)) * (2 - eta) - 1
    return gc.Interval(low, low + eta)


def microseconds(task: Callable[[], object], n: int, repeats: int = 3) -> float:
    best = np.inf
    for _ in range(repeats):
        begin = time.process_time()
        task()
        best = min(best, time.process_time() - begin)
    return best / n * 1e6


def of_families(n: int) -> None:
    print("| family | " + " | ".join(f"η {eta:g}" for eta in ETAS) + " | mean γ | µs per cell |")
    print("| --- |" + " --- |" * (len(ETAS) + 2))
    for name, gap in families():
        found = [excess(gap, cells(n, eta, 3), steps=STEPS) for eta in ETAS]
        boxes = cells(4096, ETAS[1], 3)
        took = microseconds(lambda gap=gap, boxes=boxes: gap.interval_over(boxes), len(boxes))
        row = " | ".join(f"{e.mean():.1e} ({e.max():.1e})" for e in found)
        print(f"| {name} | {row} | {gap.gamma(boxes.mid).mean():.2f} | {took:.0f} |", flush=True)


def network(activation: str) -> gapcert_networks.Network:
    rng = np.random.default_rng(0)
    first = rng.standard_normal((400, 4))
    b, last = rng.uniform(-0.7, 0.7, 400) * np.abs(first).sum(axis=1), rng.standard_normal((1, 400))
    value = gapcert_networks.Network((first, last), (b, np.zeros(1)), activation)(rng.uniform(-1, 1, (20_000, 4)))
    scale = 0.2 / np.ptp(value)
    return gapcert_networks.Network((first, scale * last), (b, np.array([0.1 - scale * value.min()])), activation)


def of_networks(n: int) -> None:
    print("| network | bound | " + " | ".join(f"η {eta:g}" for eta in NETWORK_ETAS) + " | µs per cell |")
    print("| --- | --- |" + " --- |" * (len(NETWORK_ETAS) + 1))
    for activation in ("relu", "tanh"):
        q = network(activation)
        constant = np.linalg.norm(q.weights[0], 2) * np.linalg.norm(q.weights[1])
        bounds: dict[str, Bound] = {
            "value at the centre": lambda b, q=q: q(b.mid)[:, 0],
            "constant × radius": lambda b, q=q, c=constant: q(b.mid)[:, 0] + c * np.linalg.norm(b.rad, axis=1),
            "ranges of layers": lambda b, q=q: q.over(b).hi[:, 0],
            "mean-value form": lambda b, q=q: (
                (q.over(gc.Interval.exact(b.mid))[:, 0] + (q.gradient_over(b, 0) * (b - b.mid)).sum(-1)).hi
            ),
            "`tight_over`": lambda b, q=q: q.tight_over(b).hi[:, 0],
        }
        boxes = []
        for eta in NETWORK_ETAS:
            low = cells(n, eta, 4).lo
            boxes.append(gc.Interval(low, low + np.array([eta, eta, 0.0, 0.0])))
        most = [highest(q, b) for b in boxes]
        for name, bound in bounds.items():
            found = [bound(b) - m for b, m in zip(boxes, most, strict=True)]
            row = " | ".join(f"{f.mean():.1e} ({f.max():.1e})" for f in found)
            took = microseconds(lambda bound=bound, b=boxes[0]: bound(b), n)
            print(f"| {activation} | {name} | {row} | {took:.1f} |", flush=True)


def highest(q: gapcert_networks.Network, boxes: gc.Interval) -> np.ndarray:
    """The largest value found in each box."""
    rng, width = np.random.default_rng(2), boxes.hi - boxes.lo
    at, best = boxes.mid.copy(), q(boxes.mid)[:, 0]
    corners = [np.array([k & 1, k >> 1, 0, 0]) * width + boxes.lo for k in range(4)]
    for k in range(104):
        z = corners[k] if k < 4 else boxes.lo + rng.random(width.shape) * width
        if k >= 64:
            z = np.clip(at + (rng.random(width.shape) - 0.5) * 0.8 ** (k - 64) * width, boxes.lo, boxes.hi)
        value = q(z)[:, 0]
        better = value > best
        best[better], at[better] = value[better], z[better]
    return best


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=3000)
    n = parser.parse_args().cells
    print(", ".join(f"{k}: {v}" for k, v in harness.machine().items()), end="\n\n")
    print(f"Beyond what is reached, mean (largest) over {n} cells.\n")
    of_families(n)
    print()
    of_networks(n)
