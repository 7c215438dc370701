"""What watching γ costs: one step of the online monitor against one evaluation of the nominal model in NumPy.

The certificate is that of specs/pendulum.yaml: an envelope of about 300 samples with an affine predictor.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

import harness
import numpy as np

import gapcert as gc

SPEC = Path(__file__).resolve().parent.parent / "specs" / "pendulum.yaml"
ALONE = (
    "controller=null",
    "closed_loop=null",
    "report.html=false",
    "report.rerun=false",
    "expect=null",
    "certificate.attack=0",
)
STEPS = 2_000


def measure(options: argparse.Namespace) -> list[harness.Row]:
    with tempfile.TemporaryDirectory() as folder:
        done = gc.run(SPEC, overrides=ALONE, out=folder)
        loaded = gc.Certified.load(done.folder).monitor()
    certificate = done.certificate
    assert certificate is not None
    assert certificate.model is not None
    own, (x, u, after) = certificate.monitor(), (np.array([0.01, 0.02]), np.array([0.1]), np.array([0.0101, 0.0205]))
    f = certificate.model
    p, rows, inputs = {"g": 9.81, "l": 1.0, "m": 1.0, "tau": 0.005}, x[None], u[None]

    def stepped(monitor: Any) -> Callable[[], None]:
        def run() -> None:
            for _ in range(STEPS):
                monitor.step(x, u, after)

        return run

    def plain() -> None:
        for _ in range(STEPS):
            omega = -3 * p["g"] / (2 * p["l"]) * np.sin(rows[:, 0]) + 3 * inputs[:, 0] / (p["m"] * p["l"] ** 2)
            rows + p["tau"] * np.stack([rows[:, 1], omega], axis=1)

    def model() -> None:
        for _ in range(STEPS):
            f.step(rows, inputs)

    found = []
    for case, monitor in (("pendulum, one step", own), ("pendulum, one step, of a run folder", loaded)):
        for peer, name in ((plain, "f written out in NumPy"), (model, "f as the spec's model")):
            times = harness.alternate(stepped(monitor), peer, repeats=5 if options.quick else 15)
            found.append(harness.row(case, "time", "µs of CPU", *(1e6 * t / STEPS for t in times), name))
    return found


if __name__ == "__main__":
    harness.main(measure, argparse.ArgumentParser(description=__doc__))
