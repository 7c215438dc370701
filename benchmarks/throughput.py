"""Transitions per second of a backend against a bare loop over the same engine calls, with the answers compared bit for bit."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pybullet
from harness import Row, alternate, main, row

from gapcert import EngineBackend
from gapcert_pybullet.config import PyBulletConfig
from gapcert_pybullet.engine import PyBulletEngine

Array = npt.NDArray[np.float64]
ROBOT = Path(__file__).parents[1] / "specs/models/pendulum.urdf"
PERIOD = 0.005
PEER = "bare Python loop over resetJointState, setJointMotorControl2, stepSimulation, getJointState"


def bare_loop(substeps: int) -> Callable[[Array, Array], Array]:
    """What a user would write."""
    client = pybullet.connect(pybullet.DIRECT)
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE
    body = pybullet.loadURDF(str(ROBOT), useFixedBase=True, flags=flags, physicsClientId=client)
    pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
    pybullet.setTimeStep(PERIOD / substeps, physicsClientId=client)
    pybullet.changeDynamics(body, -1, linearDamping=0.04, angularDamping=0.04, physicsClientId=client)
    pybullet.setJointMotorControl2(body, 0, pybullet.VELOCITY_CONTROL, force=0, physicsClientId=client)

    def step(x: Array, u: Array) -> Array:
        out = []
        for (theta, omega), (torque,) in zip(x.tolist(), u.tolist(), strict=True):
            pybullet.resetJointState(body, 0, theta, omega, physicsClientId=client)
            for _ in range(substeps):
                pybullet.setJointMotorControl2(body, 0, pybullet.TORQUE_CONTROL, force=torque, physicsClientId=client)
                pybullet.stepSimulation(physicsClientId=client)
            state = pybullet.getJointState(body, 0, physicsClientId=client)
            out.append((state[0], state[1]))
        return np.array(out)

    return step


def backend(tiles: int, substeps: int) -> EngineBackend:
    config = PyBulletConfig(
        robot=ROBOT,
        states={"theta": "hinge.position", "omega": "hinge.velocity"},
        inputs={"torque": "hinge"},
        period=f"{PERIOD} s",
        tiles=tiles,
        substeps=substeps,
    )
    return EngineBackend(PyBulletEngine(config))


def measure(options: argparse.Namespace) -> list[Row]:
    n = 10_000 if options.quick else 50_000
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-0.25, 0.25, (n, 2)), rng.uniform(-1, 1, (n, 1))
    rows = []
    for substeps in (1, 10):
        peer = bare_loop(substeps)
        for name, tiles in (("untiled", 1), ("tiled", PyBulletConfig.model_fields["tiles"].default)):
            ours = backend(tiles, substeps)
            if ours.step(x, u).x.tobytes() != peer(x, u).tobytes():
                raise SystemExit(f"throughput: {name} with {substeps} sub-steps differs from the bare loop")
            seconds = alternate(lambda b=ours: b.step(x, u), lambda p=peer: p(x, u), repeats=5 if options.quick else 9)
            case = f"pybullet pendulum, {substeps} engine step{'s' if substeps > 1 else ''}, {name}"
            rows.append(row(case, "time", "us per transition", *(1e6 * s / n for s in seconds), PEER))
    return rows


if __name__ == "__main__":
    main(measure, argparse.ArgumentParser(description=__doc__))
