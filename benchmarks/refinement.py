"""What is won against the number of cells: uniform grids, and the coarsest of them with cells halved where they may yet win.

The pendulum of arXiv 2506.17675 in its box, to be kept there without a gap, with one, and with one that differs in all cells,
and to come to a part of it and stay; the car of SCOTS 0.2 in its maze; and that of ROCS 2 with its formula. Each pair wins the
same states, or no row is printed. CPU seconds in one process that is warm, on one thread.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

import harness
import numpy as np
import yaml

import gapcert as gc
from gapcert_cells.testing import Band

SPECS = Path(__file__).parent.parent / "specs" / "benchmarks"
INPUTS = {"pendulum": {"torque": 21}, "vehicle": {"speed": 7, "steering": 7}, "car": {"speed": 7, "steering": 7}}
CELLS = {
    "pendulum": {"theta": 20, "omega": 50},
    "vehicle": {"x": 50, "y": 50, "heading": 35},
    "car": {"x": 50, "y": 50, "heading": 36},
}
PART = ((0.05, -0.1), (0.15, 0.1))
RANGES = {
    "pendulum": {"theta": (0, 0.2), "omega": (-0.25, 0.25), "torque": (-1, 1)},
    "vehicle": {"x": (0, 10), "y": (0, 10), "heading": (-3.5, 3.5), "speed": (-1, 1), "steering": (-1, 1)},
}


class Growing(Band):
    """A gap that grows with θ and ω."""

    def interval_over(self, boxes: gc.Interval) -> gc.Interval:
        most = 1 + boxes.mag[:, 0] + boxes.mag[:, 1]
        return gc.Interval(self.low * most[:, None], self.high * most[:, None])

    def lipschitz(self, boxes: gc.Interval) -> np.ndarray:
        return np.tile(np.array([1.0, 1.0, 0.0]), (len(boxes), 2, 1))


def problem(name: str, gap: gc.GapFunction | None, stays: bool = False) -> gc.SynthesisProblem:
    if name == "car":
        spec = gc.load_spec(SPECS / "car.yaml")
        domain = gc.Domain.of(spec.build("model"), dict(spec.config.domain or {}))
        return gc.SynthesisProblem(spec.build("model"), None, domain, spec.goal(domain))
    raw = yaml.safe_load((SPECS / f"{name}.yaml").read_text())
    model = gc.load_spec({k: raw[k] for k in ("version", "name", "model")}).build("model")
    domain = gc.Domain.of(model, RANGES[name])
    wanted = raw["controller"]["goal"]
    if name == "pendulum":
        target = gc.Region((gc.Box(domain.states.axes, *PART),))
        goal = gc.Goal("reach_and_stay", domain.states, target) if stays else gc.Goal("invariance", domain.states)
        return gc.SynthesisProblem(model, gap, domain, goal)
    parts = (region([wanted["reach_avoid"]["target"]], domain), region(wanted["reach_avoid"]["avoid"], domain))
    return gc.SynthesisProblem(model, gap, domain, gc.Goal("reach_avoid", domain.states, *parts))


def region(boxes: list[dict[str, list[float]]], domain: gc.Domain) -> gc.Region:
    """Boxes cut to the domain; what they leave out may be anything."""
    made, states = [], domain.states
    for box in boxes:
        ends = [box.get(a.name, (a_low, a_high)) for a, a_low, a_high in zip(states.axes, states.low, states.high, strict=True)]
        low = tuple(max(float(e[0]), a) for e, a in zip(ends, states.low, strict=True))
        high = tuple(min(float(e[1]), b) for e, b in zip(ends, states.high, strict=True))
        made.append(gc.Box(states.axes, low, high))
    return gc.Region(tuple(made))


def timed(name: str, given: gc.SynthesisProblem, doubled: int, refine: int) -> tuple[Any, float]:
    cells = {k: n << doubled for k, n in CELLS[name].items()}
    config = gc.registry().get("synthesizer", "symbolic").load()
    begin = time.process_time()
    made = config(cells=cells, inputs=INPUTS[name], refine=refine, threads=1).synthesize(given)
    return made, time.process_time() - begin


def same(given: gc.SynthesisProblem, fine: Any, ours: Any) -> bool:
    """Do both win the same cells? With an automaton, the same centres of cells."""
    if given.goal.automaton is None:
        return np.array_equal(fine.winning, ours.winning)
    middles = np.stack(np.meshgrid(*((e[:-1] + e[1:]) / 2 for e in fine.parts[0].edges), indexing="ij"), axis=-1)
    x = middles.reshape(-1, middles.shape[-1])
    return all(np.array_equal(fine.contains(part), ours.contains(part)) for part in np.array_split(x, 1 + len(x) // 100_000))


def rows(quick: bool) -> Iterator[harness.Row]:
    cases = (
        ("pendulum", "", None, 5),
        ("pendulum", " with a gap", Band((-5e-4, -3e-3), (5e-4, 3e-3)), 5),
        ("pendulum", " with a gap that differs", Growing((-1e-4, -6e-4), (1e-4, 6e-4)), 5),
        ("pendulum", " to stay", None, 5),
        ("vehicle", "", None, 2),
        ("car", " with a formula", None, 1),
    )
    for name, what, gap, levels in cases[: 1 if quick else None]:
        given = problem(name, gap, what == " to stay")
        for doubled in (0, 1):
            timed(name, given, 0, doubled)
        for level in range(levels + 1):
            fine, fine_time = timed(name, given, level, 0)
            ours, our_time = timed(name, given, 0, level)
            if not same(given, fine, ours):
                raise SystemExit(f"{name}, level {level}: the domains differ")
            axis = given.goal.stay.axes[0]
            width = (given.goal.stay.high[0] - given.goal.stay.low[0]) / (CELLS[name][axis.name] << level)
            case = f"{name}{what}, {width:.3g} {axis.unit}"
            yield harness.Row(case, "winning", "%", 100 * fine.evidence["winning_fraction"], None, "", None)
            solved = sum(r["cells"] for r in ours.evidence["levels"]) if level else fine.evidence["cells"]
            yield harness.row(case, "cells solved", "1", solved, fine.evidence["cells"], "uniform")
            yield harness.row(case, "time", "s of CPU", our_time, fine_time, "uniform")


if __name__ == "__main__":
    harness.main(lambda options: list(rows(options.quick)), argparse.ArgumentParser(description=__doc__))
