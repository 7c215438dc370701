"""A MuJoCo model as a section of an equations model: its bodies, what holds its joints, and how time is stepped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from gapcert_engines import Link, as_section

from .parameters import joint_name
from .robot import touches

_INTEGRATORS = {
    mujoco.mjtIntegrator.mjINT_EULER: "semi_implicit",
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST: "semi_implicit",
    mujoco.mjtIntegrator.mjINT_RK4: "rk4",
}
_LENGTH = mujoco.mjtJoint.mjJNT_SLIDE


def section(
    model: Any, coordinates: Sequence[str], free: Mapping[str, str], values: Mapping[str, float]
) -> dict[str, Any] | None:
    """See Engine.section; values: of all native parameters. Euler and implicitfast solve (M + h D) a = forces − D v with the
    joints' damping D.
    """
    if not _plain(model):
        return None
    gravity = (float(model.opt.gravity[0]), float(model.opt.gravity[1]), float(model.opt.gravity[2]))
    scheme = _INTEGRATORS[model.opt.integrator]
    links = [replace(link, moment=values.get(f"inertia.{link.name}")) for link in _links(model, coordinates)]
    return as_section(links, gravity, free, implicit=implicit(model), integrator=scheme)


def _links(model: Any, coordinates: Sequence[str]) -> list[Link]:
    """The frame of a body is that of its last joint; joints before it move links without mass."""
    found: list[Link] = []
    carrier: list[tuple[str | None, Any]] = [(None, np.zeros(3))] * model.nbody
    for k in range(1, model.nbody):
        name = model.body(k).name or f"body{k}"
        on, off = carrier[model.body_parentid[k]]
        turned, place = model.body_quat[k].tolist(), model.body_pos[k] - off
        first = int(model.body_jntadr[k])
        joints = list(range(first, first + int(model.body_jntnum[k])))
        anchor = np.zeros(3)
        for i, j in enumerate(joints):
            last = i == len(joints) - 1
            anchor_before, anchor = anchor, model.jnt_pos[j].copy()
            at = place + _rotated(turned, anchor) if i == 0 else anchor - anchor_before
            moved = _moved(model, j, coordinates[j], name if last else f"{name}_before_{i + 1}", on, at)
            found.append(moved if i else replace(moved, turn=tuple(turned)))
            on = found[-1].name
        if not joints:
            found.append(Link(name, on, tuple(place.tolist()), tuple(turned)))
        found[-1] = replace(found[-1], **_inertia(model, k, anchor))
        carrier[k] = (name, anchor)
    return found


def _moved(model: Any, j: int, coordinate: str, name: str, on: str | None, at: Any) -> Link:
    dof = model.jnt_dofadr[j]
    return Link(
        name,
        on,
        tuple(at.tolist()),
        coordinate=coordinate,
        joint=joint_name(model, j),
        straight=bool(model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE),
        axis=tuple(model.jnt_axis[j].tolist()),
        armature=float(model.dof_armature[dof]),
        damping=float(model.dof_damping[dof]),
        dry=float(model.dof_frictionloss[dof]),
        soft=_softness(model, int(dof)),
    )


def _plain(model: Any) -> bool:
    """Hinges and slides, without springs, contacts or anything else that acts; ends of joints act where they are reached."""
    scalar = np.isin(model.jnt_type, [mujoco.mjtJoint.mjJNT_HINGE, _LENGTH]).all()
    more = (model.jnt_stiffness, model.body_gravcomp)
    polynomials = model.dof_dampingpoly
    acts = any(np.any(part) for part in (*more, polynomials)) or model.ntendon or model.neq or model.nflex
    medium = model.opt.density or model.opt.viscosity or np.any(model.opt.wind)
    return bool(scalar and not acts and not medium and not touches(model) and model.opt.integrator in _INTEGRATORS)


def implicit(model: Any) -> bool:
    """Is the damping of joints solved with the step?"""
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return False
    return not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP) or (
        model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    )


def _inertia(model: Any, k: int, anchor: Any) -> dict[str, Any]:
    """Mass, centre and inertia of a body in its joint's frame."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[k])
    full = turn.reshape(3, 3) @ np.diag(model.body_inertia[k]) @ turn.reshape(3, 3).T
    entries = tuple(float(full[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    return {
        "mass": float(model.body_mass[k]),
        "com": tuple((model.body_ipos[k] - anchor).tolist()),
        "inertia": entries,
        "origin": tuple((-anchor).tolist()),
    }


def _softness(model: Any, dof: int) -> tuple[float, float]:
    """How dry friction gives way: R = (1 − d)/d · (M⁻¹)ᵢᵢ at qpos0 and b = 2/(d_max · timeconst), as mj_makeImpedance has it,
    with d the impedance at rest.
    """
    low, high = (min(max(float(d), mujoco.mjMINIMP), mujoco.mjMAXIMP) for d in model.dof_solimp[dof][:2])
    constant, ratio = map(float, model.dof_solref[dof])
    if constant <= 0:
        rate = -ratio / high
    else:
        if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_REFSAFE):
            constant = max(constant, 2 * float(model.opt.timestep))
        rate = 2 / (high * constant)
    return max(mujoco.mjMINVAL, (1 - low) / low * float(model.dof_invweight0[dof])), rate


def _rotated(quaternion: Sequence[float], vector: Any) -> Any:
    out = np.zeros(3)
    mujoco.mju_rotVecQuat(out, vector, np.asarray(quaternion, dtype=np.float64))
    return out
