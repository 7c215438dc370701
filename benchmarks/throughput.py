"""Transitions per second of the engines' backends against the bare engines, with the answers compared bit for bit.

Each engine has a module in benchmarks/engines/ with its peer. An engine that is not installed is left out. `mjx` is MuJoCo's
compiled variant, against its C code.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util

import numpy as np
from harness import Row, alternate, main, row

import gapcert

ENGINES = ("dart", "drake", "fmu", "gazebo", "gymnasium", "mujoco", "mjx", "pybullet")
OWN = ("fmu", "gymnasium", "mjx")
"""Those whose rows are cases of their own."""


def pendulum(name: str, options: argparse.Namespace) -> list[Row]:
    """One engine's rows: one and ten engine steps per transition, one copy and many."""
    engine = importlib.import_module(f"engines.{name}_").ENGINE
    n = 10_000 if options.quick else 50_000
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-0.25, 0.25, (n, 2)), rng.uniform(-1, 1, (n, 1))
    rows = []
    for substeps in (1, 10):
        peer = engine.peer(substeps)
        for tiling, tiles in (("untiled", 1), ("tiled", engine.tiles))[: 1 + (engine.tiles > 1)]:
            ours = engine.backend(tiles, substeps)
            if ours.step(x, u).x.tobytes() != peer.answer(x, u).tobytes():
                raise SystemExit(f"throughput: {name}, {tiling}, with {substeps} sub-steps differs from the bare engine")
            seconds = alternate(lambda b=ours: b.step(x, u), lambda p=peer: p.run(x, u), repeats=5 if options.quick else 9)
            case = f"{name} pendulum, {substeps} engine step{'s' if substeps > 1 else ''}, {tiling}"
            rows.append(row(case, "time", "us per transition", *(1e6 * s / n for s in seconds), peer.name))
    return rows


def measure(options: argparse.Namespace) -> list[Row]:
    rows = []
    for name in options.engines or ENGINES:
        compiled = name == "mjx"
        reason = gapcert.registry().get("backend", "mujoco" if compiled else name).missing()
        if compiled and reason is None and importlib.util.find_spec("mujoco.mjx") is None:
            reason = "mjx needs mujoco-mjx, which is not installed; run: pip install 'gapcert[mjx]'"
        if reason is None:
            rows += importlib.import_module(f"engines.{name}_").rows(options.quick) if name in OWN else pendulum(name, options)
        elif options.engines:
            raise SystemExit(f"throughput: {reason}")
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("engines", nargs="*", metavar="ENGINE", help=f"of {', '.join(ENGINES)}; all that are installed")
    main(measure, parser)
