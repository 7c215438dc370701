"""DART against a bare Python loop over its own calls."""

from __future__ import annotations

import dartpy
import numpy as np

from engines.case import MODELS, PERIOD, Array, Engine, Peer


def peer(substeps: int) -> Peer:
    """What a user would write."""
    options = dartpy.utils.DartLoaderOptions()
    options.mDefaultRootJointType = dartpy.utils.DartLoaderRootJointType.FIXED
    loader = dartpy.utils.DartLoader()
    loader.setOptions(options)
    robot = loader.parseSkeleton(str(MODELS / "pendulum.urdf"))
    awake = dartpy.simulation.DeactivationOptions()
    awake.mEnabled = False
    world = dartpy.simulation.World()
    world.setDeactivationOptions(awake)
    world.setTimeStep(PERIOD / substeps)
    world.addSkeleton(robot)

    def step(x: Array, u: Array) -> Array:
        out = []
        for (theta, omega), (torque,) in zip(x.tolist(), u.tolist(), strict=True):
            robot.setPosition(0, theta)
            robot.setVelocity(0, omega)
            for _ in range(substeps):
                robot.setForce(0, torque)
                world.step()
            out.append((robot.getPosition(0), robot.getVelocity(0)))
        return np.array(out)

    return Peer("bare Python loop over setPosition, setVelocity, setForce, step, getPosition, getVelocity", step, step)


ENGINE = Engine("dart", peer, tiles=128, options={})
