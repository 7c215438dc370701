"""What the report and the viewer draw of a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np

from gapcert.plugin import Array

from .playback import Channel, Playback

KINDS = {
    "static": "a law of the present state and input",
    "periodic": "a force that repeats over position",
    "input memory": "a memory of the input",
    "input hysteresis": "a play or a rate limit of the input",
    "position memory": "a memory of the position",
}
_PEOPLE = {"coulomb": "Coulomb", "stribeck": "Stribeck", "lugre": "LuGre", "dahl": "Dahl"}


def spoken(effect: str) -> str:
    """An effect's name in a sentence: `asymmetric-coulomb-friction` → `asymmetric Coulomb friction`."""
    return " ".join(_PEOPLE.get(word, word) for word in effect.split("-"))


def called(effect: str, site: str) -> str:
    """An effect at its site: `Coulomb friction at q`; a wrong parameter by its name: `parameter m`."""
    return f"parameter {site}" if effect == "parameter" else f"{spoken(effect)} at {site}"


def per_second(unit: str) -> str:
    """`rad` → `rad/s`, `m/s` → `(m/s)/s`."""
    return f"{unit}/s" if unit.isalnum() else f"({unit})/s"


@final
@dataclass(frozen=True)
class Law:
    """What is missing at a site against one quantity (points), and the law that was named (a line through `at`).

    half: 95 % half widths of the points, which are estimates per interval of x that assume no law; at, law: empty where none
    is named. shape: `line`, or `loop` for a law with memory, drawn in order of time, or `cloud` where the law depends on more
    than x; rising: of a loop, 1 where x grows at a point and 0 where it falls. lead: the picture that shows this law best.
    named: what the line is.
    """

    title: str
    x_label: str
    y_label: str
    x: Array
    y: Array
    at: Array
    law: Array
    half: Array = field(default_factory=lambda: np.empty(0))
    rising: Array = field(default_factory=lambda: np.empty(0))
    shape: str = "line"
    lead: bool = True
    named: str = "named law"


@final
@dataclass(frozen=True)
class Waterfall:
    """E, the held-out error over all channels, with the first k causes, in the order in which they were named."""

    labels: tuple[str, ...]
    error: Array


@final
@dataclass(frozen=True)
class Correlation:
    """Correlation of a channel's residual with itself, or with `against`, over the lag; |ρ| < band happens by chance."""

    channel: str
    against: str
    lag: Array
    before: Array
    after: Array
    band: float


@final
@dataclass(frozen=True)
class Course:
    """RMS residual of each window in units of the noise floor, over time and for one trajectory."""

    t: Array
    before: Array
    after: Array


@final
@dataclass(frozen=True)
class Signal:
    """Of the proposed experiment an input (T,), or a measured output or its speed as each rival foretells it (rivals, T).

    recorded: [low, high] of it in the recording, for what is foretold.
    """

    name: str
    unit: str
    t: Array
    values: Array
    recorded: Array = field(default_factory=lambda: np.empty(0))


@final
@dataclass(frozen=True)
class DiagnosisFigure:
    """Why wrong; the numbers are in the summary. playback: the held-out motions of the channels, made by an engine's robot."""

    channels: tuple[Channel, ...]
    laws: tuple[Law, ...]
    waterfall: Waterfall | None = None
    correlations: tuple[Correlation, ...] = ()
    courses: tuple[Course, ...] = ()
    experiment: tuple[Signal, ...] = ()
    playback: Playback | None = None
