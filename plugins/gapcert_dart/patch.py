"""Native parameters written back into a URDF or SDF file, and code for what it cannot say."""

from __future__ import annotations

from collections.abc import Mapping

from gapcert_engines import patched_file

from .config import DartConfig
from .robot import RobotFile


def files(robot: RobotFile, config: DartConfig, values: Mapping[str, float], stated: Mapping[str, float]) -> dict[str, str]:
    """`values` differ from the `stated` ones of all native parameters."""
    given = {"damping": config.joint_damping, "coulomb_friction": config.coulomb_friction}
    words = {"damping": "damping", "coulomb_friction": "friction"}
    text = robot.path.read_text(encoding="utf-8")
    patched, unsaid = patched_file(text, values, stated, words, given, config.model)
    load = _URDF if robot.kind == "urdf" else _SDF
    return patched | ({"extended.py": _code(load, config, unsaid, {**stated, **values})} if unsaid else {})


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


def _code(load: str, config: DartConfig, unsaid: Mapping[str, float], values: Mapping[str, float]) -> str:
    """Code that loads the file into a world, as this package does, and sets what the file cannot say."""
    lines = ["from pathlib import Path", "", "import dartpy", "import numpy as np"]
    lines += [load.format(root="FIXED" if config.fixed_base else "FLOATING").rstrip()]
    lines += ["world = dartpy.simulation.World()", "world.addSkeleton(robot)"]
    lines += [f"world.setGravity({', '.join(repr(float(values[f'gravity_{a}'])) for a in 'xyz')})"]
    for name, value in unsaid.items():
        what, _, element = name.partition(".")
        number = repr(float(value))
        if what in _SETTERS:
            lines.append(f'robot.getJoint("{element}").{_SETTERS[what]}(0, {number})')
        elif what == "mass":
            lines.append(f'body = robot.getBodyNode("{element}")')
            lines.append("own = body.getInertia()")
            moment = f"own.getMoment() * {number} / own.getMass()"
            lines.append(f"body.setInertia(dartpy.dynamics.Inertia({number}, own.getLocalCOM(), {moment}))")
        elif what == "inertia" or what in _PLACE:
            lines.append(f'body = robot.getBodyNode("{element}")')
            lines.append("own = body.getInertia()")
            lines.append("centre, moment = np.array(own.getLocalCOM()), np.array(own.getMoment())")
            moved = f"centre[{_PLACE.get(what)}] = {number}"
            lines.append(f"moment *= {number}" if what == "inertia" else moved)
            lines.append("body.setInertia(dartpy.dynamics.Inertia(own.getMass(), centre, moment))")
        elif what == "friction":
            lines.append("for body in robot.getBodyNodes():")
            lines.append("    for k in range(body.getNumShapeNodes()):")
            lines.append(f"        body.getShapeNode(k).getDynamicsAspect(True).setFrictionCoeff({number})")
        elif what == "ground":
            lines.append(f"# The ground that the robot stands on has the friction {number}.")
    return "\n".join([*lines, ""])


_PLACE = {"com_x": 0, "com_y": 1, "com_z": 2}
_SETTERS = {"damping": "setDampingCoefficient", "coulomb_friction": "setCoulombFriction"}
