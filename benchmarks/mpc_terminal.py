"""Where plans may end: around a steady pair, or in the winning set of a controller on cells, for several horizons.

The rod is kept in its goal under γ. Columns: the share of random states from which a plan around a steady pair begins, the
winning cells' share, that of plans which end in them, that of both together; states that only the steady pair has; the time of
a step (`advance`, `keeps`, `respond`) over that with a steady pair, along runs at a corner of γ from states that both have,
in CPU time of one thread; and steps that broke a promise in these runs and in runs without a solver after the start.
"""

from __future__ import annotations

import os
import statistics
import sys
import time

os.environ["OMP_NUM_THREADS"] = "1"

import harness
import numpy as np

from gapcert import Controller
from gapcert_cells.testing import Band, Rod, rod_problem
from gapcert_mpc.synthesizer import Mpc
from gapcert_mpc.variants.terminal import HandedController

Array = np.ndarray
GAP = Band((-1.5e-4, -6e-5), (1.5e-4, 6e-5))
STATES, RUNS, STEPS = 2000, 20, 300


def run(controller: Controller, x: Array, online: bool = True) -> tuple[float, int]:
    """(median seconds of a step, broken promises) of runs from x, each at one corner of the gap."""
    memory, seconds, broken = controller.start(x), [], 0
    corner = np.where(np.random.default_rng(2).random(x.shape) < 0.5, GAP.low, GAP.high)
    if not online:
        assert isinstance(controller, HandedController)
        controller.plans.engine.solvers.clear()
    u = controller.respond(x, memory, "first")
    for _ in range(STEPS):
        after = Rod().step(x, u).x + corner
        broken += int((~controller.kept(x, u, after, memory)).sum())
        begin = time.process_time()
        memory = controller.advance(after, memory)
        broken += int((~controller.keeps(after, memory)).sum())
        u = controller.respond(after, memory, "first")
        seconds.append((time.process_time() - begin) / len(x))
        x = after
    return statistics.median(seconds), broken


def row(horizon: int, cells: tuple[int, int]) -> list[str]:
    problem = rod_problem(gap=GAP)
    asked = {"kind": "symbolic", "cells": dict(zip(("theta", "omega"), cells, strict=True)), "inputs": {"torque": 9}}
    steady = Mpc(horizon=horizon).synthesize(problem)
    made = Mpc(horizon=horizon, terminal=asked).synthesize(problem)
    assert isinstance(made, HandedController)
    low, high = np.asarray(problem.goal.stay.low), np.asarray(problem.goal.stay.high)
    x = np.random.default_rng(1).uniform(low, high, (STATES, 2))
    around, into, won = steady.contains(x), made.plans.contains(x), made.then.contains(x)
    theirs, _ = run(steady, x[around & into][:RUNS])
    seconds, broken = run(made, x[around & into][:RUNS])
    edge = x[into & ~won][:RUNS]
    broken += run(made, edge)[1] + run(made, edge, online=False)[1]
    shares = [f"{100 * part.mean():.1f} %" for part in (around, won, into, into | won)]
    only = str(int((around & ~(into | won)).sum()))
    return [str(horizon), f"{cells[0]} × {cells[1]}", *shares, only, f"{seconds / theirs:.2f}", str(broken)]


def main() -> None:
    print(harness.machine())
    head = ["N", "cells", "steady pair", "cells win", "plans into them", "both", "steady pair alone", "time", "broken"]
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
    for horizon in map(int, sys.argv[1:] or (5, 10, 20)):
        for cells in ((100, 60), (200, 100)):
            print("| " + " | ".join(row(horizon, cells)) + " |", flush=True)


if __name__ == "__main__":
    main()
