"""Tightness: certified mean bound over true mean gap on the pendulum, against the published route and against no care at all.

Peers: the published route (theorem 1 on the published grid of 2,076,900 transitions, basis functions by the scenario
program), and the same envelope with safety factor 1, without predictor and with it, counted on the same 10⁶ fresh points.
Two fields whose constants are known (`curved`): the family multilinear beside the envelope.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import curved
import harness

import gapcert

SPECS = Path(__file__).resolve().parent.parent / "specs"
ALONE = ("controller=null", "closed_loop=null", "report.html=false", "report.rerun=false", "report.beside=[]", "expect=null")
CARELESS = {
    "no predictor, factor 1": ("lipschitz.residual.safety=1", "gap.predictor=none", "certificate.claim=empirical"),
    "same predictor, factor 1": ("lipschitz.residual.safety=1", "certificate.claim=empirical"),
}


def certified(spec: str, out: Path, overrides: Sequence[str]) -> tuple[dict[str, Any], float]:
    """The certificate's summary and the CPU seconds that it took."""
    summary = gapcert.run(SPECS / spec, overrides=(*ALONE, *overrides), out=out).summary
    return summary["certificate"], summary["timings"]["cpu"]


def measure(options: argparse.Namespace) -> list[harness.Row]:
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        points = 100_000 if options.quick else 1_000_000
        ours, _ = certified("pendulum.yaml", Path(folder) / "ours", [f"certificate.attack={points}"])
        _, seconds = certified("pendulum.yaml", Path(folder) / "bound", ["certificate.attack=0"])
        bare = {
            name: certified("pendulum.yaml", Path(folder) / name, [*how, f"certificate.attack={points}"])[0]
            for name, how in CARELESS.items()
        }
        paper, long = certified("paper/pendulum_theorem1.yaml", Path(folder) / "paper", [])
    route = "theorem 1, published grid"
    for state, s in ours["states"].items():
        peer = paper["states"][state]["tightness"]
        rows.append(harness.row(f"pendulum {state}", "tightness", "1", s["tightness"], peer, route))
    counts = [c["samples"]["bound"] for c in (ours, paper)]
    rows.append(harness.row("pendulum", "samples of the bound", "1", *counts, route))
    counts = [sum(c["samples"].values()) for c in (ours, paper)]
    rows.append(harness.row("pendulum", "samples in all, audit included", "1", *counts, route))
    rows.append(harness.row("pendulum", "time", "s of CPU", seconds, long, route))
    for name, other in bare.items():
        for state, s in ours["states"].items():
            rows.append(
                harness.row(f"pendulum {state}", "tightness", "1", s["tightness"], other["states"][state]["tightness"], name)
            )
        for key, what in (("violations", "l ≤ r ≤ u"), ("gamma_violations", "abs(r) ≤ γ")):
            case = f"violations of {what} on {points:,} fresh points"
            rows.append(harness.Row("pendulum", case, "1", ours["attack"][key], other["attack"][key], name, None))
    return [*rows, *curved.rows(options.quick)]


if __name__ == "__main__":
    harness.main(measure, argparse.ArgumentParser(description=__doc__))
