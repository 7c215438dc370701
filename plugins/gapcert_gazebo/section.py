"""An SDF model as links on joints."""

from __future__ import annotations

from collections.abc import Mapping

from gapcert_engines import Link

from .sdf import Description


def links(d: Description, coordinates: Mapping[str, str], stated: Mapping[str, float]) -> list[Link] | None:
    """coordinates: joint → coordinate; stated: native parameters. None for more than a tree."""
    kinds = {j.name: j for j in d.joints}
    waiting = [(joint, parent, child, tuple(map(float, rest))) for joint, parent, child, *rest in d.carried]
    if len(waiting) != len(d.joints) or {child for _, _, child, _ in waiting} != set(d.masses):
        return None
    found: dict[str, Link] = {}
    while waiting:
        ready = [w for w in waiting if w[1] == "world" or w[1] in found]
        if not ready or any(w[2] in found for w in ready):
            return None
        for joint, parent, child, n in ready:
            kind = kinds[joint]
            found[child] = Link(
                child,
                None if parent == "world" else parent,
                (n[0], n[1], n[2]),
                (n[3], n[4], n[5], n[6]),
                coordinates.get(joint),
                joint,
                kind.type == "prismatic",
                (n[7], n[8], n[9]),
                stated.get(f"mass.{child}", d.masses[child]),
                (n[10], n[11], n[12]),
                (n[13], n[14], n[15], n[16], n[17], n[18]),
                damping=stated.get(f"damping.{joint}"),
                dry=stated.get(f"coulomb_friction.{joint}"),
                stiffness=n[19],
                rest=n[20],
            )
            waiting.remove((joint, parent, child, n))
    return list(found.values())
