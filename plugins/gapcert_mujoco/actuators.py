"""Motors of an MJCF file: actuators that are a plain effort at one joint."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from gapcert_engines import Motor

from .parameters import joint_name

_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_SCALAR = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
_LAWLESS = (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE)


def motors(path: Path) -> tuple[Motor, ...]:
    """Those that are alone at a hinge or slide, with a gear; one without a name has its joint's."""
    spec = mujoco.MjSpec.from_file(str(path))
    if not list(spec.actuators):
        return ()
    for elements in (spec.keys, spec.tuples, spec.sensors, spec.cameras, spec.lights):
        for element in list(elements):
            spec.delete(element)
    try:
        model = spec.compile()
    except ValueError:  # What is wrong with the robot is told where it is compiled without them.
        return ()
    kinds = [mujoco.mjtTrn(int(kind)) for kind in model.actuator_trntype]
    at = [int(j) if kind in _JOINTS else -1 for j, kind in zip(model.actuator_trnid[:, 0], kinds, strict=True)]
    found = [_motor(model, k, j) for k, j in enumerate(at) if j >= 0 and at.count(j) == 1 and _plain(model, k, j)]
    names = [m.name for m in found]
    return tuple(m for m in found if names.count(m.name) == 1)


def _plain(model: Any, k: int, joint: int) -> bool:
    """Is its effort gear · control, without a law or a memory of its own?"""
    law = [int(part[k]) for part in (model.actuator_dyntype, model.actuator_gaintype, model.actuator_biastype)]
    plain = law == list(map(int, _LAWLESS)) and mujoco.mjtJoint(int(model.jnt_type[joint])) in _SCALAR
    more = (model.actuator_delay, model.actuator_armature, model.actuator_damping, model.actuator_dampingpoly)
    single = model.actuator_gainprm[k, 0] == 1 and model.actuator_gear[k, 0] != 0
    return bool(plain and single and not any(np.any(part[k]) for part in more))


def _motor(model: Any, k: int, joint: int) -> Motor:
    gear, low, high = float(model.actuator_gear[k, 0]), -np.inf, np.inf
    parts = (
        (model.actuator_ctrllimited[k], model.actuator_ctrlrange[k]),
        (model.actuator_forcelimited[k], model.actuator_forcerange[k]),
        (model.jnt_actfrclimited[joint], np.sort(model.jnt_actfrcrange[joint] / gear)),
    )
    for limited, ends in parts:
        if limited:
            low, high = max(low, float(ends[0])), min(high, float(ends[1]))
    name = joint_name(model, joint)
    return Motor(str(model.actuator(k).name) or name, name, gear, (low, high))
