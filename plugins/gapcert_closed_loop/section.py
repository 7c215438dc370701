"""The section `closed_loop:` of a spec: every spec is read with it, so that it needs nothing of what the study needs to run."""

from __future__ import annotations

from typing import Literal, final

from pydantic import Field

from gapcert.plugin import POLICIES, Count, Policy, Probability, Section, SpecSection, Whole

StartsFrom = Literal["both", "without_gamma"]


@final
class ClosedLoopConfig(Section):
    """Runs of the controller on the backend, with γ beside without γ; those with γ are an audit, with a confidence 1 − β.

    Starts are drawn where both win, or with `starts_from: without_gamma` where the controller without γ does; of these,
    those that the controller with γ refuses are counted. `policies`: by default all that the controllers know.
    """

    steps: Count = Field(600, description="of each run, in periods")
    starts: Count = Field(100, description="runs per policy, at most")
    confidence: Probability = Field(0.999, description="1 − β of what the runs with γ show")
    policies: list[Policy] = Field(list(POLICIES), min_length=1, description="which valid inputs are applied, in turn")
    starts_from: StartsFrom = Field("both", description="where both controllers win, or where the one without γ does")
    seed: Whole | None = Field(None, description="of the starts; default: the spec's")


@final
class ClosedLoopSection(SpecSection):
    model = ClosedLoopConfig
    about = "runs of the controller on the simulator"
    needs = ("controller",)
    simulated = True
