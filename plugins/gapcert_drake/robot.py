"""Robot files: what a URDF, SDF or MJCF declares, without what is only seen, and with its meshes found."""

from __future__ import annotations

import copy
import hashlib
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Literal, final

from gapcert import UsageError

KINDS: dict[str, Literal["urdf", "sdf", "xml"]] = {"robot": "urdf", "sdf": "sdf", "mujoco": "xml"}
SEEN = {"sensor", "keyframe", "visual", "statistic", "size", "custom", "actuator"}
"""Parts of an MJCF that do not move the robot; its motors give way to efforts at joints."""
STEPPING = ("timestep", "integrator", "cone", "jacobian", "solver", "iterations", "tolerance", "ls_iterations", "ls_tolerance",
            "noslip_iterations", "noslip_tolerance", "ccd_iterations", "ccd_tolerance", "impratio")  # fmt: skip
"""Of an MJCF's <option>: how MuJoCo steps, which Drake does otherwise."""
TOUCH = "condim|contype|conaffinity|priority|friction|solmix|solref|solimp|margin|gap|surfacevel"
"""Attributes of an MJCF's geoms that matter in contacts alone."""
ADDED = "gapcert motor of "
"""Begins the names of actuators that stand for the inertia of rotors."""
MESHES = ("filename", "file")


@final
class RobotFile:
    """A robot file, read once: its text for Drake, and its digest; `shapes`: they take part.

    `gravity` is that of the SDF world around the model, if any; `rubs`: joints of an SDF have dry friction, over which Drake
    passes without a word.
    """

    def __init__(self, path: Path, *, model: str | None = None, shapes: bool = False) -> None:
        self.path, self.shapes = path, shapes
        self.gravity: tuple[float, ...] | None = None
        if not path.is_file():
            raise UsageError(f"robot: there is no file {path}; give the path of a URDF, SDF or MJCF file, relative to the spec")
        try:
            root = ET.fromstring(path.read_bytes())
        except ET.ParseError as error:
            raise UsageError(f"robot: {path} is no XML: {error}; expected a URDF, SDF or MJCF file") from None
        if root.tag not in KINDS:
            raise UsageError(f"robot: {path} starts with <{root.tag}>; expected <robot> (URDF), <sdf> or <mujoco>")
        self.kind = KINDS[root.tag]
        if model is not None and self.kind != "sdf":
            raise UsageError(f"backend.model: {path} has one robot; leave out model: {model}")
        if next(root.iter("include"), None) is not None:
            raise UsageError(f"robot: {path}: <include>; expected one file with everything in it; write it out")
        body = {"urdf": _urdf, "sdf": _sdf, "xml": _mjcf}[self.kind](root, path, model)
        if self.kind == "sdf":
            self.gravity = _gravity(root, path)
        self.rubs = self.kind == "sdf" and any(float(f.text or 0.0) for f in body.iter("friction") if not len(f))
        self.joints = frozenset(j.get("name", "") for j in body.iter("joint"))
        self._clean(body)
        self._meshes = tuple((p, _sha(p)) for p in self._find_meshes(body)) if shapes else ()
        self.text = ET.tostring(body, encoding="unicode")

    def digest(self) -> str:
        """SHA-256 of what is loaded: the text, without what is only seen, and the meshes of shapes that take part."""
        parts = [self.gravity, self._plain, *(sha for _, sha in self._meshes)]
        return hashlib.sha256(repr(parts).encode()).hexdigest()

    def check_meshes(self) -> None:
        """Refuses a mesh that is no longer what it was."""
        for path, sha in self._meshes:
            if not path.is_file() or _sha(path) != sha:
                raise UsageError(f"robot: {path} has changed since it was read; run again")

    def _clean(self, body: ET.Element) -> None:
        for link in body.iter("link"):
            for part in [*link.findall("visual"), *([] if self.shapes else link.findall("collision"))]:
                link.remove(part)
        self._plain = ET.canonicalize(ET.tostring(body, encoding="unicode"), strip_text=True)

    def _find_meshes(self, body: ET.Element) -> list[Path]:
        """The files of all meshes, whose names become absolute in `body`."""
        found = []
        for mesh in body.iter("mesh"):
            uri = mesh.find("uri")
            attribute = next((a for a in MESHES if mesh.get(a)), None)
            name = (uri.text or "").strip() if uri is not None else mesh.get(attribute or "", "")
            where = name.removeprefix("file://")
            if not where:
                continue
            if "://" in where:
                raise UsageError(f"robot: {self.path}: mesh '{name}'; expected a path relative to the file; write it so")
            path = (self.path.parent / where).resolve()
            if not path.is_file():
                raise UsageError(
                    f"robot: {self.path}: there is no mesh {path}; put it there, or take its shape out of the file"
                )
            found.append(path)
            if uri is not None:
                uri.text = path.as_uri()
            elif attribute is not None:
                mesh.set(attribute, str(path))
        return found


def _sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _urdf(root: ET.Element, path: Path, model: str | None) -> ET.Element:
    return root


def _mjcf(root: ET.Element, path: Path, model: str | None) -> ET.Element:
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


def _sdf(root: ET.Element, path: Path, name: str | None) -> ET.Element:
    """The first model, or the one with this name."""
    models = [*root.findall("model"), *root.findall("world/model")]
    chosen = [m for m in models if name is None or m.get("name") == name]
    if not chosen:
        known = ", ".join(m.get("name", "") for m in models) or "none"
        raise UsageError(f"robot: {path} has no model {'' if name is None else repr(name) + ' '}of its own; it has {known}")
    alone = ET.Element("sdf", {"version": root.get("version") or "1.6"})
    alone.append(copy.deepcopy(chosen[0]))
    return alone


def _gravity(root: ET.Element, path: Path) -> tuple[float, ...] | None:
    found = root.find("world/gravity")
    found = root.find("world/physics/gravity") if found is None else found
    if found is None:
        return None
    try:
        x, y, z = (float(v) for v in (found.text or "").split())
    except ValueError:
        raise UsageError(f"robot: {path}: <gravity>{found.text}</gravity>; expected three numbers") from None
    return x, y, z


def harmless(said: str, shapes: bool, rubs: bool) -> bool:
    """Is what Drake passes over, in its own words, without influence here, or meant to be left out?"""
    words = ["mechanicalReduction", r"\bmaterial\b", "texture"]
    words += [] if shapes else ["conaffinity", rf"attribute '({TOUCH})' found in a 'geom'", "child of 'contact'"]
    words += [] if rubs else ["joint friction", "frictionloss"]
    return re.search("|".join(words), said) is not None
