"""The sections `diagnose:` and `play:` of a spec."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, final

from pydantic import BeforeValidator, Field, model_validator

from gapcert.plugin import (
    Axes,
    Bound,
    Boxes,
    Config,
    Count,
    Drawn,
    Problem,
    Registry,
    Schema,
    Seconds,
    Section,
    Share,
    SpecSection,
    Time,
    Whole,
    near,
)


@final
class Chosen(Section):
    """Whole trajectories: by name, or every so many of them, from the number `first` on (counted from 0)."""

    trajectories: list[str | int] | None = Field(default=None, min_length=1, description="by name or number")
    every: Count | None = Field(None, description="every such trajectory")
    first: Whole | None = Field(None, description="counted from 0; with `every`")

    @model_validator(mode="after")
    def _one(self) -> Chosen:
        if (self.trajectories is None) == (self.every is None) or (self.first is not None and self.every is None):
            raise ValueError("expected `every: 2`, with `first: 1` or without, or `trajectories: [...]`")
        return self


@final
class HoldOut(Section):
    """The data that take no part in the fit: the last share of each trajectory, a block of time, or whole trajectories."""

    last: Share | None = Field(None, description="share at the end of each trajectory, such as 33 %")
    trajectories: list[str | int] | None = Field(default=None, min_length=1, description="by name or number")
    start: Time | None = Field(default=None, alias="from", description="from this time on")
    stop: Time | None = Field(default=None, alias="to", description="up to this time")
    every: Count | None = Field(None, description="every such trajectory")
    first: Whole | None = Field(None, description="counted from 0; with `every`")

    @model_validator(mode="after")
    def _one(self) -> HoldOut:
        block = self.start is not None or self.stop is not None
        if sum((self.last is not None, self.trajectories is not None, block, self.every is not None)) != 1:
            raise ValueError("expected one of `last: 33 %`, `from: 10 s` with `to: 20 s`, `trajectories: [...]` and `every: 5`")
        if self.first is not None and self.every is None:
            raise ValueError("found `first` without `every`; expected `every: 5` beside it")
        return self


@final
class ExperimentConfig(Section):
    """What an experiment may do that tells apart what these data do not: [low, high] of inputs and outputs, and how long."""

    limits: Boxes = Field(
        default_factory=dict, description="input or measured output → [low, high]; default: as in the recording"
    )
    seconds: Seconds | None = Field(
        None, description="how long it may take; default: 20 turns of the motion or 12 s, at most as long as the recording"
    )


def _points(value: Any) -> Any:
    """`q_dot: 0` is the range [0, 0]."""
    return {n: v if isinstance(v, list | tuple) else (v, v) for n, v in value.items()} if isinstance(value, Mapping) else value


@final
class PlayConfig(Section):
    """What is played to a `reality`: drawn inputs, each held for a drawn time. Ranges that are left out are the domain's.

    pause: zero input after every drawn one, so that what brakes by itself starts each from rest. every: how often the reality
    is looked at within a period of the model; both take the steps that `substeps` divides their period into.
    """

    seconds: Seconds = Field(10.0, description="per trajectory")
    trajectories: Count = Field(8, description="how many")
    hold: tuple[Seconds, Seconds] = Field((0.2, 1.0), description="for how long an input is held: [least, most]")
    pause: Time = Field(0.0, description="zero input after every drawn one, in s")
    every: Seconds | None = Field(None, description="how often the reality is looked at; default: once a period")
    inputs: Boxes = Field(default_factory=dict, description="input → [low, high]; default: the domain's")
    start: Annotated[Boxes, BeforeValidator(_points, json_schema_input_type=dict[str, tuple[Bound, Bound] | Bound])] = Field(
        default_factory=dict, description="state → where it starts, a value or [low, high]; default: the domain's"
    )
    seed: Whole | None = Field(None, description="of what is drawn; default: the spec's")


@final
class DiagnoseConfig(Section):
    """Which effects may be blamed, and on what data the answer is judged. Horizons are in seconds.

    window: length of the stretches that are fitted; long ones see weak forces, and fail where motions are unstable. train: the
    trajectories that are fitted, by default all that are not held out.
    """

    effects: Literal["all"] | list[str] = Field("all", description="names of effects that may be blamed, or all")
    hold_out: HoldOut | None = Field(
        None, description="data that take no part in the fit, on which the answer is judged; default: the last quarter"
    )
    train: Chosen | None = Field(None, description="trajectories that are fitted; default: all that are not held out")
    horizons: list[Seconds] | None = Field(
        default=None,
        min_length=1,
        description="lengths of rollouts; the longest is quoted; default: in how long the motion turns once, and three times",
    )
    exact: list[str] = Field(
        default_factory=list, description="inputs that act as they are logged (gains, enables): no effect is tried at them"
    )
    window: Seconds | None = Field(None, description="length of the stretches that are fitted; default: chosen from the data")
    experiment: ExperimentConfig | None = Field(
        None, description="what may be asked of the real system where these data cannot decide"
    )


@final
class PlaySection(SpecSection):
    model = PlayConfig
    about = "what is played to a reality"
    needs = ("reality",)


@final
class DiagnoseSection(SpecSection):
    model = DiagnoseConfig
    about = "which causes are tried, and how they are judged"
    needs = ("model", "recording")
    alone = True
    timed = True

    def relate(self, config: Config, data: Mapping[str, Any], axes: Axes, registry: Registry) -> list[Problem]:
        found = []
        if "reality" in data and "recording" in data:
            what = "'reality' stands beside 'recording'; a diagnosis has one of the two"
            found.append(Problem(("reality",), what, "remove recording:", "key"))
        asked: DiagnoseConfig | None = config.sections.get("diagnose")
        known, names = registry.names("effect"), [] if asked is None or isinstance(asked.effects, str) else asked.effects
        return found + [
            Problem(("diagnose", "effects", i), f"no plugin provides effect '{name}'", near(name, known))
            for i, name in enumerate(names)
            if name not in known
        ]

    def schema(self, drawn: Drawn) -> Schema:
        made, names = super().schema(drawn), drawn.registry.names("effect")
        effects = {"anyOf": [{"const": "all"}, {"type": "array", "items": {"enum": names}}], "default": "all"}
        drawn.definitions["diagnose"]["properties"]["effects"] = effects
        return made
