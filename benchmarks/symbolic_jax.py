"""The same games by the compiled solvers on one thread and by JAX on the device that it finds, in one process.

Wall seconds of a synthesis, since a device has no CPU seconds; both warm. Domains, values and inputs are compared first. Where
the device is no CPU, ten million cells of a plane are one more case, which the compiled solvers also solve on all cores.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from dataclasses import replace

import gapcert_cells

os.environ["OMP_NUM_THREADS"] = "1"

import harness
import numpy as np
import symbolic
import symbolic_scale

import gapcert as gc
from gapcert_symbolic.synthesizer import Symbolic

CASES = ("vehicle", "pendulum", "pendulum_gap")
CELLS = 57
"""Per axis of the plane."""


def problems(quick: bool, large: bool) -> Iterator[tuple[str, Symbolic, gc.SynthesisProblem, int]]:
    """Each with the threads that the compiled solvers use at most."""
    for key in CASES[: 2 if quick else None]:
        yield symbolic.CASES[key].name, *symbolic.problem(symbolic.CASES[key]), 1
    if large:
        cells, inputs = dict.fromkeys(symbolic_scale.MODEL["states"], CELLS), dict.fromkeys(symbolic_scale.MODEL["inputs"], 5)
        made = Symbolic(cells=cells, inputs=inputs)
        yield f"plane, {CELLS**4:,} cells, 25 inputs", made, symbolic_scale.problem(), len(os.sched_getaffinity(0))


def timed(made: Symbolic, asked: gc.SynthesisProblem, solver: str, threads: int) -> tuple[gapcert_cells.GridController, float]:
    """Of the second of two."""
    made = replace(made, solver=solver, threads=threads)
    made.synthesize(asked)
    begin = time.perf_counter()
    return made.synthesize(asked), time.perf_counter() - begin


def rows(quick: bool) -> Iterator[harness.Row]:
    import jax

    device = jax.devices()[0]
    where = f"{device.platform}: {device.device_kind}"
    for name, made, asked, most in problems(quick, device.platform != "cpu"):
        ours, seconds = timed(made, asked, "jax", 1)
        for threads in sorted({1, most}):
            other, compiled = timed(made, asked, "compiled", threads)
            if not (np.array_equal(ours.values, other.values) and np.array_equal(ours.bits, other.bits)):
                raise SystemExit(f"symbolic_jax: {name}: the two solvers differ")
            peer = f"compiled, {'one thread' if threads == 1 else f'{threads} threads'}"
            yield harness.row(f"{name}, {ours.evidence['rounds']} rounds", f"time on {where}", "s", seconds, compiled, peer)


if __name__ == "__main__":
    harness.main(lambda options: list(rows(options.quick)), argparse.ArgumentParser(description=__doc__))
