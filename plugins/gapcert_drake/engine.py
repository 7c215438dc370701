"""Engine `drake`: what a URDF, SDF or MJCF file becomes in Drake, and the worlds that step it."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert import Array, Parameter
from gapcert_engines import Drive, Engine, Link, as_backend, moments, patched_file, setting_code

from .config import FIXED_STEP, DrakeConfig
from .loader import Loaded, described, load
from .robot import ADDED, RobotFile
from .world import DrakeWorld, body_inertia, central, state_of

_COORDINATES_AT_MOST = 128
"""Of all copies: beyond, a step costs no less per copy."""
_SOLVED = 1e-6
"""Relative tolerance of Drake's solvers of constraints."""


@final
class DrakeEngine(Engine):
    """Native parameters: `gravity_x`, `_y`, `_z`, `damping.JOINT`, `armature.JOINT` (the rotor's inertia as the joint feels
    it), `mass.BODY` (which scales its inertia along), `inertia.BODY` (the largest principal moment, the others in proportion),
    `com_x.BODY`, `_y`, `_z` (where its frame is along that of its joint) and friction `ground` of the ground.
    """

    def __init__(self, config: DrakeConfig, folder: Path | None = None) -> None:
        self.config: DrakeConfig = config
        self.robot = RobotFile((folder or Path()) / config.robot, model=config.model, shapes=config.touches)
        self.file = str(self.robot.path)
        loaded = load(self.robot, config, 1, 1e-3 if config.discrete else 0.0, config.gravity, config.ground)
        self.joints = tuple(described(j) for j in loaded.joints())
        self.limited = tuple(j.name for j in self.joints if j.limited)
        self.base = state_of(loaded)
        self.parameters = self._native(loaded)
        if config.touches or self.limited:
            self.unsolved = _SOLVED * max(1.0, float(np.linalg.norm([p.value for p in self.parameters[:3]])))
        self._check_mass(loaded)

    from_config = classmethod(as_backend)

    def open(self, copies: int, period: float, drive: Drive | None) -> DrakeWorld:
        return DrakeWorld(self.robot, self.config, copies, period, drive)

    def digest_data(self) -> list[object]:
        return [importlib.metadata.version("drake"), self.robot.digest()]

    def beyond(self) -> tuple[str, ...]:
        found = {
            "shapes that may touch": self.config.touches,
            f"integrator {self.config.integrator}": not self.config.discrete,
            # One of the elements is gravity.
            "springs": self._load().plant.num_force_elements() > 1,
        }
        return (*super().beyond(), *(what for what, there in found.items() if there))

    def links(self, coordinates: Mapping[str, str], period: float, values: Mapping[str, float]) -> list[Link]:
        return _links(self._load(), coordinates, self.stated)

    def _load(self) -> Loaded:
        return load(self.robot, self.config, 1, 1e-3, self.config.gravity, None)

    def implicit(self) -> bool:
        return self.config.discrete

    def resolution(self, magnitude: Array) -> Array:
        """4 ulp, and one more for every further sub-step; what an integrator's accuracy leaves, where it has one."""
        ulp = np.spacing(np.maximum(np.abs(magnitude), np.finfo(float).tiny))
        rounding = np.asarray((3 + self.config.substeps) * ulp)
        if self.config.discrete or self.config.integrator in FIXED_STEP:
            return rounding
        return np.asarray(np.maximum(rounding, self.config.accuracy * np.maximum(np.abs(magnitude), 1.0)))

    def patched(self, values: Mapping[str, float]) -> dict[str, str]:
        """Nothing for an MJCF."""
        kind, config, stated = self.robot.kind, self.config, self.stated
        if kind == "xml":
            return {}
        text, given = self.robot.path.read_text(encoding="utf-8"), {"damping": config.joint_damping}
        patched, unsaid = patched_file(text, values, stated, {"damping": "damping"}, given, config.model)
        if kind == "sdf":
            # Drake passes over the gravity of an SDF's world.
            unsaid |= {n: v for n, v in values.items() if n.startswith("gravity_")}
        code = {"extended.py": self._code(f"extended.{kind}", unsaid, stated | dict(values))} if unsaid else {}
        return patched | code

    def _code(self, name: str, unsaid: Mapping[str, float], values: Mapping[str, float]) -> str:
        """Code that loads the file into a plant, as this package does, and sets what the file cannot say."""
        gravity = ", ".join(repr(float(values[f"gravity_{a}"])) for a in "xyz")
        lines = [_PLANT.format(name=name, gravity=gravity)]
        lines += setting_code({"armature": _ROTOR}, unsaid)
        lines += [_WELD] if self.config.fixed_base else []
        lines += ["plant.Finalize()", "context = plant.CreateDefaultContext()"]
        return "\n".join([*lines, *setting_code(_SETTERS, unsaid), ""])

    def tiles(self) -> tuple[int, str]:
        if self.base:
            return 1, "untiled: copies share a fixed base"
        if self.config.touches:
            return 1, "untiled: collision shapes take part in the physics"
        if not self.config.discrete:
            return 1, "untiled: an integrator that looks at its error would look at all copies"
        if self.limited:
            return 1, f"untiled: joint '{self.limited[0]}' has limits, whose constraints copies would solve together"
        count = sum(j.movable for j in self.joints)
        return max(1, _COORDINATES_AT_MOST // max(1, count)), f"untiled: {count} joints fill a plant"

    def _native(self, loaded: Loaded) -> tuple[Parameter, ...]:
        """What can change from query to query."""
        config = self.config
        out = list(self.gravity_parameters(loaded.plant.gravity_field().gravity_vector().tolist()))
        for joint in loaded.movable():
            one = described(joint)
            out.append(self.joint_parameter("damping", one, one.damping, config.joint_damping))
            out.append(self.joint_parameter("armature", one, loaded.armature(joint)))
        aligned = {
            int(j.child_body().index()): j.frame_on_child().GetFixedPoseInBodyFrame().rotation().IsExactlyIdentity()
            for j in loaded.joints()
        }
        for body in loaded.heavy():
            own = body_inertia(body)
            out += (own if aligned.get(int(body.index()), True) else replace(own, centre=())).parameters()
        if config.ground is not None:
            out.append(Parameter("ground", config.ground, low=0.0))
        return tuple(out)

    def _check_mass(self, loaded: Loaded) -> None:
        plant = loaded.plant
        context = plant.GetMyMutableContextFromRoot(loaded.system.CreateDefaultContext())
        movers = {j.velocity_start(): f"joint '{j.name()}'" for j in loaded.movable()}
        self.check_mass(np.asarray(plant.CalcMassMatrix(context)), lambda k: movers.get(k, "the base"))


def _links(loaded: Loaded, coordinates: Mapping[str, str], stated: Mapping[str, float]) -> list[Link]:
    """Each in the frame of its joint, after the link that carries it."""
    plant = loaded.plant
    every = [plant.get_joint(j) for j in plant.GetJointIndices()]
    inboard = {int(j.child_body().index()): j for j in every}
    found: dict[int, Link] = {}

    def add(body: Any) -> None:
        number = int(body.index())
        if number in found or number not in inboard:
            return
        joint = inboard[number]
        parent, above_it = joint.parent_body(), int(joint.parent_body().index())
        add(parent)
        above, back = _pose(joint.frame_on_parent()), _pose(joint.frame_on_child()).inverse()
        if joint.type_name() == "weld":
            above = above.multiply(joint.X_FM())
        if above_it in inboard:
            above = _pose(inboard[above_it].frame_on_child()).inverse().multiply(above)
        name, moves, straight = joint.name(), joint.num_velocities() == 1, joint.type_name() == "prismatic"
        spatial, turn = body.default_spatial_inertia(), back.rotation().matrix()
        found[number] = Link(
            body.name(),
            found[above_it].name if above_it in found else None,
            tuple(above.translation().tolist()),
            tuple(above.rotation().ToQuaternion().wxyz().tolist()),
            coordinates[name] if moves else None,
            name,
            straight,
            tuple((joint.translation_axis() if straight else joint.revolute_axis()).tolist()) if moves else (0.0, 0.0, 1.0),
            float(spatial.get_mass()),
            tuple(back.multiply(spatial.get_com()).tolist()),
            moments(turn @ central(spatial) @ turn.T),
            armature=stated.get(f"armature.{name}"),
            damping=stated.get(f"damping.{name}"),
            origin=tuple(back.translation().tolist()),
            moment=stated.get(f"inertia.{body.name()}"),
        )

    for body in loaded.bodies():
        add(body)
    return list(found.values())


def _pose(frame: Any) -> Any:
    return frame.GetFixedPoseInBodyFrame()


_PLANT = """from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, UnitInertia

plant = MultibodyPlant(time_step=1e-3)
(robot,) = Parser(plant).AddModels("{name}")
plant.mutable_gravity_field().set_gravity_vector([{gravity}])"""
_ROTOR = f"""rotor = plant.AddJointActuator("{ADDED}{{element}}", plant.GetJointByName("{{element}}"))
rotor.set_default_rotor_inertia({{number}})"""
_WELD = """# A root that the file does not weld to the world:
for body in [plant.get_body(b) for b in plant.GetBodyIndices(robot)]:
    if not any(plant.get_joint(j).child_body() is body for j in plant.GetJointIndices()):
        plant.WeldFrames(plant.world_frame(), body.body_frame())"""
_INERTIA = """body = plant.GetBodyByName("{element}")
own = body.CalcSpatialInertiaInBodyFrame(context)
%s
body.SetSpatialInertiaInBodyFrame(context, new)"""
_CENTRAL = """centre, mass = own.get_com(), own.get_mass()
moment = own.Shift(centre).CalcRotationalInertia()
"""
_MOVED = "%s\nnew = SpatialInertia.MakeFromCentralInertia(mass, centre, moment)"
_SETTERS = {
    "damping": 'plant.GetJointByName("{element}").SetDampingVector(context, [{number}])',
    "ground": "# The ground that the robot stands on has the friction {number}.",
    "mass": _INERTIA % "new = SpatialInertia({number}, own.get_com(), own.get_unit_inertia())",
    "inertia": _INERTIA % f"{_CENTRAL}new = SpatialInertia.MakeFromCentralInertia(mass, centre, moment * {{number}})",
    **{f"com_{a}": _INERTIA % (_CENTRAL + _MOVED % f"centre[{k}] = {{number}}") for k, a in enumerate("xyz")},
}
