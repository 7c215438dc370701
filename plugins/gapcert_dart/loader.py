"""From a robot file to a DART skeleton of one fixed or floating base and joints with one number each."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

import dartpy
import numpy as np

from gapcert import UsageError
from gapcert_engines import Joint, JointType, muted

from .robot import RobotFile

__all__ = ["dartpy", "joints", "load"]

_TYPES: dict[str, JointType] = {
    "RevoluteJoint": "revolute",
    "PrismaticJoint": "prismatic",
    "WeldJoint": "fixed",
    "BallJoint": "ball",
    "PlanarJoint": "planar",
    "FreeJoint": "free",
}
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_MASSLESS = ("[Inertia.cpp", "[BodyNode.cpp")
"""Where DART warns of links without mass, which are meant."""


def load(robot: RobotFile, *, fixed_base: bool) -> Any:
    """The skeleton; UsageError where DART left something out or a joint has more than one number.

    A floating base's joint is placed in the world's origin, so that its numbers are the world's.
    """
    robot.check_meshes()
    skeleton, reason = None, ""
    with muted() as said:
        try:
            skeleton = _from_urdf(robot, fixed_base) if robot.kind == "urdf" else _from_sdf(robot, fixed_base)
        except (RuntimeError, ValueError, IndexError) as error:
            reason = str(error)
    if skeleton is None:
        reason = _told(said[0]) or reason or "it gave no reason"
        raise UsageError(f"robot: DART cannot load {robot.path}: {reason}; expected a valid file")
    _check_whole(robot, skeleton, _told(said[0]))
    _check_base(robot, skeleton, fixed_base)
    return skeleton


def _told(said: str) -> str:
    """What DART printed on one line, without colours and without warnings of links that are meant to have no mass."""
    lines = _COLOUR.sub("", said).splitlines()
    return " ".join(" ".join(line for line in lines if not any(m in line for m in _MASSLESS)).split())


def joints(robot: RobotFile, skeleton: Any) -> list[tuple[Joint, Any]]:
    """The file's joints in DART's order, and DART's own objects."""
    found = []
    for native in skeleton.getJoints():
        if native.getName() not in robot.joints:
            continue
        kind: JointType = _TYPES.get(native.getType(), "other")
        scalar = kind in ("revolute", "prismatic")
        limited = scalar and bool(np.isfinite(native.getPositionLowerLimit(0)) or np.isfinite(native.getPositionUpperLimit(0)))
        damping = float(native.getDampingCoefficient(0)) if scalar else 0.0
        found.append((Joint(native.getName(), kind, damping, limited), native))
    return found


def _from_urdf(robot: RobotFile, fixed_base: bool) -> Any:
    # DART would give a link without <inertial> one kilogram; URDF means none.
    massless = dartpy.dynamics.Inertia(0.0, np.zeros(3), np.zeros((3, 3)))
    root = dartpy.utils.DartLoaderRootJointType.FIXED if fixed_base else dartpy.utils.DartLoaderRootJointType.FLOATING
    loader = dartpy.utils.DartLoader()
    loader.setOptions(dartpy.utils.DartLoaderOptions(None, root, massless))
    return loader.parseSkeletonString(robot.text, str(robot.path.resolve()))


def _from_sdf(robot: RobotFile, fixed_base: bool) -> Any:
    reader = dartpy.utils.SdfParser
    kind = reader.RootJointType.FIXED if fixed_base else reader.RootJointType.FLOATING
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.sdf"
        path.write_text(robot.text, encoding="utf-8")
        return reader.readSkeleton(str(path), reader.Options(None, kind))


def _check_whole(robot: RobotFile, skeleton: Any, said: str) -> None:
    bodies = {b.getName(): b for b in skeleton.getBodyNodes()}
    natives = {j.getName(): j for j in skeleton.getJoints()}
    lost = [f"link '{n}'" for n in robot.links if n not in bodies and not (n == "world" and robot.kind == "urdf")]
    lost += [f"joint '{n}'" for n in robot.joints if n not in natives]
    lost += [
        f"a collision shape of link '{n}'"
        for n, count in robot.collisions.items()
        if count != (bodies[n].getNumShapeNodes() if n in bodies else 0)
    ]
    if lost:
        raise UsageError(f"robot: {robot.path}: DART left out {lost[0]}: {said or 'it gave no reason'}; expected a valid file")
    for joint, native in joints(robot, skeleton):
        if not (joint.movable or joint.type == "fixed"):
            name = native.getType().removesuffix("Joint").lower()
            raise UsageError(
                f"robot: joint '{joint.name}' of {robot.path} is {name}; expected revolute, continuous, prismatic or fixed "
                f"joints; write it as a chain of those"
            )
        if native.getActuatorType() == dartpy.dynamics.ActuatorType.MIMIC:
            raise UsageError(f"robot: joint '{joint.name}' of {robot.path} mimics another; expected joints that move freely")
    if not skeleton.isMobile():
        raise UsageError(f"robot: the model of {robot.path} is static; expected one that moves; take <static> out")


def _check_base(robot: RobotFile, skeleton: Any, fixed_base: bool) -> None:
    floating = [j for j in skeleton.getJoints() if j.getType() == "FreeJoint"]
    if fixed_base:
        return
    if not floating:
        raise UsageError(f"robot: {robot.path}: its root is joined to the world, so it cannot float; set fixed_base: true")
    if len(floating) > 1 or floating[0].getIndexInSkeleton(0) != 0:
        raise UsageError(f"robot: {robot.path} is in {skeleton.getNumTrees()} pieces; expected one tree of links")
    place, origin = skeleton.getRootBodyNode(0).getWorldTransform(), dartpy.math.Isometry3()
    floating[0].setTransformFromParentBodyNode(origin)
    floating[0].setTransformFromChildBodyNode(origin)
    skeleton.setPositions(np.concatenate([floating[0].convertToPositions(place), skeleton.getPositions()[6:]]))
