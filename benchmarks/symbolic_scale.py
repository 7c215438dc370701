"""How time and memory of a synthesis grow with the number of cells: a double integrator in the plane (4-D), invariance.

x⁺ = x + τ v + τ²/2 a, v⁺ = v + τ a on [−1, 1]⁴ with 5 × 5 accelerations up to 1.5 m/s² and a gap of 2 mm and 10 mm/s. Each size
in a process of its own, after a small problem that compiles what it needs. CPU seconds and the process's largest memory.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Iterator

import gapcert_cells

os.environ["OMP_NUM_THREADS"] = "1"

import harness

import gapcert as gc
from gapcert_cells.testing import Band

SIZES = (18, 32, 57, 100)  # cells per axis
MODEL = {
    "kind": "equations",
    "states": {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"},
    "inputs": {"ax": "m/s^2", "ay": "m/s^2"},
    "parameters": {"tau": "0.2 s"},
    "next": {
        "x": "x + tau*vx + tau**2/2*ax",
        "y": "y + tau*vy + tau**2/2*ay",
        "vx": "vx + tau*ax",
        "vy": "vy + tau*ay",
    },
    "period": "0.2 s",
}


def problem() -> gc.SynthesisProblem:
    spec = gc.load_spec({"version": 1, "name": "plane", "model": MODEL})
    model = spec.build("model")
    ranges = dict.fromkeys(MODEL["states"], (-1.0, 1.0)) | dict.fromkeys(MODEL["inputs"], (-1.5, 1.5))
    domain = gc.Domain.of(model, ranges)
    gap = Band((-2e-3, -2e-3, -1e-2, -1e-2), (2e-3, 2e-3, 1e-2, 1e-2))
    return gc.SynthesisProblem(model, gap, domain, gc.Goal("invariance", domain.states))


def synthesized(cells: int) -> gapcert_cells.GridController:
    options = {"cells": dict.fromkeys(MODEL["states"], cells), "inputs": dict.fromkeys(MODEL["inputs"], 5)}
    config = gc.registry().get("synthesizer", "symbolic").load()
    return config(**options).synthesize(problem())


def one(cells: int) -> None:
    """The measurement of one size, as a line of JSON."""
    synthesized(5)
    begin = time.process_time()
    made = synthesized(cells)
    seconds, memory = time.process_time() - begin, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps([seconds, memory, made.evidence["winning_fraction"]]))


def rows(quick: bool) -> Iterator[harness.Row]:
    first = None
    for cells in SIZES[: 3 if quick else None]:
        done = subprocess.run([sys.executable, __file__, "--one", str(cells)], capture_output=True, text=True, check=True)
        seconds, memory, winning = json.loads(done.stdout)
        case, first = f"{cells}⁴ = {cells**4:,} cells, 25 inputs", first or seconds
        yield harness.Row(case, "time", "s of CPU", seconds, None, "", None)
        yield harness.Row(case, "time per cell and input", "ns of CPU", 1e9 * seconds / cells**4 / 25, None, "", None)
        yield harness.Row(case, "memory of the process", "MiB", memory, None, "", None)
        yield harness.Row(case, "winning cells", "1", winning, None, "", None)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    if (given := parser.parse_known_args()[0].one) is not None:
        one(given)
    else:
        harness.main(lambda options: list(rows(options.quick)), parser)
