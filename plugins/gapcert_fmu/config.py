"""Options of backend `fmu`; imports nothing heavy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, final

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator

from gapcert.plugin import magnitude


@final
class Started(BaseModel):
    """A state whose variable cannot be set itself: `start` is the parameter that is its value at the beginning."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    variable: str = Field(description="what the FMU calls the state")
    start: str = Field(description="the parameter that is its value at the beginning")


@final
class FmuConfig(BaseModel):
    """`states` and `inputs` map the model's names to variables of the FMU, whose units must be the model's; a state may be
    `{variable: h, start: h_start}`. Whatever other continuous or discrete state the FMU declares is
    hidden state.

    `interface`: co-simulation, where the FMU has it, is one or, with `substeps`, several communication steps per `period`
    (default: the model's); model-exchange is stepped by `integrator`, once per sub-step, and events are located by bisection.
    `tolerance` is handed to the FMU's own solver (default: its default experiment's), and is the resolution of what it answers.
    `set` gives parameters another value. A query begins with a `restart`: a `snapshot` that is restored, a `reset`, or a new
    instance, `instantiate`; `auto` takes the first of these that answers as a new instance does, bit for bit. An FMU that
    remembers more than its states is refused unless `memory: forget` says that every period begins anew. `time` is the FMU's
    when a period begins.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["fmu"] = "fmu"
    file: Path = Field(description="the FMU, relative to the spec")
    states: dict[str, str | Started] = Field(min_length=1, description="state → variable, or {variable, start}")
    inputs: dict[str, str] = Field(default_factory=dict, description="input → variable")
    interface: Literal["co-simulation", "model-exchange"] | None = Field(
        None, description="default: co-simulation where the FMU has it"
    )
    period: str | None = Field(None, description="time from x to x⁺, such as 5 ms; default: the model's")
    substeps: int = Field(default=1, ge=1, description="communication steps, or steps of the integrator, per period")
    integrator: Literal["euler", "rk4"] = Field("rk4", description="of model exchange")
    tolerance: Annotated[FiniteFloat, Field(gt=0, le=0.1)] | None = Field(
        None, description="of the FMU's own solver, relative; default: its default experiment's"
    )
    set: dict[str, FiniteFloat | bool | str] = Field(default_factory=dict, description="parameter → value")
    restart: Literal["auto", "snapshot", "reset", "instantiate"] = Field(
        "auto", description="how a query begins; auto: the first that answers as a new instance does"
    )
    memory: Literal["refuse", "forget"] = Field(
        "refuse", description="what becomes of an FMU that remembers more than its states"
    )
    time: Annotated[FiniteFloat, Field(ge=0)] = Field(0.0, description="the FMU's when a period begins, in s")
    megabytes: int = Field(default=1024, ge=1, description="what the archive may unpack to")

    @field_validator("period")
    @classmethod
    def _seconds(cls, period: str | None) -> str | None:
        if period is not None and magnitude(period, "s") <= 0:
            raise ValueError(f"found '{period}'; expected a positive time such as 5 ms")
        return period

    @field_validator("states", "inputs")
    @classmethod
    def _distinct(cls, names: dict[str, Any]) -> dict[str, Any]:
        variables = [v.variable if isinstance(v, Started) else v for v in names.values()]
        if twice := [v for v in variables if variables.count(v) > 1]:
            raise ValueError(f"'{twice[0]}' stands for two of them; give each its own variable")
        return names

    def variable(self, state: str) -> str:
        """What the FMU calls a state."""
        found = self.states[state]
        return found.variable if isinstance(found, Started) else found

    def setter(self, state: str) -> str:
        """What the FMU calls the variable that sets it."""
        found = self.states[state]
        return found.start if isinstance(found, Started) else found

    def settings(self) -> dict[str, tuple[Any, ...]]:
        """Values worth trying where the FMU disagrees with something else."""
        return {"substeps": tuple(k for k in (1, 2, 5, 10) if k != self.substeps)}
