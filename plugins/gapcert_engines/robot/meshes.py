"""Triangles of STL and OBJ files."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

Mesh = tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("attribute", "<u2")])


def read_mesh(name: str, folder: Path) -> Mesh | None:
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
