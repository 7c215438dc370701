"""Engine `dart`: what a URDF or SDF file becomes in DART, and the worlds that step it."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert import Array, Parameter
from gapcert.plugin import Scene
from gapcert_engines import Drive, Engine, Joint, Link, as_backend, file_shapes, moments, patched_file, setting_code

from .config import DartConfig
from .loader import joints, load
from .robot import RobotFile
from .world import GRAVITY, DartWorld, inertia, moving_bodies, restitution, to_vector

_COORDINATES_AT_MOST = 256
"""Of all copies: beyond, a step costs more per copy, and a skeleton takes seconds to build."""


@final
class DartEngine(Engine):
    """Native parameters: `gravity_x`, `_y`, `_z`, `damping.JOINT`, `coulomb_friction.JOINT`, `mass.BODY` (which scales its
    inertia along), `inertia.BODY` (the largest principal moment, the others in proportion), `com_x.BODY`, `_y`, `_z` (where its
    frame is along that of its joint) and, where the robot can touch something, `friction` and `restitution` of its shapes (the
    latter where all have the same) and friction `ground` of the ground.
    """

    friction_after = True

    def __init__(self, config: DartConfig, folder: Path | None = None) -> None:
        self.config: DartConfig = config
        self.robot = RobotFile((folder or Path()) / config.robot, model=config.model, shapes=config.touches)
        self.file = str(self.robot.path)
        skeleton = load(self.robot, fixed_base=config.fixed_base)
        found = joints(self.robot, skeleton)
        self.joints = tuple(_ended(config, joint, native) for joint, native in found)
        self.limited = tuple(j.name for j, native in found if j.limited and enforced(config, native))
        self.base = () if config.fixed_base else _base(skeleton)
        self.parameters = self._native(skeleton, found)
        movers = dict.fromkeys(range(6 if self.base else 0), "the base")
        matrix = np.asarray(skeleton.getMassMatrix())
        self.check_mass(matrix, lambda k: movers.get(k) or f"joint '{skeleton.getDof(k).getName()}'")

    from_config = classmethod(as_backend)

    def open(self, copies: int, period: float, drive: Drive | None) -> DartWorld:
        return DartWorld(self.robot, self.config, copies, period, drive)

    def digest_data(self) -> list[object]:
        return [importlib.metadata.version("dartpy"), self.robot.digest()]

    def beyond(self) -> tuple[str, ...]:
        return (*super().beyond(), *(["shapes that may touch"] if self.config.touches else []))

    def links(self, coordinates: Mapping[str, str], period: float, values: Mapping[str, float]) -> list[Link]:
        bodies = load(self.robot, fixed_base=self.config.fixed_base).getBodyNodes()
        return [_link(body, coordinates, self.stated) for body in bodies]

    def implicit(self) -> bool:
        return True

    def accuracy(self, values: Mapping[str, float]) -> float:
        """DART's constraints, of which dry friction is one, give way by 1e-9 of their impulse, and joints share impulses."""
        return 1e-7 if self.rubs(values) else super().accuracy(values)

    def patched(self, values: Mapping[str, float]) -> dict[str, str]:
        config, stated = self.config, self.stated
        given = {"damping": config.joint_damping, "coulomb_friction": config.coulomb_friction}
        words = {"damping": "damping", "coulomb_friction": "friction"}
        text = self.robot.path.read_text(encoding="utf-8")
        patched, unsaid = patched_file(text, values, stated, words, given, config.model)
        code = {"extended.py": self._code(unsaid, stated | dict(values))} if unsaid else {}
        return patched | code

    def _code(self, unsaid: Mapping[str, float], values: Mapping[str, float]) -> str:
        """Code that loads the file into a world, as this package does, and sets what the file cannot say."""
        loader = _URDF if self.robot.kind == "urdf" else _SDF
        gravity = ", ".join(repr(float(values[f"gravity_{a}"])) for a in "xyz")
        lines = [
            *("from pathlib import Path", "", "import dartpy", "import numpy as np"),
            loader.format(root="FIXED" if self.config.fixed_base else "FLOATING").rstrip(),
            *("world = dartpy.simulation.World()", "world.addSkeleton(robot)", f"world.setGravity({gravity})"),
        ]
        return "\n".join([*lines, *setting_code(_SETTERS, unsaid), ""])

    def scene(self, position: Array, base: Array | None) -> Scene:
        skeleton = load(self.robot, fixed_base=self.config.fixed_base)
        bodies = skeleton.getBodyNodes()
        names = [body.getName() for body in bodies]
        shapes = file_shapes(self.robot.element(), self.robot.path.parent, names)
        places = [native.getIndexInSkeleton(0) for joint, native in joints(self.robot, skeleton) if joint.movable]
        poses, q = np.empty((len(position), len(names), 7)), skeleton.getPositions()
        for k, row in enumerate(position):
            q[places] = row
            if base is not None:
                q[:3], q[3:6] = to_vector(base[k : k + 1, 3:7])[0], base[k, :3]
            skeleton.setPositions(q)
            for j, body in enumerate(bodies):
                place = body.getWorldTransform()
                poses[k, j] = [*place.translation(), *place.quaternion().wxyz()]
        found = Scene(tuple(names), shapes, poses)
        return found if self.config.ground is None else found.with_ground()

    def tiles(self) -> tuple[int, str]:
        if not self.config.fixed_base:
            return 1, "untiled: copies share a fixed base"
        if self.config.touches:
            return 1, "untiled: collision shapes take part in the physics"
        if self.limited:
            return 1, f"untiled: joint '{self.limited[0]}' has limits, whose constraints copies would solve together"
        if self.rubs({}):
            return 1, "untiled: joints have dry friction, whose constraints copies would solve together"
        count = sum(j.movable for j in self.joints)
        return max(1, _COORDINATES_AT_MOST // max(1, count)), f"untiled: {count} joints fill a skeleton"

    def tileable(self, values: Mapping[str, float]) -> bool:
        return not self.rubs(values)

    def _native(self, skeleton: Any, found: list[tuple[Joint, Any]]) -> tuple[Parameter, ...]:
        """What DART can change at run time."""
        config, movable = self.config, [(j, native) for j, native in found if j.movable]
        dry = config.coulomb_friction
        contact = [Parameter("friction", 1.0 if config.friction is None else config.friction, low=0.0)]
        if config.ground is not None:
            contact.append(Parameter("ground", config.ground, low=0.0))
        if (bounce := restitution(config, skeleton)) is not None:
            contact.append(Parameter("restitution", bounce, low=0.0, high=1.0))
        return (
            *self.gravity_parameters((self.robot.gravity or GRAVITY) if config.gravity is None else config.gravity),
            *(self.joint_parameter("damping", j, j.damping, config.joint_damping) for j, _ in movable),
            *(self.joint_parameter("coulomb_friction", j, n.getCoulombFriction(0), dry) for j, n in movable),
            *(p for b in moving_bodies(skeleton) for p in _body(b)),
            *(contact if config.touches else ()),
        )


def _body(body: Any) -> list[Parameter]:
    """Mass, moment and, in a frame along that of its joint, centre of mass."""
    turn = np.asarray(body.getParentJoint().getTransformFromChildBodyNode().rotation())
    own = inertia(body)
    return (own if (turn == np.eye(3)).all() else replace(own, centre=())).parameters()


def _link(body: Any, coordinates: Mapping[str, str], stated: Mapping[str, float]) -> Link:
    """In the frame of its joint, of which DART knows where it is in both of its bodies."""
    joint, parent = body.getParentJoint(), body.getParentBodyNode()
    frame = joint.getTransformFromChildBodyNode()
    above = joint.getTransformFromParentBodyNode()
    if parent is not None:
        above = parent.getParentJoint().getTransformFromChildBodyNode().inverse().multiply(above)
    own, turn, back = body.getInertia(), np.asarray(frame.rotation()).T, frame.inverse()
    origin = np.asarray(back.translation())
    name, moves = joint.getName(), joint.getNumDofs() > 0
    return Link(
        body.getName(),
        None if parent is None else parent.getName(),
        tuple(above.translation().tolist()),
        tuple(above.quaternion().wxyz().tolist()),
        coordinates[name] if moves else None,
        name,
        joint.getType() == "PrismaticJoint",
        tuple(joint.getAxis().tolist()) if moves else (0.0, 0.0, 1.0),
        float(own.getMass()),
        tuple((turn @ np.asarray(own.getLocalCOM()) + origin).tolist()),
        moments(turn @ np.asarray(own.getMoment()) @ turn.T),
        damping=stated.get(f"damping.{name}"),
        dry=stated.get(f"coulomb_friction.{name}"),
        stiffness=float(joint.getSpringStiffness(0)) if moves else 0.0,
        rest=float(joint.getRestPosition(0)) if moves else 0.0,
        origin=tuple(origin.tolist()),
        moment=stated.get(f"inertia.{body.getName()}"),
    )


def enforced(config: DartConfig, native: Any) -> bool:
    """Does this joint stop at its limits?"""
    return bool(native.areLimitsEnforced()) if config.joint_limits is None else config.joint_limits


def _ended(config: DartConfig, joint: Joint, native: Any) -> Joint:
    """With the ends and the speeds that DART holds it to."""
    if not (joint.movable and enforced(config, native)):
        return joint
    ends = native.getPositionLowerLimit(0), native.getPositionUpperLimit(0)
    speeds = native.getVelocityLowerLimit(0), native.getVelocityUpperLimit(0)
    return replace(joint, ends=(float(ends[0]), float(ends[1])), speeds=(float(speeds[0]), float(speeds[1])))


def _base(skeleton: Any) -> tuple[float, ...]:
    place = skeleton.getRootBodyNode(0).getWorldTransform()
    return (*place.translation().tolist(), *place.quaternion().wxyz().tolist(), *(0.0,) * 6)


_URDF = """
massless = dartpy.dynamics.Inertia(0.0, np.zeros(3), np.zeros((3, 3)))
kind = dartpy.utils.DartLoaderRootJointType.{root}
loader = dartpy.utils.DartLoader()
loader.setOptions(dartpy.utils.DartLoaderOptions(None, kind, massless))
robot = loader.parseSkeleton(str(Path("extended.urdf").resolve()))
"""
_SDF = """
kind = dartpy.utils.SdfParser.RootJointType.{root}
robot = dartpy.utils.SdfParser.readSkeleton(str(Path("extended.sdf").resolve()), dartpy.utils.SdfParser.Options(None, kind))
"""
_OWN = """body = robot.getBodyNode("{element}")
own = body.getInertia()
"""
_INERTIA = f"""{_OWN}centre, moment = np.array(own.getLocalCOM()), np.array(own.getMoment())
%s
body.setInertia(dartpy.dynamics.Inertia(own.getMass(), centre, moment))"""
_SETTERS = {
    "damping": 'robot.getJoint("{element}").setDampingCoefficient(0, {number})',
    "coulomb_friction": 'robot.getJoint("{element}").setCoulombFriction(0, {number})',
    "mass": f"{_OWN}body.setInertia(dartpy.dynamics.Inertia({{number}}, own.getLocalCOM(), "
    "own.getMoment() * {number} / own.getMass()))",
    "inertia": _INERTIA % "moment *= {number}",
    **{f"com_{a}": _INERTIA % f"centre[{k}] = {{number}}" for k, a in enumerate("xyz")},
    "friction": """for body in robot.getBodyNodes():
    for k in range(body.getNumShapeNodes()):
        body.getShapeNode(k).getDynamicsAspect(True).setFrictionCoeff({number})""",
    "ground": "# The ground that the robot stands on has the friction {number}.",
}
