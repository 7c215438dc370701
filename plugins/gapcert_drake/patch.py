"""Native parameters written back into a URDF or SDF file, and code for what it cannot say."""

from __future__ import annotations

from collections.abc import Mapping

from gapcert_engines import patched_file

from .config import DrakeConfig
from .robot import ADDED, RobotFile


def files(robot: RobotFile, config: DrakeConfig, values: Mapping[str, float], stated: Mapping[str, float]) -> dict[str, str]:
    """`values` differ from the `stated` ones of all native parameters; nothing for an MJCF."""
    if robot.kind == "xml":
        return {}
    text = robot.path.read_text(encoding="utf-8")
    words, given = {"damping": "damping"}, {"damping": config.joint_damping}
    patched, unsaid = patched_file(text, values, stated, words, given, config.model)
    if robot.kind == "sdf":
        # Drake passes over the gravity of an SDF's world.
        unsaid |= {n: v for n, v in values.items() if n.startswith("gravity_")}
    (name,) = patched
    return patched | ({"extended.py": _code(name, config, unsaid, {**stated, **values})} if unsaid else {})


def _code(name: str, config: DrakeConfig, unsaid: Mapping[str, float], values: Mapping[str, float]) -> str:
    """Code that loads the file into a plant, as this package does, and sets what the file cannot say."""
    gravity = ", ".join(repr(float(values[f"gravity_{a}"])) for a in "xyz")
    lines = [
        "from pydrake.multibody.parsing import Parser",
        "from pydrake.multibody.plant import MultibodyPlant",
        "from pydrake.multibody.tree import SpatialInertia, UnitInertia",
        "",
        "plant = MultibodyPlant(time_step=1e-3)",
        f'(robot,) = Parser(plant).AddModels("{name}")',
        f"plant.mutable_gravity_field().set_gravity_vector([{gravity}])",
    ]
    rotors = {n.partition(".")[2]: v for n, v in unsaid.items() if n.startswith("armature.")}
    for joint, value in rotors.items():
        lines.append(f'rotor = plant.AddJointActuator("{ADDED}{joint}", plant.GetJointByName("{joint}"))')
        lines.append(f"rotor.set_default_rotor_inertia({float(value)!r})")
    if config.fixed_base:
        lines.append("# A root that the file does not weld to the world:")
        lines.append("for body in [plant.get_body(b) for b in plant.GetBodyIndices(robot)]:")
        lines.append("    if not any(plant.get_joint(j).child_body() is body for j in plant.GetJointIndices()):")
        lines.append("        plant.WeldFrames(plant.world_frame(), body.body_frame())")
    lines += ["plant.Finalize()", "context = plant.CreateDefaultContext()"]
    for native, value in unsaid.items():
        what, _, element = native.partition(".")
        lines += _set(what, element, float(value))
    return "\n".join([*lines, ""])


def _set(what: str, element: str, number: float) -> list[str]:
    if what == "damping":
        return [f'plant.GetJointByName("{element}").SetDampingVector(context, [{number!r}])']
    if what == "ground":
        return [f"# The ground that the robot stands on has the friction {number!r}."]
    body = [f'body = plant.GetBodyByName("{element}")', "own = body.CalcSpatialInertiaInBodyFrame(context)"]
    if what == "mass":
        return [*body, f"new = SpatialInertia({number!r}, own.get_com(), own.get_unit_inertia())", _PUT]
    centre = [
        "centre, mass = own.get_com(), own.get_mass()",
        "moment = own.Shift(centre).CalcRotationalInertia()",
    ]
    if what == "inertia":
        return [*body, *centre, f"new = SpatialInertia.MakeFromCentralInertia(mass, centre, moment * {number!r})", _PUT]
    if what in _PLACE:
        moved = f"centre[{_PLACE[what]}] = {number!r}"
        return [*body, *centre, moved, "new = SpatialInertia.MakeFromCentralInertia(mass, centre, moment)", _PUT]
    return []


_PUT = "body.SetSpatialInertiaInBodyFrame(context, new)"
_PLACE = {"com_x": 0, "com_y": 1, "com_z": 2}
