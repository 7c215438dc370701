"""Options of `controller: {kind: symbolic, ...}`."""

from __future__ import annotations

from typing import Annotated, Literal, final

from pydantic import BaseModel, ConfigDict, Field

Cells = Annotated[int, Field(ge=1)]
Inputs = Annotated[int, Field(ge=2)]


@final
class SymbolicConfig(BaseModel):
    """Cells per state, input values per input (both ends included), and the policy that is used by default."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["symbolic"] = "symbolic"
    cells: dict[str, Cells] = Field(min_length=1, description="number of cells per state")
    inputs: dict[str, Inputs] = Field(min_length=1, description="number of values per input, both ends of its range included")
    policy: Literal["first", "middle", "last", "random"] = Field("first", description="which valid input is applied")
