"""Options of `controller: {kind: symbolic, ...}`."""

from __future__ import annotations

from typing import Annotated, Literal, final

from pydantic import BaseModel, ConfigDict, Field

Cells = Annotated[int, Field(ge=1)]
Inputs = Annotated[int, Field(ge=2)]
Bound = float | str


@final
class SymbolicConfig(BaseModel):
    """Cells per state, input values per input (both ends included), and the policy that is used by default.

    With `on`, only these states have cells: the others are kept in a box that no input of `input_range` leads out of.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["symbolic"] = "symbolic"
    cells: dict[str, Cells] = Field(min_length=1, description="number of cells per state")
    inputs: dict[str, Inputs] = Field(min_length=1, description="number of values per input, both ends of its range included")
    on: list[str] | None = Field(None, min_length=1, description="the states that have cells; the others are held in a box")
    input_range: dict[str, tuple[Bound, Bound]] | None = Field(None, description="ranges of the inputs, within the domain")
    policy: Literal["first", "middle", "last", "random"] = Field("first", description="which valid input is applied")
