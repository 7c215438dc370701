"""Predictive controllers of every kind against whoever chooses the gap."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import gapcert as gc
from attacks import Attempt
from attacks.adversary import fought

STEPS = 5000
RUNS = 10


def model(rng: np.random.Generator) -> tuple[dict[str, Any], float]:
    """A cart, damped or not, or a rod about a steady state; and what its input has to overcome, in its unit."""
    a, b = (float(v) for v in rng.uniform(0.5, 1.5, 2))
    force = str(rng.choice(["u/m", "(u - b*v)/m", "(u - k*p)/m", "(u - k*l*sin(p/l))/m"]))
    values = {"m": f"{a!r} kg", "b": f"{b!r} kg/s", "k": f"{b!r} kg/s^2", "l": "1 m"}
    return {
        "kind": "equations", "states": {"p": "m", "v": "m/s"}, "inputs": {"u": "N"},
        "parameters": {n: v for n, v in values.items() if n in force},
        "derivative": {"p": "v", "v": force}, "integrator": str(rng.choice(["euler", "semi_implicit", "rk4"])),
        "period": f"{rng.uniform(0.05, 0.2)!r} s",
    }, a  # fmt: skip


def options(rng: np.random.Generator, kind: str, mass: float) -> dict[str, Any]:
    """What makes the variants; some do not go together, and are refused then."""
    pool: list[dict[str, Any]] = [
        {}, {}, {"linearisation": "successive"}, {"feedback": "disturbance"},
        {"adapt": {"m": [f"{0.8 * mass!r} kg", f"{1.2 * mass!r} kg"]}},
        {"terminal": {"kind": "symbolic", "cells": {"p": 30, "v": 30}, "inputs": {"u": 7}}}, {"rates": {"u": "3 N"}},
        {"soft": {"v": {"range": [-0.3, 0.3]}}}, {"majorant": "constant"}, {"majorant": "affine"},
    ]  # fmt: skip
    chosen = dict(pool[rng.integers(len(pool))])
    if rng.random() < 0.3:
        chosen |= pool[rng.integers(len(pool))]
    reference = {"reference": {"p": float(rng.uniform(-0.5, 0.5))}} if kind == "invariance" and rng.random() < 0.7 else {}
    return {
        **chosen,
        **reference,
        "horizon": int(rng.integers(6, 25)),
        "solver": str(rng.choice(["auto", "osqp", "piqp", "clarabel"])),
    }


def drawn(rng: np.random.Generator) -> dict[str, Any]:
    f, mass = model(rng)
    kind = str(rng.choice(["invariance", "invariance", "reach_avoid"]))
    goal: dict[str, Any] = {"invariance": {"p": [-1, float(rng.uniform(0.3, 1))], "v": [-1, 1]}}
    if kind == "reach_avoid":
        low = float(rng.uniform(-0.8, 0.3))
        goal = {kind: {"target": {"p": [low, low + 0.5]}}}
        if rng.random() < 0.5:
            at = float(rng.choice([low - 0.6, low + 0.8]))
            goal[kind]["avoid"] = [{"p": [at, at + 0.1], "v": [float(rng.uniform(-0.5, 0.5)), 1]}]
    size = float(rng.choice([0.0, 1e-4, 2e-3, 1e-2]))
    return {
        "version": 1, "name": "drawn", "model": f, "domain": {"p": [-2, 2], "v": [-2, 2], "u": [-4, 4]},
        "gap": {"kind": "declared", "gamma": {"p": size * float(rng.random()), "v": size}},
        "controller": {"kind": "mpc", "goal": goal, **options(rng, kind, mass)},
    }  # fmt: skip


def attempt(rng: np.random.Generator, folder: Path, tries: int = STEPS) -> Attempt:
    spec = drawn(rng)
    case = {k: spec[k] for k in ("model", "gap", "controller")}
    try:
        run = gc.run(spec, overrides=("report.html=false", "report.rerun=false"), out=folder, executor="threads")
    except gc.GapcertError as error:
        return Attempt("refused", case={**case, "why": str(error).splitlines()[0][:300]})
    controller = run.controller
    if controller is None or not controller.wins:
        return Attempt("refused", case={"why": run.summary["reason"][:200]})
    made, broken, first = fought(run.artifacts["model"], run.certificate.gap, controller, tries, 150, rng, RUNS)
    return Attempt("deterministic", made, broken, case={**case, **first} if broken else {"controller": spec["controller"]})
