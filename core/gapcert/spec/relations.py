"""What must hold between sections: units and boxes against the model, claims against ingredients, sections that need others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from gapcert.contracts.data.units import grouped, magnitude
from gapcert.contracts.plugins.options import of_config
from gapcert.contracts.plugins.registry import Registry, registry
from gapcert.numerics.errors import UsageError
from gapcert.spec.models import near, unknown_key
from gapcert.spec.sections.plugin_sections import Axes, SpecSection
from gapcert.spec.sections.sections import GOALS, Config, Cut, GoalConfig, GridSampling, HiddenConfig, Round, Targeted
from gapcert.spec.sections.simulator_absence import declared, declared_problems, measured, measured_problems, unasked
from gapcert.spec.source import At, Problem

if TYPE_CHECKING:
    from gapcert.contracts.controllers.goal import Automaton
    from gapcert.numerics.constraint_zone import Relation

NEEDS = {
    "certificate": ("model", "backend", "domain"),
    "controller": ("certificate",),
    "relations": ("domain",),
    "coordinates": ("domain",),
    "symmetries": ("domain",),
    "hidden": ("backend", "domain"),
}
MEASURED = (("certificate", "backend"),)  # not needed where a recording stands for the backend
DECLARED = (("certificate", "backend"), ("controller", "certificate"))  # nor where a declared gap does
INSTEAD = {"backend": ("reality",), "recording": ("reality",)}
SEEN = ("recording", "reality")
"""What means nothing but to a section that needs a recording."""
STRENGTH = ("assumed", "empirical", "statistical", "deterministic")
Ranges = dict[str, tuple[float, float]]
Units = dict[str, str]


def relate(
    config: Config, data: Mapping[str, Any], registry: Registry, more: Mapping[str, SpecSection]
) -> tuple[Config, list[Problem]]:
    """The config with its boxes in the model's units, and what does not fit together."""
    given = {name: section for name, section in more.items() if name in data}
    problems = _needs(data, registry, more) + _period(config, given) + _claims(config, data, registry, more)
    problems += declared_problems(config, data, registry, more)
    known = axes(config.model, data.get("model"))
    for section in ("backend", "reality"):
        problems += backend_axes(data.get(section), known, registry, (section,), getattr(config, section))
    units = {**known.states, **known.inputs}
    problems += measured_problems(config, data, units, more)
    first, *others = [name for name, section in given.items() if section.alone] or [""]
    for name in others:
        told = f"'{name}' does not go with '{first}'"
        problems.append(Problem((name,), told, f"write it in a spec of its own, or {name}: null", "key"))
    for part in given.values():
        problems += part.relate(config, data, known, registry)
    own, hidden = _split_domain(config, units)
    config = replace(config, domain=own, hidden=hidden)
    at = ("domain",) if hidden.mode == "augment" else ("hidden", "sample", "ranges")
    _box(hidden.ranges, at, {}, problems)  # only the backend knows their units
    if hidden.mode == "augment":
        known = known._replace(states={**known.states, **dict.fromkeys(hidden.ranges, "1")})
    if config.domain is not None:
        problems += _coverage(config.domain, ("domain",), units)
        config = replace(config, domain=_box(config.domain, ("domain",), units, problems))
    for option in ("counts", "cells"):
        if (numbers := getattr(config.sampling, option, None)) is not None:
            problems += _coverage(numbers, ("sampling", option), units)
    problems += _cuts(config, known)
    for section in ("controller", "gap"):
        problems += _keyed(getattr(config, section), data.get(section), (section,), known)
    if config.goal is not None:
        config = replace(config, goal=_goal(config.goal, known, config.domain or {}, problems))
    return config, problems


def _split_domain(config: Config, known: Mapping[str, str]) -> tuple[Mapping[str, tuple[Any, Any]] | None, HiddenConfig]:
    """(domain, hidden): with `augment`, ranges of names that the model does not have are those of hidden states."""
    hidden = config.hidden
    if config.domain is None or hidden.mode != "augment" or not known:
        return config.domain, hidden
    own = {n: r for n, r in config.domain.items() if n in known}
    return own, replace(hidden, ranges={n: r for n, r in config.domain.items() if n not in known})


def _period(config: Config, given: Mapping[str, SpecSection]) -> list[Problem]:
    """A model may leave its period to a recording; a certificate has none."""
    left_out = of_config(config.model, "untimed")
    due = config.certificate is not None or config.controller is not None or any(s.alone for s in given.values())
    if not left_out or not due or any(s.timed for s in given.values()):
        return []
    return [Problem(("model",), "missing required key 'period'", "add period:, such as 5 ms", "key")]


def axes(config: Any, section: Any) -> Axes:
    """Names and units of a model's states and inputs: what its config's `axes()` says, else what its section declares.

    A coordinate `q` stands for the states `q` and `q_dot`. Empty where the section does not tell.
    """
    if (told := of_config(config, "axes")) is not None:
        return Axes(dict(told[0]), dict(told[1]))
    if not isinstance(section, Mapping):
        return Axes({}, {})
    coordinates = _units(section.get("coordinates"))
    speeds = {f"{q}_dot": "1/s" if unit == "1" else f"{grouped(unit)}/s" for q, unit in coordinates.items()}
    return Axes({**coordinates, **speeds, **_units(section.get("states"))}, _units(section.get("inputs")))


def _units(given: Any) -> Units:
    if not isinstance(given, Mapping):
        return {}
    written = {str(n): d.get("unit", 1) if isinstance(d, Mapping) else d or 1 for n, d in given.items()}
    return {n: "1" if unit == 1 else str(unit) for n, unit in written.items()}


def _needs(data: Mapping[str, Any], registry: Registry, more: Mapping[str, SpecSection]) -> list[Problem]:
    needs = NEEDS | {name: section.needs for name, section in more.items()}
    instead = {k: {*v, *(n for n, section in more.items() if k in section.instead)} for k, v in INSTEAD.items()}
    readers = [name for name, section in more.items() if "recording" in section.needs]
    if not measured(data, more) and not any(name in data for name in readers):
        needs |= dict.fromkeys(SEEN, tuple(readers[:1]))
    return [
        Problem((section,), f"'{section}' needs '{needed}', which is missing", f"add {needed}:", "key")
        for section, others in needs.items()
        if section in data
        for needed in others
        if needed not in data
        and not (measured(data, more) and (section, needed) in MEASURED)
        and not (unasked(data, registry, more) and (section, needed) in DECLARED)
        and not any(other in data for other in instead.get(needed, ()))
    ]


def _claims(config: Config, data: Mapping[str, Any], registry: Registry, more: Mapping[str, SpecSection]) -> list[Problem]:
    """A claim is no stronger than the weakest thing that it rests on."""
    if (certificate := config.certificate) is None:
        return []
    found = []
    residual = config.lipschitz.get("residual")
    unproved = certificate.claim == "deterministic" and not measured(data, more) and not declared(data, registry)
    if unproved and residual is None and "residual" not in (data.get("lipschitz") or {}):
        hint = "add lipschitz: {residual: {kind: interval}} or declared constants"
        found.append(Problem(("certificate", "claim"), "a deterministic claim needs constants that are no estimates", hint))
    if certificate.route == "theorem1" and not isinstance(config.sampling, GridSampling) and "sampling" in data:
        hint = "use sampling: {kind: grid, ...}, or route: dominate"
        found.append(
            Problem(("certificate", "route"), "theorem1 needs a cover of known radius, which adaptive sampling is not", hint)
        )
    rests: dict[str, tuple[tuple[str, ...], Any]] = {
        "backend": (("backend", "model"), config.backend or config.reality),
        "gap": (("gap_family",), config.gap),
        "lipschitz.residual": (("lipschitz",), residual),
    }
    for section, (kinds, part) in rests.items():
        component = None if part is None else registry.find(kinds, part.kind)
        if component is not None and STRENGTH.index(component.claim) < STRENGTH.index(certificate.claim):
            message = f"{section} '{component.name}' cannot give a {certificate.claim} claim, {component.claim} at most"
            found.append(Problem(("certificate", "claim"), message, f"use claim: {component.claim}, or another {section}"))
    return found


def backend_axes(section: Any, of_model: Axes, registry: Registry, at: At, config: Any = None) -> list[Problem]:
    """A backend, whose options are in `config`, has the model's states and inputs, by name."""
    if not isinstance(section, Mapping):
        return []
    found = _keyed(config, section, at, of_model)
    component = registry.find(("backend", "model"), str(section.get("kind")))
    if component is not None and component.of:
        inner = None if config is None else config.of
        return found + backend_axes(section.get("of"), of_model, registry, (*at, "of"), inner)
    for key, have, want in zip(Axes._fields, axes(config, section), of_model, strict=True):
        if have and want:
            place = key if key in section else "coordinates"
            found += _coverage(have, (*at, place), want, what=f"the model's {key}")
    return found


def _keyed(config: Any, section: Any, at: At, of_model: Axes) -> list[Problem]:
    """What is wrong with options that go by names of the model. Only what is written has to fit: a default is the plugin's."""
    found: list[Problem] = []
    for key in of_config(config, "keyed"):
        path, units = (*at, key.option), getattr(of_model, key.axes)
        # A name that is no state of the model is reported where states are named first.
        want = {n: u for n, u in units.items() if key.among is None or n in key.among}
        if key.option not in section or (have := getattr(config, key.option)) is None:
            continue
        if not isinstance(have, Mapping):
            problems = [(k, unknown_key((n,), units, "state or input")) for k, n in enumerate(have) if units and n not in units]
            found += [Problem((*path, k), p.message, p.hint) for k, p in problems]
        elif key.every:
            found += _coverage(have, path, want, f"the model's {key.axes}")
        else:
            found += [unknown_key((*path, n), want, key.axes.removesuffix("s")) for n in have if want and n not in want]
        if key.values == "ranges":
            _box(have, path, units, found)
        for name in have if key.values == "quantities" else ():
            if name in units:
                _number(have[name], units[name], (*path, name), found)
    return found


def _coverage(have: Mapping[str, Any], path: At, want: Units, what: str = "the model's states and inputs") -> list[Problem]:
    """Names that should be there and are not, or the other way round."""
    if not want:
        return []
    found = [unknown_key((*path, n), want, "state or input") for n in have if n not in want]
    if missing := [n for n in want if n not in have]:
        found.append(
            Problem(
                path,
                f"nothing for '{missing[0]}'; every one of {what} is needed ({', '.join(want)})",
                f"add {missing[0]}:",
                "key",
            )
        )
    return found


def _number(value: Any, unit: str, at: At, problems: list[Problem]) -> float | None:
    """A quantity in a unit; None, and a problem, where it is none."""
    try:
        return magnitude(value, unit)
    except ValueError as error:
        problems.append(Problem(at, str(error)))
        return None


def _box(box: Mapping[str, tuple[Any, Any]], path: At, units: Units, problems: list[Problem]) -> Ranges:
    """A box in the model's units; an unknown unit is checked for finiteness and order only."""
    out: Ranges = {}
    for name, (low, high) in box.items():
        ends = [(i, end) for i, end in enumerate((low, high)) if name in units or not isinstance(end, str)]
        bounds = [b for i, end in ends if (b := _number(end, units.get(name, "1"), (*path, name, i), problems)) is not None]
        if len(bounds) == 2 and bounds[0] >= bounds[1]:
            state = "empty" if bounds[0] == bounds[1] else "inverted"
            told = f"[{_short(low)}, {_short(high)}] is {state}; expected [low, high] with low < high"
            problems.append(Problem((*path, name), told))
        elif len(bounds) == 2:  # what is wrong itself is no measure for others
            out[name] = (bounds[0], bounds[1])
    return out


def _short(bound: Any) -> str:
    return bound if isinstance(bound, str) else f"{bound:g}"


def _goal(goal: GoalConfig, axes: Axes, domain: Mapping[str, tuple[Any, Any]], problems: list[Problem]) -> GoalConfig:
    """The goal in the model's units; each of its boxes lies in the domain, and obstacles at least touch it."""
    at: At = ("controller", "goal")

    def boxed(box: Mapping[str, Any], path: At, within: bool) -> Any:
        return _state_box(box, path, axes, domain, within, problems)

    def shape(value: Any, path: At, within: bool) -> Any:
        if isinstance(value, list):
            return [shape(v, (*path, i), within) for i, v in enumerate(value)]
        if isinstance(value, Cut):
            _parsed(value.where, axes.states, (*path, "where"), problems)
            return Cut.model_construct(box=boxed(value.box, (*path, "box"), within), where=value.where)
        if isinstance(value, Round):
            return _round(value, path, axes, problems)
        return boxed(value, path, within)

    def targeted(value: Targeted, path: At) -> Targeted:
        return Targeted.model_construct(
            target=shape(value.target, (*path, "target"), True),
            avoid=shape(value.avoid, (*path, "avoid"), False),
            stay=None if value.stay is None else boxed(value.stay, (*path, "stay"), True),
        )

    out: dict[str, Any] = {}
    for kind in GOALS:
        if (value := getattr(goal, kind)) is not None and kind not in ("ltl", "automaton"):
            out[kind] = targeted(value, (*at, kind)) if isinstance(value, Targeted) else shape(value, (*at, kind), True)
    if goal.regions is None:
        return GoalConfig.model_construct(None, **out)
    if goal.ltl is not None:
        _worded(goal.ltl, goal.regions, at, problems)
    return GoalConfig.model_construct(
        ltl=goal.ltl,
        automaton=goal.automaton,
        regions={name: shape(r, (*at, "regions", name), False) for name, r in goal.regions.items()},
        avoid=shape(goal.avoid, (*at, "avoid"), False),
        stay=None if goal.stay is None else boxed(goal.stay, (*at, "stay"), True),
    )


def _worded(text: str, regions: Mapping[str, Any], at: At, problems: list[Problem]) -> None:
    """Is the formula one that can be kept, over the regions that there are?"""
    try:
        names = read_automaton("ltl", text).propositions
    except UsageError as error:
        problems.append(Problem((*at, "ltl"), str(error).partition("ltl: ")[2]))
        return
    problems += [Problem((*at, "ltl"), f"no region '{n}'", near(n, regions)) for n in names if n not in regions]
    unused = [n for n in regions if n not in names]
    problems += [Problem((*at, "regions", n), f"region '{n}' is not in the formula", near(n, names), "key") for n in unused]


def read_automaton(form: str, *text: str) -> Automaton:
    """What a text of this form says, by the component that reads it."""
    automaton: Automaton = registry().get("automaton", form).load()(*text)
    return automaton


def _parsed(texts: Sequence[str], units: Units, path: At, problems: list[Problem]) -> list[Relation]:
    """Linear inequalities; nothing can be said of a model whose axes are not known."""
    from gapcert.contracts.data.inequality import MalformedError, parse

    found: list[Relation] = []
    for k, text in enumerate(texts if units else ()):
        try:
            found += parse(text, units)
        except MalformedError as error:
            problems.append(Problem((*path, k), str(error), error.hint, offset=error.offset))
    return found


def _state_box(
    box: Mapping[str, Any], path: At, axes: Axes, domain: Mapping[str, Any], within: bool, problems: list[Problem]
) -> Ranges:
    strange = [n for n in box if axes.states and (n in axes.inputs or n not in axes.states)]
    problems += [_no_state((*path, n), axes) for n in strange]
    ranges = _box(box, path, {**axes.states, **axes.inputs}, problems)
    outside: Callable[[float, float, float, float], bool] = (
        (lambda a, b, low, high: a < low or b > high) if within else (lambda a, b, low, high: b < low or a > high)
    )
    for name, (a, b) in ranges.items():
        if name in domain and not isinstance(domain[name][0], str) and outside(a, b, *domain[name]):
            low, high = domain[name]
            told = f"[{a:g}, {b:g}] is outside the domain [{low:g}, {high:g}]"
            problems.append(Problem((*path, name), told, "shrink it, or widen domain:"))
    return ranges


def _no_state(at: At, axes: Axes) -> Problem:
    """About a name that is no state's."""
    what = f"'{at[-1]}' is an input; a goal is about states ({', '.join(axes.states)})"
    return Problem(at, what, where="key") if at[-1] in axes.inputs else unknown_key(at, axes.states, "state")


def _round(value: Round, path: At, axes: Axes, problems: list[Problem]) -> Round:
    made: dict[str, dict[str, Any]] = {"centre": {}, "radii": {}}
    for part, numbers in made.items():
        for name, given in getattr(value, part).items():
            at = (*path, part, name)
            if axes.states and name not in axes.states:
                problems.append(_no_state(at, axes))
            elif (number := _number(given, axes.states.get(name, "1"), at, problems)) is not None:
                numbers[name] = number
                if part == "radii" and not number > 0:
                    problems.append(Problem(at, f"found {number:g}; expected a positive radius"))
    if set(value.centre) != set(value.radii):
        odd = sorted(set(value.centre) ^ set(value.radii))[0]
        have, lack = ("centre", "radii") if odd in value.centre else ("radii", "centre")
        problems.append(Problem((*path, have, odd), f"'{odd}' is not in {lack}", f"name the same states in {lack}", "key"))
    return Round.model_construct(None, **made)


def _cuts(config: Config, axes: Axes) -> list[Problem]:
    """What is wrong with relations, coordinates and symmetries. Nothing can be said of a model whose axes are not known."""
    units = {**axes.states, **axes.inputs}
    if not units or not (config.relations or config.symmetries or config.coordinates):
        return []
    from gapcert.contracts.data.inequality import substitution
    from gapcert.numerics.constraint_zone import Zone

    problems = list[Problem]()
    found = _parsed(config.relations, units, ("relations",), problems)
    for name, fault in substitution(config.coordinates, *axes)[1] if config.coordinates else ():
        place: At = ("coordinates", name) if name else ("coordinates",)
        where: Literal["key", "value"] = "value" if fault.offset >= 0 else "key"
        problems.append(Problem(place, str(fault), fault.hint, where, max(fault.offset, 0)))
    ends = zip(*((config.domain or {}).get(name, ("", "")) for name in units), strict=True)
    low, high = (tuple(end for end in side if isinstance(end, float)) for side in ends)
    if found and not problems and len(low) == len(high) == len(units):
        import numpy as np

        try:
            Zone(low, high, tuple(found)).draw(1, np.random.default_rng(0))
        except UsageError as error:
            problems.append(Problem(("relations",), str(error).partition(": ")[2]))
    for k, name in enumerate(config.symmetries.translation if config.symmetries else ()):
        at = ("symmetries", "translation", k)
        if name not in units:
            unknown = unknown_key((name,), units, "state or input")
            problems.append(Problem(at, unknown.message, unknown.hint))
        elif bound := next((r for r in found if r.coefficients[list(units).index(name)]), None):
            hint = "leave it out of one of them"
            problems.append(Problem(at, f"'{name}' stands in the relation '{bound.text}', which a shift may break", hint))
    return problems
