"""The same games by the compiled solvers on one thread and by JAX on the device that it finds, in one process.

Wall seconds of a synthesis, since a device has no CPU seconds; both warm. Domains, values and inputs are compared first.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator

os.environ["OMP_NUM_THREADS"] = "1"

import harness
import numpy as np
import symbolic

CASES = ("vehicle", "pendulum", "pendulum_gap")


def rows(quick: bool) -> Iterator[harness.Row]:
    import jax

    device = jax.devices()[0]
    where = f"{device.platform}: {device.device_kind}"
    for key in CASES[: 2 if quick else None]:
        made, asked = symbolic.problem(symbolic.CASES[key])
        made.threads = 1
        found, seconds = [], []
        for solver in ("jax", "compiled"):
            made.solver = solver
            found.append(made.synthesize(asked))
            begin = time.perf_counter()
            made.synthesize(asked)
            seconds.append(time.perf_counter() - begin)
        ours, other = found
        if not (np.array_equal(ours.values, other.values) and np.array_equal(ours.bits, other.bits)):
            raise SystemExit(f"symbolic_jax: {key}: the two solvers differ")
        case = f"{symbolic.CASES[key].name}, {ours.evidence['rounds']} rounds"
        yield harness.row(case, f"time on {where}", "s", seconds[0], seconds[1], "compiled, one thread")


if __name__ == "__main__":
    harness.main(lambda options: list(rows(options.quick)), argparse.ArgumentParser(description=__doc__))
