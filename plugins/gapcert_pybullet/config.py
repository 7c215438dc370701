"""Options of backend `pybullet`; the defaults are PyBullet's own physics, with its default velocity motors off."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, final

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator

from gapcert import magnitude

Damping = Annotated[FiniteFloat, Field(ge=0)]


@final
class PyBulletConfig(BaseModel):
    """`states` maps a state to `joint.position` or `joint.velocity`, `inputs` an input to the joint that its torque drives.

    `period` (default: the model's) is divided into `substeps` engine steps that share one torque. `joint_damping` replaces
    the file's. `tiles` copies of the robot are stepped at once where that gives the same bits; it never changes an answer.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["pybullet"] = "pybullet"
    robot: Path
    fixed_base: bool = True
    states: dict[str, str] = Field(min_length=1)
    inputs: dict[str, str] = Field(default_factory=dict)
    period: str | None = None
    substeps: int = Field(default=1, ge=1)
    linear_damping: Damping = 0.04
    angular_damping: Damping = 0.04
    joint_damping: Damping | None = None
    use_inertia_from_file: bool = True
    gravity: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = (0.0, 0.0, -9.81)
    tiles: int = Field(default=16, ge=1, le=120)
    self_collision: bool = False

    @field_validator("states")
    @classmethod
    def _fields(cls, states: dict[str, str]) -> dict[str, str]:
        for name, target in states.items():
            if target.rpartition(".")[0] == "" or target.rpartition(".")[2] not in ("position", "velocity"):
                raise ValueError(f"state '{name}' is '{target}'; expected JOINT.position or JOINT.velocity")
        return _distinct(states)

    @field_validator("inputs")
    @classmethod
    def _joints(cls, inputs: dict[str, str]) -> dict[str, str]:
        return _distinct(inputs)

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
