"""Robot files: what a URDF, SDF or MJCF declares, without what is only seen, and with its meshes found."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import final

from gapcert import UsageError
from gapcert_engines import RobotDescription, chosen_model

KINDS = {"robot": "urdf", "sdf": "sdf", "mujoco": "xml"}
SEEN = {"sensor", "keyframe", "visual", "statistic", "size", "custom", "actuator"}
"""Parts of an MJCF that do not move the robot; its motors give way to efforts at joints."""
STEPPING = ("timestep", "integrator", "cone", "jacobian", "solver", "iterations", "tolerance", "ls_iterations", "ls_tolerance",
            "noslip_iterations", "noslip_tolerance", "ccd_iterations", "ccd_tolerance", "impratio")  # fmt: skip
"""Of an MJCF's <option>: how MuJoCo steps, which Drake does otherwise."""
TOUCH = "condim|contype|conaffinity|priority|friction|solmix|solref|solimp|margin|gap|surfacevel"
"""Attributes of an MJCF's geoms that matter in contacts alone."""
ADDED = "gapcert motor of "
"""Begins the names of actuators that stand for the inertia of rotors."""


@final
class RobotFile(RobotDescription):
    """For Drake. `rubs`: joints of an SDF have dry friction, over which Drake passes without a word."""

    kinds = KINDS
    expected = "a URDF, SDF or MJCF file"
    tags = "<robot> (URDF), <sdf> or <mujoco>"
    single = "has one robot"
    attributes = ("filename", "file")

    def _body(self, root: ET.Element, model: str | None) -> ET.Element:
        if next(root.iter("include"), None) is not None:
            raise UsageError(f"robot: {self.path}: <include>; expected one file with everything in it; write it out")
        if self.kind == "xml":
            return _mjcf(root, self.path)
        if self.kind == "urdf":
            return root
        alone = ET.Element("sdf", {"version": root.get("version") or "1.6"})
        alone.append(chosen_model(root, model, self.path))
        return alone

    def _read(self, body: ET.Element) -> None:
        self.rubs = self.kind == "sdf" and any(float(f.text or 0.0) for f in body.iter("friction") if not len(f))
        self.joints = frozenset(j.get("name", "") for j in body.iter("joint"))

    def _named(self, path: Path) -> str:
        return str(path)


def _mjcf(root: ET.Element, path: Path) -> ET.Element:
    """Without what is seen and without motors, and with one actuator per joint: Drake reads `armature` for those alone."""
    root.set("model", root.get("model") or "robot")
    for part in [p for p in root if p.tag in SEEN]:
        root.remove(part)
    for parent in list(root.iter()):
        for part in [p for p in parent if p.tag in ("site", "camera", "light")]:
            parent.remove(part)
    for option in root.iter("option"):
        for name in STEPPING:
            option.attrib.pop(name, None)
        for flag in option.findall("flag"):
            option.remove(flag)
    motors = ET.SubElement(root, "actuator")
    for k, joint in enumerate(j for world in root.iter("worldbody") for j in world.iter("joint")):
        if float(joint.get("ref") or 0.0):
            raise UsageError(
                f"robot: {path}: joint '{joint.get('name')}' has ref=\"{joint.get('ref')}\", which Drake passes over; "
                f"take it out"
            )
        joint.set("name", name := joint.get("name") or f"joint{k}")
        if joint.get("type", "hinge") in ("hinge", "slide"):
            ET.SubElement(motors, "motor", {"name": ADDED + name, "joint": name, "gear": "1"})
    return root


def harmless(said: str, shapes: bool, rubs: bool) -> bool:
    """Is what Drake passes over, in its own words, without influence here, or meant to be left out?"""
    words = ["mechanicalReduction", r"\bmaterial\b", "texture"]
    words += [] if shapes else ["conaffinity", rf"attribute '({TOUCH})' found in a 'geom'", "child of 'contact'"]
    words += [] if rubs else ["joint friction", "frictionloss"]
    return re.search("|".join(words), said) is not None
