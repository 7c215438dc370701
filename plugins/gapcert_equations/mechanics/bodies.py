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
import numpy.typing as npt

from gapcert_equations.config import BodyConfig, EquationsConfig
from gapcert_equations.programs.tape import Recorder, Value
from gapcert_equations.text import declarations, units
from gapcert_equations.text.sympy_text import symbol
from gapcert_equations.text.units import METRE

from .rigid import Read, gravity

_TINY = 1e-300
Vector = npt.NDArray[Any]
Matrix = npt.NDArray[Any]
"""Of numbers and Values, which operators of NumPy take from the left: `array * value`."""


def terms(config: EquationsConfig, recorder: Recorder, read: Read) -> tuple[list[list[Any]], list[Any]]:
    """(M, forces − bias) in the order of the coordinates: numbers or Values; `read` turns (path, text) into an expression."""
    sections = list((config.bodies or {}).items())
    names, order = list(config.coordinates), [b.joint for _, b in sections if b.joint is not None]

    def number(path: str, text: str) -> Any:
        return recorder.value(read(path, text))

    def moving() -> tuple[list[_Body], list[Any], list[list[Any]], list[Any]]:
        tree = [_body(name, b, [n for n, _ in sections], config, number) for name, b in sections]
        q, v = ([recorder.value(symbol(f"{b.joint}{end}")) if b.joint else 0.0 for _, b in sections] for end in ("", "_dot"))
        armature = [number(f"bodies.{name}.armature", b.armature) for name, b in sections]
        return tree, q, *_mechanics(tree, q, v, down, armature)

    falling = gravity(config, read, 3)
    down = _array([recorder.value(g) for g in falling])
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
    −I ω (c + d |ω|). Of its weight the share `lifted` is carried by something else.

    place, mass, com, inertia (3, 3) about com, drag, lifted: numbers or Values.
    """

    parent: int
    place: Vector
    turn: Matrix
    axis: Vector
    kind: str
    mass: Any
    com: Vector
    inertia: Matrix
    drag: Sequence[Any]
    lifted: Any


def _body(name: str, b: BodyConfig, earlier: list[str], config: EquationsConfig, number: Callable[[str, str], Any]) -> _Body:
    at, com = (_array([number(f"bodies.{name}.{k}.{i}", e) for i, e in enumerate(getattr(b, k))]) for k in ("at", "com"))
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
        _array(axis.tolist()),
        kind,
        number(f"bodies.{name}.mass", b.mass),
        com,
        _array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]),
        [number(f"bodies.{name}.drag.{k}.{i}", t) for k in ("linear", "angular") for i, t in enumerate(getattr(b.drag, k))],
        number(f"bodies.{name}.lifted", b.lifted),
    )


def _of_quaternion(quaternion: Any) -> Matrix:
    w, (x, y, z) = float(quaternion[0]), quaternion[1:].tolist()
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return _array(rows)


def _array(values: Sequence[Any]) -> npt.NDArray[Any]:
    return np.array(values, dtype=object)


def _mechanics(
    bodies: Sequence[_Body], q: Sequence[Any], v: Sequence[Any], gravity: Vector, armature: Sequence[Any]
) -> tuple[list[list[Any]], list[Any]]:
    """(M, bias) of the bodies that move, in order: q[i], v[i] are those of body i, and armature[i] is added to M's diagonal
    (anything where it is fixed); gravity (3,) in the world's frame. Drag is part of the bias.
    """
    turns, places = _poses(bodies, q)
    mass, bias = _mass(bodies, turns, places), _bias(bodies, turns, places, v, gravity)
    moved = [i for i, b in enumerate(bodies) if b.kind != "fixed"]
    for i in moved:
        mass[i][i] = mass[i][i] + armature[i]
    return [[mass[i][j] for j in moved] for i in moved], [bias[i] for i in moved]


def _poses(bodies: Sequence[_Body], q: Sequence[Any]) -> tuple[list[Matrix], list[Vector]]:
    """Of every body's frame in its parent's: rotation and origin."""
    turns = [b.turn @ _rotation(b.axis, angle) if b.kind == "revolute" else b.turn for b, angle in zip(bodies, q, strict=True)]
    slid = [b.place + (b.turn @ b.axis) * s if b.kind == "prismatic" else b.place for b, s in zip(bodies, q, strict=True)]
    return turns, slid


def _rotation(a: Vector, angle: Any) -> Matrix:
    """By Rodrigues: 1 + sin K + (1 − cos) K²."""
    s, c, outer = angle.sin(), angle.cos(), np.outer(a, a)
    cross = _array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
    # cos (δ − aᵢaⱼ) + aᵢaⱼ + sin Kᵢⱼ: one cosine where the axis is a frame's own.
    return np.asarray((np.eye(3) - outer) * c + outer + cross * s)


def _mass(bodies: Sequence[_Body], turns: list[Matrix], places: list[Vector]) -> list[list[Any]]:
    n = len(bodies)
    mass = [b.mass for b in bodies]
    moment = [b.com * b.mass for b in bodies]
    inertia = [b.inertia + _spread(b.com, b.com) * b.mass for b in bodies]
    for i in reversed(range(n)):
        p = bodies[i].parent
        if p >= 0:
            m, r, h = mass[i], places[i], turns[i] @ moment[i]
            turned, moved = turns[i] @ inertia[i] @ turns[i].T, _spread(r, h) + _spread(h, r)
            inertia[p] = inertia[p] + (turned + (moved + _spread(r, r) * m))
            mass[p], moment[p] = mass[p] + m, moment[p] + (h + r * m)
    out: list[list[Any]] = [[0.0] * n for _ in range(n)]
    for j in range(n):
        a = bodies[j].axis
        if bodies[j].kind == "fixed":
            continue
        if bodies[j].kind == "revolute":
            force, torque = _cross(a, moment[j]), inertia[j] @ a
        else:
            force, torque = a * mass[j], _cross(moment[j], a)
        i = j
        while True:
            if bodies[i].kind != "fixed":
                out[i][j] = out[j][i] = bodies[i].axis @ (torque if bodies[i].kind == "revolute" else force)
            if bodies[i].parent < 0:
                break
            force = turns[i] @ force
            torque = turns[i] @ torque + _cross(places[i], force)
            i = bodies[i].parent
    return out


def _bias(bodies: Sequence[_Body], turns: list[Matrix], places: list[Vector], v: Sequence[Any], gravity: Vector) -> list[Any]:
    zero, dragged = _array([0.0, 0.0, 0.0]), any(isinstance(d, Value) or d for b in bodies for d in b.drag)
    carried = any(isinstance(b.lifted, Value) or b.lifted for b in bodies)
    down: list[Vector] = []
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
            else (zero, zero, gravity * -1.0, zero)
        )
        back, r = turns[i].T, places[i]
        rate = zero if b.kind == "fixed" else b.axis * v[i]
        here, turn = back @ w, back @ dw
        rise = back @ (a + (_cross(dw, r) + _cross(w, _cross(w, r))))
        move = back @ (moves + _cross(w, r)) if dragged else zero
        if b.kind == "revolute":
            turn, here = turn + _cross(here, rate), here + rate
        elif b.kind == "prismatic":
            rise, move = rise + _cross(here, rate) * 2.0, move + rate
        centre = rise + (_cross(turn, b.com) + _cross(here, _cross(here, b.com)))
        momentum = b.inertia @ here
        force, torque = centre * b.mass, b.inertia @ turn + _cross(here, momentum)
        if dragged:
            push, twist = _drag(b, move + _cross(here, b.com), here, momentum)
            force, torque = force + push, torque + twist
        if carried:
            down.append(turns[i].T @ (down[b.parent] if b.parent >= 0 else gravity))
            force = force + down[i] * (b.mass * b.lifted)
        torque = torque + _cross(b.com, force)
        for known, new in zip(
            (spin, speed, turning, rising, forces, torques), (here, move, turn, rise, force, torque), strict=True
        ):
            known.append(new)
    out: list[Any] = [0.0] * len(bodies)
    for i in reversed(range(len(bodies))):
        b = bodies[i]
        if b.kind != "fixed":
            out[i] = b.axis @ (torques[i] if b.kind == "revolute" else forces[i])
        if b.parent >= 0:
            force = turns[i] @ forces[i]
            forces[b.parent] = forces[b.parent] + force
            torques[b.parent] = torques[b.parent] + (turns[i] @ torques[i] + _cross(places[i], force))
    return out


def _drag(b: _Body, v: Vector, w: Vector, momentum: Vector) -> tuple[Vector, Vector]:
    """What holds a body back: m v (a + b |v|), and I ω (c + d |ω|) of its momentum I ω."""
    linear, square, angular, twice = b.drag
    return v * (b.mass * (linear + square * _length(v))), momentum * (angular + twice * _length(w))


def _length(a: Vector) -> Any:
    """|a|; the root has a slope everywhere, since its argument is kept above what float64 squares can be told from."""
    left = [x for x in a if isinstance(x, Value) or x]
    if len(left) < 2:
        return abs(left[0]) if left else 0.0
    square = a @ a
    return square.max(_TINY).sqrt() if isinstance(square, Value) else math.sqrt(square)


def _spread(a: Vector, b: Vector) -> Matrix:
    """(a·b) 1 − b aᵀ: what a mass at a distance adds to an inertia."""
    return np.asarray(np.eye(3) * (a @ b) - np.outer(b, a))


def _cross(a: Vector, b: Vector) -> Vector:
    return _array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
