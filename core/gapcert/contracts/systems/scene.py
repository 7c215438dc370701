"""What a robot looks like and where its links are, as plain data: what an engine hands to those who draw it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from gapcert.numerics.arrays import Array, Ints

GREY = (0.62, 0.65, 0.7, 1.0)
FACES = 6000
"""Of a mesh; a finer one is drawn coarser."""
THIN = 0.02
"""A body without any thickness is drawn this thick, relative to its length."""


def at_rest() -> Array:
    """The pose (x, y, z, w, x, y, z) that moves nothing."""
    return np.array([0.0, 0, 0, 1, 0, 0, 0])


@final
@dataclass(frozen=True)
class Shape:
    """A rigid shape of link number `link`, at `place` in its frame: x, y, z (m) and a unit quaternion w, x, y, z.

    kind and size (m): `box`, `ellipsoid` half sizes (3,); `sphere` radius (1,); `cylinder`, `capsule` radius and length
    without the caps (2,), along z about the middle; `plane` half sizes (2,) of the part of z = 0 that is drawn; `mesh` none,
    but vertices (v, 3) and faces (f, 3). colour: RGBA in [0, 1].
    """

    link: int
    kind: str
    size: Array
    place: Array = field(default_factory=at_rest)
    colour: Array = field(default_factory=lambda: np.array(GREY))
    vertices: Array = field(default_factory=lambda: np.empty((0, 3)))
    faces: Ints = field(default_factory=lambda: np.empty((0, 3), dtype=np.int64))

    @classmethod
    def of_inertia(cls, link: int, mass: float, moments: Array, place: Array) -> Shape | None:
        """The uniform box of this mass (kg) and these principal moments (3,) (kg·m²) about `place`; None without either."""
        moments = np.asarray(moments, dtype=np.float64)
        if mass <= 0 or not moments.max(initial=0.0) > 0:
            return None
        # I_x = m (b² + c²)/12, so that 6 (I_y + I_z − I_x)/m = a², with half sizes a/2.
        half = np.sqrt(np.maximum(6 * (moments.sum() - 2 * moments) / mass, 0)) / 2
        return cls(link, "box", np.maximum(half, THIN * half.max()), np.asarray(place, dtype=np.float64))

    def bounded(self) -> Shape:
        """With a mesh of at most FACES: vertices of one cell of a grid become one, on the finest grid that does."""
        cells = 256
        shape = self
        while len(shape.faces) > FACES and cells > 1:
            shape, cells = _clustered(self, cells), cells // 2
        return shape


@final
@dataclass(frozen=True)
class Scene:
    """The links of a robot by name, their shapes, and poses (n, links, 7) of the links in n states: x, y, z (m) in the world,
    and a unit quaternion w, x, y, z.
    """

    links: tuple[str, ...]
    shapes: tuple[Shape, ...]
    poses: Array

    def with_ground(self) -> Scene:
        """With the plane z = 0 as one more link, drawn from the origin to 2 m beyond the links."""
        half = 2.0 + float(np.abs(self.poses[..., :2]).max())
        plane = Shape(len(self.links), "plane", np.array([half, half]))
        still = np.broadcast_to(at_rest(), (len(self.poses), 1, 7))
        return Scene((*self.links, "ground"), (*self.shapes, plane), np.concatenate([self.poses, still], axis=1))


def _clustered(shape: Shape, cells: int) -> Shape:
    low, high = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
    key = np.floor((shape.vertices - low) / (float((high - low).max()) or 1.0) * cells).astype(np.int64)
    _, first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)
    faces = group.reshape(-1)[shape.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    return replace(shape, vertices=shape.vertices[first], faces=np.unique(faces[whole], axis=0))
