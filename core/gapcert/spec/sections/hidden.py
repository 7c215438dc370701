"""The section `hidden`: what is done about engine state outside (x, u) that matters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, final, get_args

from pydantic import Field, TypeAdapter, model_validator

from gapcert.spec.sections import sections as s

Word = Literal["refuse", "augment", "default"]
WORDS = get_args(Word)
HINT = f"write hidden: {' | '.join(WORDS)}, or hidden: {{sample: {{ranges: ...}}}} or {{sample: {{visited: {{}}}}}}"


@final
class Visited(s.Section):
    """Hidden states met in `runs` rollouts of `steps` periods; at x, one of the `near` met closest to x."""

    runs: s.Count = Field(50, description="rollouts that visit hidden states")
    steps: Annotated[int, Field(strict=True, ge=2)] = Field(20, description="of each")
    near: s.Count = Field(8, description="visited states that may lend theirs")


@final
class Sample(s.Section):
    """Hidden state is drawn, from `ranges` or as `visited`, and bounded over; `safety` multiplies the measured spread."""

    ranges: s.Boxes | None = Field(default=None, min_length=1, description="hidden state → [low, high]")
    visited: Visited | None = Field(None, description="or drawn from rollouts")
    safety: Annotated[float, Field(strict=True, ge=1)] = Field(1.5, description="factor on the measured spread")

    @model_validator(mode="after")
    def _one(self) -> Sample:
        if (self.ranges is None) == (self.visited is None):
            raise ValueError("expected either `ranges: {state: [low, high]}` or `visited: {runs, steps, near}`")
        return self


@final
class Sampled(s.Section):
    sample: Sample = Field(description="how hidden state is drawn")


@final
@dataclass(frozen=True)
class HiddenConfig:
    """`ranges`: those of `sample:`, or of the domain with `augment`; as written, since only the backend knows their units."""

    mode: Literal["refuse", "augment", "default", "sample"] = "refuse"
    sample: Sample | None = None
    ranges: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)


def schema() -> dict[str, Any]:
    """The JSON Schema of the section."""
    return TypeAdapter(Word | Sampled).json_schema()
