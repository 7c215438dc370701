"""PyBullet against a bare Python loop over its own calls."""

from __future__ import annotations

import numpy as np
import pybullet

from engines.case import MODELS, PERIOD, Array, Engine, Peer


def peer(substeps: int) -> Peer:
    """What a user would write."""
    client = pybullet.connect(pybullet.DIRECT)
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE
    body = pybullet.loadURDF(str(MODELS / "pendulum.urdf"), useFixedBase=True, flags=flags, physicsClientId=client)
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

    name = "bare Python loop over resetJointState, setJointMotorControl2, stepSimulation, getJointState"
    return Peer(name, step, step)


ENGINE = Engine("pybullet", peer, tiles=16, options={})
