"""Controllers for gaps that differ with all states and inputs, beside the constant gap of the same samples: CPU seconds, cells.

The specs are those of specs/benchmarks, each with a backend that differs from its model: the cars drive by up to 0.4 % slower
or faster, by where they are, and the pendulum is damped. One thread of a process that has compiled everything; the seconds
are those of bounding the gap over blocks, and of all of the synthesizer. The last rows have room for fewer entries of tables.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import replace
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

import harness
import numpy as np
import symbolic as published

import gapcert as gc
import gapcert_symbolic.cells.gaps as gaps
from gapcert.spec.spec import Spec

TURN = "atan(tan(steering)/2)"
CAR = (
    f"backend.derivative.x=(1 - 0.004*cos(y/wheelbase))*speed*cos({TURN} + heading)/cos({TURN})",
    f"backend.derivative.y=(1 - 0.004*sin(x/wheelbase))*speed*sin({TURN} + heading)/cos({TURN})",
)
ROD = ("backend.derivative.omega=-0.99*3*g/(2*l)*sin(theta) - 0.1*omega*sqrt(g/l) + 3*torque/(m*l**2)",)
CASES = {"pendulum": ROD, "vehicle": CAR, "car": CAR}
ROOMS = (gaps.THRESHOLDS.window_entries, 100_000)


def certified(spec: Spec) -> gc.GapFunction:
    data = {k: v for k, v in spec.data.items() if k not in ("controller", "closed_loop")}
    with tempfile.TemporaryDirectory() as folder:
        made = gc.run(data, out=folder).certificate
    if not isinstance(made, gc.Certificate):
        raise SystemExit(f"symbolic_gaps: {spec.config.name} has no certificate")
    return made.gap


def synthesized(spec: Spec, gap: gc.GapFunction) -> tuple[float, float, Any]:
    """CPU seconds of the gap over blocks, and of the whole, the better of two; and the controller's evidence."""
    model, made = spec.build("model"), replace(spec.build("controller"), threads=1)
    domain = gc.Domain.of(model, dict(spec.config.domain))
    best, bounded, evidence = np.inf, 0.0, None
    for _ in range(2):
        spent = dict[str, float]()

        def emit(event: gc.Event, spent: dict[str, float] = spent) -> None:
            if event.data.get("part") == "gap over cells":
                spent["gap"] = time.process_time()

        begin = time.process_time()
        evidence = made.synthesize(gc.SynthesisProblem(model, gap, domain, spec.goal(domain), emit=emit)).evidence
        if (took := time.process_time() - begin) < best:
            best, bounded = took, spent["gap"] - begin
    return bounded, best, evidence


def rows(name: str) -> None:
    for kind in ("constant", "envelope"):
        spec = gc.load_spec(published.SPECS / f"{name}.yaml", [f"gap.kind={kind}", *CASES[name]])
        gap = certified(spec)
        for room in ROOMS if kind == "envelope" else ROOMS[:1]:
            gaps.THRESHOLDS = replace(gaps.THRESHOLDS, window_entries=room)
            bounded, took, evidence = synthesized(spec, gap)
            told = evidence.get("gap_over_cells", {"blocks": {}})
            blocks = " × ".join(str(n) for n in told["blocks"].values()) or "1"
            taken = "; ".join(
                f"{k}: over {', '.join(s['over'])} ({s['cells']:.2g} cells)" for k, s in told.get("suprema", {}).items()
            )
            room_ = f"{room:,}" if kind == "envelope" else ""
            cells = f"{evidence['winning_cells']:,} of {evidence['cells']:,}"
            print(f"| {name} | {kind} | {room_} | {blocks} | {bounded:.1f} | {took:.1f} | {cells} | {taken} |", flush=True)
    gaps.THRESHOLDS = replace(gaps.THRESHOLDS, window_entries=ROOMS[0])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=list(CASES), help=f"some of {', '.join(CASES)}")
    print(", ".join(f"{k}: {v}" for k, v in harness.machine().items()), end="\n\n")
    print("| spec | gap | entries at most | blocks | gap, s | in all, s | cells won | supremum in the windows of |")
    print("| --- |" + " --- |" * 7)
    for case in parser.parse_args().cases:
        rows(case)
