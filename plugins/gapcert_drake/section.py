"""A Drake plant as links on joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gapcert_engines import Link

from .loader import Loaded


def links(loaded: Loaded, coordinates: Mapping[str, str], damping: float | None, moments: Mapping[str, float]) -> list[Link]:
    """coordinates: joint → coordinate; damping of all joints, None: the file's; moments: what `inertia.BODY` calls a body's."""
    plant = loaded.plant
    every = [plant.get_joint(j) for j in plant.GetJointIndices()]
    inboard = {int(j.child_body().index()): j for j in every}
    found: dict[int, Link] = {}

    def add(body: Any) -> None:
        number = int(body.index())
        if number in found or number not in inboard:
            return
        joint = inboard[number]
        parent, above_it = joint.parent_body(), int(joint.parent_body().index())
        add(parent)
        above, turned = _pose(joint.frame_on_parent()), _pose(joint.frame_on_child())
        if joint.type_name() == "weld":
            above = above.multiply(joint.X_FM())
        if above_it in inboard:
            above = _pose(inboard[above_it].frame_on_child()).inverse().multiply(above)
        name, moves = joint.name(), joint.num_velocities() == 1
        quaternion = above.rotation().ToQuaternion()
        straight = joint.type_name() == "prismatic"
        found[number] = Link(
            body.name(),
            found[above_it].name if above_it in found else None,
            tuple(above.translation().tolist()),
            tuple(quaternion.wxyz().tolist()),
            coordinates[name] if moves else None,
            name,
            straight,
            tuple((joint.translation_axis() if straight else joint.revolute_axis()).tolist()) if moves else (0.0, 0.0, 1.0),
            armature=armature(loaded, joint) if moves else None,
            damping=(float(joint.default_damping_vector()[0]) if damping is None else damping) if moves else None,
            moment=moments.get(body.name()),
            **_inertia(body.default_spatial_inertia(), turned),
        )

    for body in loaded.bodies():
        add(body)
    return list(found.values())


def armature(loaded: Loaded, joint: Any) -> float:
    """Inertia of the rotor as the joint feels it."""
    actuator = loaded.actuator(joint)
    return float(actuator.default_rotor_inertia() * actuator.default_gear_ratio() ** 2)


def _pose(frame: Any) -> Any:
    return frame.GetFixedPoseInBodyFrame()


def _inertia(spatial: Any, frame: Any) -> dict[str, Any]:
    """Mass, centre and inertia in the joint's frame."""
    back = frame.inverse()
    turn, centre = back.rotation().matrix(), back.multiply(spatial.get_com())
    full = turn @ central(spatial) @ turn.T
    entries = tuple(float(full[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    place = tuple(back.translation().tolist())
    return {"mass": float(spatial.get_mass()), "com": tuple(centre.tolist()), "inertia": entries, "origin": place}


def central(spatial: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The inertia (3, 3) about the centre of mass, along the axes of the body."""
    found = spatial.Shift(spatial.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    return np.asarray(found, dtype=np.float64)
