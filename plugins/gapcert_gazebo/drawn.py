"""What a robot in Gazebo's physics looks like: shapes of the SDF text, and where Gazebo has its links."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from gapcert import Array
from gapcert.plugin import Scene
from gapcert_engines import file_shapes

from .sdf import Description


def drawn(text: str, folder: Path, found: Description, poses: Array, *, ground: bool) -> Scene:
    """poses (n, links, 7) of the links in the order of `found.masses`; the last link is the world, where there is a ground."""
    names = list(found.masses)
    models = ET.fromstring(text).iter("model")
    model = next((m for m in models if m.get("name") == found.model), None)
    shapes = () if model is None else file_shapes(model, folder, names)
    scene = Scene(tuple(names), shapes, poses)
    return scene.with_ground() if ground else scene
