"""Robot files: what a URDF or an SDF declares, without pictures, and with its meshes found."""

from __future__ import annotations

import copy
import hashlib
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Literal, final

from gapcert import UsageError

NEWER = ("relative_to", "expressed_in", "attached_to", "rotation_format", "degrees")
"""Attributes of SDF 1.7 and later that move things; DART's reader knows 1.4 to 1.6 and would pass over them."""

SHAPES = ("box", "cylinder", "mesh", "sphere")


NUMBERS = {"pose": 6, "xyz": 3, "size": 3, "scale": 3, "gravity": 3, "normal": 3}


def _check_numbers(body: ET.Element, path: Path) -> None:
    """Refuses vectors of another length, of which DART would take what is no number, or write beyond their end."""
    for element in body.iter():
        words = (element.text or "").split()
        if words and element.tag in NUMBERS and len(words) != (most := NUMBERS[element.tag]):
            raise UsageError(f"robot: {path}: a <{element.tag}> has {len(words)} numbers; expected {most}")


@final
class RobotFile:
    """A URDF file or one model of an SDF file, read once: its names, its meshes and its digest; `shapes`: they take part.

    `gravity` is that of the SDF world around the model, if any.
    """

    def __init__(self, path: Path, *, model: str | None = None, shapes: bool = False) -> None:
        self.path, self.shapes = path, shapes
        self.gravity: tuple[float, ...] | None = None
        if not path.is_file():
            raise UsageError(f"robot: there is no file {path}; give the path of a URDF or SDF file, relative to the spec")
        try:
            root = ET.fromstring(path.read_bytes())
        except ET.ParseError as error:
            raise UsageError(f"robot: {path} is no XML: {error}; expected a URDF or SDF file") from None
        if root.tag not in ("robot", "sdf"):
            raise UsageError(f"robot: {path} starts with <{root.tag}>; expected <robot> (URDF) or <sdf>")
        self.kind: Literal["urdf", "sdf"] = "urdf" if root.tag == "robot" else "sdf"
        if self.kind == "sdf":
            self.gravity = _gravity(root, path)
            body = _model(root, model, path)
        elif model is not None:
            raise UsageError(f"backend.model: {path} is a URDF file, which has one robot; leave out model: {model}")
        else:
            body = root
        self._name = model
        _check_numbers(body, path)
        self.links = tuple(link.get("name", "") for link in body.findall("link"))
        self.joints = tuple(joint.get("name", "") for joint in body.findall("joint"))
        children = {c.get("link") for c in body.findall("joint/child")}
        self.roots = tuple(name for name in self.links if name not in children) if self.kind == "urdf" else ()
        self._clean(body)
        self.collisions = {link.get("name", ""): len(link.findall("collision")) for link in body.findall("link")}
        self._check_shapes(body)
        self._meshes = tuple((p, _sha(p)) for p in self._find_meshes(body))
        self.text = ET.tostring(body if self.kind == "urdf" else _alone(body), encoding="unicode")

    def digest(self) -> str:
        """SHA-256 of what is loaded: the text, without what is only seen, and the meshes of shapes that take part."""
        parts = [self.gravity, self._plain, *(sha for _, sha in self._meshes)]
        return hashlib.sha256(repr(parts).encode()).hexdigest()

    def element(self) -> ET.Element:
        """The <robot> or <model> as it stands in the file, with all that is seen of it."""
        root = ET.fromstring(self.path.read_bytes())
        return root if self.kind == "urdf" else _model(root, self._name, self.path)

    def check_meshes(self) -> None:
        """Refuses a mesh that is no longer what it was."""
        for path, sha in self._meshes:
            if not path.is_file() or _sha(path) != sha:
                raise UsageError(f"robot: {path} has changed since it was read; run again")

    def _clean(self, body: ET.Element) -> None:
        for link in body.findall("link"):
            for part in [*link.findall("visual"), *([] if self.shapes else link.findall("collision"))]:
                link.remove(part)
        body.tail = None  # text behind the element is none of the robot
        self._plain = ET.canonicalize(ET.tostring(body, encoding="unicode"), strip_text=True)

    def _check_shapes(self, body: ET.Element) -> None:
        """Refuses a shape that DART's readers pass over, or crash on."""
        for shape in body.findall("link/collision/geometry/*"):
            if shape.tag not in SHAPES:
                raise UsageError(f"robot: {self.path}: collision shape <{shape.tag}>; expected one of {', '.join(SHAPES)}")

    def _find_meshes(self, body: ET.Element) -> list[Path]:
        """The files of all meshes, whose names become absolute in `body`."""
        found = []
        for mesh in body.findall("link/collision/geometry/mesh"):
            uri = mesh.find("uri")
            name = mesh.get("filename", "") if uri is None else (uri.text or "").strip()
            where = name.removeprefix("file://")
            if "://" in where:
                raise UsageError(f"robot: {self.path}: mesh '{name}'; expected a path relative to the file; write it so")
            path = (self.path.parent / where).resolve()
            if not path.is_file():
                raise UsageError(
                    f"robot: {self.path}: there is no mesh {path}; put it there, or take its shape out of the file"
                )
            found.append(path)
            if uri is None:
                mesh.set("filename", path.as_uri())
            else:
                uri.text = path.as_uri()
        return found


def _sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _model(root: ET.Element, name: str | None, path: Path) -> ET.Element:
    """The first model, or the one with this name; UsageError where DART would read it as something else."""
    models = [*root.findall("model"), *root.findall("world/model")]
    chosen = [m for m in models if name is None or m.get("name") == name]
    if not chosen:
        known = ", ".join(m.get("name", "") for m in models) or "none"
        raise UsageError(f"robot: {path} has no model {'' if name is None else repr(name) + ' '}of its own; it has {known}")
    model = copy.deepcopy(chosen[0])
    for element in model.iter():
        attribute = next((a for a in NEWER if element.get(a)), None)
        nested = element is not model and element.tag in ("model", "include", "frame")
        if attribute or nested:
            what = f'{attribute}="…" in <{element.tag}>' if attribute else f"<{element.tag}> in a model"
            raise UsageError(
                f"robot: {path}: {what}; DART's reader knows SDF 1.4 to 1.6 without it; write it out, or use a URDF"
            )
    for inertia in model.findall("link/inertial/inertia"):
        # SDF's own defaults, which DART's reader asks to be written.
        for name, value in (("ixx", "1"), ("iyy", "1"), ("izz", "1"), ("ixy", "0"), ("ixz", "0"), ("iyz", "0")):
            if inertia.find(name) is None:
                ET.SubElement(inertia, name).text = value
    return model


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


def _alone(model: ET.Element) -> ET.Element:
    sdf = ET.Element("sdf", {"version": "1.6"})
    sdf.append(model)
    return sdf
