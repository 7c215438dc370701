"""MuJoCo XLA on the device that JAX finds, over the rows that it steps at once, against the C code on one core and on all.

Wall seconds, since a device has no CPU seconds; queries of `tiles` rows, so that no row is in vain, and all that goes to the
device and back is in. Answers are compared with the C code's first. Compilation is a row of its own.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator

import harness
import numpy as np
from engines.case import PENDULUM
from engines.mjx_ import ARM, backend

TILES = (256, 4096, 16_384, 65_536)
OWN = 1024
"""Rows that differ in dampings: each costs the C code a model of its own."""
ROBOTS = (("pendulum", PENDULUM, 1), ("arm of 7 joints", ARM, 1), ("arm of 7 joints, 10 sub-steps", ARM, 10))


def rows(quick: bool) -> Iterator[harness.Row]:
    import jax

    device = jax.devices()[0]
    where, cores, repeats = f"{device.platform}: {device.device_kind}", len(os.sched_getaffinity(0)), 3 if quick else 5
    for name, section, substeps in ROBOTS[: 2 if quick else None]:
        theirs = [(n, backend(section | {"substeps": substeps, "threads": n}, "c", 256)) for n in sorted({1, cores})]
        for tiles in TILES[: 3 if quick else None]:
            ours, rng = backend(section | {"substeps": substeps}, "mjx", tiles), np.random.default_rng(0)
            x, u = rng.uniform(-1, 1, (tiles, ours.nx)), rng.uniform(-1, 1, (tiles, ours.nu))
            start = time.perf_counter()
            there = ours.step(x, u).x
            first = time.perf_counter() - start
            case = f"{name}, {tiles:,} rows at once"
            if (worst := np.abs(there - theirs[0][1].step(x, u).x).max()) > 1e-9:
                raise SystemExit(f"mjx_tiles: {case} differs from the C code by {worst:.2g}")
            yield harness.row(case, f"first query on {where}, compilation", "s", first, None, "")
            for threads, other in theirs:
                seconds = harness.alternate(
                    lambda b=ours, x=x, u=u: b.step(x, u),
                    lambda b=other, x=x, u=u: b.step(x, u),
                    repeats=repeats,
                    clock=time.perf_counter,
                    warm=0.1,
                )
                peer = f"`implementation: c`, {threads} core{'s' if threads > 1 else ''} of the same machine"
                yield harness.row(case, f"time on {where}", "us per transition", *(1e6 * s / tiles for s in seconds), peer)
    yield _own(where)


def _own(where: str) -> harness.Row:
    """The arm with other dampings in every row, along a rollout: parameters are handed over once."""
    rng, steps = np.random.default_rng(0), 20
    ours, theirs = backend(ARM, "mjx", OWN), backend(ARM, "c", 256)
    x, u = rng.uniform(-1, 1, (OWN, ours.nx)), rng.uniform(-1, 1, (OWN, steps, ours.nu))
    given = {f"damping.j{j}": rng.uniform(0.05, 1, OWN) for j in range(1, 8)}
    seconds = []
    for by in (ours, theirs):
        by.rollout(x[:8], u[:8, :2])
        start = time.perf_counter()
        by.rollout(x, u, parameters=given)
        seconds.append(time.perf_counter() - start)
    case = f"arm of 7 joints, {OWN:,} rows of other dampings, {steps} periods"
    return harness.row(
        case, f"time on {where}", "us per transition", *(1e6 * s / OWN / steps for s in seconds), "`implementation: c`"
    )


if __name__ == "__main__":
    harness.main(lambda options: list(rows(options.quick)), argparse.ArgumentParser(description=__doc__))
