"""Options of the components in this package; imports nothing heavier than pydantic."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal, final

from pydantic import BaseModel, ConfigDict, Field


@final
class LipSDPConfig(BaseModel):
    """`tolerance`: relative gap of L² between both sides at which the solver ends (deep networks). For networks, in Python; not
    for the residual of a spec."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["lipsdp"]
    tolerance: Annotated[float, Field(ge=1e-12, le=1e-2)] = Field(1e-9, description="at which the solver stops, relative")

    def check(self) -> Iterator[tuple[tuple[str | int, ...], str, int]]:
        """What a spec bounds is a residual, and no network."""
        yield (
            ("kind",),
            "lipsdp bounds networks, not residuals; use interval, wood-zhang, piecewise or declared, and lipsdp from Python",
            0,
        )
