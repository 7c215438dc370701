"""Gymnasium's environments against a bare Python loop over their own calls."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from harness import Row, alternate, row

import gapcert
from engines.case import Array

CASES: dict[str, dict[str, Any]] = {
    "Pendulum-v1": {"states": {"theta": "theta", "omega": "theta_dot"}, "inputs": {"torque": "torque"}},
    "CartPole-v1": {
        "states": {n: n for n in ("x", "x_dot", "theta", "theta_dot")},
        "inputs": {"force": "force"},
    },
    "InvertedPendulum-v5": {
        "states": {f"{j}_{f}": f"{j}.{f}" for f in ("position", "velocity") for j in ("slider", "hinge")},
        "inputs": {"push": "slide"},
    },
}


def rows(quick: bool) -> list[Row]:
    """One step of the environment per transition."""
    registry, found = gapcert.registry(), list[Row]()
    config = registry.config("backend", "gymnasium")
    assert config is not None, "it has options"
    for env, section in CASES.items():
        ours: gapcert.Backend = registry.build("backend", "gymnasium", config(env=env, **section))
        rng = np.random.default_rng(0)
        n = 2000 if quick else 10_000
        x, u = rng.uniform(-0.2, 0.2, (n, ours.nx)), rng.uniform(-1, 1, (n, 1))
        theirs = _loop(env)
        if ours.step(x, u).x.tobytes() != theirs(x, u).tobytes():
            raise SystemExit(f"throughput: {env} differs from the bare environment")
        seconds = alternate(
            lambda b=ours, x=x, u=u: b.step(x, u), lambda f=theirs, x=x, u=u: f(x, u), repeats=5 if quick else 9
        )
        found.append(row(f"gymnasium {env}", "time", "us per transition", *(1e6 * s / n for s in seconds), PEER))
    return found


PEER = "bare Python loop that sets the state, steps, and reads the state"


def _loop(name: str) -> Callable[[Array, Array], Array]:
    env: Any = gymnasium.make(name).unwrapped
    env.reset(seed=0)

    def pendulum(x: Array, u: Array) -> Array:
        out = np.empty_like(x)
        for k in range(len(x)):
            env.state = x[k]
            env.step(u[k])
            out[k] = env.state
        return out

    def cartpole(x: Array, u: Array) -> Array:
        out = np.empty_like(x)
        for k in range(len(x)):
            env.state, env.steps_beyond_terminated = x[k], None
            env.step(int(u[k, 0] > 0))
            out[k] = env.state
        return out

    def mujoco(x: Array, u: Array) -> Array:
        out, q = np.empty_like(x), x.shape[1] // 2
        for k in range(len(x)):
            env.reset(seed=0)
            env.set_state(x[k, :q], x[k, q:])
            env.step(u[k])
            out[k, :q], out[k, q:] = env.data.qpos, env.data.qvel
        return out

    return {"Pendulum-v1": pendulum, "CartPole-v1": cartpole, "InvertedPendulum-v5": mujoco}[name]
