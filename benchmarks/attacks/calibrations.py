"""Calibrated bands of stochastic simulators: how much of what is drawn later they leave out, against their level."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import gapcert as gc
from attacks import Attempt

POINTS = 40_000
DOUBT = 0.1
"""β of each; so large that it shows where it is not kept."""


def drawn(rng: np.random.Generator) -> dict[str, Any]:
    c, k = (float(v) for v in rng.uniform(0.2, 2, 2))
    model = {
        "kind": "equations", "states": {"x": "m", "v": "m/s"}, "inputs": {"a": "m/s^2"},
        "parameters": {"c": f"{c!r} 1/s", "k": f"{k!r} 1/s^2"}, "derivative": {"x": "v", "v": "a - c*v"},
        "integrator": "euler", "period": "0.1 s",
    }  # fmt: skip
    real = {**model, "derivative": {"x": "v", "v": str(rng.choice(["a - c*v - k*x", "a - c*v - k*abs(x)", "a - k*abs(x)"]))}}
    noises = {
        "sensor_noise": {"x": f"{rng.uniform(0.1, 5)!r} mm"},
        "jitter": f"{rng.uniform(0.1, 5)!r} ms",
        "parameters": {"c": [0.8, 1.2]},
    }
    chosen = [n for n in noises if rng.random() < 0.6] or ["jitter"]
    family = str(rng.choice(["envelope", "constant"]))
    asked = {
        "claim": "statistical",
        "route": "calibrate",
        "violation": float(rng.choice([0.01, 0.05, 0.2])),
        "confidence": 1 - DOUBT,
    }
    return {
        "version": 1, "name": "drawn", "model": model, "seed": int(rng.integers(2**31)),
        "backend": {"kind": "stochastic", "of": real, **{n: noises[n] for n in chosen}},
        "domain": {"x": [-1, 1], "v": [-1, 1], "a": [-2, 2]}, "gap": {"kind": family},
        "certificate": {**asked, "exceedances": int(rng.choice([0, 3, 10]))},
    }  # fmt: skip


def attempt(rng: np.random.Generator, folder: Path, tries: int = POINTS) -> Attempt:
    spec = drawn(rng)
    case = {k: spec[k] for k in ("backend", "gap", "certificate")}
    try:
        run = gc.run(spec, overrides=("report.html=false", "report.rerun=false"), out=folder, executor="threads")
    except gc.GapcertError as error:
        return Attempt("refused", case={**case, "why": str(error).splitlines()[0][:300]})
    certificate = run.certificate
    z = certificate.domain.draw(tries, rng)
    x, u = z[:, :2], z[:, 2:]
    r = run.artifacts["backend"].step(x, u, seed=int(rng.integers(2**31))).x - run.artifacts["model"].step(x, u).x
    low, high = certificate.gap.interval(z)
    wrong = int((~((low <= r) & (r <= high)).all(axis=1)).sum())
    claim = certificate.claim
    return Attempt(
        claim.kind if certificate.holds else "refused", tries, wrong, claim.epsilon, claim.beta, (tries, wrong), case
    )
