"""What is won against the number of cells: uniform grids, and the coarsest of them with cells halved where they may yet win.

The pendulum of arXiv 2506.17675 in its box, without a gap and with one, and the car of SCOTS 0.2 in its maze. Each pair wins
the same states, or no row is printed. CPU seconds in one process that is warm, on one thread.
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
from gapcert.testing.synthesis import Band

SPECS = Path(__file__).parent.parent / "specs" / "benchmarks"
INPUTS = {"pendulum": {"torque": 21}, "vehicle": {"speed": 7, "steering": 7}}
CELLS = {"pendulum": {"theta": 20, "omega": 50}, "vehicle": {"x": 50, "y": 50, "heading": 35}}
RANGES = {
    "pendulum": {"theta": (0, 0.2), "omega": (-0.25, 0.25), "torque": (-1, 1)},
    "vehicle": {"x": (0, 10), "y": (0, 10), "heading": (-3.5, 3.5), "speed": (-1, 1), "steering": (-1, 1)},
}


def problem(name: str, gap: tuple[float, ...] | None) -> gc.SynthesisProblem:
    raw = yaml.safe_load((SPECS / f"{name}.yaml").read_text())
    model = gc.load_spec({k: raw[k] for k in ("version", "name", "model")}).build("model")
    domain = gc.Domain.of(model, RANGES[name])
    band = None if gap is None else Band([-g for g in gap], gap)
    wanted = raw["controller"]["goal"]
    if name == "pendulum":
        return gc.SynthesisProblem(model, band, domain, gc.Goal("invariance", domain.states))
    parts = (region([wanted["reach_avoid"]["target"]], domain), region(wanted["reach_avoid"]["avoid"], domain))
    return gc.SynthesisProblem(model, band, domain, gc.Goal("reach_avoid", domain.states, *parts))


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
    made = config(cells=cells, inputs=INPUTS[name], refine=refine).synthesize(given)
    return made, time.process_time() - begin


def rows(quick: bool) -> Iterator[harness.Row]:
    cases = (("pendulum", None, 5), ("pendulum", (5e-4, 3e-3), 5), ("vehicle", None, 2))
    for name, gap, levels in cases[: 1 if quick else None]:
        given = problem(name, gap)
        for doubled in (0, 1):
            timed(name, given, 0, doubled)
        for level in range(levels + 1):
            fine, fine_time = timed(name, given, level, 0)
            ours, our_time = timed(name, given, 0, level)
            if not np.array_equal(fine.winning, ours.winning):
                raise SystemExit(f"{name}, level {level}: the domains differ")
            axis = given.goal.stay.axes[0]
            width = RANGES[name][axis.name][1] / (CELLS[name][axis.name] << level)
            case = f"{name}{'' if gap is None else ' with a gap'}, {width:.3g} {axis.unit}"
            yield harness.Row(case, "winning", "%", 100 * fine.evidence["winning_fraction"], None, "", None)
            solved = sum(r["cells"] for r in ours.evidence["levels"]) if level else fine.evidence["cells"]
            yield harness.row(case, "cells solved", "1", solved, fine.evidence["cells"], "uniform")
            yield harness.row(case, "time", "s of CPU", our_time, fine_time, "uniform")


if __name__ == "__main__":
    harness.main(lambda options: list(rows(options.quick)), argparse.ArgumentParser(description=__doc__))
