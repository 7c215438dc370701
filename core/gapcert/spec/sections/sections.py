"""The sections of a spec that belong to the core, and a checked spec; sections with a `kind` are their plugin's own models."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, final, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag, WithJsonSchema, model_validator

from gapcert.contracts.data.units import magnitude, shown
from gapcert.contracts.plugins.registry import registry

SECTIONS: Mapping[str, str] = {
    "version": "of the format: 1",
    "name": "of the run, in lower-case letters, digits, - and _",
    "extends": "another spec that this one is merged over; null removes what it has",
    "matrix": "path of a value: list of values; one run for each combination",
    "seed": "of everything that is drawn",
    "model": "what is trusted to be right up to a gap: equations whose slopes and ranges are known",
    "backend": "the simulator that the model is certified against",
    "reality": "what stands for the real system in a diagnosis: any backend or model, to which inputs are played",
    "recording": "a log of the real system",
    "domain": "name of a state or input: [low, high]; where the claim holds",
    "relations": "linear inequalities that cut the domain",
    "coordinates": "linear combinations that take the place of an input",
    "symmetries": "what leaves the gap as it is",
    "sampling": "which transitions of the simulator are looked at",
    "lipschitz": "how fast the gap can change between samples, and how that is known",
    "gap": "the family of functions that bounds the gap",
    "certificate": "what is claimed of the bound, and by which route",
    "hidden": "what happens to state that the simulator has and the model has not",
    "controller": "a goal, and what makes a controller that reaches it against the gap",
    "report": "what a run leaves behind besides its summary",
    "expect": "path into the summary, with an operator after a space: value",
}
Count = Annotated[int, Field(strict=True, ge=1)]
Whole = Annotated[int, Field(strict=True, ge=0)]
Probability = Annotated[float, Field(strict=True, gt=0, lt=1)]
NAME, LONGEST_NAME = "[a-z0-9_-]+", 100
Positive = Annotated[float, Field(strict=True, gt=0)]


def _name(value: Any) -> str:
    if not isinstance(value, str) or re.fullmatch(NAME, value) is None:
        raise ValueError(f"found {shown(value)}; expected lower-case letters, digits, - and _")
    if len(value) > LONGEST_NAME:
        raise ValueError(f"found {len(value)} characters; expected at most {LONGEST_NAME}, since folders are called so")
    return value


def _bound(value: Any) -> float | str:
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(f"found {shown(value)}; expected a number or a quantity such as '0.2 rad'")
    return value


def _seconds(value: Any) -> float:
    if (seconds := magnitude(value, "s")) <= 0:
        raise ValueError(f"found {shown(value)}; expected a positive time")
    return seconds


def _share(value: Any) -> float:
    share = magnitude(value, "1") if not isinstance(value, str) else magnitude(value.replace("%", "").strip(), "1") / 100
    if not 0 < share < 1:
        raise ValueError(f"found {shown(value)}; expected a share between 0 and 1, such as 33 %")
    return share


def routes() -> list[str]:
    """What may be asked for: what a person declares is no choice of a route."""
    return [part.name for part in registry().of("route") if part.claim != "assumed"]


def _route(value: Any) -> str:
    if value not in (known := routes()):
        raise ValueError(f"found {shown(value)}; expected {', '.join(map(repr, known[:-1]))} or {known[-1]!r}")
    return str(value)


class Routes:
    """Installed routes, for editors."""

    @classmethod
    def __get_pydantic_json_schema__(cls, core: Any, handler: Any) -> dict[str, Any]:
        return {"enum": routes(), "type": "string"}


# `quantity`: in which unit editors offer numbers ("": in any).
_QUANTITY, _SECONDS, _SHARE = (WithJsonSchema({"type": ["number", "string"], "quantity": unit}) for unit in ("", "s", "%"))
Name = Annotated[str, BeforeValidator(_name)]
RouteName = Annotated[str, BeforeValidator(_route), Routes]
Bound = Annotated[float | str, BeforeValidator(_bound), _QUANTITY]
Boxes = dict[str, tuple[Bound, Bound]]
Seconds = Annotated[float, BeforeValidator(_seconds), _SECONDS]
Time = Annotated[float, BeforeValidator(lambda value: magnitude(value, "s")), _SECONDS]
Share = Annotated[float, BeforeValidator(_share), _SHARE]


class Section(BaseModel):
    """A section whose unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@final
class Radius(Section):
    """Cover radii, Euclidean: every state within `states` of a grid point, every input within `inputs`."""

    states: Positive = Field(description="ε of the states together")
    inputs: Positive = Field(description="ε of the inputs together")


class _Sampling(Section):
    chunk: Count = Field(100_000, description="samples that a worker takes at once")
    executor: str = Field("processes", description="who computes: processes, threads, dask, dask:ADDRESS")
    workers: Count | None = Field(None, description="how many; default: the processors of this process")


@final
class GridSampling(_Sampling):
    """A uniform grid: cells per axis, or the radii that it must cover.

    `keep: extremes` keeps, of each of the coarse `cells` per axis (by default about 65,536 in all), only the samples with the
    smallest and the largest residual of each state.
    """

    kind: Literal["grid"]
    counts: dict[str, Count] | None = Field(None, description="axis → cells along it")
    radius: Radius | None = Field(None, description="or the largest distance to a sample, in the units of the model")
    keep: Literal["all", "extremes"] = Field("all", description="all samples, or the extreme ones of every coarse cell")
    cells: dict[str, Count] | None = Field(None, description="axis → coarse cells, with keep: extremes")

    @model_validator(mode="after")
    def _one(self) -> GridSampling:
        if (self.counts is None) == (self.radius is None):
            raise ValueError("expected either `counts: {axis: cells}` or `radius: {states: ..., inputs: ...}`")
        if self.cells is not None and self.keep == "all":
            raise ValueError("found `cells` with `keep: all`; expected `keep: extremes` beside them")
        if self.cells is not None and self.counts is not None:
            for name in self.cells.keys() & self.counts.keys():
                if (found := self.cells[name]) > (most := self.counts[name]):
                    raise ValueError(f"found {found} cells for {name}; expected at most its {most} counts")
        return self


@final
class AdaptiveSampling(_Sampling):
    """Cells are split where the certified bound is loosest, until `budget` transitions are spent, or until the mean γ of the
    envelope is at most `tightness` times the mean gap, as the middle of the band has it, in every state."""

    kind: Literal["adaptive"]
    budget: Count = Field(description="transitions, at most")
    tightness: Annotated[float, Field(gt=1, allow_inf_nan=False)] | None = Field(
        None, description="mean γ / mean |r| at which it ends sooner"
    )


@final
class LatticeSampling(_Sampling):
    """Nodes from end to end of each axis, for the family `multilinear`: `counts` per axis, or as many as `budget` transitions
    allow, spread where the constants ask for them.
    """

    kind: Literal["lattice"]
    counts: dict[str, Count] | None = Field(None, description="axis → nodes along it")
    budget: Count | None = Field(None, description="or transitions, at most, laid where they narrow the band most")

    @model_validator(mode="after")
    def _one(self) -> LatticeSampling:
        if (self.counts is None) == (self.budget is None):
            raise ValueError("expected either `counts: {axis: nodes}` or `budget: transitions`")
        return self


@final
class CertificateConfig(Section):
    """What is claimed: `violation` ε, `confidence` 1 − β; `attack` further fresh points are tried and counted.

    `assumed` is the claim of `gap: {kind: declared}`, and of nothing else.

    Route `calibrate` moves the band of any family until fresh points say that it fails at a share ε at most: `exceedances` of
    them may leave it (more take more points, and give a tighter band); `repeats` draws of a stochastic backend at one point
    count as one trial, in which all have to lie inside.

    Where a recording stands in place of a backend, its windows of length `window` (default: whole trajectories) are the units;
    a share `fit` of them (default: a third) makes the band, and the others set it. `confidence` then has no default: where it
    is given, windows are taken as independent draws.
    """

    claim: Literal["deterministic", "statistical", "empirical", "assumed"] = Field(description="the level that is asked for")
    violation: Probability = Field(1e-3, description="ε, the share of points that may be missed")
    confidence: Probability = Field(0.999999, description="1 − β, over all audits of this question together")
    route: RouteName | None = Field(None, description="default: theorem1 on a grid, dominate otherwise")
    attack: Whole = Field(0, description="further fresh points that are tried and counted")
    exceedances: Whole = Field(0, description="with route: calibrate, points that may leave the band")
    repeats: Count = Field(1, description="with route: calibrate, draws of the noise per point")
    window: Seconds | None = Field(None, description="of a recording, the length of a unit; default: whole trajectories")
    fit: Share | None = Field(None, description="of a recording, the share of windows that make the band; default: a third")

    @model_validator(mode="after")
    def _calibrated(self) -> CertificateConfig:
        if self.route == "calibrate" and self.claim == "deterministic":
            raise ValueError("route calibrate gives a statistical claim at most; expected claim: statistical")
        if self.route != "calibrate" and (self.exceedances, self.repeats) != (0, 1):
            raise ValueError("found exceedances or repeats without `route: calibrate`; only its points may leave the band")
        return self


@final
class SymmetriesConfig(Section):
    """Axes along which the residual does not change when they are shifted; checked on pairs before it saves samples."""

    translation: list[str] = Field(min_length=1, description="axes that may be shifted without a change of the residual")


@final
class ReportConfig(Section):
    """What a run leaves behind besides `summary.json`; `beside` names specs whose certificates stand beside this one's."""

    html: bool = Field(True, description="write report.html?")
    rerun: bool = Field(True, description="write run.rrd?")
    beside: list[str] = Field(default_factory=list, description="specs whose certificates stand beside this one's")


_HiddenWord = Literal["refuse", "augment", "default"]
HIDDEN_WORDS = get_args(_HiddenWord)
HIDDEN_HINT = (
    f"write hidden: {' | '.join(HIDDEN_WORDS)}, or hidden: {{sample: {{ranges: ...}}}} or {{sample: {{visited: {{}}}}}}"
)


@final
class Visited(Section):
    """Hidden states met in `runs` rollouts of `steps` periods; at x, one of the `near` met closest to x."""

    runs: Count = Field(50, description="rollouts that visit hidden states")
    steps: Annotated[int, Field(strict=True, ge=2)] = Field(20, description="of each")
    near: Count = Field(8, description="visited states that may lend theirs")


@final
class Sample(Section):
    """Hidden state is drawn, from `ranges` or as `visited`, and bounded over; `safety` multiplies the measured spread."""

    ranges: Boxes | None = Field(default=None, min_length=1, description="hidden state → [low, high]")
    visited: Visited | None = Field(None, description="or drawn from rollouts")
    safety: Annotated[float, Field(strict=True, ge=1)] = Field(1.5, description="factor on the measured spread")

    @model_validator(mode="after")
    def _one(self) -> Sample:
        if (self.ranges is None) == (self.visited is None):
            raise ValueError("expected either `ranges: {state: [low, high]}` or `visited: {runs, steps, near}`")
        return self


@final
class Sampled(Section):
    sample: Sample = Field(description="how hidden state is drawn")


Hidden = _HiddenWord | Sampled
"""What is done about engine state outside (x, u) that matters."""


@final
@dataclass(frozen=True)
class HiddenConfig:
    """`ranges`: those of `sample:`, or of the domain with `augment`; as written, since only the backend knows their units."""

    mode: Literal["refuse", "augment", "default", "sample"] = "refuse"
    sample: Sample | None = None
    ranges: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)


@final
class Cut(Section):
    """A polytope: what linear inequalities such as `x + 2*y <= 1 m` leave of a box."""

    box: Boxes = Field(default_factory=dict, description="state → [low, high]")
    where: list[str] = Field(min_length=1, description="linear inequalities, such as x + 2*y <= 1 m")


@final
class Round(Section):
    """An ellipsoid along the axes: Σ ((x − centre) / radius)² ≤ 1 over the states that are named."""

    centre: dict[str, Bound] = Field(min_length=1, description="state → middle")
    radii: dict[str, Bound] = Field(min_length=1, description="state → half-axis")


def _which(value: Any) -> str:
    """Which branch is meant. In a box every key is a state with a list."""
    if isinstance(value, Cut) or (isinstance(value, Mapping) and ("where" in value or isinstance(value.get("box"), Mapping))):
        return "<cut>"
    round_ = isinstance(value, Mapping) and any(isinstance(value.get(k), Mapping) for k in ("centre", "radii"))
    return "<round>" if isinstance(value, Round) or round_ else "<box>"


Shape = Annotated[
    Annotated[Boxes, Tag("<box>")] | Annotated[Cut, Tag("<cut>")] | Annotated[Round, Tag("<round>")], Discriminator(_which)
]
Shapes = Annotated[
    Annotated[list[Shape], Tag("<list>"), Field(min_length=1)] | Annotated[Shape, Tag("<one>")],
    Discriminator(lambda value: "<list>" if isinstance(value, list) else "<one>"),
]


@final
class Targeted(Section):
    """Reach `target`, never touch `avoid`, stay in `stay` (default: the domain) until then, or for ever."""

    target: Shapes = Field(description="where the state is to come")
    avoid: list[Shape] = Field(default_factory=list, description="regions that it never touches")
    stay: Boxes | None = Field(None, description="the box that it never leaves; default: the domain")


GOALS = ("invariance", "reach", "reach_avoid", "reach_and_stay", "recurrence", "ltl", "automaton")


@final
class GoalConfig(Section):
    """One goal; regions are over states, and a state left out may be anywhere in the domain."""

    invariance: Boxes | None = Field(None, description="the box in which the state stays")
    reach: Shapes | None = Field(None, description="the region that it comes into")
    reach_avoid: Targeted | None = Field(None, description="a target, and what is avoided on the way")
    reach_and_stay: Targeted | None = Field(None, description="a target that is not left again")
    recurrence: Targeted | None = Field(None, description="a target that is visited again and again")
    ltl: str | None = Field(None, description="a formula over regions")
    automaton: Path | None = Field(None, description="a file in the HOA format")
    regions: dict[str, Shapes] | None = Field(None, description="name → region, for `ltl` and `automaton`")
    avoid: list[Shape] = Field(default_factory=list, description="beside these two: regions never touched")
    stay: Boxes | None = Field(None, description="beside these two: the box never left")

    @model_validator(mode="after")
    def _one(self) -> GoalConfig:
        if sum(getattr(self, kind) is not None for kind in GOALS) != 1:
            raise ValueError(f"expected exactly one of {', '.join(GOALS)}")
        worded = self.ltl is not None or self.automaton is not None
        if worded != (self.regions is not None) or ((self.avoid or self.stay) and not worded):
            raise ValueError("regions are needed with ltl or automaton, and there alone; avoid and stay there, or in the goal")
        return self


@final
@dataclass(frozen=True)
class Config:
    """A checked spec. Sections with a `kind` hold their plugin's config model; boxes are in the model's units, as floats.

    `sections` are those that plugins contribute, by name; `study` is the one that answers in place of a certificate, if any.
    """

    name: str
    seed: int = 0
    model: Any = None
    backend: Any = None
    domain: Mapping[str, tuple[float, float]] | None = None
    relations: tuple[str, ...] = ()
    coordinates: Mapping[str, str] = field(default_factory=dict)
    symmetries: SymmetriesConfig | None = None
    hidden: HiddenConfig = HiddenConfig()
    sampling: GridSampling | AdaptiveSampling | LatticeSampling | None = None
    lipschitz: Mapping[str, Any] = field(default_factory=dict)
    gap: Any = None
    certificate: CertificateConfig | None = None
    controller: Any = None
    goal: GoalConfig | None = None
    recording: Any = None
    reality: Any = None
    sections: Mapping[str, Any] = field(default_factory=dict)
    study: str = ""
    report: ReportConfig = field(default_factory=ReportConfig)
    expect: Mapping[str, Any] = field(default_factory=dict)
