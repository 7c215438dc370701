"""Robot files as engines that load them whole get them: one robot, without what is only seen, and with its meshes found."""

from __future__ import annotations

import copy
import hashlib
import xml.etree.ElementTree as ET
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import ClassVar

from gapcert.plugin import UsageError


class RobotDescription(ABC):
    """A robot file, read once: its text for the engine, its meshes and its digest; `shapes`: they take part.

    `gravity` is that of the SDF world around the model, if any. A subclass says which files its engine reads: `kinds` by the
    tag of their root, and in words `expected`, `tags` and `single`, what has no models to choose from.
    """

    kinds: ClassVar[Mapping[str, str]]
    expected: ClassVar[str]
    tags: ClassVar[str]
    single: ClassVar[str]
    attributes: ClassVar[tuple[str, ...]] = ("filename",)

    def __init__(self, path: Path, *, model: str | None = None, shapes: bool = False) -> None:
        self.path, self.shapes = path, shapes
        _, root = read_robot(path, self.kinds, self.expected, self.tags)
        self.kind = self.kinds[root.tag]
        if model is not None and self.kind != "sdf":
            raise UsageError(f"backend.model: {path} {self.single}; leave out model: {model}")
        self.gravity = _gravity(root, path) if self.kind == "sdf" else None
        body = self._body(root, model)
        self._read(body)
        for link in body.iter("link"):
            for part in [*link.findall("visual"), *([] if shapes else link.findall("collision"))]:
                link.remove(part)
        body.tail = None  # text behind the element is none of the robot
        self._plain = ET.canonicalize(ET.tostring(body, encoding="unicode"), strip_text=True)
        self._meshes = tuple((p, _sha(p)) for p in self._find_meshes(body)) if shapes else ()
        self.text = ET.tostring(self._whole(body), encoding="unicode")

    @abstractmethod
    def _body(self, root: ET.Element, model: str | None) -> ET.Element:
        """What of the file is loaded; UsageError for what the engine would take for something else."""

    @abstractmethod
    def _read(self, body: ET.Element) -> None:
        """Keep what the engine's plugin asks for later, such as names."""

    def _whole(self, body: ET.Element) -> ET.Element:
        """As a file has it."""
        return body

    def digest(self) -> str:
        """SHA-256 of what is loaded: the text, without what is only seen, and the meshes of shapes that take part."""
        parts = [self.gravity, self._plain, *(sha for _, sha in self._meshes)]
        return hashlib.sha256(repr(parts).encode()).hexdigest()

    def check_meshes(self) -> None:
        """Refuses a mesh that is no longer what it was."""
        for path, sha in self._meshes:
            if not path.is_file() or _sha(path) != sha:
                raise UsageError(f"robot: {path} has changed since it was read; run again")

    def _find_meshes(self, body: ET.Element) -> list[Path]:
        """The files of all meshes, whose names become absolute in `body`."""
        found = []
        for mesh in body.iter("mesh"):
            uri = mesh.find("uri")
            attribute = next((a for a in self.attributes if mesh.get(a)), self.attributes[0])
            name = (uri.text or "").strip() if uri is not None else mesh.get(attribute, "")
            where = name.removeprefix("file://")
            if not where and self.kind == "xml":  # of an MJCF: vertices may stand in its text
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
            else:
                mesh.set(attribute, self._named(path))
        return found

    def _named(self, path: Path) -> str:
        return path.as_uri()


def read_robot(path: Path, roots: Collection[str], expected: str, tags: str) -> tuple[bytes, ET.Element]:
    """The content of a file and its root, which is one of `roots`; UsageError, with what is `expected` in words, else."""
    if not path.is_file():
        raise UsageError(f"robot: there is no file {path}; give the path of {expected}, relative to the spec")
    content = path.read_bytes()
    try:
        root = ET.fromstring(content)
    except ET.ParseError as error:
        raise UsageError(f"robot: {path} is no XML: {error}; expected {expected}") from None
    if root.tag not in roots:
        raise UsageError(f"robot: {path} starts with <{root.tag}>; expected {tags}")
    return content, root


def chosen_model(root: ET.Element, name: str | None, path: Path) -> ET.Element:
    """A copy of the first model of an SDF file, or of the one with this name."""
    models = [*root.findall("model"), *root.findall("world/model")]
    chosen = [m for m in models if name is None or m.get("name") == name]
    if not chosen:
        known = ", ".join(m.get("name", "") for m in models) or "none"
        raise UsageError(f"robot: {path} has no model {'' if name is None else repr(name) + ' '}of its own; it has {known}")
    return copy.deepcopy(chosen[0])


def _sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


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
