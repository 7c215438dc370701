"""Controllers on cells against whoever chooses the gap: every goal, seams of angles, relations, refinement, automata."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import gapcert as gc
from attacks import Attempt
from attacks.adversary import fought

STEPS = 100_000
FORMULAS = ("G F a & G F b", "F (a & F b)", "F a & G !b", "!b U a", "G (a | b)", "F G a")


def shape(rng: np.random.Generator, low: np.ndarray, high: np.ndarray, least: float, most: float) -> dict[str, list[float]]:
    """A box of these shares of the axes, its edges anywhere; now and then on the edge of the whole."""
    size = (high - low) * rng.uniform(least, most, 2)
    at = low + (high - low - size) * rng.choice([0.0, 1.0, *rng.random(4)], 2)
    return {n: [float(a), float(a + s)] for n, a, s in zip("pv", at, size, strict=True)}


def model(rng: np.random.Generator) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """A point that is pushed, one that is damped, a pendulum, or a phase on the circle; with its domain."""
    a, b, c = (float(v) for v in rng.uniform(0.3, 1.5, 3))
    kind = rng.integers(4)
    angle = kind >= 2
    turn = kind == 3 or (kind == 2 and rng.random() < 0.5)
    w = "(v*S/R)" if angle else "v"
    v = [
        f"{a!r}*u",
        f"{a!r}*u - {b!r}*{w} - {c!r}*{w}*abs({w})",
        f"{a!r}*u - {c!r}*sin(p)",
        f"{a!r}*u - {b!r}*{w} + {c!r}*cos(2*p)",
    ][kind]
    low, high = (-np.pi, np.pi) if turn else (-float(rng.uniform(0.5, 2)), float(rng.uniform(0.5, 2)))
    if turn and rng.random() < 0.5:
        low, high = low + 2 * np.pi * int(rng.integers(-3, 4)) + 0.3, high + 0.3
        high = low + 2 * np.pi
    return {
        "kind": "equations",
        "states": {"p": {"unit": "rad", "kind": "angle"} if angle else "1", "v": "rad/s" if angle else "1"},
        "inputs": {"u": "1"}, "parameters": {"T": "1 s"} if not angle else {"S": "1 s", "R": "1 rad"},
        "derivative": {"p": "v", "v": f"({v})*R/S**2"} if angle else {"p": "v/T", "v": f"({v})/T"},
        "integrator": str(rng.choice(["euler", "semi_implicit", "rk4"])), "period": float(rng.uniform(0.1, 0.6)),
    }, np.array([low, -float(rng.uniform(0.5, 1.5))]), np.array([high, float(rng.uniform(0.5, 1.5))])  # fmt: skip


def drawn(rng: np.random.Generator) -> dict[str, Any]:
    f, low, high = model(rng)
    counts = rng.integers(10, 60, 2)
    width = (high - low) / counts
    kind = str(rng.choice(["invariance", "reach_avoid", "reach_avoid", "reach_and_stay", "recurrence", "ltl"]))
    box = shape(rng, low, high, 0.3, 0.7)
    avoid = [shape(rng, low, high, 0.02, 0.2) for _ in range(rng.integers(0, 3))]
    goal: dict[str, Any] = {kind: {"target": box, **({"avoid": avoid} if avoid else {})}}
    if kind == "invariance":
        goal = {
            kind: shape(rng, low, high, 0.6, 1.0)
            if rng.random() < 0.5
            else dict(zip("pv", np.stack([low, high], 1).tolist(), strict=True))
        }
    if kind == "ltl":
        goal = {kind: str(rng.choice(FORMULAS)), "regions": {"a": box, "b": shape(rng, low, high, 0.2, 0.5)}}
    gamma = {n: float(w * rng.choice([0.0, 0.02, 0.1, 0.3])) for n, w in zip("pv", width, strict=True)}
    cells = dict(zip("pv", counts.tolist(), strict=True))
    inputs = {"u": int(rng.integers(3, 12))}
    refine = int(rng.integers(1, 3)) if rng.random() < 0.3 else 0
    relations = ["abs(v + 0.5 rad/s*u) <= 1.2 rad/s"] if f["states"]["v"] != "1" else ["abs(v + 0.5*u) <= 1.2"]
    return {
        "version": 1, "name": "drawn", "model": f, "seed": 0,
        "domain": {"p": [float(low[0]), float(high[0])], "v": [float(low[1]), float(high[1])], "u": [-3, 3]},
        "gap": {"kind": "declared", "gamma": gamma},
        **({"relations": relations} if rng.random() < 0.2 else {}),
        "controller": {"kind": "symbolic", "goal": goal, "cells": cells, "inputs": inputs, "refine": refine},
    }  # fmt: skip


def attempt(rng: np.random.Generator, folder: Path, tries: int = STEPS) -> Attempt:
    spec = drawn(rng)
    case = {k: spec[k] for k in ("model", "domain", "gap", "controller")} | {"relations": spec.get("relations")}
    try:
        run = gc.run(spec, overrides=("report.html=false", "report.rerun=false"), out=folder, executor="threads")
    except gc.GapcertError as error:
        return Attempt("refused", case={**case, "why": str(error).splitlines()[0][:300]})
    controller = run.controller
    if controller is None or not controller.wins:
        return Attempt("refused", case={"why": run.summary["reason"][:200]})
    made, broken, first = fought(run.artifacts["model"], run.certificate.gap, controller, tries, 200, rng)
    return Attempt("deterministic", made, broken, case={**case, **first} if broken else {"goal": spec["controller"]["goal"]})
