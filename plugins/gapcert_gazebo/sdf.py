"""The text of an SDF world: read, completed, and what Gazebo finds in it as plain data."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final
from xml.parsers import expat

from gapcert import UsageError
from gapcert_engines import Joint, Link

_NEVER = 1e15  # larger ones are no limits, as in SDF
_GROUND = """<model name="gapcert_ground"><static>true</static><link name="plane"><collision name="plane">
<geometry><plane><normal>0 0 1</normal></plane></geometry>
<surface><friction><ode><mu>{mu!r}</mu><mu2>{mu!r}</mu2></ode></friction></surface></collision></link></model>
"""


def world_text(path: Path, ground: float | None) -> str:
    """The file as one world, which is put around a model that has none, with the plane z = 0 where it is asked for."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise UsageError(f"robot: {path}: {reason}; expected an SDF file") from None
    try:
        expat.ParserCreate().Parse(text, True)
    except expat.ExpatError as error:
        raise UsageError(f"robot: {path}: {error}; expected well-formed XML") from None
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    head = re.search(r"<sdf\b[^>]*>", text)
    if head is None or "</sdf>" not in text:
        raise UsageError(f"robot: {path}: found no <sdf> element; expected an SDF file with a world or a model")
    if re.search(r"<include\b", text):
        raise UsageError(f"robot: {path}: it includes other files; write it out as one with `ign sdf -p`")
    body, tail = text[head.end() :].rsplit("</sdf>", 1)
    if not re.search(r"<world\b", body):
        body = f'<world name="default">{body}</world>'
    if ground is not None:
        before, after = body.rsplit("</world>", 1)
        body = f"{before}{_GROUND.format(mu=ground)}</world>{after}"
    return f"{text[: head.end()]}{body}</sdf>{tail}"


@final
@dataclass(frozen=True)
class Description:
    """What the shim says of a robot: its joints with their dry friction, masses of its links, the world around it.

    stiff: joints with limits of position and without one of effort, which Gazebo's rate motor drives through their limits.
    carried: of every joint its name, parent and child, and the numbers that `links` reads.
    """

    joints: tuple[Joint, ...]
    friction: Mapping[str, float]
    masses: Mapping[str, float]
    stiff: tuple[str, ...]
    gravity: tuple[float, ...]
    base: tuple[float, ...]
    touches: bool
    engine: str
    model: str
    carried: tuple[tuple[str, ...], ...]

    @classmethod
    def parse(cls, text: str) -> Description:
        """One tab-separated line per fact."""
        found: dict[str, list[list[str]]] = {}
        for key, *rest in (line.split("\t") for line in text.splitlines()):
            found.setdefault(key, []).append(rest)
        joints = found.get("joint", [])
        return cls(
            tuple(_joint(*parts) for parts in joints),
            {name: float(friction) for name, _, _, friction, *_ in joints},
            {name: float(mass) for name, mass in found["link"]},
            tuple(name for name, _, _, _, limited, bounded, *_ in joints if (limited, bounded) == ("1", "0")),
            tuple(map(float, found["gravity"][0])),
            tuple(map(float, found.get("base", [[]])[0])),
            found["touches"] == [["1"]],
            found["engine"][0][0],
            found["model"][0][0],
            tuple(map(tuple, found.get("carried", []))),
        )

    def links(self, coordinates: Mapping[str, str], stated: Mapping[str, float]) -> list[Link] | None:
        """None for more than a tree; coordinates: joint → coordinate; stated: native parameters."""
        slides = {j.name for j in self.joints if j.type == "prismatic"}
        waiting = [(joint, parent, child, tuple(map(float, rest))) for joint, parent, child, *rest in self.carried]
        if len(waiting) != len(self.joints) or {child for _, _, child, _ in waiting} != set(self.masses):
            return None
        found: dict[str, Link] = {}
        while waiting:
            ready = [w for w in waiting if w[1] == "world" or w[1] in found]
            if not ready or any(w[2] in found for w in ready):
                return None
            for joint, parent, child, n in ready:
                found[child] = Link(
                    child,
                    None if parent == "world" else parent,
                    (n[0], n[1], n[2]),
                    (n[3], n[4], n[5], n[6]),
                    coordinates.get(joint),
                    joint,
                    joint in slides,
                    (n[7], n[8], n[9]),
                    stated.get(f"mass.{child}", self.masses[child]),
                    (n[10], n[11], n[12]),
                    (n[13], n[14], n[15], n[16], n[17], n[18]),
                    damping=stated.get(f"damping.{joint}"),
                    dry=stated.get(f"coulomb_friction.{joint}"),
                    stiffness=n[19],
                    rest=n[20],
                )
                waiting.remove((joint, parent, child, n))
        return list(found.values())


def _joint(name: str, kind: Any, damping: str, _friction: str, limited: str, _bounded: str, *ends: str) -> Joint:
    # What is as large as SDF's default is no end.
    low, high, speed, effort = (e if abs(e) < _NEVER else math.copysign(math.inf, e) for e in map(float, ends))
    # A negative limit means none.
    speed, effort = (math.inf if e < 0 else e for e in (speed, effort))
    return Joint(name, kind, float(damping), limited == "1", 0.0, (low, high), (-speed, speed), (-effort, effort))
