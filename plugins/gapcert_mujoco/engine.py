"""Engine `mujoco`: a robot file described by plain data, and the worlds that step it."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, final

import mujoco
import numpy as np

from gapcert import Array, UsageError
from gapcert.plugin import Scene
from gapcert_engines import Drive, Engine, EngineWorld, Joint, Link, as_backend, moments

from .config import MuJoCoConfig
from .drawn import scene
from .parameters import Natives
from .patch import patched, wrapper
from .robot import (
    SCHEMES,
    actuators,
    beyond,
    binary,
    compiled,
    joint_name,
    left_over,
    loose,
    motors,
    restored,
    unconstrained,
)
from .world import MuJoCoWorld
from .xla import check, versions

_KINDS = {
    mujoco.mjtJoint.mjJNT_HINGE: "revolute",
    mujoco.mjtJoint.mjJNT_SLIDE: "prismatic",
    mujoco.mjtJoint.mjJNT_BALL: "ball",
    mujoco.mjtJoint.mjJNT_FREE: "free",
}
_ITERATED = 1e-4  # relative: what MuJoCo's solver leaves at its default tolerance; chosen, not measured
_COORDINATES_AT_MOST = 2048
"""Of all copies together."""


@final
class MuJoCoEngine(Engine):
    """A robot in MuJoCo, compiled once; its native parameters are those of `Natives`.

    The file's actuators, sensors and keyframes are left out: an input is the effort at a joint, or the control of a motor,
    times its gear, at a joint or at a site. `base` is the frame of the body that floats, not its centre of mass.
    """

    def __init__(self, config: MuJoCoConfig, folder: Path | None = None) -> None:
        self.config: MuJoCoConfig = config
        self._path = (folder or Path()) / config.robot
        self.file = str(self._path)
        model = compiled(self._path, config)
        self._models = {1: zlib.compress(binary(model), 1)}
        kinds = [_KINDS[mujoco.mjtJoint(kind)] for kind in model.jnt_type]
        self._check(model, kinds)
        self.rowwise = config.implementation == "mjx"
        self.joints = tuple(_joint(model, k, kind) for k, kind in enumerate(kinds) if kind != "free")
        self._loose = loose(model, fixed_base=config.fixed_base)
        poses = [one.rest(model) for one in self._loose]
        floats = not config.fixed_base
        self.base, self.beside_default = poses[0] if floats else (), tuple(v for pose in poses[floats:] for v in pose)
        self.beside = tuple(s for one in self._loose[floats:] for s in one.columns)
        self.motors, self.served = motors(self._path)
        self.actuators = () if config.drive else actuators(model)
        natives = Natives(model)
        self.parameters = tuple(natives.parameters)
        self._unconstrained, self._implicit = unconstrained(model), _implicit(model)
        self.integrator = SCHEMES.get(model.opt.integrator, "")
        # Newton's too: it stops as the others do, also where a constraint has just begun or ceased to act.
        self.unsolved = 0.0 if self._unconstrained else left_over(model)
        self._belts = tuple(model.geom(int(k)).name for k in np.flatnonzero(model.geom_surfacevel.any(axis=1)))

    springs_held = False
    from_config = classmethod(as_backend)

    def open(self, copies: int, period: float, drive: Drive | None) -> EngineWorld:
        if copies not in self._models:
            if binary(compiled(self._path, self.config)) != zlib.decompress(self._models[1]):
                raise UsageError(f"backend.robot: {self.file} has changed since it was read; run again")
            self._models[copies] = zlib.compress(binary(compiled(self._path, self.config, copies)), 1)
        one, many = self._model(), self._model(copies)
        one.opt.timestep = many.opt.timestep = period / self.config.substeps
        return MuJoCoWorld(one, many, copies, self.config, drive)

    def digest_data(self) -> list[object]:
        data: list[object] = [
            f"mujoco {mujoco.mj_versionString()}",
            hashlib.sha256(zlib.decompress(self._models[1])).hexdigest(),
        ]
        return [*data, self.config.tiles, *versions()] if self.rowwise else data

    def beyond(self) -> tuple[str, ...]:
        return (*super().beyond(), *beyond(self._model()))

    def links(self, coordinates: Mapping[str, str], period: float, values: Mapping[str, float]) -> list[Link]:
        model, every = self._model(), self.stated | dict(values)
        model = Natives(model).varied(model, every)
        model.opt.timestep = period / self.config.substeps
        return _links(model, coordinates, every)

    def accuracy(self, values: Mapping[str, float]) -> float:
        """Dry friction is solved until an iteration gains less than the option `tolerance`."""
        return _ITERATED if self.rubs(values) else super().accuracy(values)

    def implicit(self) -> bool:
        return self._implicit

    def patched(self, values: Mapping[str, float]) -> dict[str, str]:
        gravity = self._model().opt.gravity.tolist()
        name = f"extended{self._path.suffix}"
        text, unsaid = patched(self._path.read_text(encoding="utf-8"), values, gravity)
        return {name: text} | ({"extended.py": wrapper(name, unsaid)} if unsaid else {})

    def scene(self, position: Array, base: Array | None) -> Scene:
        return scene(self._model(), position, base, self._loose)

    def tiles(self) -> tuple[int, str]:
        if self.rowwise:
            return 1, f"untiled: MJX takes {self.config.tiles} rows at once"
        if not self._unconstrained:
            return 1, "untiled: copies would solve their contacts, limits, dry friction or equalities together"
        most = _COORDINATES_AT_MOST // max(1, len(self.joints))
        return most, f"untiled: {len(self.joints)} joints fill a model"

    def resolution(self, magnitude: Array) -> Array:
        """4 ulp of max |x⁺|, and one for every further sub-step; where constraints act, of at least 1: forces balance."""
        size = np.maximum(np.abs(magnitude), np.finfo(float).tiny if self._unconstrained else 1.0)
        return np.asarray((3 + self.config.substeps) * np.spacing(size))

    def drivable(self) -> tuple[str, ...]:
        """The joints, and the geoms whose surface moves in the file: a target is a multiple of that velocity."""
        return (*super().drivable(), *(name for name in self._belts if name))

    def _model(self, copies: int = 1) -> Any:
        return restored(zlib.decompress(self._models[copies]))

    def _check(self, model: Any, kinds: list[str]) -> None:
        where = f"backend.robot: {self.file}"
        drive = self.config.drive
        if drive and any(kind == mujoco.mjtTrn.mjTRN_SITE for kind in model.actuator_trntype):
            raise UsageError(f"{where}: inputs go to motors at sites and to a drive; expected one of the two")
        if drive and (drive.gain or drive.limit) and not model.nu:
            raise UsageError("backend.drive: gain and limit are a motor's, and no element is a joint; leave them out")
        if self.config.implementation == "mjx":
            if drive:
                raise UsageError("backend.implementation: mjx has no drive; give efforts at joints, or set implementation: c")
            check(model, self._path)
        memory = {"a plugin": model.nplugin, "a plastic spring": model.nplastic, "a deformable body": model.nflex}
        if found := [what for what, count in memory.items() if count]:
            raise UsageError(f"{where} has {found[0]}, whose state is no joint's; expected rigid bodies, hinges and slides")


def _joint(model: Any, k: int, kind: Any) -> Joint:
    damping = float(model.dof_damping[model.jnt_dofadr[k]])
    rest = float(model.qpos0[model.jnt_qposadr[k]])
    joint = Joint(joint_name(model, k), kind, damping, rest=rest)
    # A constraint begins to act where the distance is below the margin.
    low, high, margin = float(model.jnt_range[k, 0]), float(model.jnt_range[k, 1]), float(model.jnt_margin[k])
    return replace(joint, limited=True, ends=(low + margin, high - margin)) if model.jnt_limited[k] else joint


def _implicit(model: Any) -> bool:
    """Is the damping D of joints solved with the step, (M + h D) a = forces − D v, as Euler and implicitfast do?"""
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return False
    return not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP) or (
        model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    )


def _links(model: Any, coordinates: Mapping[str, str], values: Mapping[str, float]) -> list[Link]:
    """The frame of a body is that of its last joint; joints before it move links without mass.

    values: of all native parameters, which the model has.
    """
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
            moved = _moved(model, j, coordinates[joint_name(model, j)], name if last else f"{name}_before_{i + 1}", on, at)
            found.append(moved if i else replace(moved, turn=tuple(turned)))
            on = found[-1].name
        if not joints:
            found.append(Link(name, on, tuple(place.tolist()), tuple(turned)))
        found[-1] = replace(found[-1], moment=values.get(f"inertia.{name}"), **_inertia(model, k, anchor))
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
        stiffness=float(model.jnt_stiffness[j]),
        rest=float(model.qpos_spring[model.jnt_qposadr[j]]),
    )


def _inertia(model: Any, k: int, anchor: Any) -> dict[str, Any]:
    """Mass, centre and inertia of a body in its joint's frame."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[k])
    full = turn.reshape(3, 3) @ np.diag(model.body_inertia[k]) @ turn.reshape(3, 3).T
    return {
        "mass": float(model.body_mass[k]),
        "com": tuple((model.body_ipos[k] - anchor).tolist()),
        "inertia": moments(full),
        "origin": tuple((-anchor).tolist()),
        "lifted": float(model.body_gravcomp[k]),
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
