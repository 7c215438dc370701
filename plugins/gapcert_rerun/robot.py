"""The engine's robot along its runs: shapes once, poses of links by columns."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from gapcert.plugin import Array, Shape
from gapcert_figures import Motion, Playback

from .canvas import BAD, ROLES, Canvas

_ASIDE, _ABOVE, _AWAY = 0.4, 0.3, 2.1
_GHOST = 0.35


def draw_robot(canvas: Canvas, played: Playback) -> None:
    """A view per motion; those of a diagnosis have the recording in them, as a ghost."""
    canvas.static("robot", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    by_name = {m.name: m for m in played.motions}
    eye = _eye(played)
    for motion in played.motions:
        root = f"robot/{as_path(motion.name)}"
        _log(canvas, root, played, motion)
        if motion.name == "measured":
            continue
        contents = [f"{root}/**"] + (["robot/measured/**"] if "measured" in by_name else [])
        one = rrb.Spatial3DView(
            origin="robot", contents=contents, name=_title(motion, "measured" in by_name), eye_controls=eye, line_grid=False
        )
        canvas.show("robot", motion.name, one)
    canvas.plays = True


def as_path(name: str) -> str:
    """What a motion is called in a recording: `with_gamma`."""
    return name.replace(" γ", "_gamma")


def _title(motion: Motion, beside: bool) -> str:
    if beside:
        return f"Recording (white), simulation {motion.name} the causes ({'orange' if motion.name == 'before' else 'blue'})"
    if motion.ended >= 0:
        return f"Robot {motion.name}: breaks after {motion.ended:.3g} s, then red"
    return f"Robot {motion.name}: {motion.t[-1]:.3g} s unbroken"


def _log(canvas: Canvas, root: str, played: Playback, motion: Motion) -> None:
    tint = ROLES[motion.name]
    reach = 1.2 * max(float(np.abs(_places(played, m)[:, :2]).max(initial=0.0)) for m in played.motions)
    for i, link in enumerate(played.links):
        shapes = [s for s in played.shapes if s.link == i]
        if not shapes:
            continue
        path, poses = f"{root}/{rr.escape_entity_path_part(link)}", motion.poses[:, i]
        moved = np.ptp(poses, axis=0).any()
        t, kept = (motion.t, poses) if moved else (motion.t[:1], poses[:1])
        canvas.columns(path, t, rr.Transform3D.columns(translation=kept[:, :3], quaternion=np.roll(kept[:, 3:], -1, axis=1)))
        for k, shape in enumerate(shapes):
            _shape(canvas, f"{path}/{k}", _wide(shape, reach), tint, motion)
    way = _way(played, motion)
    if way is not None and motion.name != "measured":
        canvas.static(f"{root}/way", rr.LineStrips3D([way], colors=[(*tint[:3], 90)], radii=rr.Radius.ui_points(1.0)))


def _shape(canvas: Canvas, path: str, shape: Shape, tint: tuple[int, ...], motion: Motion) -> None:
    """A shape in the colour of its motion, shaded by its own; a plane keeps its own. Red from a violation on."""
    ground = shape.kind == "plane"
    if ground and motion.name == "measured":
        return
    shade = 0.6 + 0.4 * float(shape.colour[:3].mean())
    colour = [60, 64, 72, 255] if ground else [int(shade * c) for c in tint[:3]] + [255]
    if motion.name == "measured":
        colour[3] = int(255 * _GHOST)
    place = shape.place
    canvas.static(path, rr.Transform3D(translation=place[:3], quaternion=rr.Quaternion(xyzw=np.roll(place[3:], -1))))
    canvas.recording.set_time("time", duration=0.0)
    what = _archetype(shape, colour)
    canvas.recording.log(path, what)
    if motion.ended >= 0 and not ground:
        canvas.recording.set_time("time", duration=motion.ended)
        canvas.recording.log(path, _archetype(shape, list(BAD)))
    canvas.recording.reset_time()


def _wide(shape: Shape, reach: float) -> Shape:
    """A plane has no end for what may touch it: as much of it as the motions need."""
    return replace(shape, size=np.maximum(shape.size, reach)) if shape.kind == "plane" else shape


def _way(played: Playback, motion: Motion) -> Array | None:
    """The way of the first link that goes anywhere; None where none does."""
    for i in dict.fromkeys(s.link for s in played.shapes if s.kind != "plane"):
        places = motion.poses[:, i, :3]
        if np.ptp(places, axis=0).max() > 1e-6:
            return places
    return None


def _archetype(shape: Shape, colour: list[int]) -> Any:
    solid = rr.components.FillMode.Solid
    size, colours = shape.size, [colour]
    match shape.kind:
        case "box":
            return rr.Boxes3D(half_sizes=[size], colors=colours, fill_mode=solid)
        case "plane":
            return rr.Boxes3D(half_sizes=[[*size, 1e-3 * float(size.max())]], colors=colours, fill_mode=solid)
        case "sphere" | "ellipsoid":
            return rr.Ellipsoids3D(half_sizes=[np.broadcast_to(size, 3)], colors=colours, fill_mode=solid)
        case "cylinder":
            return rr.Cylinders3D(lengths=[size[1]], radii=[size[0]], colors=colours, fill_mode=solid)
        case "capsule":
            # Its origin is the middle of one cap.
            middle = [[0.0, 0.0, -size[1] / 2]]
            return rr.Capsules3D(lengths=[size[1]], radii=[size[0]], translations=middle, colors=colours, fill_mode=solid)
        case "mesh":
            normals = _normals(shape)
            return rr.Mesh3D(
                vertex_positions=shape.vertices, triangle_indices=shape.faces, vertex_normals=normals, albedo_factor=colour
            )
    raise ValueError(f"a shape of kind {shape.kind!r}")


def _normals(shape: Shape) -> Array:
    a, b, c = (shape.vertices[shape.faces[:, k]] for k in range(3))
    face, out = np.cross(b - a, c - a), np.zeros_like(shape.vertices)
    for k in range(3):
        np.add.at(out, shape.faces[:, k], face)
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300))


def _eye(played: Playback) -> rrb.EyeControls3D:
    """A camera that sees all motions, across the direction in which they are shallowest."""
    places = np.concatenate([_places(played, m) for m in played.motions])
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    spans = [np.ptp(_places(played, m), axis=0) for m in played.motions]
    flat = int(np.argmin(np.max(spans, axis=0)))
    away = np.array([[1.0, -_ASIDE, _ABOVE], [_ASIDE, -1.0, _ABOVE], [0.0, -0.8, 1.0]][flat])
    away /= np.linalg.norm(away)
    aside = np.cross([0.0, 0.0, 1.0], away)
    aside /= np.linalg.norm(aside)
    across, up, deep = (np.abs((places - middle) @ axis) for axis in (aside, np.cross(away, aside), away))
    # Cells are about twice as wide as high; what is nearer looks larger.
    distance = _AWAY * max(float(up.max()), float(across.max()) / 1.9, 1e-3) + float(deep.max())
    return rrb.EyeControls3D(position=middle + distance * away, look_target=middle, eye_up=[0.0, 0.0, 1.0])


def _places(played: Playback, motion: Motion) -> Array:
    """Corners of the boxes around the shapes that are no ground, over a motion: (·, 3)."""
    out = [np.zeros((0, 3))]
    for shape in played.shapes:
        if shape.kind == "plane":
            continue
        half = _half(shape)
        signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
        corners = _moved(shape.place[None], signs * half)[0]
        out.append(_moved(motion.poses[:, shape.link], corners).reshape(-1, 3))
    return np.concatenate(out) if len(out) > 1 else motion.poses[:, :, :3].reshape(-1, 3)


def _half(shape: Shape) -> Array:
    match shape.kind:
        case "box" | "ellipsoid":
            return shape.size
        case "sphere":
            return np.repeat(shape.size, 3)
        case "mesh":
            return np.asarray(np.abs(shape.vertices).max(axis=0))
    radius, length = shape.size
    return np.array([radius, radius, length / 2 + (radius if shape.kind == "capsule" else 0.0)])


def _moved(poses: Array, points: Array) -> Array:
    """Points (k, 3) under poses (n, 7): (n, k, 3)."""
    w, v = poses[:, None, 3:4], poses[:, None, 4:]
    turned = np.cross(v, np.cross(v, points[None]) + w * points[None])
    return np.asarray(points[None] + 2 * turned + poses[:, None, :3])
