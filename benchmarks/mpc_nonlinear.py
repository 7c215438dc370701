"""Robust MPC along lines of its own: what γ costs of the domain, and what a step costs beside the intervals of slopes alone.

The cart-pole and the quadrotor of the tests, at corners of their gaps drawn afresh at each step. Times are seconds of CPU of
one thread, beside those of one call for the slopes of all boxes of all stages.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from harness import Row, main, row

sys.path.append(str(Path(__file__).parents[1] / "tests" / "mpc"))
from test_nonlinear import CARTPOLE, CARTPOLE_GAP, CARTPOLE_Z, QUADROTOR, QUADROTOR_GAP, QUADROTOR_Z, band, problem

from gapcert import Interval
from gapcert_mpc.synthesizer import Mpc
from gapcert_mpc.thresholds import THRESHOLDS


def measured(name: str, spec: Any, ranges: Any, gamma: np.ndarray, steps: int, horizon: int = 20) -> list[Row]:
    """Of one model."""
    makes = Mpc(horizon=horizon, linearisation="successive")
    made = [makes.synthesize(problem(gap, spec, ranges)) for gap in (None, band(gamma))]
    nominal, robust = (c.evidence["domain_fraction"] for c in made)
    controller, rng = made[1], np.random.default_rng(0)
    model = controller.nominal.model
    x = controller.draw(24, rng)[:6]
    memory, violations = controller.start(x), 0
    times: list[float] = []
    for _ in range(steps):
        u = controller.respond(x, memory, "first")
        x = model.step(x, u).x + gamma * rng.choice([-1, 1], x.shape)
        violations += int((~controller.goal.holds(x)).sum())
        for i in range(len(x)):
            began = time.process_time()
            memory[i : i + 1] = controller.advance(x[i : i + 1], memory[i : i + 1])
            times.append(time.process_time() - began)
    boxes = Interval(np.full((horizon * THRESHOLDS.slope_parts, model.nx + model.nu), -0.1), 0.1)
    began = time.process_time()
    for _ in range(20):
        model.jacobian_enclosure(boxes)
    slopes = (time.process_time() - began) / 20 * 1e3
    asked = f"{len(x)} runs of {steps} steps"
    return [
        row(name, "share of the goal won", "1", robust, nominal, "without γ", less_is_better=False),
        Row(name, f"violations in {asked}", "1", float(violations), None, "", None),
        Row(name, f"steps with a plan of before in {asked}", "1", float(controller.counts["shifted"]), None, "", None),
        row(name, "step, median", "ms of CPU", float(np.median(times)) * 1e3, slopes, "slopes alone"),
        row(name, "step, 99 %", "ms of CPU", float(np.quantile(times, 0.99)) * 1e3, slopes, "slopes alone"),
    ]


def measure(options: argparse.Namespace) -> list[Row]:
    steps = 20 if options.quick else 100
    return measured("cart-pole", CARTPOLE, CARTPOLE_Z, CARTPOLE_GAP, steps) + measured(
        "quadrotor", QUADROTOR, QUADROTOR_Z, QUADROTOR_GAP, steps
    )


if __name__ == "__main__":
    main(measure, argparse.ArgumentParser(description=__doc__))
