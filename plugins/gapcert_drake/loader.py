"""From a robot file to a finished Drake plant of joints with one number each, on a base that is fixed or floats."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, final

from pydrake import geometry
from pydrake.math import RigidTransform
from pydrake.multibody import plant as multibody
from pydrake.multibody.parsing import Parser
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder

from gapcert import UsageError
from gapcert_engines import Joint, JointType

from .config import DrakeConfig
from .robot import ADDED, RobotFile, harmless

_TYPES: dict[str, JointType] = {
    "revolute": "revolute",
    "prismatic": "prismatic",
    "weld": "fixed",
    "ball_rpy": "ball",
    "planar": "planar",
    "quaternion_floating": "free",
}


@final
@dataclass(frozen=True)
class Loaded:
    """A finished plant with copies of a robot: `instances` are theirs; `system` owns the plant and its shapes.

    names: of the file's joints.
    """

    plant: Any
    system: Any
    instances: tuple[Any, ...]
    names: frozenset[str]

    def joints(self, k: int = 0) -> list[Any]:
        """The file's joints of one copy, in Drake's order."""
        found = (self.plant.get_joint(j) for j in self.plant.GetJointIndices(self.instances[k]))
        return [j for j in found if j.name() in self.names]

    def movable(self, k: int = 0) -> list[Any]:
        return [j for j in self.joints(k) if j.type_name() in ("revolute", "prismatic")]

    def bodies(self, k: int = 0) -> list[Any]:
        return [self.plant.get_body(b) for b in self.plant.GetBodyIndices(self.instances[k])]

    def heavy(self, k: int = 0) -> list[Any]:
        """Bodies with mass that move."""
        return [b for b in self.bodies(k) if b.default_mass() > 0 and not self.plant.IsAnchored(b)]

    def floating(self, k: int = 0) -> list[Any]:
        """The bodies that float: the base, where it is not fixed."""
        return [b for b in self.bodies(k) if b.is_floating_base_body()]

    def actuator(self, joint: Any) -> Any:
        """The actuator that carries the inertia of a joint's rotor."""
        found = (self.plant.get_joint_actuator(a) for a in self.plant.GetJointActuatorIndices())
        return next(a for a in found if int(a.joint().index()) == int(joint.index()))

    def armature(self, joint: Any) -> float:
        """Inertia of the rotor as the joint feels it."""
        actuator = self.actuator(joint)
        return float(actuator.default_rotor_inertia() * actuator.default_gear_ratio() ** 2)


def load(
    robot: RobotFile, config: DrakeConfig, copies: int, step: float, gravity: Sequence[float] | None, ground: float | None
) -> Loaded:
    """`step`: of the discrete plant, 0 for the continuous one. UsageError where Drake leaves out what moves the robot."""
    robot.check_meshes()
    if robot.rubs and config.coulomb_friction is None:
        raise UsageError(
            f"robot: {robot.path}: joints have <friction>, and Drake has no dry friction in joints; take it out of the file, "
            f"or say backend.coulomb_friction: 0"
        )
    with listening():
        loaded = _load(robot, config, copies, step, gravity, ground)
    _check_whole(robot, loaded, config)
    return loaded


def _load(
    robot: RobotFile, config: DrakeConfig, copies: int, step: float, gravity: Sequence[float] | None, ground: float | None
) -> Loaded:
    builder = DiagramBuilder() if config.touches else None
    scene = None
    if builder is not None:
        plant, scene = multibody.AddMultibodyPlantSceneGraph(builder, step)
    else:
        plant = multibody.MultibodyPlant(step)
    plant.set_contact_model(getattr(multibody.ContactModel, _camel(config.contact_model)))
    if step:
        approximation = getattr(multibody.DiscreteContactApproximation, _camel(config.contact_approximation))
        plant.set_discrete_contact_approximation(approximation)
        # Sampled output ports would add the last contact's results to the state.
        plant.SetUseSampledOutputPorts(False)
    instances = tuple(_parse(robot, plant, config) for _ in range(copies))
    for instance in instances:
        _hold(plant, instance, robot, config)
    down = robot.gravity if gravity is None else gravity
    if down is not None:
        plant.mutable_gravity_field().set_gravity_vector(list(down))
    if ground is not None:
        rubbing = multibody.CoulombFriction(ground, ground)
        plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), geometry.HalfSpace(), "gapcert ground", rubbing)
    plant.Finalize()
    loaded = Loaded(plant, plant if builder is None else builder.Build(), instances, robot.joints)
    if scene is not None:
        touch(loaded, scene, config)
    return loaded


def _parse(robot: RobotFile, plant: Any, config: DrakeConfig) -> ModelInstanceIndex:
    parser = Parser(plant)
    parser.SetAutoRenaming(True)
    with listening() as said:
        try:
            found = parser.AddModelsFromString(robot.text, robot.kind)
        except RuntimeError as error:
            reason = _plain(str(error))
            raise UsageError(f"robot: Drake cannot load {robot.path}: {reason}; expected a valid file") from None
    if left := [s for s in map(_plain, said) if not harmless(s, config.touches, config.coulomb_friction is None)]:
        more = "; backend.coulomb_friction: 0 leaves the friction out" if "friction" in left[0] else ""
        raise UsageError(f"robot: {robot.path}: Drake passes over a part of it: {left[0]}; take it out of the file{more}")
    if len(found) != 1:
        raise UsageError(f"robot: {robot.path} has {len(found)} models for Drake; expected one")
    return found[0]


def _hold(plant: Any, instance: Any, robot: RobotFile, config: DrakeConfig) -> None:
    """What has to be said before the plant is finished: limits, rotors, and a base that is fixed."""
    joints = [plant.get_joint(j) for j in plant.GetJointIndices(instance)]
    driven = {int(plant.get_joint_actuator(a).joint().index()) for a in plant.GetJointActuatorIndices()}
    for joint in joints:
        if joint.num_velocities() == 1 and not (config.joint_limits and config.discrete):
            joint.set_position_limits([-float("inf")], [float("inf")])
        if joint.type_name() in ("revolute", "prismatic") and int(joint.index()) not in driven:
            plant.AddJointActuator(ADDED + joint.name(), joint)
    children = {int(j.child_body().index()) for j in joints}
    roots = [plant.get_body(b) for b in plant.GetBodyIndices(instance) if int(b) not in children]
    if robot.kind != "xml" and config.fixed_base:
        for body in roots:
            pose = plant.GetDefaultFloatingBaseBodyPose(body)
            plant.WeldFrames(plant.world_frame(), body.body_frame(), pose)


def _check_whole(robot: RobotFile, loaded: Loaded, config: DrakeConfig) -> None:
    for joint in loaded.joints():
        kind = _TYPES.get(joint.type_name(), "other")
        if kind not in ("revolute", "prismatic", "fixed"):
            raise UsageError(
                f"robot: joint '{joint.name()}' of {robot.path} is {joint.type_name()}; expected revolute, continuous, "
                f"prismatic or fixed joints; write it as a chain of those"
            )
    if loaded.plant.num_constraints():
        raise UsageError(f"robot: {robot.path}: a joint mimics another, or links are tied; expected joints that move freely")
    floating = loaded.floating()
    if config.fixed_base and floating:
        raise UsageError(f"robot: {robot.path}: its base has a free joint; set fixed_base: false, or take the joint out")
    if not config.fixed_base and len(floating) != 1:
        found = f"is in {len(floating)} pieces" if floating else "has a root that is joined to the world, so it cannot float"
        raise UsageError(f"robot: {robot.path} {found}; expected one tree of links, or set fixed_base: true")


def described(joint: Any) -> Joint:
    """A joint of the plant as gapcert's."""
    kind = _TYPES.get(joint.type_name(), "other")
    if kind not in ("revolute", "prismatic"):
        return Joint(joint.name(), kind)
    low, high = float(joint.position_lower_limits()[0]), float(joint.position_upper_limits()[0])
    limited = low > -float("inf") or high < float("inf")
    rest = float(joint.default_positions()[0])
    return Joint(joint.name(), kind, float(joint.default_damping_vector()[0]), limited, rest, ends=(low, high))


def touch(loaded: Loaded, scene: Any, config: DrakeConfig) -> None:
    """Friction of all the robot's shapes, and whether these may touch each other."""
    plant, inspector = loaded.plant, scene.model_inspector()
    shapes = [s for b in loaded.bodies() for s in plant.GetCollisionGeometriesForBody(b)]
    if (mu := config.friction) is not None:
        for shape in shapes:
            new = geometry.ProximityProperties(inspector.GetProximityProperties(shape))
            new.RemoveProperty("material", "coulomb_friction")
            geometry.AddContactMaterial(friction=multibody.CoulombFriction(mu, mu), properties=new)
            scene.AssignRole(plant.get_source_id(), shape, new, geometry.RoleAssign.kReplace)
    if not config.self_collision:
        apart = geometry.CollisionFilterDeclaration().ExcludeWithin(geometry.GeometrySet(shapes))
        scene.collision_filter_manager().Apply(apart)


def _camel(name: str) -> str:
    return "k" + "".join(part.capitalize() for part in name.split("_"))


def _plain(said: str) -> str:
    """Drake's words on one line, without the name that it gives to a text."""
    return " ".join(said.replace("<literal-string>.urdf:", "line ").replace("<literal-string>.sdf:", "line ").split())


@contextlib.contextmanager
def listening() -> Iterator[list[str]]:
    """What Drake says meanwhile goes into a list instead of to the terminal."""
    said, log = list[str](), logging.getLogger("drake")
    ear = _Ear(said)
    kept = log.handlers[:], log.propagate
    log.handlers[:], log.propagate = [ear], False
    try:
        yield said
    finally:
        log.handlers[:], log.propagate = kept


@final
class _Ear(logging.Handler):
    def __init__(self, said: list[str]) -> None:
        super().__init__()
        self.said = said

    def emit(self, record: logging.LogRecord) -> None:
        self.said.append(record.getMessage())
