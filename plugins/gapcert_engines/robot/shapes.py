"""The shapes of a URDF or SDF text, link by link: what is seen of it, else what may collide, else a box of its inertia."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gapcert.plugin import GREY, Array, Shape, at_rest

Mesh = tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("attribute", "<u2")])


def file_shapes(robot: ET.Element, folder: Path, links: Sequence[str]) -> tuple[Shape, ...]:
    """Of a <robot> (URDF) or a <model> (SDF), for the links of these names, in their order; meshes are looked for in `folder`.

    A shape that cannot be drawn (a mesh that is absent or in a format other than STL and OBJ) is left out.
    """
    materials = {m.get("name", ""): _rgba(m) for m in robot.findall("material")}
    found: list[Shape] = []
    for link in robot.findall("link"):
        if (name := link.get("name", "")) in links:
            found += _of_link(link, links.index(name), folder, materials)
    return tuple(found)


def _of_link(link: ET.Element, number: int, folder: Path, materials: Mapping[str, Array | None]) -> list[Shape]:
    for kind in ("visual", "collision"):
        shapes = [_shape(part, number, folder, materials) for part in link.findall(kind)]
        if drawn := [s for s in shapes if s is not None]:
            return drawn
    box = _inertia(link, number)
    return [] if box is None else [box]


def _shape(part: ET.Element, number: int, folder: Path, materials: Mapping[str, Array | None]) -> Shape | None:
    geometry = part.find("geometry")
    if geometry is None or not len(geometry):
        return None
    one, kind = geometry[0], geometry[0].tag
    shape: Shape | None = None
    match kind:
        case "box":
            shape = Shape(number, kind, _numbers(one, "size") / 2)
        case "sphere":
            shape = Shape(number, kind, _numbers(one, "radius"))
        case "cylinder" | "capsule":
            shape = Shape(number, kind, np.concatenate([_numbers(one, "radius"), _numbers(one, "length")]))
        case "ellipsoid":
            shape = Shape(number, kind, _numbers(one, "radii"))
        case "plane":
            # Endless where it may collide; the size is of what is seen.
            shape = Shape(number, kind, _numbers(one, "size", [2.0, 2.0]) / 2)
        case "mesh":
            shape = _mesh(one, number, folder)
    if shape is None:
        return None
    material = part.find("material")
    colour = None if material is None else _rgba(material)
    if colour is None and material is not None:
        colour = materials.get(material.get("name", ""))
    return replace(shape, place=_pose(part), colour=np.array(GREY) if colour is None else colour)


def _mesh(element: ET.Element, number: int, folder: Path) -> Shape | None:
    uri = element.find("uri")
    name = element.get("filename", "") if uri is None else (uri.text or "").strip()
    read = _read_mesh(name, folder)
    if read is None:
        return None
    vertices, faces = read
    return Shape(number, "mesh", np.empty(0), vertices=vertices * _numbers(element, "scale", [1.0, 1.0, 1.0]), faces=faces)


def _read_mesh(name: str, folder: Path) -> Mesh | None:
    """Vertices (v, 3) and faces (f, 3); None where there is no such file in `folder` or above it, or no triangles in it."""
    relative = name.partition("://")[2].lstrip("/") if "://" in name else name
    places = (place / relative for place in (folder.resolve(), *folder.resolve().parents))
    path = next((p for p in places if relative and p.is_file()), None)
    reader = None if path is None else {".stl": _stl, ".obj": _obj}.get(path.suffix.lower())
    mesh = None if path is None or reader is None else reader(path.read_bytes())
    return mesh if mesh is not None and len(mesh[1]) else None


def _stl(data: bytes) -> Mesh | None:
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + count * _TRIANGLE.itemsize:
        corners = np.frombuffer(data, _TRIANGLE, count, 84)["vertices"].reshape(-1, 3).astype(np.float64)
    else:
        lines = (line.split() for line in data.decode(errors="replace").splitlines())
        corners = np.array([parts[1:4] for parts in lines if parts[:1] == ["vertex"]], dtype=np.float64).reshape(-1, 3)
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    return vertices, index.reshape(-1, 3).astype(np.int64)


def _obj(data: bytes) -> Mesh | None:
    """Faces of more than three corners become fans."""
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    for line in data.decode(errors="replace").splitlines():
        kind, *parts = line.split() or [""]
        if kind == "v":
            vertices.append([float(p) for p in parts[:3]])
        elif kind == "f":
            corners = [int(p.split("/")[0]) for p in parts]
            # Counted from 1, or, where negative, from the last vertex so far.
            corners = [c - 1 if c > 0 else len(vertices) + c for c in corners]
            faces += [[corners[0], a, b] for a, b in pairwise(corners[1:])]
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), np.array(faces, dtype=np.int64).reshape(-1, 3)


def _numbers(element: ET.Element, name: str, default: Sequence[float] = ()) -> Array:
    """An attribute (URDF) or a child (SDF) as numbers."""
    child = element.find(name)
    text = element.get(name) if child is None else child.text
    return np.array(default if text is None else text.split(), dtype=np.float64)


def _rgba(material: ET.Element) -> Array | None:
    colour = material.find("color")
    if colour is not None:
        return np.array(colour.get("rgba", "").split(), dtype=np.float64)
    diffuse = material.find("diffuse")
    if diffuse is None:
        return None
    return np.array([*(diffuse.text or "").split(), "1"][:4], dtype=np.float64)


def _pose(element: ET.Element) -> Array:
    """<origin xyz rpy> or <pose>x y z r p y</pose>."""
    origin, pose = element.find("origin"), element.find("pose")
    numbers = np.zeros(6)
    if origin is not None:
        numbers[:3], numbers[3:] = _numbers(origin, "xyz", [0.0] * 3), _numbers(origin, "rpy", [0.0] * 3)
    elif pose is not None:
        numbers[:] = [float(v) for v in (pose.text or "").split()]
    place = at_rest()
    place[:3] = numbers[:3]
    if numbers[3:].any():
        from scipy.spatial.transform import Rotation

        place[3:] = np.roll(Rotation.from_euler("xyz", numbers[3:]).as_quat(), 1)
    return place


def _inertia(link: ET.Element, number: int) -> Shape | None:
    inertial = link.find("inertial")
    mass, inertia = (None if inertial is None else inertial.find(n) for n in ("mass", "inertia"))
    if inertial is None or mass is None or inertia is None:
        return None
    xx, yy, zz, xy, xz, yz = (_entry(inertia, n) for n in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
    moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    from scipy.spatial.transform import Rotation

    place, own = _pose(inertial), Rotation.from_matrix(axes * np.linalg.det(axes))
    turn = Rotation.from_quat(np.roll(place[3:], -1)) * own
    place = np.concatenate([place[:3], np.roll(turn.as_quat(), 1)])
    return Shape.of_inertia(number, float(mass.get("value") or mass.text or 0), moments, place)


def _entry(inertia: ET.Element, name: str) -> float:
    child = inertia.find(name)
    return float(inertia.get(name, "0") if child is None else child.text or 0)
