"""The section `bodies` as mass matrix and right-hand sides, recorded."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gapcert_equations.config import BodyConfig, EquationsConfig
from gapcert_equations.programs.tape import Recorder
from gapcert_equations.text import checks, units
from gapcert_equations.text.sympy_text import symbol
from gapcert_equations.text.units import METRE

from .bodies import Body, mechanics
from .rigid import gravity

Read = Callable[[str, str], Any]
Moving = tuple[list[Body], list[Any], list[list[Any]], list[Any]]


def terms(config: EquationsConfig, recorder: Recorder, read: Read) -> tuple[list[list[Any]], list[Any]]:
    """(M, forces − bias) in the order of the coordinates: numbers or Values; `read` turns (path, text) into an expression."""
    sections = list((config.bodies or {}).items())
    names, order = list(config.coordinates), [b.joint for _, b in sections if b.joint is not None]

    def number(path: str, text: str) -> Any:
        return recorder.value(read(path, text))

    def moving() -> Moving:
        tree = [_body(name, b, [n for n, _ in sections], config, number) for name, b in sections]
        q, v = ([recorder.value(symbol(f"{b.joint}{end}")) if b.joint else 0.0 for _, b in sections] for end in ("", "_dot"))
        armature = [number(f"bodies.{name}.armature", b.armature) for name, b in sections]
        return tree, q, *mechanics(tree, q, v, down, armature)

    falling = gravity(config, read, 3)
    down = [recorder.value(g) for g in falling]
    # An effect seldom changes the bodies themselves.
    tree, q, mass, bias = recorder.once((config.model_dump_json(include={"bodies", "coordinates"}), *falling), moving)
    still = [0.0] * len(tree)
    for n, text in config.tilt.items():
        # As for any mechanical model: what gravity does at rest is taken at q − angle.
        angle = number(f"tilt.{n}", text)
        turned = [a - angle if b.joint == n else a for a, (_, b) in zip(q, sections, strict=True)]
        rest, moved = (mechanics(tree, at, still, down, still)[1] for at in (q, turned))
        bias = [b - r + m for b, r, m in zip(bias, rest, moved, strict=True)]
    place = [order.index(n) for n in names]
    forces = [number(f"forces.{n}", config.forces.get(n, "0")) for n in names]
    return [[mass[i][j] for j in place] for i in place], [f - bias[i] for f, i in zip(forces, place, strict=True)]


def _body(name: str, b: BodyConfig, earlier: list[str], config: EquationsConfig, number: Callable[[str, str], Any]) -> Body:
    at, com = (
        [number(f"bodies.{name}.{k}.{i}", t) for i, t in enumerate(place)] for k, place in (("at", b.at), ("com", b.com))
    )
    xx, yy, zz, xy, xz, yz = (*(number(f"bodies.{name}.inertia.{i}", t) for i, t in enumerate(b.inertia)), 0.0, 0.0, 0.0)[:6]
    axis = np.array(b.axis) / np.linalg.norm(b.axis)
    kind = "fixed"
    if b.joint is not None:
        straight = units.unit(checks.axes(config.coordinates)[b.joint].unit)[0] == METRE
        kind = "prismatic" if straight else "revolute"
    return Body(
        -1 if b.on is None else earlier.index(b.on),
        at,
        _rotation(np.array(b.turned) / np.linalg.norm(b.turned)),
        axis.tolist(),
        kind,
        number(f"bodies.{name}.mass", b.mass),
        com,
        [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]],
        [number(f"bodies.{name}.drag.{k}.{i}", t) for k in ("linear", "angular") for i, t in enumerate(getattr(b.drag, k))],
    )


def _rotation(quaternion: Any) -> list[list[float]]:
    w, (x, y, z) = float(quaternion[0]), quaternion[1:].tolist()
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
