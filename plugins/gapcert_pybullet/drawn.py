"""What Bullet's robot looks like: shapes of its file, and where Bullet has its links."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

import numpy as np

from gapcert import Array
from gapcert.plugin import Scene
from gapcert_engines import file_shapes

from .client import Client, pybullet

if TYPE_CHECKING:
    from .urdf import RobotFile


def scene(client: Client, robot: RobotFile, ground: bool, position: Array, base: Array | None) -> Scene:
    """See Engine.scene; the last link is the world, where there is a ground."""
    number = pybullet.getNumJoints(client.body, client.id)
    names = [pybullet.getBodyInfo(client.body, client.id)[0].decode()]
    names += [pybullet.getJointInfo(client.body, k, client.id)[12].decode() for k in range(number)]
    shapes = file_shapes(ET.fromstring(robot.content), robot.path.parent, names)
    poses = np.empty((len(position), len(names), 7))
    for k, row in enumerate(position):
        if base is not None:
            client.set_base([*base[k, :7].tolist(), *[0.0] * 6])
        client.set_joints(np.column_stack([row, np.zeros_like(row)]))
        poses[k, 0] = client.base()[:7]
        links = pybullet.getLinkStates(client.body, range(number), 0, 1, client.id) if number else ()
        for j, link in enumerate(links):
            x, y, z, w = link[5]
            poses[k, 1 + j] = [*link[4], w, x, y, z]
    found = Scene(tuple(names), shapes, poses)
    return found.with_ground() if ground else found
