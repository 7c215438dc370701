"""Drawn specs of MPC in every mode, with gaps from nothing to more than the goal: each ends in a verdict or in one sentence.

python tests/support/drawn_mpc.py FIRST LAST    # seeds; prints what ended otherwise, and how the others ended
"""

import sys
from collections import Counter
from typing import Any

import numpy as np

import gapcert as gc
from gapcert.plugin import SynthesisProblem
from gapcert_cells.testing import Band

MODES = ("once", "tight", "rates", "soft", "moving", "successive", "adaptive", "terminal", "disturbance", "reach", "around")
FORMS = ("free", "pushed", "rod", "pair")
EXTENT = {"p": 1.0, "v": 2.0, "q": 1.0, "w": 2.0}


def drawn(seed: int) -> dict[str, Any]:
    """Spec `seed`: its mode goes round, all else is drawn."""
    rng = np.random.default_rng([seed, 11])
    mode, form = MODES[seed % len(MODES)], FORMS[int(rng.integers(len(FORMS)))]
    states, following, inputs = _motion(form, rng)
    extent = {s: EXTENT[s] * float(rng.choice([1.0, rng.uniform(0.3, 3)])) for s in states}
    strength = {u: float(10 ** rng.uniform(-1.5, 1)) for u in inputs}
    gap = float(10 ** rng.uniform(-4, 0.3))
    spec: dict[str, Any] = {
        "version": 1,
        "name": f"drawn-{seed}",
        "report": {"rerun": False, "html": False},
        "model": {
            "kind": "equations",
            "states": dict.fromkeys(states, "1"),
            "inputs": dict.fromkeys(inputs, "1"),
            "parameters": {"k": float(rng.uniform(0.3, 2))},
            "next": following,
            "period": "0.1 s",
        },
        "domain": {n: [-e, e] for n, e in (*extent.items(), *strength.items())},
        "gap": {"kind": "declared", "gamma": {s: gap * extent[s] * float(rng.uniform(0.2, 1)) for s in states}},
    }
    stay = {s: [-e * float(rng.uniform(0.4, 1)), e * float(rng.uniform(0.4, 1))] for s, e in extent.items()}
    return spec | {"controller": _controller(mode, stay, inputs, strength, rng)}


def _motion(form: str, rng: np.random.Generator) -> tuple[list[str], dict[str, str], list[str]]:
    a = float(rng.uniform(-0.3, 0.3))
    if form == "free":
        return ["p"], {"p": f"{1 + a}*p + k*0.3*u"}, ["u"]
    if form == "pushed":
        return ["p", "v"], {"p": "p + 0.1*v", "v": f"v + {a}*p + 0.3*k*u"}, ["u"]
    if form == "rod":
        return ["p", "v"], {"p": "p + 0.1*v", "v": "v - 0.5*k*sin(p) + 0.3*u"}, ["u"]
    return ["p", "q"], {"p": f"{1 + a}*p + 0.1*q + 0.3*k*u", "q": "q - 0.1*p + 0.3*z"}, ["u", "z"]


def _box(stay: dict[str, list[float]], rng: np.random.Generator, largest: float) -> dict[str, list[float]]:
    """Somewhere inside, in each state a share of it."""
    out = {}
    for name, (low, high) in stay.items():
        width = (high - low) * float(rng.uniform(0.02, largest))
        at = float(rng.uniform(low, high - width))
        out[name] = [at, at + width]
    return out


def _controller(
    mode: str, stay: dict[str, list[float]], inputs: list[str], strength: dict[str, float], rng: np.random.Generator
) -> dict[str, Any]:
    state = next(iter(stay))
    own: dict[str, Any] = {
        "kind": "mpc",
        "horizon": int(rng.choice([1, 2, 4, 7, 12])),
        "solver": str(rng.choice(["auto", "osqp", "piqp", "clarabel"])),
        "majorant": str(rng.choice(["auto", "affine", "constant"])),
        "searches": 4,
        "goal": {"invariance": stay},
    }
    if mode in ("reach", "around"):
        goal: dict[str, Any] = {"target": _box(stay, rng, 0.9), "stay": stay}
        if mode == "around":
            goal["avoid"] = [_box(stay, rng, 0.4)]
        return own | {"goal": {"reach_avoid": goal}}
    ends = [0.999 * end for end in stay[state]]
    return (
        own
        | {
            "once": {},
            "tight": {"tolerance": float(rng.choice([1e-8, 1e-2])), "reference": {state: ends[int(rng.integers(2))]}},
            "rates": {"rates": {inputs[0]: strength[inputs[0]] * float(10 ** rng.uniform(-2, 0.5))}},
            "soft": {"soft": {state: {"range": [0.2 * e for e in ends], "linear": float(10 ** rng.uniform(-3, 6))}}},
            "moving": {"reference": {state: {"at": [[0, ends[0]], ["0.5 s", ends[1]]]}}},
            "successive": {"linearisation": "successive"},
            "adaptive": {"adapt": {"k": f"{float(rng.uniform(1, 60)):.3g} %"}, "levels": 2},
            "terminal": {
                "terminal": {"kind": "symbolic", "cells": dict.fromkeys(stay, 12), "inputs": dict.fromkeys(inputs, 5)}
            },
            "disturbance": {"feedback": "disturbance"},
        }[mode]
    )


def ended(seed: int, steps: int = 3) -> str:
    """How a drawn spec ends: `made`, `nothing` with a reason, or `refused` by a UsageError; whatever else is raised goes on.

    A controller is walked a few steps, pushed to the corners of its band.
    """
    spec, rng = gc.load_spec(drawn(seed)), np.random.default_rng([seed, 12])
    try:
        model = spec.build("model")
        domain = gc.Domain.of(model, dict(spec.config.domain))
        wide = np.array([float(v) for v in spec.data["gap"]["gamma"].values()])
        problem = SynthesisProblem(model, Band(-wide, wide), domain, spec.goal(domain))
        maker = spec.build("controller")
        maker.starts = 8
        made = maker.synthesize(problem)
    except gc.UsageError:
        return "refused"
    if not made.evidence["domain_fraction"]:
        assert made.evidence.get("reason") or "tube" in made.evidence, made.evidence
        return "nothing"
    for x in made.draw(2, rng):
        memory = None
        for _ in range(steps):
            u, told = made.step(x, memory)
            if not told.feasible or told.left == 0:
                break
            x, memory = model.step(x[None], u[None]).x[0] + wide * rng.choice((-1.0, 1.0), len(wide)), told.memory
    return "made"


def main(first: int, last: int) -> int:
    found: Counter[tuple[str, str]] = Counter()
    broken = 0
    for seed in range(first, last):
        mode = MODES[seed % len(MODES)]
        try:
            found[mode, ended(seed)] += 1
        except Exception as error:
            broken += 1
            print(f"seed {seed} ({mode}): {type(error).__name__}: {str(error)[:300]}", flush=True)
    for (mode, how), count in sorted(found.items()):
        print(f"{mode:12} {how:8} {count}")
    print(f"{broken} of {last - first} ended in an exception")
    return int(broken > 0)


if __name__ == "__main__":
    raise SystemExit(main(int(sys.argv[1]), int(sys.argv[2])))
