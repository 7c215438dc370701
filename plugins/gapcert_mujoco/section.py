"""A MuJoCo model as a section of an equations model: its bodies, what holds its joints, and how time is stepped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from gapcert_mujoco.parameters import UNITS, joint_name
from gapcert_mujoco.robot import touches

_INTEGRATORS = {mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_IMPLICITFAST}
_LENGTH = mujoco.mjtJoint.mjJNT_SLIDE


def section(model: Any, coordinates: Sequence[str], free: Mapping[str, str]) -> dict[str, Any] | None:
    """`parameters`, `bodies`, `gravity`, `forces` (without inputs) and `integrator`; None for more than a tree of bodies.

    coordinates: of the joints in their order; free: native parameters → names of parameters that stand for them. Euler and
    implicitfast solve (M + h D) a = forces − D v with the joints' damping D, which is more inertia in the diagonal.
    """
    if not _plain(model):
        return None
    value = _Values(model, free)
    bodies: dict[str, dict[str, Any]] = {}
    carrier: list[tuple[str | None, Any]] = [(None, np.zeros(3))] * model.nbody
    forces: dict[str, str] = {}
    for k in range(1, model.nbody):
        name = model.body(k).name or f"body{k}"
        on, off = carrier[model.body_parentid[k]]
        turned, place = model.body_quat[k].tolist(), model.body_pos[k] - off
        first = int(model.body_jntadr[k])
        joints = list(range(first, first + int(model.body_jntnum[k])))
        anchor = np.zeros(3)
        for i, j in enumerate(joints):
            # The frame of a body is that of its last joint; joints before it move bodies without mass.
            last = i == len(joints) - 1
            here = f"{name}" if last else f"{name}_before_{i + 1}"
            anchor_before, anchor = anchor, model.jnt_pos[j].copy()
            at = place + _rotated(turned, anchor) if i == 0 else anchor - anchor_before
            q = coordinates[j]
            armature, damping = (value.joint(what, j) for what in ("armature", "damping"))
            if damping is not None:
                forces[q] = f"-{damping}*{q}_dot"
                own = "" if armature is None else f"{armature} + "
                armature = f"{own}h*{damping}" if implicit(model) else armature
            bodies[here] = {"joint": q, "at": at.tolist(), "axis": model.jnt_axis[j].tolist(), "armature": armature or 0.0}
            bodies[here] |= {"on": on} if on is not None else {}
            bodies[here] |= {"turned": turned} if i == 0 else {}
            on = here
        if not joints:
            bodies[name] = {"at": place.tolist(), "turned": turned} | ({"on": on} if on is not None else {})
        bodies[name] |= value.inertia(k, anchor)
        carrier[k] = (name, anchor)
    gravity = [value.gravity(a) for a in range(3)]
    parameters = {"metre": "1 m", **value.parameters}
    return {"parameters": parameters, "bodies": bodies, "gravity": gravity, "forces": forces, "integrator": "semi_implicit"}


def _plain(model: Any) -> bool:
    """Hinges and slides, without ends, springs, contacts or anything else that acts."""
    scalar = np.isin(model.jnt_type, [mujoco.mjtJoint.mjJNT_HINGE, _LENGTH]).all()
    more = (model.jnt_limited, model.jnt_stiffness, model.dof_frictionloss, model.body_gravcomp)
    polynomials = model.dof_dampingpoly
    acts = any(np.any(part) for part in (*more, polynomials)) or model.ntendon or model.neq or model.nflex
    medium = model.opt.density or model.opt.viscosity or np.any(model.opt.wind)
    return bool(scalar and not acts and not medium and not touches(model) and model.opt.integrator in _INTEGRATORS)


def implicit(model: Any) -> bool:
    """Is the damping of joints solved with the step?"""
    return not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP) or (
        model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    )


class _Values:
    """Numbers of a model as texts, or the parameters that stand for them."""

    def __init__(self, model: Any, free: Mapping[str, str]) -> None:
        self.model, self.free = model, free
        self.parameters: dict[str, str] = {}

    def joint(self, what: str, joint: int) -> str | None:
        """The name of a joint's parameter, whose unit no number in an expression can say; None where it is zero."""
        number = float(getattr(self.model, f"dof_{what}")[self.model.jnt_dofadr[joint]])
        if (name := self.free.get(f"{what}.{joint_name(self.model, joint)}")) is not None or not number:
            return name
        straight = self.model.jnt_type[joint] == _LENGTH
        unit = UNITS[_LENGTH if straight else mujoco.mjtJoint.mjJNT_HINGE][what]
        self.parameters[f"{what}_{joint}"] = f"{number!r} {unit}"
        return f"{what}_{joint}"

    def gravity(self, axis: int) -> str:
        known = self.free.get(f"gravity_{'xyz'[axis]}")
        return known or f"{float(self.model.opt.gravity[axis])!r} m/s^2"

    def inertia(self, k: int, anchor: Any) -> dict[str, Any]:
        """Mass, centre and inertia of a body in its joint's frame; the inertia follows a mass that is free."""
        m, mass = self.model, float(self.model.body_mass[k])
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, m.body_iquat[k])
        full = turn.reshape(3, 3) @ np.diag(m.body_inertia[k]) @ turn.reshape(3, 3).T
        entries = [full[0, 0], full[1, 1], full[2, 2], full[0, 1], full[0, 2], full[1, 2]]
        name = self.free.get(f"mass.{m.body(k).name or f'body{k}'}")
        texts = [repr(float(e)) if name is None else f"{float(e) / mass!r}*{name}*metre**2" for e in entries]
        return {"mass": name or repr(mass), "com": (m.body_ipos[k] - anchor).tolist(), "inertia": texts}


def _rotated(quaternion: Sequence[float], vector: Any) -> Any:
    out = np.zeros(3)
    mujoco.mju_rotVecQuat(out, vector, np.asarray(quaternion, dtype=np.float64))
    return out
