"""Native parameters written back into an MJCF or URDF file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from gapcert import RobotText, UsageError

_JOINT = {"damping": "damping", "frictionloss": "friction", "armature": None}
"""Of a joint, and what a URDF file calls it."""


def patched(text: str, values: Mapping[str, float], gravity: Sequence[float]) -> tuple[str, dict[str, float]]:
    """The text, and the values that it cannot say; `gravity`: what the file says, of which `values` may change some."""
    file, unsaid = RobotText(text), dict[str, float]()
    urdf = file.tags[0].kind == "robot"
    for name, value in values.items():
        try:
            file = _with(file, urdf, name, value)
        except UsageError:
            unsaid[name] = value
    if not urdf and any(n.startswith("gravity_") for n in values):
        down = [float(values.get(f"gravity_{a}", g)) for a, g in zip("xyz", gravity, strict=True)]
        file = _option(file, gravity=" ".join(map(repr, down)))
        unsaid = {n: v for n, v in unsaid.items() if not n.startswith("gravity_")}
    return file.text, unsaid


def wrapper(file: str, values: Mapping[str, float]) -> str:
    """Code that loads the file and sets what it cannot say."""
    lines = ["import mujoco", "", f'model = mujoco.MjModel.from_xml_path("{file}")']
    for name, value in values.items():
        what, _, element = name.partition(".")
        number = repr(float(value))
        if what in _JOINT:
            lines.append(f'model.dof_{what}[model.joint("{element}").dofadr] = {number}')
        elif what == "mass":
            lines.append(f'body = model.body("{element}")')
            lines.append(f"body.inertia *= {number} / body.mass")
            lines.append(f"body.mass = {number}")
        elif what == "friction":
            lines.append(f"model.geom_friction[:, 0] *= {number}")
        else:
            lines.append(f"model.opt.gravity[{'xyz'.index(what[-1])}] = {number}")
    return "\n".join([*lines, "mujoco.mj_setConst(model, mujoco.MjData(model))", ""])


def _with(file: RobotText, urdf: bool, name: str, value: float) -> RobotText:
    what, _, element = name.partition(".")
    known = _JOINT.get(what) if urdf else what
    if what in _JOINT and known is not None:
        return (_dynamics if urdf else _joint)(file, element, known, value)
    if what == "mass":
        return (_link if urdf else _body)(file, element, value)
    raise UsageError(f"{name}: no robot file of this kind says it")


def _joint(file: RobotText, joint: str, what: str, value: float) -> RobotText:
    return file.put(file.named("joint", joint), **{what: repr(float(value))})


def _dynamics(file: RobotText, joint: str, what: str, value: float) -> RobotText:
    tag = file.named("joint", joint)
    for below in file.inside(tag):
        if below.kind == "dynamics":
            return file.put(below, **{what: repr(float(value))})
    return file.insert(tag, f'<dynamics {what}="{float(value)!r}"/>')


def _body(file: RobotText, body: str, mass: float) -> RobotText:
    """With the inertia in proportion."""
    for below in file.inside(file.named("body", body)):
        if below.kind == "inertial":
            ratio = mass / float(below.attributes["mass"])
            inertia = {k: v for k, v in below.attributes.items() if k in ("diaginertia", "fullinertia")}
            scaled = {k: " ".join(repr(float(n) * ratio) for n in v.split()) for k, v in inertia.items()}
            return file.put(below, mass=repr(float(mass)), **scaled)
    raise UsageError(f"mass.{body}: it follows from the geometry; give the body an inertial element, or set it in code")


def _link(file: RobotText, link: str, mass: float) -> RobotText:
    """With the inertia in proportion."""
    for inertial in file.inside(file.named("link", link)):
        if inertial.kind == "inertial":
            below = {t.kind: t for t in file.inside(inertial)}
            ratio = mass / float(below["mass"].attributes["value"])
            changes = [(below["mass"], {"value": repr(float(mass))})]
            if "inertia" in below:
                changes.append((below["inertia"], {k: repr(float(v) * ratio) for k, v in below["inertia"].attributes.items()}))
            # From the end on, so that what stands before keeps its place.
            for tag, values in sorted(changes, key=lambda c: -c[0].begin):
                file = file.put(tag, **values)
            return file
    raise UsageError(f"mass.{link}: the link has no inertial element; give it one, or set it in code")


def _option(file: RobotText, **values: str) -> RobotText:
    for tag in file.tags:
        if tag.kind == "option":
            return file.put(tag, **values)
    attributes = " ".join(f'{k}="{v}"' for k, v in values.items())
    return file.insert(file.tags[0], f"<option {attributes}/>")
