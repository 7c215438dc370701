"""Native parameters written back into an MJCF or URDF file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from gapcert import UsageError
from gapcert_engines import RobotText, largest_moment, patched_urdf, setting_code

_JOINT = {"damping": "damping", "frictionloss": "friction", "armature": None}
"""Of a joint, and what a URDF file calls it."""
_PLACE, _INERTIA = {"com_x": 0, "com_y": 1, "com_z": 2}, ("diaginertia", "fullinertia")
_FRICTION, _SPRING = {"friction": 0, "spinning_friction": 1, "rolling_friction": 2}, {"contact_time": 0, "contact_damping": 1}
"""Of contacts: columns of MuJoCo's arrays of geoms."""
_GEAR = """at = [model.actuator(k).name or model.joint(model.actuator_trnid[k, 0]).name for k in range(model.nu)]
model.actuator_gear[at.index("{element}"), 0] = {number}"""
_SETTERS = {
    **{name: f'model.dof_{name}[model.joint("{{element}}").dofadr] = {{number}}' for name in _JOINT},
    **{name: f'model.body("{{element}}").ipos[{k}] = {{number}}' for name, k in _PLACE.items()},
    "mass": 'body = model.body("{element}")\nbody.inertia *= {number} / body.mass\nbody.mass = {number}',
    "inertia": 'body = model.body("{element}")\nbody.inertia *= {number} / body.inertia.max()',
    "gear": _GEAR,
    **{name: f"model.geom_friction[:, {k}] *= {{number}}" for name, k in _FRICTION.items()},
    **{name: f"model.geom_solref[:, {k}] = {{number}}" for name, k in _SPRING.items()},
    **{f"gravity_{a}": f"model.opt.gravity[{k}] = {{number}}" for k, a in enumerate("xyz")},
}


def patched(text: str, values: Mapping[str, float], gravity: Sequence[float]) -> tuple[str, dict[str, float]]:
    """The text, and the values that it cannot say; `gravity`: what the file says, of which `values` may change some."""
    file, unsaid = RobotText(text), dict[str, float]()
    # A moment of inertia is that at the stated mass, and a mass takes it along.
    values = dict(sorted(values.items(), key=lambda v: not v[0].startswith("inertia.")))
    if file.tags[0].kind == "robot":
        return patched_urdf(text, values, {k: v for k, v in _JOINT.items() if v is not None})
    for name, value in values.items():
        try:
            file = _with(file, name, value)
        except UsageError:
            unsaid[name] = value
    if any(n.startswith("gravity_") for n in values):
        down = [float(values.get(f"gravity_{a}", g)) for a, g in zip("xyz", gravity, strict=True)]
        file = _option(file, gravity=" ".join(map(repr, down)))
        unsaid = {n: v for n, v in unsaid.items() if not n.startswith("gravity_")}
    return file.text, unsaid


def wrapper(file: str, values: Mapping[str, float]) -> str:
    """Code that loads the file and sets what it cannot say."""
    load = f'import mujoco\n\nmodel = mujoco.MjModel.from_xml_path("{file}")'
    return "\n".join([load, *setting_code(_SETTERS, values), "mujoco.mj_setConst(model, mujoco.MjData(model))", ""])


def _with(file: RobotText, name: str, value: float) -> RobotText:
    what, _, element = name.partition(".")
    if what in _JOINT:
        return file.put(file.named("joint", element), **{what: repr(float(value))})
    if what in ("mass", "inertia", *_PLACE):
        return _body(file, element, what, value)
    if what == "gear":
        return _geared(file, element, value)
    raise UsageError(f"{name}: no robot file of this kind says it")


def _geared(file: RobotText, name: str, gear: float) -> RobotText:
    """At the actuator of this name, or at the one without a name whose joint has it."""
    for tag in [t for above in file.tags if above.kind == "actuator" for t in file.inside(above)]:
        at = {tag.attributes.get(key) for key in ("joint", "jointinparent")}
        if tag.attributes.get("name") == name or ("name" not in tag.attributes and name in at):
            rest = tag.attributes.get("gear", "").split()[1:]
            return file.put(tag, gear=" ".join([repr(float(gear)), *rest]))
    raise UsageError(f"gear.{name}: the file has no such motor; it may be in a file that it includes")


def _body(file: RobotText, body: str, what: str, value: float) -> RobotText:
    """A mass has the inertia in proportion."""
    for below in file.inside(file.named("body", body)):
        if below.kind == "inertial":
            if what in _PLACE:
                place = below.attributes["pos"].split()
                place[_PLACE[what]] = repr(float(value))
                return file.put(below, pos=" ".join(place))
            inertia = {k: list(map(float, v.split())) for k, v in below.attributes.items() if k in _INERTIA}
            stated = float(below.attributes["mass"]) if what == "mass" else max(largest_moment(*n) for n in inertia.values())
            scaled = {k: " ".join(repr(n * value / stated) for n in v) for k, v in inertia.items()}
            return file.put(below, **scaled, **({"mass": repr(float(value))} if what == "mass" else {}))
    raise UsageError(f"{what}.{body}: it follows from the geometry; give the body an inertial element, or set it in code")


def _option(file: RobotText, **values: str) -> RobotText:
    for tag in file.tags:
        if tag.kind == "option":
            return file.put(tag, **values)
    attributes = " ".join(f'{k}="{v}"' for k, v in values.items())
    return file.insert(file.tags[0], f"<option {attributes}/>")
