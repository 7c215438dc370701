"""Options that every engine understands; imports nothing heavy, since listing options must be cheap."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Annotated, Any, final

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, WithJsonSchema, field_validator

from gapcert.plugin import magnitude

Coefficient = Annotated[FiniteFloat, Field(ge=0)]
FEEDBACK = ("yaw", "yaw_rate")
"""What a drive may feed back besides the inputs: heading and turning rate of the base."""
_LOOSE = ("rotation", *(f"{kind}{axis}" for kind in ("", "v", "w") for axis in "xyz"))
"""Fields of what is no joint of one number."""


@final
class DriveConfig(BaseModel):
    """The base's own loop: each element (a joint, or what the engine offers besides) follows the rate
    Σ coefficient · quantity over inputs, `yaw` and `yaw_rate`, renewed `every` so many sub-steps.

    A joint is driven by the effort clip(gain · (target − rate), ±limit) in every sub-step; without a gain by the engine's own
    rate motor, within the limit.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    elements: dict[str, dict[str, FiniteFloat]] = Field(
        min_length=1, description="joint (or what the engine offers besides) → coefficients of inputs, `yaw` and `yaw_rate`"
    )
    gain: Annotated[FiniteFloat, Field(gt=0)] | None = Field(
        None, description="effort per rate error; default: the engine's own rate motor"
    )
    limit: Annotated[FiniteFloat, Field(gt=0)] | None = Field(None, description="largest effort, in N·m or N; default: none")
    every: int = Field(default=1, ge=1, description="sub-steps between two renewals of the target")


class EngineConfig(BaseModel, ABC):
    """`states` maps a state to `JOINT.position`, `JOINT.velocity` or, for a base that floats, `base.FIELD`; `inputs` maps an
    input to the joint that its effort drives, to `ACTUATOR.ctrl`, the control of an actuator of the file, or to `drive`; an
    effort in the place of such an actuator is `JOINT.effort`.

    Fields of the base, and of another body that is free, BODY.FIELD: x, y, z, vx, vy, vz, wx, wy, wz in the world's frame, and
    of the base with `rotation: euler` roll, pitch and yaw
    (turned in this order about the fixed axes; singular at a pitch of ±90°). `period` (default: the model's) is divided into
    `substeps` engine steps with one effort. `gravity` and `joint_damping` replace the file's (or the engine's default).
    `ground` is the friction coefficient of a plane z = 0 that is added. `tiles` copies are stepped at once where that gives the
    same bits; it never changes an answer.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    robot: Path = Field(description="the robot file, relative to the spec")
    fixed_base: bool = Field(True, description="is the base welded to the world, or does it float?")
    states: dict[str, str] = Field(min_length=1, description="state → `JOINT.position`, `JOINT.velocity` or `base.FIELD`")
    inputs: dict[str, str] = Field(
        default_factory=dict, description="input → the joint that its effort drives, `ACTUATOR.ctrl`, `JOINT.effort` or `drive`"
    )
    drive: DriveConfig | None = Field(None, description="the base's own loop, for inputs that are `drive`")
    rotation: Annotated[str, Field(pattern="^(quaternion|euler)$")] = Field(
        "quaternion", description="of a base that floats: `quaternion` or `euler` (roll, pitch, yaw)"
    )
    period: Annotated[str | None, WithJsonSchema({"type": ["string", "null"], "quantity": "s"})] = Field(
        None, description="time from x to x⁺, such as 5 ms; default: the model's"
    )
    substeps: int = Field(default=1, ge=1, description="engine steps per period, with one effort")
    gravity: tuple[FiniteFloat, FiniteFloat, FiniteFloat] | None = Field(
        None, description="[x, y, z] in m/s²; default: the file's or the engine's"
    )
    joint_damping: Coefficient | None = Field(
        None, description="viscous friction of all joints, in N·m·s/rad or N·s/m; default: the file's"
    )
    ground: Coefficient | None = Field(
        None, description="friction coefficient of a plane z = 0 that is added; default: no plane"
    )
    tiles: int = Field(default=16, ge=1, description="copies that are stepped at once; never changes an answer")

    @abstractmethod
    def settings(self) -> dict[str, tuple[Any, ...]]:
        """Values worth trying when this engine disagrees with another: dotted option → candidates (a mapping sets several)."""
        return {"substeps": tuple(k for k in (1, 2, 5, 10) if k != self.substeps)}

    def unsaid(self) -> set[str]:
        """Options that are as they were before there was a choice: a digest leaves them out."""
        return set()

    def coarse(self) -> dict[str, Any]:
        """Options with which this engine is much faster and nearly the same, for what is only tried; none by default."""
        return {}

    def others(self, candidates: dict[str, tuple[Any, ...]]) -> dict[str, tuple[Any, ...]]:
        """Of candidates by option those that this section does not have already."""
        left = {name: tuple(v for v in values if v != getattr(self, name)) for name, values in candidates.items()}
        return {name: values for name, values in left.items() if values}

    @field_validator("states")
    @classmethod
    def _fields(cls, states: dict[str, str]) -> dict[str, str]:
        for name, target in states.items():
            owner, _, field = target.rpartition(".")
            if not owner or (owner != "base" and field not in ("position", "velocity", *_LOOSE)):
                raise ValueError(f"state '{name}' is '{target}'; expected JOINT.position, JOINT.velocity or base.FIELD")
        return _distinct(states)

    @field_validator("inputs")
    @classmethod
    def _joints(cls, inputs: dict[str, str]) -> dict[str, str]:
        _distinct({name: target for name, target in inputs.items() if target != "drive"})
        return inputs

    @field_validator("period")
    @classmethod
    def _seconds(cls, period: str | None) -> str | None:
        if period is not None:
            seconds(period)
        return period


def _distinct(names: dict[str, str]) -> dict[str, str]:
    seen: dict[str, str] = {}
    for name, target in names.items():
        if (other := seen.setdefault(target, name)) != name:
            raise ValueError(f"'{name}' and '{other}' are both '{target}'; give each its own")
    return names


def seconds(period: str) -> float:
    """The seconds in a quantity such as `5 ms`; ValueError when it is not a positive time."""
    value = magnitude(period, "s")
    if value <= 0:
        raise ValueError(f"found '{period}'; expected a positive time such as 5 ms")
    return value
