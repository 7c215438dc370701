"""Options of `controller: {kind: symbolic, ...}`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, final

from pydantic import BaseModel, ConfigDict, Field, model_validator

from gapcert.plugin import Keyed, Policy

if TYPE_CHECKING:
    from gapcert.plugin import Context, Model

Cells = Annotated[int, Field(ge=1)]
Inputs = Annotated[int, Field(ge=2)]
Bound = float | str


@final
class Growth(BaseModel):
    """`model`: a spec whose `model:` has radii as states: its map bounds by how much the successors of a cell spread."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: str = Field(description="a spec whose `model:` is the map of the radii, relative to this spec")

    def made(self, context: Context) -> Model:
        return context.other(self.model)


@final
class SymbolicConfig(BaseModel):
    """Cells per state, input values per input (both ends included), and the policy that is used by default.

    With `on`, only these states have cells: the others are kept in a box that no input of `input_range` leads out of.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["symbolic"] = "symbolic"
    cells: dict[str, Cells] = Field(default_factory=dict, description="number of cells per state")
    inputs: dict[str, Inputs] = Field(
        default_factory=dict, description="number of values per input, both ends of its range included"
    )
    on: list[str] | None = Field(None, min_length=1, description="the states that have cells; the others are held in a box")
    input_range: dict[str, tuple[Bound, Bound]] | None = Field(None, description="ranges of the inputs, within the domain")
    policy: Policy = Field("first", description="which valid input is applied")
    align: Literal["tile", "scots"] = Field("tile", description="do cells fill the goal's box, or lie as SCOTS 0.2 has them")
    eta: dict[str, Bound] | None = Field(None, description="with align: scots, the distance of cells and of input values")
    growth: Growth | None = Field(None, description="a growth bound, taken on trust; default: intervals")
    solver: Literal["compiled", "jax"] = Field(
        "compiled", description="jax: all cells and inputs at once on JAX's device, for large problems where that is a GPU"
    )
    threads: int | None = Field(
        None,
        ge=1,
        description="how many threads the compiled solvers may use; default: one per core for large problems, else one",
    )
    refine: int = Field(0, ge=0, le=12, description="how many times cells that may yet win are halved along every axis")
    error: dict[str, Bound] | None = Field(None, description="with growth, how far a state may be from where it was measured")

    @model_validator(mode="after")
    def _counted(self) -> SymbolicConfig:
        if self.align == "tile" and not (self.cells and self.inputs):
            raise ValueError("cells and inputs are needed: numbers per state and per input")
        return self

    def keyed(self) -> tuple[Keyed, ...]:
        return (
            Keyed("on", "states"),
            Keyed("input_range", "inputs", values="ranges"),
            Keyed("cells", "states", self.on),
            Keyed("inputs", "inputs"),
        )

    def headline(self) -> str:
        return self.policy
