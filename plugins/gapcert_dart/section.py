"""A DART skeleton as links on joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gapcert_engines import Link


def links(skeleton: Any, coordinates: Mapping[str, str], damping: float | None, dry: float | None) -> list[Link]:
    """coordinates: joint → coordinate; damping and dry friction of all joints, None: the file's."""
    found: dict[str, Link] = {}
    for body in skeleton.getBodyNodes():
        joint, parent = body.getParentJoint(), body.getParentBodyNode()
        frame = joint.getTransformFromChildBodyNode()
        above = joint.getTransformFromParentBodyNode()
        if parent is not None:
            above = parent.getParentJoint().getTransformFromChildBodyNode().inverse().multiply(above)
        name = joint.getName()
        moves = joint.getNumDofs() > 0
        found[body.getName()] = Link(
            body.getName(),
            None if parent is None else parent.getName(),
            tuple(above.translation().tolist()),
            tuple(above.quaternion().wxyz().tolist()),
            coordinates[name] if moves else None,
            name,
            joint.getType() == "PrismaticJoint",
            tuple(joint.getAxis().tolist()) if moves else (0.0, 0.0, 1.0),
            damping=_stated(damping, joint.getDampingCoefficient(0)) if moves else None,
            dry=_stated(dry, joint.getCoulombFriction(0)) if moves else None,
            stiffness=float(joint.getSpringStiffness(0)) if moves else 0.0,
            rest=float(joint.getRestPosition(0)) if moves else 0.0,
            **_inertia(body.getInertia(), frame),
        )
    return list(found.values())


def _stated(given: float | None, own: float) -> float:
    return float(own) if given is None else given


def _inertia(inertia: Any, frame: Any) -> dict[str, Any]:
    """Mass, centre and inertia in the joint's frame."""
    turn, back = np.asarray(frame.rotation()).T, frame.inverse()
    full = turn @ np.asarray(inertia.getMoment()) @ turn.T
    centre = turn @ np.asarray(inertia.getLocalCOM()) + np.asarray(back.translation())
    entries = tuple(float(full[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    place = tuple(np.asarray(back.translation()).tolist())
    return {"mass": float(inertia.getMass()), "com": tuple(centre.tolist()), "inertia": entries, "origin": place}
