"""Options of backend `gymnasium`; imports nothing heavy."""

from __future__ import annotations

from typing import Any, Literal, final

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator

from gapcert.plugin import magnitude


@final
class Component(BaseModel):
    """One number of an environment's state or action, where gapcert does not know the environment."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    unit: str = Field("1", description="its unit")
    kind: Literal["real", "angle"] = Field("real", description="does it come round?")


@final
class Levels(BaseModel):
    """An input of an environment with discrete actions: what each action is as a number. The nearest one is taken."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    action: str = Field(description="the environment's name of it")
    levels: dict[int, FiniteFloat] = Field(min_length=2, description="action → value")


@final
class GymnasiumConfig(BaseModel):
    """`env` is an environment's id; `MODULE:ID` imports a module that registers it, which needs --allow-code. `options` go to
    `gymnasium.make`.

    `states` and `inputs` map the model's names to the environment's: of classic control as in the documentation, of MuJoCo
    `JOINT.position`, `JOINT.velocity` and an actuator's name or `action[k]`; numbers that no state names are hidden state.
    Of an environment that gapcert does not know, `state` and `action` say what stands in its attribute `attribute`, in order.
    Where actions are discrete, an input is `{action: NAME, levels: {0: -10, 1: 10}}`, by default with the levels that the
    environment gives them. `period` is the environment's own, or is set where it can be.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["gymnasium"] = "gymnasium"
    env: str = Field(description="an environment's id, or MODULE:ID, which needs --allow-code")
    states: dict[str, str] = Field(min_length=1, description="state → the environment's name of it")
    inputs: dict[str, str | Levels] = Field(
        default_factory=dict, description="input → the environment's name of it, or {action, levels}"
    )
    options: dict[str, Any] = Field(default_factory=dict, description="of gymnasium.make")
    period: str | None = Field(None, description="time from x to x⁺, such as 20 ms; default: the environment's own")
    state: dict[str, Component] | None = Field(None, description="what stands in `attribute`, in order")
    action: dict[str, Component] | None = Field(None, description="what its actions are, in order")
    attribute: str = Field("state", description="of an unknown environment, the one that is its whole state")
    single: bool = Field(False, description="does it compute in single precision?")

    @field_validator("period")
    @classmethod
    def _seconds(cls, period: str | None) -> str | None:
        if period is not None and magnitude(period, "s") <= 0:
            raise ValueError(f"found '{period}'; expected a positive time such as 20 ms")
        return period

    @field_validator("states")
    @classmethod
    def _distinct(cls, states: dict[str, str]) -> dict[str, str]:
        if twice := [v for v in states.values() if list(states.values()).count(v) > 1]:
            raise ValueError(f"'{twice[0]}' stands for two of them; give each its own")
        return states
