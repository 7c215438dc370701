"""The options that a spec may give."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class GymPendulumConfig(BaseModel):
    """Gravity in m/s² and the period in seconds, both Pendulum-v1's own by default."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["gymnasium-pendulum"] = "gymnasium-pendulum"
    gravity: float = Field(default=10.0, ge=0)
    period: float = Field(default=0.05, gt=0)
