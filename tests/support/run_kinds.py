"""A small run of every kind that a run folder may be of: how γ was found, of what, and what was built on it.

Their numbers are fixed, or drawn: masses, friction, ranges and seeds, in which the declared constants stay true.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import gapcert as gc

ROOT = Path(__file__).parents[2]
MODEL = {
    "kind": "equations",
    "states": {"x": "m", "v": "m/s"},
    "inputs": {"F": "N"},
    "parameters": {"m": "2 kg", "b": "0.3 N*s/m"},
    "derivative": {"x": "v", "v": "(F - b*v)/m"},
    "integrator": "euler",
    "period": "50 ms",
}
BACKEND = {
    **MODEL,
    "parameters": {"m": "2 kg", "b": "0.34 N*s/m", "c": "0.05 N*s^2/m^2"},
    "derivative": {"x": "v", "v": "(F - b*v - c*v*abs(v))/m"},
    "integrator": "rk4",
}
PLAIN: dict[str, Any] = {
    "version": 1,
    "model": MODEL,
    "backend": BACKEND,
    "domain": {"x": [-1, 1], "v": [-1.5, 1.5], "F": [-2, 2]},
    "sampling": {"kind": "adaptive", "budget": 120, "executor": "threads"},
    "certificate": {"claim": "statistical", "violation": 0.05, "confidence": 0.95, "attack": 500},
    "report": {"rerun": False, "html": False},
    "expect": {"verdict": "holds"},
}
PROVED = {"residual": {"kind": "interval", "boxes": 256}}
STATED = {"x": {"x": 0, "v": 0.01, "F": 0.01}, "v": {"x": 0, "v": 0.06, "F": 0.02}}
DETERMINISTIC = {"claim": "deterministic", "violation": 0.05, "confidence": 0.95}
STAY = {"invariance": {"x": [-0.8, 0.8], "v": [-1, 1]}}
CELLS = {"kind": "symbolic", "goal": STAY, "cells": {"x": 20, "v": 30}, "inputs": {"F": 5}}
STRONG = {**PLAIN["domain"], "F": [-10, 10]}
ASSUMED: dict[str, Any] = {
    "backend": None,
    "sampling": None,
    "certificate": None,
    "domain": STRONG,
    "gap": {"kind": "declared", "gamma": {"x": 0.001, "v": 0.005}},
}
VISITS = {"ltl": "G F a & G F b", "regions": {"a": {"v": [-1.2, -0.3]}, "b": {"v": [0.3, 1.2]}}}
KINDS: dict[str, dict[str, Any]] = {
    "statistical": {"gap": {"kind": "envelope", "predictor": "affine"}},
    "controller": {
        "domain": STRONG,
        "lipschitz": PROVED,
        "certificate": DETERMINISTIC,
        "controller": CELLS,
        "closed_loop": {"steps": 10, "starts": 4},
        "report": {"rerun": False, "html": True},
    },
    "constant": {"lipschitz": PROVED, "certificate": DETERMINISTIC, "gap": {"kind": "constant"}},
    "theorem1": {
        "lipschitz": {"residual": {"kind": "declared", "values": STATED}},
        "sampling": {"kind": "grid", "counts": {"x": 3, "v": 10, "F": 10}, "executor": "threads"},
        "gap": {"kind": "basis", "functions": ["1", "abs(v)", "v^2"]},
        "certificate": {**DETERMINISTIC, "route": "theorem1"},
        "symmetries": {"translation": ["x"]},
    },
    "multilinear": {
        "lipschitz": {
            "residual": {"kind": "declared", "values": STATED, "curvature": {k: dict.fromkeys("xvF", 1.0) for k in "xv"}}
        },
        "sampling": {"kind": "lattice", "budget": 120, "executor": "threads"},
        "gap": {"kind": "multilinear"},
        "certificate": DETERMINISTIC,
    },
    "calibrated": {
        "backend": {"kind": "stochastic", "of": BACKEND, "sensor_noise": {"x": "1 mm", "v": "2 mm/s"}},
        "sampling": None,
        "certificate": {"claim": "statistical", "route": "calibrate", "violation": 0.1, "confidence": 0.9, "exceedances": 1},
    },
    "declared": {**ASSUMED, "controller": CELLS},
    "lost": {**ASSUMED, "domain": PLAIN["domain"], "controller": CELLS},
    "refined": {**ASSUMED, "controller": {**CELLS, "cells": {"x": 10, "v": 15}, "refine": 1}},
    "automaton": {**ASSUMED, "controller": {**CELLS, "goal": VISITS, "cells": {"x": 50, "v": 30}}},
    "empirical": {
        "certificate": {"claim": "empirical", "violation": 0.05, "confidence": 0.95},
        "lipschitz": {"residual": {"kind": "piecewise", "budget": 4000}},
    },
    "mpc": {
        "lipschitz": PROVED,
        "certificate": DETERMINISTIC,
        "controller": {"kind": "mpc", "goal": STAY, "horizon": 5},
        "closed_loop": {"steps": 5, "starts": 2},
    },
    "related": {
        "relations": ["abs(x + v*1 s) <= 1.5 m"],
        "gap": {"kind": "envelope", "predictor": "none"},
        "lipschitz": PROVED,
        "certificate": DETERMINISTIC,
    },
    "recording": {
        "backend": None,
        "sampling": None,
        "recording": {"kind": "csv", "time": "t", "trajectory": "run", "columns": {"x": "x", "v": "v", "F": "F"}},
        "gap": {"kind": "constant"},
        "certificate": {"claim": "statistical", "route": "calibrate", "violation": 0.1, "confidence": 0.9},
    },
    "engine": {
        "model": {
            "kind": "equations",
            "states": {"theta": {"unit": "rad", "kind": "angle"}, "omega": "rad/s"},
            "inputs": {"torque": "N*m"},
            "parameters": {"m": "1 kg", "l": "1 m", "g": "9.81 m/s^2"},
            "derivative": {"theta": "omega", "omega": "-3*g/(2*l)*sin(theta) + 3*torque/(m*l**2)"},
            "integrator": "euler",
            "period": "5 ms",
        },
        "backend": {
            "kind": "pybullet",
            "robot": str(ROOT / "specs/models/pendulum.urdf"),
            "fixed_base": True,
            "states": {"theta": "hinge.position", "omega": "hinge.velocity"},
            "inputs": {"torque": "hinge"},
        },
        "domain": {"theta": [-0.2, 0.2], "omega": [-0.25, 0.25], "torque": [-1, 1]},
        "gap": {"kind": "envelope", "predictor": "affine"},
        "lipschitz": {"residual": {"kind": "wood-zhang", "batches": 10, "pairs": 200}},
    },
}


def write_log(path: Path, rng: np.random.Generator, runs: int = 60, rows: int = 20) -> None:
    """Trajectories of the real system with sensor noise."""
    lines = ["run,t,x,v,F"]
    for k in range(runs):
        x, v, force = rng.uniform(-0.8, 0.8), rng.uniform(-1, 1), rng.uniform(-2, 2)
        for n in range(rows):
            lines.append(f"{k},{n * 0.05:.2f},{x + 1e-4 * rng.normal()!r},{v + 1e-3 * rng.normal()!r},{force!r}")
            x, v = x + 0.05 * v, v + 0.05 * (force - 0.34 * v - 0.05 * v * abs(v)) / 2
    path.write_text("\n".join(lines) + "\n")


def spec(kind: str, rng: np.random.Generator | None = None) -> dict[str, Any]:
    """That of a kind; with numbers of its own where they are drawn."""
    found = {k: v for k, v in {**PLAIN, **KINDS[kind], "name": kind}.items() if v is not None}
    if rng is None:
        return found
    if kind == "engine":
        return {**found, "seed": int(rng.integers(2**31))}
    share = rng.uniform(0.8, 1.2, 4).tolist()
    stated = {"m": f"{2 / share[0]!r} kg", "b": f"{0.3 * share[1]!r} N*s/m"}
    found["model"] = {**found["model"], "parameters": stated}
    real = {**BACKEND, "parameters": {**BACKEND["parameters"], "m": stated["m"], "c": f"{0.05 * share[2]!r} N*s^2/m^2"}}
    if "backend" in found:
        found["backend"] = {**found["backend"], "of": real} if "of" in found["backend"] else real
    low, high = found["domain"]["F"]
    return {**found, "seed": int(rng.integers(2**31)), "domain": {**found["domain"], "F": [low * share[3], high * share[3]]}}


def made(kind: str, out: Path, rng: np.random.Generator | None = None) -> Path:
    """The folder of an honest run of a kind."""
    found = spec(kind, rng)
    if kind == "recording":
        write_log(out / "log.csv", rng or np.random.default_rng(1))
        found["recording"] = {**found["recording"], "files": [str(out / "log.csv")]}
    return gc.run(found, out=out, executor="threads").folder
