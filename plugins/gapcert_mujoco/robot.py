"""A robot file as a compiled MuJoCo model: what the spec's options change, several copies in one model, and its motors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import mujoco
import numpy as np
import numpy.typing as npt

from gapcert import StateSpec, UsageError
from gapcert_engines import UNITS, Actuator, Law, Motor, ball_columns, body_columns

if TYPE_CHECKING:
    from .config import MuJoCoConfig

_SCALAR = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_PLAIN = (int(mujoco.mjtDyn.mjDYN_NONE), int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_NONE))
_DISABLE = mujoco.mjtDisableBit
SCHEMES = {
    mujoco.mjtIntegrator.mjINT_EULER: "semi_implicit",
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST: "semi_implicit",
    mujoco.mjtIntegrator.mjINT_RK4: "rk4",
}
"""Integrators that equations have, too."""
_ROUND = (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER)
"""What tendons lie around."""
_ALL = 2**31 - 1
"""The bit mask of a geom that meets all others."""
_SMALLEST = 1e-15
"""MuJoCo refuses a moving body with a principal moment of inertia below this; kg m². Such a moment is raised to it."""


def compiled(path: Path, config: MuJoCoConfig, copies: int = 1) -> Any:
    """The MjModel of `copies` robots; their elements are called NAME, NAME#1, NAME#2, …"""
    if not path.is_file():
        raise UsageError(f"backend.robot: there is no file {path}; give the path of an MJCF or URDF file, relative to the spec")
    try:
        path.read_text(encoding="utf-8")
    except UnicodeDecodeError:  # MuJoCo takes it, and its names are none
        raise UsageError(f"backend.robot: {path} is not UTF-8 text; expected an MJCF or URDF file") from None
    # MuJoCo keeps meshes by name and time in seconds: one that is edited within a second would be missed.
    mujoco.mj_clearCache(mujoco.mj_getCache())
    try:
        return _compiled(path, config, copies, 0.0)
    except ValueError as error:
        # A thin rod in a URDF may have no moment of inertia about its own axis.
        try:
            return _compiled(path, config, copies, _SMALLEST)
        except ValueError:
            said = " ".join(str(error).split())
            raise UsageError(f"backend.robot: MuJoCo cannot load {path}: {said}; expected a valid MJCF or URDF file") from None
    finally:
        mujoco.mj_clearCache(mujoco.mj_getCache())


def _compiled(path: Path, config: MuJoCoConfig, copies: int, smallest: float) -> Any:
    """With principal moments of inertia raised to `smallest`, unless the file sets a bound of its own."""
    spec = _spec(path, config)
    spec.compiler.boundinertia = spec.compiler.boundinertia or smallest
    if copies > 1:
        _bare(spec)
        more = [spec.copy() for _ in range(copies - 1)]
        for k, copy in enumerate(more, 1):
            spec.attach(copy, suffix=f"#{k}", frame=spec.worldbody.add_frame())
    return spec.compile()


def _bare(spec: Any) -> None:
    """Takes out shapes, once bodies have the inertia that these give them: copies share a model where nothing touches."""
    model = spec.compile()
    wrapped = model.wrap_objid[np.isin(model.wrap_type, _ROUND)].tolist()
    for body in list(spec.bodies)[1:]:
        body.mass, body.ipos, body.iquat = model.body_mass[body.id], model.body_ipos[body.id], model.body_iquat[body.id]
        body.inertia, body.fullinertia, body.explicitinertial = model.body_inertia[body.id], [np.nan, *[0.0] * 5], True
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    spec.compiler.settotalmass, spec.compiler.balanceinertia = -1, False
    idle = [g for g in spec.geoms if not g.fluid_ellipsoid and g.id not in wrapped]
    shapes = {g.meshname for g in spec.geoms if g.fluid_ellipsoid}
    for elements in (spec.pairs, spec.excludes, idle, [m for m in spec.meshes if m.name not in shapes], spec.hfields):
        for element in list(elements):
            spec.delete(element)


def _spec(path: Path, config: MuJoCoConfig) -> Any:
    """The file with the spec's options, without what cannot move it: sensors, cameras, lights, pictures; and without its
    actuators but those that inputs name and that are no motors."""
    spec = mujoco.MjSpec.from_file(str(path))
    controls = {target for target in config.inputs.values() if target.endswith(".ctrl")}
    for actuator in (nameless := [a for a in spec.actuators if not a.name]):
        if [a.target for a in nameless].count(actuator.target) == 1:
            actuator.name = actuator.target
    lone = {m.name for m in motors(path)[0]} if controls else set()
    _strip(spec, [a for a in spec.actuators if f"{a.name}.ctrl" not in controls or a.name in lone or not _kept(a)])
    _set_base(spec, path, config.fixed_base)
    _set_options(spec, config)
    for joint in spec.joints:
        if joint.type in _SCALAR:
            _set_joint(joint, config)
    if config.ground is not None:
        _add_ground(spec, config.ground)
    if config.drive is not None:
        _add_motors(spec, config)
    return spec


def _strip(spec: Any, actuators: Sequence[Any] = ()) -> None:
    """Takes out what moves nothing, and these actuators."""
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    unmoving = (spec.keys, spec.tuples, spec.sensors, spec.cameras, spec.lights, spec.textures, spec.skins)
    for elements in (*unmoving, actuators):
        for element in list(elements):
            spec.delete(element)


def _kept(actuator: Any) -> bool:
    """Has it no memory of its own: no activation, no delay?"""
    return bool(actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE and not np.any(actuator.delay))


def actuators(model: Any) -> tuple[Actuator, ...]:
    """Of a compiled robot without a drive: what it has kept."""
    return tuple(_actuator(model, k) for k in range(model.nu))


def _actuator(model: Any, k: int) -> Actuator:
    name, kind, law = str(model.actuator(k).name), mujoco.mjtTrn(int(model.actuator_trntype[k])), _law(model, k)
    if law is not None:
        slides = model.jnt_type[model.actuator_trnid[k, 0]] == mujoco.mjtJoint.mjJNT_SLIDE
        position, velocity, _ = UNITS["prismatic" if slides else "revolute"]
        return Actuator(name, {"position": position, "velocity": velocity, "effort": "1"}[law.commands], law)
    plain = (int(model.actuator_gaintype[k]), int(model.actuator_biastype[k])) == _PLAIN[1:]
    if kind == mujoco.mjtTrn.mjTRN_SITE and plain:
        return Actuator(name, "N" if model.actuator_gear[k, :3].any() else "N*m")
    return Actuator(name, "1")


def _law(model: Any, k: int) -> Law | None:
    """Of an affine effort at a hinge or slide."""
    joint = int(model.actuator_trnid[k, 0])
    gain, bias = mujoco.mjtGain(int(model.actuator_gaintype[k])), mujoco.mjtBias(int(model.actuator_biastype[k]))
    straight = gain == mujoco.mjtGain.mjGAIN_FIXED and bias in (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
    more = (model.actuator_armature, model.actuator_damping, model.actuator_dampingpoly)
    if mujoco.mjtTrn(int(model.actuator_trntype[k])) not in _JOINTS or not straight or any(np.any(part[k]) for part in more):
        return None
    if mujoco.mjtJoint(int(model.jnt_type[joint])) not in _SCALAR or model.jnt_actfrclimited[joint]:
        return None
    offset, position, velocity = model.actuator_biasprm[k, :3].tolist() if bias == mujoco.mjtBias.mjBIAS_AFFINE else [0.0] * 3
    limited = not model.opt.disableflags & int(_DISABLE.mjDSBL_CLAMPCTRL)
    return Law(
        joint_name(model, joint),
        float(model.actuator_gear[k, 0]),
        float(model.actuator_gainprm[k, 0]),
        offset,
        position,
        velocity,
        _ends(model.actuator_ctrllimited[k] and limited, model.actuator_ctrlrange[k]),
        _ends(model.actuator_forcelimited[k], model.actuator_forcerange[k]),
        held=model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    )


def _ends(limited: Any, ends: Any) -> tuple[float, float]:
    return (float(ends[0]), float(ends[1])) if limited else (-math.inf, math.inf)


def motors(path: Path) -> tuple[tuple[Motor, ...], dict[str, str]]:
    """Actuators of the file that are a plain effort, alone at a hinge or slide; and joints that others drive, by whose name.

    One without a name has its joint's.
    """
    spec = mujoco.MjSpec.from_file(str(path))
    if not list(spec.actuators):
        return (), {}
    _strip(spec)
    for geom in spec.geoms:
        if geom.meshname:  # What they look like is not asked.
            geom.meshname, geom.type, geom.size = "", mujoco.mjtGeom.mjGEOM_SPHERE, [0.01, 0.0, 0.0]
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    try:
        model = spec.compile()
    except ValueError:  # What is wrong with the robot is told where it is compiled without them.
        return (), {}
    kinds = [mujoco.mjtTrn(int(kind)) for kind in model.actuator_trntype]
    at = [int(j) if kind in _JOINTS else -1 for j, kind in zip(model.actuator_trnid[:, 0], kinds, strict=True)]
    found = [_motor(model, k, j) for k, j in enumerate(at) if j >= 0 and at.count(j) == 1 and _lawless(model, k, j)]
    names = [m.name for m in found]
    alone = tuple(m for m in found if names.count(m.name) == 1)
    laws = zip(model.actuator_dyntype, model.actuator_gaintype, model.actuator_biastype, strict=True)
    lawful = {k: joint_name(model, at[k]) for k, own in enumerate(laws) if at[k] >= 0 and tuple(map(int, own)) != _PLAIN}
    return alone, {joint: str(model.actuator(k).name) or joint for k, joint in lawful.items()}


def _lawless(model: Any, k: int, joint: int) -> bool:
    """Is its effort gear · control, without a law or a memory of its own?"""
    law = [int(part[k]) for part in (model.actuator_dyntype, model.actuator_gaintype, model.actuator_biastype)]
    plain = law == list(_PLAIN) and mujoco.mjtJoint(int(model.jnt_type[joint])) in _SCALAR
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


def _set_base(spec: Any, path: Path, fixed: bool) -> None:
    free = [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]
    # Beside a robot that stands fast, bodies may be free that carry no joint.
    if fixed and free and (len(free) == len(spec.joints) or any(len(j.parent.find_all("joint")) > 1 for j in free)):
        raise UsageError(f"backend.robot: {path} has a base with a free joint; set fixed_base: false, or take the joint out")
    if fixed or free:
        return
    tops = [b for b in spec.worldbody.bodies if b.mass > 0 or list(b.bodies)]
    if len(tops) != 1 or list(tops[0].joints):
        raise UsageError(
            f"backend.robot: {path} has no base that could float; expected one body below the world, without a joint; "
            f"give it a free joint or set fixed_base: true"
        )
    if not tops[0].explicitinertial and not list(tops[0].geoms):
        raise UsageError(
            f"backend.robot: the base of {path} has no inertia, so it cannot float; give it one or fixed_base: true"
        )
    tops[0].add_freejoint()


def _set_options(spec: Any, config: MuJoCoConfig) -> None:
    option = spec.option
    for name, kinds in (("integrator", mujoco.mjtIntegrator), ("solver", mujoco.mjtSolver), ("cone", mujoco.mjtCone)):
        if (chosen := getattr(config, name)) is not None:
            prefix = {"integrator": "mjINT_", "solver": "mjSOL_", "cone": "mjCONE_"}[name]
            setattr(option, name, int(getattr(kinds, prefix + chosen.upper())))
    for name in ("iterations", "tolerance", "impratio", "noslip_iterations"):
        if (chosen := getattr(config, name)) is not None:
            setattr(option, name, chosen)
    if config.gravity is not None:
        option.gravity = config.gravity
    elif option.disableflags & int(_DISABLE.mjDSBL_GRAVITY):
        option.gravity = [0.0, 0.0, 0.0]
    # Where it is off, it is zero: a number like any other.
    option.disableflags &= ~int(_DISABLE.mjDSBL_GRAVITY)
    # A reset in the middle of a query would answer for another state; sleeping bodies would remember earlier queries.
    option.disableflags |= int(_DISABLE.mjDSBL_AUTORESET | _DISABLE.mjDSBL_SENSOR)
    option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP | mujoco.mjtEnableBit.mjENBL_ENERGY)
    if not config.contact:
        option.disableflags |= int(_DISABLE.mjDSBL_CONTACT)
    if config.euler_damping == "explicit":
        option.disableflags |= int(_DISABLE.mjDSBL_EULERDAMP)
    elif config.euler_damping == "implicit":
        option.disableflags &= ~int(_DISABLE.mjDSBL_EULERDAMP)


def _set_joint(joint: Any, config: MuJoCoConfig) -> None:
    if config.joint_damping is not None:
        # Linear, quadratic and cubic in the rate.
        joint.damping = [config.joint_damping, 0, 0]
    if config.frictionloss is not None:
        joint.frictionloss = config.frictionloss
    if config.armature is not None:
        joint.armature = config.armature


def _add_ground(spec: Any, friction: float) -> None:
    """A plane z = 0 whose friction counts: the geom of higher priority decides a contact's."""
    geoms = list(spec.geoms)
    taken = {g.name for g in geoms}
    spec.worldbody.add_geom(
        name=next(n for n in ("ground", *(f"ground{k}" for k in range(len(geoms)))) if n not in taken),
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 1],
        contype=_ALL,
        conaffinity=_ALL,
        friction=[friction, 0.005, 0.0001],
        surfacevel=np.zeros(6),
        priority=1 + max((g.priority for g in geoms), default=0),
        condim=max((g.condim for g in geoms), default=3),
    )


def _add_motors(spec: Any, config: MuJoCoConfig) -> None:
    """One motor clip(gain · (command − rate), ±limit) per driven joint; it overrides the joint's own effort limit."""
    drive = config.drive
    assert drive is not None, "there is a drive"
    joints = {j.name: j for j in spec.joints if j.type in _SCALAR}
    for name in drive.elements:
        if name not in joints:
            continue
        joints[name].actfrclimited = False
        # A new actuator starts from the file's default class.
        spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gear=[1, 0, 0, 0, 0, 0],
            dyntype=mujoco.mjtDyn.mjDYN_NONE,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            delay=0,
            ctrllimited=False,
            forcelimited=drive.limit is not None,
            forcerange=[-(drive.limit or 0), drive.limit or 0],
        )


def binary(model: Any) -> bytes:
    """The model as MuJoCo saves it."""
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def restored(data: bytes) -> Any:
    """Inverse of `binary`."""
    return mujoco.MjModel.from_binary_path("robot.mjb", {"robot.mjb": data})


def joint_name(model: Any, k: int) -> str:
    """The file's, or joint0, joint1, …"""
    return str(model.joint(k).name) or f"joint{k}"


def scalar(model: Any) -> npt.NDArray[np.bool_]:
    """Which joints are hinges and slides, of one number each."""
    return np.isin(model.jnt_type, _SCALAR)


@final
@dataclass(frozen=True)
class Loose:
    """A free joint, or a ball: where its positions and velocities start, and what its columns are called."""

    name: str
    ball: bool
    q: int
    v: int

    @property
    def columns(self) -> tuple[StateSpec, ...]:
        return ball_columns(self.name) if self.ball else body_columns(self.name)

    def rest(self, model: Any) -> tuple[float, ...]:
        """Its columns in the file's pose."""
        turns, moves = (4, 3) if self.ball else (7, 6)
        return (*model.qpos0[self.q : self.q + turns].tolist(), *[0.0] * moves)


def loose(model: Any, *, fixed_base: bool) -> list[Loose]:
    """The base first, where it floats: what carries joints, or else the first free body."""
    found = []
    for j in np.flatnonzero(~scalar(model)).tolist():
        ball = bool(model.jnt_type[j] == mujoco.mjtJoint.mjJNT_BALL)
        body = int(model.jnt_bodyid[j])
        name = joint_name(model, j) if ball else str(model.body(body).name) or f"body{body}"
        carries = np.count_nonzero(model.body_rootid[model.jnt_bodyid] == model.body_rootid[body]) > 1
        one = Loose(name, ball, int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j]))
        found.append((fixed_base or ball or not carries, ball, one))
    return [one for *_, one in sorted(found, key=lambda f: f[:2])]


def unconstrained(model: Any) -> bool:
    """Can no constraint ever act: no limit, dry friction, equality, or pair of geoms that may touch?"""
    limited = model.jnt_limited.any() or model.tendon_limited.any()
    dry = model.dof_frictionloss.any() or model.tendon_frictionloss.any()
    return not (limited or dry or model.eq_active0.any() or touches(model))


def beyond(model: Any) -> list[str]:
    """What acts besides bodies on hinges and slides, their springs, damping and dry friction, and the ends of joints."""
    off, option = model.opt.disableflags, model.opt
    idle = {"constraints": _DISABLE.mjDSBL_CONSTRAINT, "limits": _DISABLE.mjDSBL_LIMIT, "springs": _DISABLE.mjDSBL_SPRING}
    idle |= {"damping": _DISABLE.mjDSBL_DAMPER, "dry friction": _DISABLE.mjDSBL_FRICTIONLOSS}
    held = (model.tendon_stiffness, model.tendon_damping, model.tendon_frictionloss, model.tendon_limited)
    tendons = [*held, model.tendon_stiffnesspoly, model.tendon_dampingpoly, model.tendon_armature]
    found = {
        "springs or dampers that bend": np.any(model.jnt_stiffnesspoly) or np.any(model.dof_dampingpoly),
        f"tendon {_first(model.tendon, tendons)}": any(map(np.any, tendons)),
        f"equality {_first(model.equality, [model.eq_active0])}": model.eq_active0.any(),
        "deformable bodies": model.nflex,
        "a medium": option.density or option.viscosity or np.any(option.wind),
        "geoms that may touch": touches(model),
        f"integrator {mujoco.mjtIntegrator(int(option.integrator)).name.removeprefix('mjINT_').lower()}": (
            option.integrator not in SCHEMES
        ),
        **{f"{what} that the file switches off": off & int(flag) for what, flag in idle.items()},
    }
    return [what for what, there in found.items() if there]


def _first(named: Any, parts: Sequence[Any]) -> str:
    """The name of the first element of which anything is there."""
    there = [np.flatnonzero(np.asarray(part).reshape(len(part), -1).any(axis=1)) for part in parts if len(part)]
    rows = [int(r[0]) for r in there if len(r)]
    return (str(named(min(rows)).name) or f"number {min(rows)}") if rows else ""


def left_over(model: Any) -> float:
    """√(2 tol n m̄/λ): an acceleration that an iterated solver may leave, with λ the least eigenvalue of M in the file's pose.

    The solver stops where an iteration lowers its cost, ½ aᵀM a and more, by less than tol·n·m̄ (m̄: the mean of M's diagonal).
    """
    data, inertia = mujoco.MjData(model), np.empty((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, inertia)
    least = max(float(np.linalg.eigvalsh(inertia)[0]), np.finfo(float).tiny)
    return math.sqrt(2 * float(model.opt.tolerance) * model.nv * float(model.stat.meaninertia) / least)


def touches(model: Any) -> bool:
    """May two bodies meet? Filters beyond the bit masks are left aside, so the answer may be yes for want of proof."""
    if model.opt.disableflags & int(_DISABLE.mjDSBL_CONTACT):
        return False
    kind, meets, body = model.geom_contype, model.geom_conaffinity, model.body_weldid[model.geom_bodyid]
    pairs = (kind[:, None] & meets[None, :]) | (kind[None, :] & meets[:, None])
    return bool(model.npair or model.nflex or (pairs.astype(bool) & (body[:, None] != body[None, :])).any())


def idle(model: Any) -> int:
    """Flags that leave out parts of MuJoCo's pipeline which, in a model without constraints, add nothing but zeros."""
    flags = _DISABLE.mjDSBL_CONSTRAINT | _DISABLE.mjDSBL_CONTACT
    springs = (model.jnt_stiffness, model.jnt_stiffnesspoly, model.tendon_stiffness, model.tendon_stiffnesspoly)
    dampers = (model.dof_damping, model.dof_dampingpoly, model.tendon_damping, model.tendon_dampingpoly)
    medium = (model.opt.density, model.opt.viscosity, model.flg_gravcomp)
    if not any(np.any(part) for part in (*springs, *dampers, *medium)):
        flags |= _DISABLE.mjDSBL_SPRING | _DISABLE.mjDSBL_DAMPER
    return int(flags)
