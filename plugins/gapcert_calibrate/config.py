"""Options of backend `stochastic`."""

from __future__ import annotations

from typing import Annotated, Any, Literal, final

from pydantic import BeforeValidator, Field, FiniteFloat, WithJsonSchema, model_validator

from gapcert.plugin import Keyed, magnitude, shown
from gapcert.plugin import sections as s

_QUANTITY = WithJsonSchema({"type": ["number", "string"], "quantity": "s"})


def _jitter(value: Any) -> float:
    if (seconds := magnitude(value, "s")) < 0:
        raise ValueError(f"found {shown(value)}; expected a time of 0 or more")
    return seconds


@final
class Absolute(s.Section):
    """A parameter's value is drawn from this range, in its unit."""

    range: tuple[s.Bound, s.Bound] = Field(description="[low, high], in the parameter's unit")


@final
class StochasticConfig(s.Section):
    """`of` is any backend. `sensor_noise`: standard deviations of Gaussian noise on x⁺, per state. `jitter`: the read-out comes
    up to this much early or late, along the line from x to x⁺. `parameters`, drawn uniformly in every step: `[0.9, 1.1]` are
    factors of the stated value, `{range: [a, b]}` is absolute. Nothing is drawn without a seed.
    """

    kind: Literal["stochastic"] = "stochastic"
    of: Any = Field(description="the backend that is made noisy, a section like `backend`")
    sensor_noise: dict[str, s.Bound] = Field(
        default_factory=dict, description="standard deviation of Gaussian noise on x⁺, per state, in its unit"
    )
    jitter: Annotated[float, BeforeValidator(_jitter), _QUANTITY] = Field(
        0.0, description="by how much the read-out may come early or late, such as 0.5 ms"
    )
    parameters: dict[str, tuple[FiniteFloat, FiniteFloat] | Absolute] = Field(
        default_factory=dict,
        description="native parameters drawn in every step: [0.9, 1.1] are factors, {range: [a, b]} is absolute",
    )

    def keyed(self) -> tuple[Keyed, ...]:
        return (Keyed("sensor_noise", "states", every=False, values="quantities"),)

    @model_validator(mode="after")
    def _some(self) -> StochasticConfig:
        if not (self.sensor_noise or self.jitter or self.parameters):
            raise ValueError("expected at least one of sensor_noise, jitter, parameters; else nothing is drawn")
        return self
