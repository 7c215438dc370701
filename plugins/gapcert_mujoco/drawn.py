"""What MuJoCo's robot looks like: geoms of the compiled model, and where its bodies are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from gapcert import Array
from gapcert.plugin import Scene, Shape

from .robot import Loose, scalar

SEEN = 3
"""Geoms of groups below this are seen, as in MuJoCo's own viewer; the others collide."""
_GEOM = mujoco.mjtGeom
_ROOM = 2.0
"""Half size of a plane without end, in sizes of the robot."""


def scene(model: Any, position: Array, base: Array | None, moving: Sequence[Loose]) -> Scene:
    """See Engine.scene; links are the bodies that have a shape. moving: what the columns of the base are of."""
    shapes = _shapes(model)
    bodies = sorted({s.link for s in shapes})
    data, places = mujoco.MjData(model), model.jnt_qposadr[scalar(model)]
    poses = np.empty((len(position), len(bodies), 7))
    for k, row in enumerate(position):
        data.qpos[places] = row
        if base is not None:
            at = 0
            for one in moving:
                shown = 4 if one.ball else 7
                data.qpos[one.q : one.q + shown] = base[k, at : at + shown]
                at += sum(s.size for s in one.columns)
        mujoco.mj_kinematics(model, data)
        poses[k, :, :3], poses[k, :, 3:] = data.xpos[bodies], data.xquat[bodies]
    names = tuple(model.body(b).name or f"body{b}" for b in bodies)
    return Scene(names, tuple(replace(s, link=bodies.index(s.link)) for s in shapes), poses)


def _shapes(model: Any) -> list[Shape]:
    seen = [k for k in range(model.ngeom) if model.geom_group[k] < SEEN] or range(model.ngeom)
    found = [s for k in seen if (s := _shape(model, k)) is not None and s.colour[3] > 0]
    shown = {s.link for s in found}
    for b in range(1, model.nbody):
        if b not in shown:
            place = np.concatenate([model.body_ipos[b], model.body_iquat[b]])
            box = Shape.of_inertia(b, float(model.body_mass[b]), model.body_inertia[b], place)
            found += [] if box is None else [box]
    return found


def _shape(model: Any, k: int) -> Shape | None:
    kind, size = model.geom_type[k], model.geom_size[k].astype(np.float64)
    material = int(model.geom_matid[k])
    colour = np.asarray(model.geom_rgba[k] if material < 0 else model.mat_rgba[material], dtype=np.float64)
    place = np.concatenate([model.geom_pos[k], model.geom_quat[k]])
    body = int(model.geom_bodyid[k])
    match kind:
        case _GEOM.mjGEOM_BOX | _GEOM.mjGEOM_ELLIPSOID:
            return Shape(body, "box" if kind == _GEOM.mjGEOM_BOX else "ellipsoid", size, place, colour)
        case _GEOM.mjGEOM_SPHERE:
            return Shape(body, "sphere", size[:1], place, colour)
        case _GEOM.mjGEOM_CAPSULE | _GEOM.mjGEOM_CYLINDER:
            name = "capsule" if kind == _GEOM.mjGEOM_CAPSULE else "cylinder"
            return Shape(body, name, np.array([size[0], 2 * size[1]]), place, colour)
        case _GEOM.mjGEOM_PLANE:
            half = np.where(size[:2] > 0, size[:2], _ROOM * float(model.stat.extent))
            return Shape(body, "plane", half, place, colour)
        case _GEOM.mjGEOM_MESH:
            return _mesh(model, int(model.geom_dataid[k]), body, place, colour)
    return None


def _mesh(model: Any, mesh: int, body: int, place: Array, colour: Array) -> Shape:
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    start, many = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    vertices = model.mesh_vert[first : first + count].astype(np.float64)
    faces = model.mesh_face[start : start + many].astype(np.int64)
    return Shape(body, "mesh", np.empty(0), place, colour, vertices, faces)
