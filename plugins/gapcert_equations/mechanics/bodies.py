"""The section `bodies`, rigid bodies joined in a tree: mass matrix and bias by recursion, recorded as straight-line code.

Composite bodies give M, Newton–Euler without accelerations the bias (Featherstone, Rigid Body Dynamics Algorithms, 2008,
chapters 5 and 6), in 3-vectors of each body's own frame. What is zero or one in the numbers of a robot is no operation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert_equations.config import BodyConfig, EquationsConfig
from gapcert_equations.programs.tape import Recorder, Value
from gapcert_equations.text import declarations, units
from gapcert_equations.text.sympy_text import symbol
from gapcert_equations.text.units import METRE

from .rigid import Read, gravity

_TINY = 1e-300
Vector = list[Any]
Matrix = list[Vector]


def terms(config: EquationsConfig, recorder: Recorder, read: Read) -> tuple[Matrix, Vector]:
    """(M, forces − bias) in the order of the coordinates: numbers or Values; `read` turns (path, text) into an expression."""
    sections = list((config.bodies or {}).items())
    names, order = list(config.coordinates), [b.joint for _, b in sections if b.joint is not None]

    def number(path: str, text: str) -> Any:
        return recorder.value(read(path, text))

    def moving() -> tuple[list[_Body], Vector, Matrix, Vector]:
        tree = [_body(name, b, [n for n, _ in sections], config, number) for name, b in sections]
        q, v = ([recorder.value(symbol(f"{b.joint}{end}")) if b.joint else 0.0 for _, b in sections] for end in ("", "_dot"))
        armature = [number(f"bodies.{name}.armature", b.armature) for name, b in sections]
        return tree, q, *_mechanics(tree, q, v, down, armature)

    falling = gravity(config, read, 3)
    down = [recorder.value(g) for g in falling]
    # An effect seldom changes the bodies themselves.
    tree, q, mass, bias = recorder.once((config.model_dump_json(include={"bodies", "coordinates"}), *falling), moving)
    still = [0.0] * len(tree)
    for n, text in config.tilt.items():
        # As for any mechanical model: what gravity does at rest is taken at q − angle.
        angle = number(f"tilt.{n}", text)
        turned = [a - angle if b.joint == n else a for a, (_, b) in zip(q, sections, strict=True)]
        rest, moved = (_mechanics(tree, at, still, down, still)[1] for at in (q, turned))
        bias = [b - r + m for b, r, m in zip(bias, rest, moved, strict=True)]
    place = [order.index(n) for n in names]
    forces = [number(f"forces.{n}", config.forces.get(n, "0")) for n in names]
    return [[mass[i][j] for j in place] for i in place], [f - bias[i] for f, i in zip(forces, place, strict=True)]


@final
@dataclass(frozen=True)
class _Body:
    """A body on its `parent` (index, −1: the world). Its frame is the joint's: at `place` in the parent's frame, turned by
    `turn` (3, 3) when q = 0; `axis` is the joint's unit vector there, `kind` what q does along it: revolute, prismatic, or
    fixed, where there is no q. drag (a, b, c, d) is the force −m v (a + b |v|) on the centre of mass and the torque
    −I ω (c + d |ω|).

    place, mass, com, inertia (3, 3) about com, drag: numbers or Values.
    """

    parent: int
    place: Vector
    turn: Matrix
    axis: Vector
    kind: str
    mass: Any
    com: Vector
    inertia: Matrix
    drag: Vector


def _body(name: str, b: BodyConfig, earlier: list[str], config: EquationsConfig, number: Callable[[str, str], Any]) -> _Body:
    at, com = (
        [number(f"bodies.{name}.{k}.{i}", t) for i, t in enumerate(place)] for k, place in (("at", b.at), ("com", b.com))
    )
    xx, yy, zz, xy, xz, yz = (*(number(f"bodies.{name}.inertia.{i}", t) for i, t in enumerate(b.inertia)), 0.0, 0.0, 0.0)[:6]
    axis = np.array(b.axis) / np.linalg.norm(b.axis)
    kind = "fixed"
    if b.joint is not None:
        straight = units.unit(declarations.axes(config.coordinates)[b.joint].unit)[0] == METRE
        kind = "prismatic" if straight else "revolute"
    return _Body(
        -1 if b.on is None else earlier.index(b.on),
        at,
        _of_quaternion(np.array(b.turned) / np.linalg.norm(b.turned)),
        axis.tolist(),
        kind,
        number(f"bodies.{name}.mass", b.mass),
        com,
        [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]],
        [number(f"bodies.{name}.drag.{k}.{i}", t) for k in ("linear", "angular") for i, t in enumerate(getattr(b.drag, k))],
    )


def _of_quaternion(quaternion: Any) -> Matrix:
    w, (x, y, z) = float(quaternion[0]), quaternion[1:].tolist()
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def _mechanics(bodies: Sequence[_Body], q: Vector, v: Vector, gravity: Vector, armature: Vector) -> tuple[Matrix, Vector]:
    """(M, bias) of the bodies that move, in order: q[i], v[i] are those of body i, and armature[i] is added to M's diagonal
    (anything where it is fixed); gravity (3,) in the world's frame. Drag is part of the bias.
    """
    turns, places = _poses(bodies, q)
    mass, bias = _mass(bodies, turns, places), _bias(bodies, turns, places, v, gravity)
    moved = [i for i, b in enumerate(bodies) if b.kind != "fixed"]
    for i in moved:
        mass[i][i] = mass[i][i] + armature[i]
    return [[mass[i][j] for j in moved] for i in moved], [bias[i] for i in moved]


def _poses(bodies: Sequence[_Body], q: Vector) -> tuple[list[Matrix], list[Vector]]:
    """Of every body's frame in its parent's: rotation and origin."""
    turns: list[Matrix] = []
    places: list[Vector] = []
    for b, angle in zip(bodies, q, strict=True):
        fixed = b.turn
        if b.kind == "revolute":
            turns.append(_product(fixed, _rotation(b.axis, angle)))
            places.append(b.place)
        else:
            turns.append(fixed)
            slid = b.kind == "prismatic"
            places.append(_add(b.place, _scale(angle, _apply(fixed, b.axis))) if slid else b.place)
    return turns, places


def _rotation(a: Vector, angle: Any) -> Matrix:
    """By Rodrigues: 1 + sin K + (1 − cos) K²."""
    s, c = angle.sin(), angle.cos()
    cross = [[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]]
    out = []
    for i in range(3):
        row = []
        for j in range(3):
            outer = a[i] * a[j]
            # cos (δ − aᵢaⱼ) + aᵢaⱼ + sin Kᵢⱼ: one cosine where the axis is a frame's own.
            row.append(c * (float(i == j) - outer) + outer + s * cross[i][j])
        out.append(row)
    return out


def _mass(bodies: Sequence[_Body], turns: list[Matrix], places: list[Vector]) -> Matrix:
    n = len(bodies)
    mass = [b.mass for b in bodies]
    moment = [_scale(b.mass, b.com) for b in bodies]
    inertia = [_about_origin(b) for b in bodies]
    for i in reversed(range(n)):
        p = bodies[i].parent
        if p >= 0:
            m, r, h = mass[i], places[i], _apply(turns[i], moment[i])
            turned = _product(_product(turns[i], inertia[i]), _transposed(turns[i]))
            moved = [_add(a, b) for a, b in zip(_spread(r, h), _spread(h, r), strict=True)]
            inertia[p] = _sum(inertia[p], _sum(turned, _sum(moved, [_scale(m, row) for row in _spread(r, r)])))
            mass[p], moment[p] = mass[p] + m, _add(moment[p], _add(h, _scale(m, r)))
    out: Matrix = [[0.0] * n for _ in range(n)]
    for j in range(n):
        a = bodies[j].axis
        if bodies[j].kind == "fixed":
            continue
        if bodies[j].kind == "revolute":
            force, torque = _cross(a, moment[j]), _apply(inertia[j], a)
        else:
            force, torque = _scale(mass[j], a), _cross(moment[j], a)
        i = j
        while True:
            if bodies[i].kind != "fixed":
                out[i][j] = out[j][i] = _dot(bodies[i].axis, torque if bodies[i].kind == "revolute" else force)
            if bodies[i].parent < 0:
                break
            force = _apply(turns[i], force)
            torque = _add(_apply(turns[i], torque), _cross(places[i], force))
            i = bodies[i].parent
    return out


def _bias(bodies: Sequence[_Body], turns: list[Matrix], places: list[Vector], v: Vector, gravity: Vector) -> Vector:
    zero, dragged = [0.0, 0.0, 0.0], any(isinstance(d, Value) or d for b in bodies for d in b.drag)
    spin: list[Vector] = []
    speed: list[Vector] = []
    turning: list[Vector] = []
    rising: list[Vector] = []
    forces: list[Vector] = []
    torques: list[Vector] = []
    for i, b in enumerate(bodies):
        # The world accelerates against gravity.
        w, dw, a, moves = (
            (spin[b.parent], turning[b.parent], rising[b.parent], speed[b.parent])
            if b.parent >= 0
            else (zero, zero, _scale(-1.0, gravity), zero)
        )
        back, r = _transposed(turns[i]), places[i]
        rate = zero if b.kind == "fixed" else _scale(v[i], b.axis)
        here = _apply(back, w)
        rise = _apply(back, _add(a, _add(_cross(dw, r), _cross(w, _cross(w, r)))))
        turn = _apply(back, dw)
        move = _apply(back, _add(moves, _cross(w, r))) if dragged else zero
        if b.kind == "revolute":
            turn, here = _add(turn, _cross(here, rate)), _add(here, rate)
        elif b.kind == "prismatic":
            rise, move = _add(rise, _scale(2.0, _cross(here, rate))), _add(move, rate)
        com, inertia = b.com, b.inertia
        centre = _add(rise, _add(_cross(turn, com), _cross(here, _cross(here, com))))
        momentum = _apply(inertia, here)
        force = _scale(b.mass, centre)
        torque = _add(_apply(inertia, turn), _cross(here, momentum))
        if dragged:
            push, twist = _drag(b, _add(move, _cross(here, com)), here, momentum)
            force, torque = _add(force, push), _add(torque, twist)
        torque = _add(torque, _cross(com, force))
        for known, new in zip(
            (spin, speed, turning, rising, forces, torques), (here, move, turn, rise, force, torque), strict=True
        ):
            known.append(new)
    out: Vector = [0.0] * len(bodies)
    for i in reversed(range(len(bodies))):
        b = bodies[i]
        if b.kind != "fixed":
            out[i] = _dot(b.axis, torques[i] if b.kind == "revolute" else forces[i])
        if b.parent >= 0:
            force = _apply(turns[i], forces[i])
            forces[b.parent] = _add(forces[b.parent], force)
            torques[b.parent] = _add(torques[b.parent], _add(_apply(turns[i], torques[i]), _cross(places[i], force)))
    return out


def _drag(b: _Body, v: Vector, w: Vector, momentum: Vector) -> tuple[Vector, Vector]:
    """What holds a body back: m v (a + b |v|), and I ω (c + d |ω|) of its momentum I ω."""
    linear, square, angular, twice = b.drag
    push = _scale(b.mass * (linear + square * _length(v)), v)
    return push, _scale(angular + twice * _length(w), momentum)


def _length(a: Vector) -> Any:
    """|a|; the root has a slope everywhere, since its argument is kept above what float64 squares can be told from."""
    left = [x for x in a if isinstance(x, Value) or x]
    if len(left) < 2:
        return abs(left[0]) if left else 0.0
    square = _dot(a, a)
    return square.max(_TINY).sqrt() if isinstance(square, Value) else math.sqrt(square)


def _about_origin(b: _Body) -> Matrix:
    com = b.com
    return _sum(b.inertia, [_scale(b.mass, row) for row in _spread(com, com)])


def _spread(a: Vector, b: Vector) -> Matrix:
    """(a·b) 1 − b aᵀ: what a mass at a distance adds to an inertia."""
    inner = _dot(a, b)
    return [[(inner if i == j else 0.0) - b[i] * a[j] for j in range(3)] for i in range(3)]


def _dot(a: Vector, b: Vector) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _add(a: Vector, b: Vector) -> Vector:
    return [x + y for x, y in zip(a, b, strict=True)]


def _scale(s: Any, a: Vector) -> Vector:
    return [s * x for x in a]


def _apply(m: Matrix, a: Vector) -> Vector:
    return [_dot(row, a) for row in m]


def _product(a: Matrix, b: Matrix) -> Matrix:
    columns = _transposed(b)
    return [[_dot(row, column) for column in columns] for row in a]


def _transposed(m: Matrix) -> Matrix:
    return [list(column) for column in zip(*m, strict=True)]


def _sum(a: Matrix, b: Matrix) -> Matrix:
    return [_add(x, y) for x, y in zip(a, b, strict=True)]
