"""Robot files: what a URDF or an SDF declares, without pictures, and with its meshes found."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, final

from gapcert import UsageError
from gapcert_engines import RobotDescription, chosen_model

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
class RobotFile(RobotDescription):
    """For DART, with the names of links and joints."""

    kinds: ClassVar[Mapping[str, str]] = {"robot": "urdf", "sdf": "sdf"}
    expected = "a URDF or SDF file"
    tags = "<robot> (URDF) or <sdf>"
    single = "is a URDF file, which has one robot"

    def _body(self, root: ET.Element, model: str | None) -> ET.Element:
        self._name = model
        return root if self.kind == "urdf" else _model(root, model, self.path)

    def _read(self, body: ET.Element) -> None:
        _check_numbers(body, self.path)
        self.links = tuple(link.get("name", "") for link in body.findall("link"))
        self.joints = tuple(joint.get("name", "") for joint in body.findall("joint"))
        children = {c.get("link") for c in body.findall("joint/child")}
        self.roots = tuple(name for name in self.links if name not in children) if self.kind == "urdf" else ()
        seen = {link.get("name", ""): len(link.findall("collision")) for link in body.findall("link")}
        self.collisions = seen if self.shapes else dict.fromkeys(seen, 0)
        for shape in body.findall("link/collision/geometry/*") if self.shapes else ():
            if shape.tag not in SHAPES:  # DART's readers pass over it, or crash on it
                raise UsageError(f"robot: {self.path}: collision shape <{shape.tag}>; expected one of {', '.join(SHAPES)}")

    def _whole(self, body: ET.Element) -> ET.Element:
        if self.kind == "urdf":
            return body
        alone = ET.Element("sdf", {"version": "1.6"})
        alone.append(body)
        return alone

    def element(self) -> ET.Element:
        """The <robot> or <model> as it stands in the file, with all that is seen of it."""
        root = ET.fromstring(self.path.read_bytes())
        return root if self.kind == "urdf" else _model(root, self._name, self.path)


def _model(root: ET.Element, name: str | None, path: Path) -> ET.Element:
    """The first model, or the one with this name; UsageError where DART would read it as something else."""
    model = chosen_model(root, name, path)
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
