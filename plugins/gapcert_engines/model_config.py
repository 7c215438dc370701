"""Options of model `engine`."""

from __future__ import annotations

from typing import Annotated, Any, Literal, final

from pydantic import BeforeValidator, Field, FiniteFloat, WithJsonSchema

from gapcert.plugin import magnitude, shown
from gapcert.plugin import sections as s

_TOLERANCE = WithJsonSchema({"type": ["number", "string"], "quantity": "%"})


def _tolerance(value: Any) -> str | float:
    text = str(value).strip()
    number = magnitude(text.removesuffix("%").strip() if text.endswith("%") else value, "1")
    if number < 0:
        raise ValueError(f"found {shown(value)}; expected 0 or more, such as 2 %")
    return text if text.endswith("%") else number


@final
class Native(s.Section):
    """A native parameter's value in its unit (by default the file's) and tolerance: `2 %` of the value, or absolute."""

    value: FiniteFloat | None = Field(None, description="in the unit of the parameter; default: the file's")
    tolerance: Annotated[str | float, BeforeValidator(_tolerance), _TOLERANCE] = Field(
        0.0, description="`2 %` of the value, or absolute; 0: taken at its word"
    )

    def absolute(self, value: float) -> float:
        if isinstance(self.tolerance, str):
            return abs(value) * float(self.tolerance.removesuffix("%")) / 100
        return self.tolerance


def _native(value: Any) -> Any:
    """`mass.rod: 2 %` is a tolerance."""
    return {"tolerance": value} if isinstance(value, str | int | float) and not isinstance(value, bool) else value


@final
class EngineModelConfig(s.Section):
    """`of` is a physics engine's section, as `backend` has it; the velocity of a state `q` is called `q_dot`, and a diagnosis
    may leave out its period. `parameters` are native ones that may be off: `mass.rod: 2 %`, or a value with a tolerance.
    """

    kind: Literal["engine"] = "engine"
    of: Any = Field(description="the engine's section, as `backend` has it")
    parameters: dict[str, Annotated[Native, BeforeValidator(_native, json_schema_input_type=Native | str | float)]] = Field(
        default_factory=dict, description="native parameters that may be off: `mass.rod: 2 %`, or a value with a tolerance"
    )

    @property
    def period(self) -> str | None:
        """The engine's; None leaves it to the recording."""
        return getattr(self.of, "period", None)

    def untimed(self) -> bool:
        return self.period is None

    def axes(self) -> tuple[dict[str, str], dict[str, str]]:
        """Units are the robot's, which only the engine knows."""
        return {}, {}
