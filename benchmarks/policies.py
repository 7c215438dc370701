"""The pendulum in closed loop on PyBullet under every policy: how many runs depart without γ, and with the certified γ.

150 starts in the controller's domain, 400 steps; a departure is a state outside the domain, from which no input is promised.
Which input a controller takes among the valid ones decides what a wrong model costs: so no row stands for the others.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"

import harness

import gapcert

PENDULUM = Path(__file__).parents[1] / "specs" / "pendulum.yaml"


def rows(quick: bool) -> Iterator[harness.Row]:
    starts, steps = (30, 100) if quick else (150, 400)
    changes = (f"closed_loop.starts={starts}", f"closed_loop.steps={steps}")
    with tempfile.TemporaryDirectory() as folder:
        run = gapcert.run(PENDULUM, out=folder, overrides=changes)
    counted = {(r["policy"], r["controller"]): r["violations"] for r in run.summary["closed_loop"]["policies"]}
    for policy in dict.fromkeys(p for p, _ in counted):
        case = f"{starts} starts, {steps} steps, policy {policy}"
        ours, without = (float(counted[policy, name]) for name in ("with_gamma", "without_gamma"))
        yield harness.Row(case, "runs that depart, with γ", "1", ours, without, "without γ", None)


if __name__ == "__main__":
    harness.main(lambda options: list(rows(options.quick)), argparse.ArgumentParser(description=__doc__))
