"""The `goal:` of a controller as it is written: regions of states, and one of the kinds of goals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, final

from pydantic import Discriminator, Field, Tag, model_validator

from gapcert.contracts.data.units import magnitude
from gapcert.contracts.plugins.registry import registry
from gapcert.numerics.errors import UsageError
from gapcert.spec.models import near, unknown_key
from gapcert.spec.sections.sections import Bound, Boxes, Section
from gapcert.spec.text.source import At, Problem

if TYPE_CHECKING:
    from gapcert.contracts.controllers.goal import Automaton


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


KINDS = ("invariance", "reach", "reach_avoid", "reach_and_stay", "recurrence", "ltl", "automaton")


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
        if sum(getattr(self, kind) is not None for kind in KINDS) != 1:
            raise ValueError(f"expected exactly one of {', '.join(KINDS)}")
        worded = self.ltl is not None or self.automaton is not None
        if worded != (self.regions is not None) or ((self.avoid or self.stay) and not worded):
            raise ValueError("regions are needed with ltl or automaton, and there alone; avoid and stay there, or in the goal")
        return self


Axes = Mapping[str, str]
Boxed = Callable[[Mapping[str, Any], At, bool], Any]


def in_units(goal: GoalConfig, states: Axes, inputs: Axes, boxed: Boxed, problems: list[Problem]) -> GoalConfig:
    """The goal in the model's units. boxed(box, path, within): a box in those units, which lies in the domain or touches it."""
    at: At = ("controller", "goal")

    def shape(value: Any, path: At, within: bool) -> Any:
        if isinstance(value, list):
            return [shape(v, (*path, i), within) for i, v in enumerate(value)]
        if isinstance(value, Cut):
            _parsed(value.where, states, (*path, "where"), problems)
            return Cut.model_construct(box=boxed(value.box, (*path, "box"), within), where=value.where)
        if isinstance(value, Round):
            return _round(value, path, states, inputs, problems)
        return boxed(value, path, within)

    def targeted(value: Targeted, path: At) -> Targeted:
        return Targeted.model_construct(
            target=shape(value.target, (*path, "target"), True),
            avoid=shape(value.avoid, (*path, "avoid"), False),
            stay=None if value.stay is None else boxed(value.stay, (*path, "stay"), True),
        )

    out: dict[str, Any] = {}
    for kind in KINDS:
        if (value := getattr(goal, kind)) is not None and kind not in ("ltl", "automaton"):
            out[kind] = targeted(value, (*at, kind)) if isinstance(value, Targeted) else shape(value, (*at, kind), True)
    if goal.regions is None:
        return GoalConfig.model_construct(None, **out)
    if goal.ltl is not None:
        _worded(goal.ltl, goal.regions, problems)
    return GoalConfig.model_construct(
        ltl=goal.ltl,
        automaton=goal.automaton,
        regions={name: shape(r, (*at, "regions", name), False) for name, r in goal.regions.items()},
        avoid=shape(goal.avoid, (*at, "avoid"), False),
        stay=None if goal.stay is None else boxed(goal.stay, (*at, "stay"), True),
    )


def read_automaton(form: str, *text: str) -> Automaton:
    """What a text of this form says, by the component that reads it."""
    automaton: Automaton = registry().get("automaton", form).load()(*text)
    return automaton


def _worded(text: str, regions: Mapping[str, Any], problems: list[Problem]) -> None:
    """Is the formula one that can be kept, over the regions that there are?"""
    try:
        names = read_automaton("ltl", text).propositions
    except UsageError as error:
        problems.append(Problem(("controller", "goal", "ltl"), str(error).partition("ltl: ")[2]))
        return
    at: At = ("controller", "goal")
    problems += [Problem((*at, "ltl"), f"no region '{n}'", near(n, regions)) for n in names if n not in regions]
    unused = [n for n in regions if n not in names]
    problems += [Problem((*at, "regions", n), f"region '{n}' is not in the formula", near(n, names), "key") for n in unused]


def _parsed(texts: list[str], states: Axes, path: At, problems: list[Problem]) -> None:
    from gapcert.contracts.data.inequality import MalformedError, parse

    for k, text in enumerate(texts):
        try:
            parse(text, states) if states else ()
        except MalformedError as error:
            problems.append(Problem((*path, k), str(error), error.hint, offset=error.offset))


def _round(value: Round, path: At, states: Axes, inputs: Axes, problems: list[Problem]) -> Round:
    made: dict[str, dict[str, Any]] = {"centre": {}, "radii": {}}
    for part, numbers in made.items():
        for name, given in getattr(value, part).items():
            if states and name not in states:
                what = f"'{name}' is an input; a goal is about states ({', '.join(states)})"
                at = (*path, part, name)
                problems.append(Problem(at, what, where="key") if name in inputs else unknown_key(at, states, "state"))
                continue
            try:
                numbers[name] = magnitude(given, states.get(name, "1"))
            except ValueError as error:
                problems.append(Problem((*path, part, name), str(error)))
            else:
                if part == "radii" and not numbers[name] > 0:
                    problems.append(Problem((*path, part, name), f"found {numbers[name]:g}; expected a positive radius"))
    if set(value.centre) != set(value.radii):
        odd = sorted(set(value.centre) ^ set(value.radii))[0]
        have, lack = ("centre", "radii") if odd in value.centre else ("radii", "centre")
        problems.append(Problem((*path, have, odd), f"'{odd}' is not in {lack}", f"name the same states in {lack}", "key"))
    return Round.model_construct(None, **made)
