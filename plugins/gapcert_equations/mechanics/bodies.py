"""Rigid bodies joined in a tree: mass matrix and bias by recursion over the bodies, recorded as straight-line code.

Composite bodies give M, Newton–Euler without accelerations the bias (Featherstone, Rigid Body Dynamics Algorithms, 2008,
chapters 5 and 6), in 3-vectors of each body's own frame. What is zero or one in the numbers of a robot is no operation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

from gapcert_equations.programs.tape import Value

_TINY = 1e-300
Vector = list[Any]
Matrix = list[Vector]


@final
@dataclass(frozen=True)
class Body:
    """A body on its `parent` (index, −1: the world). Its frame is the joint's: at `place` in the parent's frame, turned by
    `turn` (3, 3) when q = 0; `axis` is the joint's unit vector there, `kind` what q does along it: revolute, prismatic, or
    fixed, where there is no q. drag (a, b, c, d) is the force −m v (a + b |v|) on the centre of mass and the torque
    −I ω (c + d |ω|).

    place, mass, com, inertia (3, 3) about com, drag: numbers or Values.
    """

    parent: int
    place: Sequence[Any]
    turn: Sequence[Sequence[float]]
    axis: Sequence[float]
    kind: str
    mass: Any
    com: Sequence[Any]
    inertia: Sequence[Sequence[Any]]
    drag: Sequence[Any] = (0.0, 0.0, 0.0, 0.0)


def mechanics(
    bodies: Sequence[Body], q: Sequence[Any], v: Sequence[Any], gravity: Sequence[Any], armature: Sequence[Any]
) -> tuple[Matrix, Vector]:
    """(M, bias) of the bodies that move, in order: q[i], v[i] are those of body i, and armature[i] is added to M's diagonal
    (anything where it is fixed); gravity (3,) in the world's frame. Drag is part of the bias.
    """
    turns, places = _poses(bodies, q)
    mass, bias = _mass(bodies, turns, places), _bias(bodies, turns, places, v, gravity)
    moved = [i for i, b in enumerate(bodies) if b.kind != "fixed"]
    for i in moved:
        mass[i][i] = mass[i][i] + armature[i]
    return [[mass[i][j] for j in moved] for i in moved], [bias[i] for i in moved]


def _poses(bodies: Sequence[Body], q: Sequence[Any]) -> tuple[list[Matrix], list[Vector]]:
    """Of every body's frame in its parent's: rotation and origin."""
    turns: list[Matrix] = []
    places: list[Vector] = []
    for b, angle in zip(bodies, q, strict=True):
        fixed = [list(row) for row in b.turn]
        if b.kind == "revolute":
            turns.append(_product(fixed, _rotation(list(b.axis), angle)))
            places.append(list(b.place))
        else:
            turns.append(fixed)
            slid = b.kind == "prismatic"
            places.append(_add(list(b.place), _scale(angle, _apply(fixed, list(b.axis)))) if slid else list(b.place))
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


def _mass(bodies: Sequence[Body], turns: list[Matrix], places: list[Vector]) -> Matrix:
    n = len(bodies)
    mass = [b.mass for b in bodies]
    moment = [_scale(b.mass, list(b.com)) for b in bodies]
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
        a = list(bodies[j].axis)
        if bodies[j].kind == "fixed":
            continue
        if bodies[j].kind == "revolute":
            force, torque = _cross(a, moment[j]), _apply(inertia[j], a)
        else:
            force, torque = _scale(mass[j], a), _cross(moment[j], a)
        i = j
        while True:
            if bodies[i].kind != "fixed":
                out[i][j] = out[j][i] = _dot(list(bodies[i].axis), torque if bodies[i].kind == "revolute" else force)
            if bodies[i].parent < 0:
                break
            force = _apply(turns[i], force)
            torque = _add(_apply(turns[i], torque), _cross(places[i], force))
            i = bodies[i].parent
    return out


def _bias(
    bodies: Sequence[Body], turns: list[Matrix], places: list[Vector], v: Sequence[Any], gravity: Sequence[Any]
) -> Vector:
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
            else (zero, zero, _scale(-1.0, list(gravity)), zero)
        )
        back, r = _transposed(turns[i]), places[i]
        rate = zero if b.kind == "fixed" else _scale(v[i], list(b.axis))
        here = _apply(back, w)
        rise = _apply(back, _add(a, _add(_cross(dw, r), _cross(w, _cross(w, r)))))
        turn = _apply(back, dw)
        move = _apply(back, _add(moves, _cross(w, r))) if dragged else zero
        if b.kind == "revolute":
            turn, here = _add(turn, _cross(here, rate)), _add(here, rate)
        elif b.kind == "prismatic":
            rise, move = _add(rise, _scale(2.0, _cross(here, rate))), _add(move, rate)
        com, inertia = list(b.com), [list(row) for row in b.inertia]
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
            out[i] = _dot(list(b.axis), torques[i] if b.kind == "revolute" else forces[i])
        if b.parent >= 0:
            force = _apply(turns[i], forces[i])
            forces[b.parent] = _add(forces[b.parent], force)
            torques[b.parent] = _add(torques[b.parent], _add(_apply(turns[i], torques[i]), _cross(places[i], force)))
    return out


def _drag(b: Body, v: Vector, w: Vector, momentum: Vector) -> tuple[Vector, Vector]:
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


def _about_origin(b: Body) -> Matrix:
    com = list(b.com)
    return _sum([list(row) for row in b.inertia], [_scale(b.mass, row) for row in _spread(com, com)])


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
