"""The published figures of the neural gap function (arXiv 2506.17675) beside those of runs: `paper.py NAME=FOLDER ...`.

A folder is that of a run of family neural on route theorem1, such as `gapcert run specs/paper/mecanum_neural.yaml` leaves, with
`--set gap.training=certified` or without. η is the largest γ less 𝓛; constants are Euclidean, L₁ as the certificate proves it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import harness
import numpy as np

import gapcert

HEADER = ("certificate", "state", "η", "L₁", "L₂x", "L₂u", "𝓛", "mean γ", "tightness", "samples", "time")
# As published, 𝓛 by the published formula; the pendulum's are not stated.
PUBLISHED = (
    ("mecanum, as published", "px", "0.11", "10", "1.03", "1.03", "0.1968", "–", "–", "4.7e+08", "about 1.5 days"),
    ("mecanum, as published", "py", "0.08", "10", "1.02", "1.01", "0.1964", "–", "–", "4.7e+08", "about 1.5 days"),
)


def rows(name: str, folder: Path) -> Iterator[tuple[str, ...]]:
    """One per state."""
    data = json.loads((folder / "certificate.json").read_text(encoding="utf-8"))
    seconds = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["timings"]["cpu"]
    domain, split = data["domain"], data["domain"]["states"]
    axes = [gapcert.StateSpec(n) for n in domain["axes"]]
    parts = (slice(None, split), slice(split, None))
    boxes = (gapcert.Box(tuple(axes[p]), tuple(domain["low"][p]), tuple(domain["high"][p])) for p in parts)
    cover = gapcert.plugin.Cover(gapcert.Domain(*boxes), tuple(data["cover"]))
    with np.load(folder / "certificate.npz") as arrays:
        own, constants, e = np.sqrt(arrays["gap.squares"]), arrays["lipschitz"], arrays["resolution"]
        both, rest = cover.radii(arrays["gap.q.W0"].any(axis=0)), cover.radii((constants > 0).any(axis=0))
    in_x, in_u = (np.linalg.norm(constants[:, p], axis=1) for p in parts)
    margin = own * np.hypot(*both) + in_x * rest[0] + in_u * rest[1] + 2 * e
    for i, axis in enumerate(axes[:split]):
        s = data["states"][axis.name]
        numbers = s["gamma_max"] - margin[i], own[i], in_x[i], in_u[i], margin[i], s["gamma_mean"], s["tightness"]
        yield name, axis.name, *(f"{v:.4g}" for v in numbers), f"{data['samples']['bound']:.4g}", f"{seconds:.0f} s of CPU"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="*", metavar="NAME=FOLDER")
    runs = (run.partition("=") for run in parser.parse_args().runs)
    body = [*PUBLISHED, *(row for name, _, folder in runs for row in rows(name, Path(folder)))]
    lines = [HEADER, ("---", "---", *("---:",) * (len(HEADER) - 2)), *body]
    print(", ".join(f"{k}: {v}" for k, v in harness.machine().items()), end="\n\n")
    print("\n".join(f"| {' | '.join(line)} |" for line in lines))


if __name__ == "__main__":
    main()
