"""Options of `controller: {kind: mpc, ...}`."""

from __future__ import annotations

from typing import Annotated, Literal, final

from pydantic import ConfigDict, Field

from gapcert.plugin import Section

Quantity = float | str
Choice = Literal["auto", "osqp", "piqp", "clarabel"]
Weight = Annotated[float, Field(ge=0)]


@final
class Terminal(Section):
    """Plans end in the winning set of this synthesizer, whose controller is on cells; its options stand beside these."""

    model_config = ConfigDict(frozen=True, extra="allow")

    kind: str = "symbolic"
    boxes: int = Field(6, ge=1, le=100, description="boxes of winning cells in which a plan may end, at most")


@final
class Schedule(Section):
    """A reference that jumps: each value is wanted from its time after the start of a run on."""

    at: list[tuple[Quantity, Quantity]] = Field(description="pairs [time, value], the first of them at 0 s")


@final
class Soft(Section):
    """A range that is preferred; being outside by e half-ranges costs linear·e + quadratic·e² in each period."""

    range: tuple[Quantity, Quantity] = Field(description="[low, high]")
    linear: float = Field(10.0, gt=0, description="a large one keeps the range wherever a plan can")
    quadratic: Weight = Field(1.0, description="cost of the squared distance to the range, in half-ranges")


@final
class MpcConfig(Section):
    """Horizon in periods, what the plan is drawn to, and what it costs to be away from there.

    Weights are those of squared distances, each measured in half of its range: 1 and 1 weigh a state and an input alike.
    """

    kind: Literal["mpc"] = "mpc"
    horizon: int = Field(20, ge=1, le=1000, description="periods that are planned ahead")
    reference: dict[str, Quantity | Schedule] = Field(
        default_factory=dict,
        description="states and inputs that are wanted, or {at: [[time, value], …]}; default: the middle of the goal, and rest",
    )
    weights: dict[str, Weight] = Field(default_factory=dict, description="costs per state and input; default: 1")
    solver: Choice = Field(
        "auto", description="who solves the quadratic program first; auto: who needs less work on sample runs"
    )
    tolerance: float = Field(
        1e-5, gt=0, le=1e-2, description="by how much rows may be missed, in half-ranges; it is added to the tube"
    )
    majorant: Literal["auto", "affine", "constant"] = Field(
        "auto", description="does the tube follow how γ depends on the plan? auto: where a constant one takes much of the room"
    )
    searches: int = Field(30, ge=1, le=1000, description="starts from which ways around obstacles are searched for at most")
    linearisation: Literal["once", "successive"] = Field(
        "once", description="is the model made straight over the whole goal, or at each step about the plan?"
    )
    feedback: Literal["fixed", "disturbance"] = Field(
        "fixed", description="by one gain for all plans, or does each plan choose its answer to each disturbance?"
    )
    adapt: dict[str, tuple[Quantity, Quantity] | Quantity | None] = Field(
        default_factory=dict,
        description="parameters that are learned: [low, high], a tolerance around the stated value, or null for their own",
    )
    levels: int = Field(4, ge=0, le=20, description="how often what is known of them is halved before tubes stay as they are")
    rates: dict[str, Quantity] = Field(
        default_factory=dict, description="largest change of inputs from one period to the next; default: none"
    )
    soft: dict[str, Soft] = Field(
        default_factory=dict, description="ranges of states and inputs that are preferred, and may be left at a cost"
    )
    terminal: Terminal | None = Field(
        None, description="where plans end: in the winning set of another synthesizer; default: around a steady state"
    )
