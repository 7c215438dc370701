"""One DART world that holds one robot, or copies of it as trees of one skeleton, and advances it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np

from gapcert import Array, UsageError
from gapcert_engines import ABSURD, BodyInertia, Drive, EngineWorld

from .config import DartConfig
from .loader import dartpy, joints, load
from .robot import RobotFile

GRAVITY = tuple(float(g) for g in dartpy.simulation.World().getGravity())
"""DART's own, m/s²."""
GROUND_SIZE = (1000.0, 1000.0, 10.0)
"""m; a box, because DART finds all corners of a box on a box, and one on a plane."""
_AHEAD = (1.0, 0.0, 0.0, 0.0)


@final
class DartWorld(EngineWorld):
    """`copies` of a robot, advanced together in `substeps` steps; DART is told everything anew before every query."""

    def __init__(self, robot: RobotFile, config: DartConfig, copies: int, period: float, drive: Drive | None) -> None:
        self.copies, self.config, self.substeps, self._touches = copies, config, config.substeps, config.touches
        single = load(robot, fixed_base=config.fixed_base)
        self.skeleton = single if copies == 1 else _tiled(single, copies)
        movable = [native for joint, native in joints(robot, single) if joint.movable]
        index = np.array([j.getIndexInSkeleton(0) for j in movable], dtype=np.intp)
        self._dofs = (index + single.getNumDofs() * np.arange(copies)[:, None]).ravel()
        owner = {j.getIndexInSkeleton(0): j for j in self.skeleton.getJoints() if j.getNumDofs()}
        self._joints = [owner[k] for k in self._dofs.tolist()]
        self._names = [j.getName() for j in movable]
        bodies = [b.getName() for b in moving_bodies(single)]
        self._bodies = dict(zip(bodies, zip(*_blocks(moving_bodies(self.skeleton), len(bodies)), strict=True), strict=True))
        self._stated = {name: (inertia(group[0]), _moment(group[0])) for name, group in self._bodies.items()}
        self._held = {name: own for name, (own, _) in self._stated.items()}
        for joint in self._joints if config.joint_limits is not None else ():
            joint.setLimitEnforcement(config.joint_limits)
        self.world, self._ground = _simulation(config, self.skeleton)
        self.world.setTimeStep(period / self.substeps)
        self._drive = None if drive is None else _Driver(drive, self.skeleton, self._joints, floats=not config.fixed_base)
        self._values: Mapping[str, float] = {}

    def close(self) -> None:
        """Leaves the objects to Python's memory management."""

    def set(self, values: Mapping[str, float]) -> None:
        if values == self._values:
            return
        self._values = dict(values)
        self.world.setGravity(*(values[f"gravity_{a}"] for a in "xyz"))
        for joint, name in zip(self._joints, self._names * self.copies, strict=True):
            joint.setDampingCoefficient(0, values[f"damping.{name}"])
            joint.setCoulombFriction(0, values[f"coulomb_friction.{name}"])
        for name, group in self._bodies.items():
            own, moment = self._stated[name]
            wanted = own.under(values)
            if wanted == self._held[name]:
                continue
            self._held[name] = wanted
            for body in group:
                body.setInertia(dartpy.dynamics.Inertia(wanted.mass, np.array(wanted.centre), moment * wanted.factor(own)))
        if self._touches:
            for aspect in _aspects(self.skeleton):
                aspect.setFrictionCoeff(values["friction"])
                if "restitution" in values:
                    aspect.setRestitutionCoeff(values["restitution"])
        if self._ground is not None:
            for aspect in _aspects(self._ground):
                aspect.setFrictionCoeff(values["ground"])

    def advance(
        self, joints: Array, effort: Array, base: Array | None = None, command: Array | None = None
    ) -> tuple[Array, Array | None]:
        n, nj, _ = joints.shape
        blocks, dofs, steps = n // self.copies, self.skeleton.getNumDofs(), effort.shape[1]
        q, v, f = np.empty((blocks, dofs)), np.empty((blocks, dofs)), np.zeros((blocks, steps, dofs))
        q[:, self._dofs] = joints[:, :, 0].reshape(blocks, -1)
        v[:, self._dofs] = joints[:, :, 1].reshape(blocks, -1)
        f[:, :, self._dofs] = effort.reshape(blocks, self.copies, steps, nj).transpose(0, 2, 1, 3).reshape(blocks, steps, -1)
        if base is not None:
            # The positions of DART's free joint are a rotation vector and a place, its velocities a rate and a velocity,
            # all in the frame that the joint hangs in: here, the world's.
            q[:, :3], q[:, 3:6] = to_vector(base[:, 3:7]), base[:, :3]
            v[:, :3], v[:, 3:6] = base[:, 10:], base[:, 7:10]
        if self._drive is not None:
            self._drive.check(effort)
        q_after, v_after = np.empty_like(q), np.empty_like(v)
        for k in range(blocks):
            self._advance_one(q[k], v[k], f[k], None if command is None else command[k])
            q_after[k], v_after[k] = self.skeleton.getPositions(), self.skeleton.getVelocities()
        self._check_sane(q, q_after, v_after)
        after = np.stack([q_after[:, self._dofs], v_after[:, self._dofs]], axis=-1).reshape(n, nj, 2)
        if base is None:
            return after, None
        return after, np.concatenate([q_after[:, 3:6], from_vector(q_after[:, :3]), v_after[:, 3:6], v_after[:, :3]], axis=1)

    def _advance_one(self, q: Array, v: Array, f: Array, command: Array | None) -> None:
        world, skeleton = self.world, self.skeleton
        world.setTime(0.0)
        skeleton.setPositions(q)
        skeleton.setVelocities(v)
        if self._touches:
            _forget_contacts(world, self.config)
        if self._drive is not None and command is not None:
            self._drive.run(world, f, command, self.substeps)
            return
        # Efforts stay until they are replaced: step(False) does not clear them.
        if len(f) == 1:
            skeleton.setForces(f[0])
            for _ in range(self.substeps):
                world.step(False)
            return
        for row in f:
            skeleton.setForces(row)
            world.step(False)

    def _check_sane(self, q: Array, *after: Array) -> None:
        """DART replaces an acceleration that is not finite by zero and goes on; before that the numbers have run away."""
        bad = np.any([~(np.abs(numbers) < ABSURD).all(axis=1) for numbers in after], axis=0)
        if bad.any():
            start = q[np.argmax(bad)][: q.shape[1] // self.copies].tolist()
            raise UsageError(
                f"DartWorld: the state has run away one period after positions {start}; expected a stable simulation; "
                f"use more substeps or a smaller domain"
            )


@final
class _Driver:
    """Without a gain the joints get DART's servo motor within the limit, or its velocity motor, which has none."""

    def __init__(self, drive: Drive, skeleton: Any, joints: Sequence[Any], *, floats: bool) -> None:
        self.drive, self.skeleton = drive, skeleton
        names = [j.getName() for j in joints]
        self._columns = [names.index(element) for element in drive.elements]
        self._dofs = [joints[k].getIndexInSkeleton(0) for k in self._columns]
        self._base = skeleton.getRootBodyNode(0) if floats and drive.feeds_back else None
        if drive.gain is None:
            for k in self._columns:
                self._motor(joints[k])

    def check(self, effort: Array) -> None:
        """Refuses forces on a joint that follows DART's own motor, which would pass over them."""
        if self.drive.gain is None and (pushed := effort[:, :, self._columns].any(axis=(0, 1))).any():
            name = self.drive.elements[int(np.argmax(pushed))]
            raise UsageError(
                f"DartWorld: joint '{name}' follows DART's own motor, which takes no force; give the drive a gain and a limit"
            )

    def run(self, world: Any, efforts: Array, command: Array, substeps: int) -> None:
        """All sub-steps of one period under efforts (1 or substeps, dofs)."""
        skeleton, drive, target = self.skeleton, self.drive, command
        for k in range(substeps):
            if k % drive.every == 0:
                target = self._targets(command)
            effort = efforts[k if len(efforts) > 1 else 0]
            if drive.gain is None:
                skeleton.setForces(effort)
                for dof, rate in zip(self._dofs, target.tolist(), strict=True):
                    skeleton.setCommand(dof, rate)
            else:
                effort = effort.copy()
                effort[self._dofs] += drive.effort(target, skeleton.getVelocities()[self._dofs])
                skeleton.setForces(effort)
            world.step(False)

    def _targets(self, command: Array) -> Array:
        if self._base is None:
            return self.drive.targets(command, _AHEAD, 0.0)
        rotation = self._base.getWorldTransform().quaternion().wxyz()
        return self.drive.targets(command, rotation.tolist(), float(self._base.getAngularVelocity()[2]))

    def _motor(self, joint: Any) -> None:
        limit = self.drive.limit
        kinds = dartpy.dynamics.ActuatorType
        joint.setActuatorType(kinds.VELOCITY if limit is None else kinds.SERVO)
        # DART would cut the command to the file's limits without a word.
        joint.setVelocityLowerLimit(0, -np.inf)
        joint.setVelocityUpperLimit(0, np.inf)
        joint.setForceLowerLimit(0, -np.inf if limit is None else -limit)
        joint.setForceUpperLimit(0, np.inf if limit is None else limit)


def _simulation(config: DartConfig, skeleton: Any) -> tuple[Any, Any]:
    """(world, ground or None): the robot in a world with the options of the spec."""
    world = dartpy.simulation.World()
    # A body at rest for half a second would be put to sleep: an engine state that no position or velocity shows.
    awake = dartpy.simulation.DeactivationOptions()
    awake.mEnabled = False
    world.setDeactivationOptions(awake)
    ground = None
    world.getConstraintSolver().setSplitImpulseEnabled(config.split_impulse)
    _set_solver(world, config)
    if config.self_collision:
        skeleton.enableSelfCollisionCheck()
    if config.ground is not None:
        ground = _ground()
        world.addSkeleton(ground)
    world.addSkeleton(skeleton)
    if config.restitution is not None:
        for aspect in _aspects(skeleton):
            aspect.setRestitutionCoeff(config.restitution)
    return world, ground


def moving_bodies(skeleton: Any) -> list[Any]:
    """Bodies with mass that some coordinate moves."""
    return [b for b in skeleton.getBodyNodes() if b.getMass() > 0 and b.getNumDependentDofs() > 0]


def _ground() -> Any:
    """A box with its top at z = 0; a contact's restitution is the product of both shapes', so the ground's is 1."""
    ground = dartpy.dynamics.Skeleton("gapcert ground")
    _, body = ground.createWeldJointAndBodyNodePair()
    node = body.createShapeNode(dartpy.dynamics.BoxShape(list(GROUND_SIZE)))
    node.createCollisionAspect()
    node.createDynamicsAspect().setRestitutionCoeff(1.0)
    node.setRelativeTranslation([0.0, 0.0, -GROUND_SIZE[2] / 2])
    return ground


def _forget_contacts(world: Any, config: DartConfig) -> None:
    """A new collision detector and solver: theirs keep trees, manifolds and last answers, in which earlier queries live on.

    Built here, not by DART's factory: once Gazebo's own DART is loaded as well, the two share the factory, and it fails.
    """
    world.getConstraintSolver().setCollisionDetector(_detector(config))
    if config.lcp_solver in ("nsgs", "fbf"):
        _set_solver(world, config)


def _detector(config: DartConfig) -> Any:
    kinds = dartpy.collision
    makers = {
        "fcl": kinds.FCLCollisionDetector,
        "dart": kinds.DARTCollisionDetector,
        "bullet": kinds.BulletCollisionDetector,
        "ode": kinds.OdeCollisionDetector,
    }
    return makers[config.collision_detector]()


def _set_solver(world: Any, config: DartConfig) -> None:
    solver = world.getConstraintSolver()
    kinds = {"nsgs": dartpy.constraint.NsgsFrictionSolver, "fbf": dartpy.constraint.FbfFrictionSolver}
    if (kind := kinds.get(config.lcp_solver)) is not None:
        round_cone = kind()
        options = round_cone.getOptions()
        options.tolerance = config.lcp_tolerance
        round_cone.setOptions(options)
        solver.setBoxedLcpSolver(round_cone)
    elif config.lcp_solver == "pgs":
        # Python cannot construct this one; every world has one in reserve.
        solver.setBoxedLcpSolver(dartpy.simulation.World().getConstraintSolver().getSecondaryBoxedLcpSolver())


def restitution(config: DartConfig, skeleton: Any) -> float | None:
    """Of all shapes of a robot; None where they differ."""
    if config.restitution is not None:
        return config.restitution
    found = {float(aspect.getRestitutionCoeff()) for aspect in _aspects(skeleton)}
    return found.pop() if len(found) == 1 else None


def _aspects(skeleton: Any) -> list[Any]:
    """What decides the contacts of each shape."""
    nodes = [b.getShapeNode(k) for b in skeleton.getBodyNodes() for k in range(b.getNumShapeNodes())]
    return [node.getDynamicsAspect(True) for node in nodes]


def _tiled(single: Any, copies: int) -> Any:
    """One skeleton with `copies` of every tree, without shapes."""
    tiled = dartpy.dynamics.Skeleton("tiles")
    for _ in range(copies):
        for tree in range(single.getNumTrees()):
            single.getRootBodyNode(tree).copyTo(tiled, None)
    for body in tiled.getBodyNodes():
        body.removeAllShapeNodes()
    return tiled


def inertia(body: Any) -> BodyInertia:
    """As the file states it."""
    stated = body.getInertia()
    return BodyInertia.of(body.getName(), stated.getMass(), _moment(body), stated.getLocalCOM())


def _moment(body: Any) -> Array:
    """(3, 3) about the centre of mass."""
    return np.array(body.getInertia().getMoment())


def _blocks(items: list[Any], size: int) -> list[list[Any]]:
    return [items[k : k + size] for k in range(0, len(items), size)]


def to_vector(rotation: Array) -> Array:
    """Quaternions w, x, y, z (n, 4) of any length → axes times angles in [0, π] (n, 3); no row's bits depend on another."""
    w, x, y, z = rotation.T
    sign = np.where(w < 0, -1.0, 1.0)
    norm = np.sqrt(x * x + y * y + z * z)
    angle = 2 * np.arctan2(norm, np.abs(w))
    scale = sign * np.divide(angle, norm, out=np.full_like(norm, 2.0), where=norm > 0)
    return np.stack([scale * x, scale * y, scale * z], axis=1)


def from_vector(vector: Array) -> Array:
    """Back, row by row as well: (n, 3) → unit quaternions (n, 4) with w ≥ 0 up to an angle of π."""
    x, y, z = vector.T
    angle = np.sqrt(x * x + y * y + z * z)
    scale = np.divide(np.sin(angle / 2), angle, out=np.full_like(angle, 0.5), where=angle > 0)
    return np.stack([np.cos(angle / 2), scale * x, scale * y, scale * z], axis=1)
