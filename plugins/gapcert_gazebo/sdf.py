"""The text of an SDF world: read, completed, and what Gazebo finds in it as plain data."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, final
from xml.parsers import expat

from gapcert import UsageError
from gapcert_engines import Joint

_TYPES: dict[str, Literal["revolute", "prismatic", "fixed"]] = {
    "revolute": "revolute",
    "prismatic": "prismatic",
    "fixed": "fixed",
}
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


def _joint(name: str, kind: str, damping: str, _friction: str, limited: str, _bounded: str, *ends: str) -> Joint:
    # What is as large as SDF's default is no end.
    low, high, speed, effort = (e if abs(e) < _NEVER else math.copysign(math.inf, e) for e in map(float, ends))
    # A negative limit means none.
    speed, effort = (math.inf if e < 0 else e for e in (speed, effort))
    return Joint(
        name,
        _TYPES[kind],
        float(damping),
        limited == "1",
        ends=(low, high),
        speeds=(-speed, speed),
        efforts=(-effort, effort),
    )
