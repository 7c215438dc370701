"""URDF text: what a robot file declares, and several copies of a robot in one body."""

from __future__ import annotations

import copy
import hashlib
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import final

from gapcert import UsageError
from gapcert_engines import read_robot

KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical")


@final
class RobotFile:
    """A URDF file, read once: its text, its digest, and what decides whether copies may share one body.

    limits: whether its joints keep theirs.
    """

    def __init__(self, path: Path, *, limits: bool = True) -> None:
        self.path, self.limits = path, limits
        self.content, root = read_robot(path, ["robot"], "a URDF file", "a URDF file, which starts with <robot>")
        _check_joints(root, path)
        children = {c.get("link") for c in root.findall("joint/child")}
        self.roots = [name for link in root.findall("link") if (name := link.get("name")) not in children]
        self.root_has_inertia = any(
            link.find("inertial") is not None for link in root.findall("link") if link.get("name") in self.roots
        )
        self._root = root if limits else _endless(root)

    def digest(self, *, shapes: bool) -> str:
        """SHA-256 of the file and, where `shapes` decide the physics, of the meshes that its collision shapes name."""
        parts = [self.content]
        if shapes:
            names = {m.get("filename", "") for m in self._root.findall("link/collision/geometry/mesh")}
            parts += [p.read_bytes() for n in sorted(names) if (p := self.path.parent / n).is_file()]
        return hashlib.sha256(b"".join(hashlib.sha256(p).digest() for p in parts)).hexdigest()

    def text(self, *, shapes: bool) -> str:
        """What is loaded, to be written elsewhere: without shapes that are only seen, and with `shapes` that may collide."""
        root = copy.deepcopy(self._root)
        for link in root.findall("link"):
            for shape in [*link.findall("visual"), *([] if shapes else link.findall("collision"))]:
                link.remove(shape)
        for mesh in root.iter("mesh"):
            mesh.set("filename", _found(mesh.get("filename", ""), self.path.parent))
        return _written(root)

    def tiled(self, copies: int) -> str:
        """One robot whose root link carries `copies` of every other link and joint, named `NAME#k`, without any shape.

        Shapes have no part in the dynamics of a robot whose inertia comes from the file and that touches nothing. The root
        must be fixed: it is what the copies share.
        """
        robot = ET.Element("robot", {"name": "tiled"})
        robot.append(
            _bare(next(link for link in self._root.findall("link") if link.get("name") in self.roots), self.roots, None)
        )
        for k in range(copies):
            for element in self._root:
                if element.tag == "joint" or (element.tag == "link" and element.get("name") not in self.roots):
                    robot.append(_bare(element, self.roots, k))
        return _written(robot)


def _check_joints(root: ET.Element, path: Path) -> None:
    """Refuses what ends Bullet's process when it is loaded: links without a name, joints without a name, a kind or an end."""
    named = [link.get("name") or "" for link in root.findall("link")]
    links = set(named)
    if "" in links or len(links) < len(named):
        raise UsageError(
            f"robot: {path}: its links are called {', '.join(map(repr, named))}; expected a name of its own for each"
        )
    for k, joint in enumerate(root.findall("joint")):
        ends = [end.get("link") for name in ("parent", "child") for end in joint.findall(name)]
        if joint.get("type") not in KINDS or not joint.get("name") or len(ends) != 2 or not set(ends) <= links:
            raise UsageError(
                f"robot: {path}: joint {joint.get('name') or k} has type {joint.get('type')} and ends {ends}; expected a name, "
                f"one of the types {', '.join(KINDS)}, one parent and one child, which are links of the file"
            )


def _written(robot: ET.Element) -> str:
    # Bullet reads a file in pieces of 8 KiB, cut at line ends; on one long line it would cut inside a word.
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def _found(name: str, folder: Path) -> str:
    """The path of a mesh, which Bullet looks for beside the file and above it; the name where it is nowhere."""
    relative = name.partition("://")[2] or name
    places = (place / relative for place in (folder.resolve(), *folder.resolve().parents))
    return next((str(place) for place in places if place.is_file()), name)


def _endless(root: ET.Element) -> ET.Element:
    """Without limits of joints, which Bullet knows of a slide by an upper one below the lower one."""
    for joint in root.findall("joint"):
        if joint.get("type") == "revolute":
            joint.set("type", "continuous")
            for limit in joint.findall("limit"):
                joint.remove(limit)
        elif joint.get("type") == "prismatic":
            found = joint.find("limit")
            found = ET.SubElement(joint, "limit", {"effort": "0", "velocity": "0"}) if found is None else found
            found.attrib.update(lower="1", upper="-1")
    return root


def _bare(element: ET.Element, roots: list[str | None], k: int | None) -> ET.Element:
    """A copy of a link or joint with the names of tile k and without shapes."""
    element = copy.deepcopy(element)
    for shape in [*element.findall("visual"), *element.findall("collision")]:
        element.remove(shape)
    if k is not None:
        element.set("name", f"{element.get('name')}#{k}")
        for end in (*element.findall("parent"), *element.findall("child")):
            if (name := end.get("link")) not in roots:
                end.set("link", f"{name}#{k}")
    return element
