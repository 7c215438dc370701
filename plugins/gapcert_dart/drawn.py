"""What DART's robot looks like: shapes of its file, and where DART has its bodies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gapcert import Array
from gapcert.plugin import Scene
from gapcert_engines import file_shapes

from .config import DartConfig
from .loader import joints, load
from .rotation import to_vector

if TYPE_CHECKING:
    from .robot import RobotFile


def scene(robot: RobotFile, config: DartConfig, position: Array, base: Array | None) -> Scene:
    """See Engine.scene; the last link is the world, where there is a ground."""
    skeleton = load(robot, fixed_base=config.fixed_base)
    bodies = skeleton.getBodyNodes()
    names = [body.getName() for body in bodies]
    shapes = file_shapes(robot.element(), robot.path.parent, names)
    places = [native.getIndexInSkeleton(0) for joint, native in joints(robot, skeleton) if joint.movable]
    poses = np.empty((len(position), len(names), 7))
    q = skeleton.getPositions()
    for k, row in enumerate(position):
        q[places] = row
        if base is not None:
            q[:3], q[3:6] = to_vector(base[k : k + 1, 3:7])[0], base[k, :3]
        skeleton.setPositions(q)
        for j, body in enumerate(bodies):
            place = body.getWorldTransform()
            poses[k, j] = [*place.translation(), *place.quaternion().wxyz()]
    found = Scene(tuple(names), shapes, poses)
    return found if config.ground is None else found.with_ground()
