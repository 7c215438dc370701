"""Native parameters written back into a URDF file, and code for what it cannot say."""

from __future__ import annotations

from collections.abc import Mapping

from gapcert_engines import patched_file

from .config import PyBulletConfig


def files(text: str, config: PyBulletConfig, values: Mapping[str, float], stated: Mapping[str, float]) -> dict[str, str]:
    """`values` differ from the `stated` ones of all native parameters."""
    # Bullet passes over the friction of a file's joints.
    patched, unsaid = patched_file(text, values, stated, {"damping": "damping"}, {"damping": config.joint_damping})
    mass = sum(v for n, v in stated.items() if n.startswith("mass."))
    return patched | ({"extended.py": _code(config, unsaid, {**stated, **values}, mass)} if unsaid else {})


def _code(config: PyBulletConfig, unsaid: Mapping[str, float], values: Mapping[str, float], mass: float) -> str:
    """Code that loads the file as a client of this package does, and sets what the file cannot say."""
    flags = ", flags=pybullet.URDF_USE_INERTIA_FROM_FILE" if config.use_inertia_from_file else ""
    gravity = ", ".join(repr(float(values[f"gravity_{a}"])) for a in "xyz")
    drag = ", ".join(f"{w}Damping={float(values[f'{w}_damping'])!r}" for w in ("linear", "angular"))
    lines = [
        "import pybullet",
        "",
        "pybullet.connect(pybullet.DIRECT)",
        f'robot = pybullet.loadURDF("extended.urdf", useFixedBase={config.fixed_base}{flags})',
        f"pybullet.setGravity({gravity})",
        f"pybullet.changeDynamics(robot, -1, {drag})",
        "names = [pybullet.getJointInfo(robot, k) for k in range(pybullet.getNumJoints(robot))]",
        "joints, links = ({info[i].decode(): info[0] for info in names} for i in (1, 12))",
        "for joint in joints.values():",
        "    pybullet.setJointMotorControl2(robot, joint, pybullet.VELOCITY_CONTROL, force=0)",
    ]
    if any(name.startswith("coulomb_friction.") for name in unsaid):
        lines.append(
            "# Bullet turns a motor's strength into an impulse now, with the time step that is set: setTimeStep comes before."
        )
    for name, value in unsaid.items():
        what, _, element = name.partition(".")
        if what == "damping":
            lines.append(f'pybullet.changeDynamics(robot, joints["{element}"], jointDamping={float(value)!r})')
        elif what == "coulomb_friction":
            lines.append(
                f'pybullet.setJointMotorControl2(robot, joints["{element}"], pybullet.VELOCITY_CONTROL, targetVelocity=0, '
                f"force={float(value)!r})"
            )
        elif what == "mass":
            lines.append(f'link = links.get("{element}", -1)')
            lines.append("mass, _, inertia, *_ = pybullet.getDynamicsInfo(robot, link)")
            scaled = f"[i * {float(value)!r} / mass for i in inertia]"
            lines.append(f"pybullet.changeDynamics(robot, link, mass={float(value)!r}, localInertiaDiagonal={scaled})")
        elif what == "inertia":
            lines.append(f'link = links.get("{element}", -1)')
            lines.append(f"inertia = [i * {float(value)!r} for i in pybullet.getDynamicsInfo(robot, link)[2]]")
            lines.append("pybullet.changeDynamics(robot, link, localInertiaDiagonal=inertia)")
        elif touch := _contact(what, float(value), mass):
            lines.append("for link in (-1, *links.values()):")
            lines.append(f"    pybullet.changeDynamics(robot, link, {touch})")
    return "\n".join([*lines, ""])


def _contact(what: str, value: float, mass: float) -> str:
    """Arguments of changeDynamics for a parameter of contacts; a contact has the product of both restitutions."""
    if what == "contact_time":
        return f"contactStiffness={mass / value**2!r}, contactDamping={2 * mass / value!r}" if value else ""
    known = {"friction": "lateralFriction", "rolling_friction": "rollingFriction", "spinning_friction": "spinningFriction"}
    known["restitution"] = "restitution"
    return f"{known[what]}={value!r}" if what in known else ""
