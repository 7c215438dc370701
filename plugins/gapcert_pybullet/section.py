"""A robot in Bullet as links on joints, with Bullet's drag."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from gapcert import UsageError
from gapcert_engines import Link, as_section

from .client import Client, pybullet
from .rotation import inverse, product, rotated

_UNIT = 1e-10  # between an axis that was written in decimals and a unit vector; chosen, not measured


def section(client: Client, coordinates: Sequence[str], stated: Mapping[str, float], free: Mapping[str, str]) -> dict[str, Any]:
    """See Engine.section; stated: native parameters.

    Bullet takes damping from the velocity at the beginning of a step. Its drag holds every link back by m v k (1 + |v|) at its
    centre of mass, and by I ω l (1 + |ω|), with k its linear and l its angular damping (btMultiBody).
    """
    named = dict(zip(client.names, coordinates, strict=True))
    gravity = stated["gravity_x"], stated["gravity_y"], stated["gravity_z"]
    out = as_section(_links(client, named, stated), gravity, free, implicit=False)
    drag = {}
    for what, square in (("linear", "second/metre"), ("angular", "second")):
        name, number = free.get(f"{what}_damping"), stated[f"{what}_damping"]
        if name is not None:
            out["parameters"] |= {"metre": "1 m", "second": "1 s"}
            drag[what] = [name, f"{name}*{square}"]
        elif number:
            drag[what] = [repr(number)] * 2
    for body in out["bodies"].values() if drag else ():
        body["drag"] = drag
    return out


def _links(client: Client, coordinates: Mapping[str, str], stated: Mapping[str, float]) -> list[Link]:
    """Bullet has the frame of a link in its centre of mass, along the axes of its inertia, and says there where joints are."""
    found: list[Link] = []
    body, number = client.body, client.id
    base = pybullet.getBasePositionAndOrientation(body, number)
    for at, joint in enumerate(client.joints):
        info, dynamics = pybullet.getJointInfo(body, at, number), pybullet.getDynamicsInfo(body, at, number)
        mass, inertia, centre, axes = dynamics[0], dynamics[2], dynamics[3], dynamics[4]
        parent = None if info[16] < 0 else found[info[16]]
        # What Bullet calls the joint's rotation turns the parent's vectors into the link's.
        place, turn = info[14], inverse(info[15])
        if parent is None:
            place, turn = rotated(base[1], place), product(base[1], turn)
        x, y, z = (a + b for a, b in zip(place, base[0] if parent is None else parent.com, strict=True))
        i, j, k, w = turn
        link = Link(
            info[12].decode(),
            None if parent is None else parent.name,
            (x, y, z),
            (w, i, j, k),
            mass=mass,
            com=rotated(inverse(axes), centre),
            inertia=(*inertia, 0.0, 0.0, 0.0),
            moment=max(inertia),
        )
        if joint.movable:
            if abs(1 - (length := math.hypot(*info[13]))) > _UNIT:
                raise UsageError(
                    f"robot: the axis of joint '{joint.name}' is {length:.9g} long, and Bullet moves it by that much faster; "
                    f"expected a unit vector; write it with all its digits"
                )
            name, slides = joint.name, joint.type == "prismatic"
            link = replace(
                link,
                coordinate=coordinates[name],
                joint=name,
                straight=slides,
                axis=info[13],
                damping=stated[f"damping.{name}"],
                dry=stated[f"coulomb_friction.{name}"],
            )
        found.append(link)
    return found
