"""MuJoCo XLA against the C code, through the same backend; compilation is a row of its own."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from harness import Row, alternate, row

import gapcert
from engines.case import MODELS, PENDULUM, Array

JOINTS = tuple(f"j{k}" for k in range(1, 8))
ARM: dict[str, Any] = {
    "robot": MODELS / "arm7.xml",
    "states": {f"{j}.{kind}": f"{j}.{kind}" for kind in ("position", "velocity") for j in JOINTS},
    "inputs": {j: j for j in JOINTS},
    "period": "2 ms",
}
PEER = "the same backend with `implementation: c`"


def backend(section: dict[str, Any], implementation: str, tiles: int) -> gapcert.Backend:
    registry = gapcert.registry()
    config = registry.config("backend", "mujoco")
    assert config is not None, "an engine has options"
    built: gapcert.Backend = registry.build(
        "backend", "mujoco", config(**section | {"implementation": implementation, "tiles": tiles})
    )
    return built


def rows(quick: bool) -> list[Row]:
    """A pendulum and an arm of seven joints, and the arm with other dampings in every row."""
    found: list[Row] = []
    repeats = 5 if quick else 9
    for name, section, n, tiles in (("pendulum", PENDULUM, 8192, 4096), ("arm of 7 joints", ARM, 2048, 1024)):
        ours, theirs = backend(section, "mjx", tiles), backend(section, "c", 256)
        rng = np.random.default_rng(0)
        x, u = rng.uniform(-1, 1, (n, ours.nx)), rng.uniform(-1, 1, (n, ours.nu))
        start = time.process_time()
        ours.step(x[:1], u[:1])
        found.append(row(f"mujoco {name}, MJX: first query", "time", "s", time.process_time() - start, None, "compilation"))
        found.append(_pair(f"mujoco {name}, MJX, {tiles} rows at once", ours, theirs, x, u, repeats))
        if section is ARM:
            given = {f"damping.{j}": rng.uniform(0.05, 1, n) for j in JOINTS}
            found.append(_pair(f"mujoco {name}, MJX, other dampings in every row", ours, theirs, x, u, repeats, given))
    return found


def _pair(
    case: str, ours: gapcert.Backend, theirs: gapcert.Backend, x: Array, u: Array, repeats: int, given: Any = None
) -> Row:
    answers = [b.step(x, u, parameters=given).x for b in (ours, theirs)]
    if not np.allclose(*answers, rtol=0, atol=1e-9):
        raise SystemExit(f"throughput: {case} differs from the C code by {np.abs(answers[0] - answers[1]).max():.2g}")
    seconds = alternate(lambda: ours.step(x, u, parameters=given), lambda: theirs.step(x, u, parameters=given), repeats=repeats)
    return row(case, "time", "us per transition", *(1e6 * s / len(x) for s in seconds), PEER)
