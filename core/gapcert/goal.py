"""What a controller is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
import numpy.typing as npt

from gapcert.domain import Box, Domain
from gapcert.errors import UsageError
from gapcert.system import Array, StateSpec

TURN = 2 * np.pi


def turned(box: Box, x: Array) -> Array:
    """x (n, axes) with every angle outside the box moved by whole turns to the one nearest to the box's centre."""
    for j, axis in enumerate(box.axes):
        if axis.kind != "angle":
            continue
        column, low, high = x[:, j], box.low[j], box.high[j]
        out = ((column < low) | (column > high)) & np.isfinite(column)
        if out.any():
            x = x.copy()
            x[out, j] += TURN * np.round(((low + high) / 2 - column[out]) / TURN)
    return x


@final
@dataclass(frozen=True)
class Region:
    """A union of boxes in the state space."""

    boxes: tuple[Box, ...]

    def contains(self, x: Array) -> npt.NDArray[np.bool_]:
        """(n,) booleans; angles count modulo a turn, NaN is outside."""
        inside = np.zeros(len(x), dtype=bool)
        for box in self.boxes:
            inside |= box.contains(turned(box, x))
        return inside


@final
@dataclass(frozen=True)
class Goal:
    """`invariance`: stay in `stay` for ever. `reach_avoid`: reach `target`, never touch `avoid`, and stay in `stay` until then.

    `stay` defaults to the domain's state box. UsageError where the parts do not fit together.
    """

    kind: Literal["invariance", "reach_avoid"]
    stay: Box
    target: Region | None = None
    avoid: Region | None = None

    def __post_init__(self) -> None:
        if self.kind not in ("invariance", "reach_avoid"):
            raise UsageError(f"goal: kind '{self.kind}' is unknown; use invariance or reach_avoid")
        if (self.kind == "reach_avoid") != (self.target is not None and bool(self.target.boxes)):
            wanted = "needs a target" if self.kind == "reach_avoid" else "has no target; use reach_avoid, or leave it out"
            raise UsageError(f"goal: {self.kind} {wanted}")
        for part, region in (("target", self.target), ("avoid", self.avoid)):
            for box in region.boxes if region else ():
                if box.axes != self.stay.axes:
                    raise UsageError(f"goal: {part} is over {', '.join(box.names)}; expected {', '.join(self.stay.names)}")
                if part == "target":
                    _inside("target", box, "stay", self.stay)

    def check(self, domain: Domain) -> None:
        """UsageError unless the goal lies inside the domain."""
        if self.stay.axes != domain.states.axes:
            names = ", ".join(domain.states.names)
            raise UsageError(f"goal: stay is over {', '.join(self.stay.names)}; expected the model's states {names}")
        _inside("stay", self.stay, "the domain", domain.states)

    def holds(self, x: Array) -> npt.NDArray[np.bool_]:
        """(n,) booleans: in `stay` and not in `avoid`, for states (n, nx)."""
        inside = np.asarray(self.stay.contains(turned(self.stay, x)))
        return inside if self.avoid is None else inside & ~self.avoid.contains(x)

    def reached(self, x: Array) -> npt.NDArray[np.bool_]:
        """(n,) booleans: the goal is over, successfully."""
        return np.zeros(len(x), dtype=bool) if self.target is None else self.target.contains(x) & self.holds(x)

    def to_data(self) -> dict[str, Any]:
        """JSON-able; `from_data` is its inverse, bit for bit."""
        data: dict[str, Any] = {
            "kind": self.kind,
            "axes": [[a.name, a.unit, a.kind] for a in self.stay.axes],
            "stay": _bounds(self.stay),
        }
        regions = {"target": self.target, "avoid": self.avoid}
        return data | {name: [_bounds(b) for b in region.boxes] for name, region in regions.items() if region is not None}

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> Goal:
        axes = tuple(StateSpec(*a) for a in data["axes"])

        def region(name: str) -> Region | None:
            return Region(tuple(_box(axes, b) for b in data[name])) if name in data else None

        return cls(data["kind"], _box(axes, data["stay"]), region("target"), region("avoid"))


def _inside(name: str, inner: Box, frame: str, outer: Box) -> None:
    for axis, a, b, low, high in zip(inner.axes, inner.low, inner.high, outer.low, outer.high, strict=True):
        if a < low or b > high:
            raise UsageError(
                f"goal: {name} asks for {axis.name} in [{a:g}, {b:g}] {axis.unit}, but {frame} is [{low:g}, {high:g}]; "
                f"narrow the goal or widen {frame}"
            )


def _bounds(box: Box) -> dict[str, list[float]]:
    return {a.name: [low, high] for a, low, high in zip(box.axes, box.low, box.high, strict=True)}


def _box(axes: tuple[StateSpec, ...], bounds: Mapping[str, Any]) -> Box:
    return Box(axes, tuple(float(bounds[a.name][0]) for a in axes), tuple(float(bounds[a.name][1]) for a in axes))
