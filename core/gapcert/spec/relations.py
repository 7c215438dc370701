"""What must hold between sections: units and boxes against the model, claims against ingredients, sections that need others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from gapcert.contracts.data.units import grouped, magnitude
from gapcert.contracts.plugins.options import of_config
from gapcert.contracts.plugins.registry import Registry
from gapcert.spec.models import unknown_key
from gapcert.spec.sections.areas import GoalConfig, in_units
from gapcert.spec.sections.config import Config
from gapcert.spec.sections.cuts import cut_problems
from gapcert.spec.sections.hidden import HiddenConfig
from gapcert.spec.sections.plugin_sections import Axes, SpecSection
from gapcert.spec.sections.sections import GridSampling, LatticeSampling
from gapcert.spec.sections.simulator_absence import declared, declared_problems, measured, measured_problems, unasked
from gapcert.spec.text.source import At, Problem

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
    states, inputs = axes(config.model, data.get("model"))
    for section in ("backend", "reality"):
        problems += backend_axes(data.get(section), Axes(states, inputs), registry, (section,), getattr(config, section))
    problems += measured_problems(config, data, {**states, **inputs}, more)
    first, *others = [name for name, section in given.items() if section.alone] or [""]
    for name in others:
        told = f"'{name}' does not go with '{first}'"
        problems.append(Problem((name,), told, f"write it in a spec of its own, or {name}: null", "key"))
    for part in given.values():
        problems += part.relate(config, data, Axes(states, inputs), registry)
    units = {**states, **inputs}
    own, hidden = _split_domain(config, units)
    config = replace(config, domain=own, hidden=hidden)
    if hidden is not None:
        at = ("domain",) if hidden.mode == "augment" else ("hidden", "sample", "ranges")
        _box(hidden.ranges, at, {}, problems)  # only the backend knows their units
    if hidden is not None and hidden.mode == "augment":
        states = {**states, **dict.fromkeys(hidden.ranges, "1")}
    if config.domain is not None:
        problems += _coverage(config.domain, ("domain",), units)
        config = replace(config, domain=_box(config.domain, ("domain",), units, problems))
    if isinstance(config.sampling, GridSampling | LatticeSampling) and config.sampling.counts is not None and units:
        problems += _coverage(config.sampling.counts, ("sampling", "counts"), units)
    if isinstance(config.sampling, GridSampling) and config.sampling.cells is not None and units:
        problems += _coverage(config.sampling.cells, ("sampling", "cells"), units)
    problems += cut_problems(config, states, inputs)
    for section in ("controller", "gap"):
        problems += _keyed(getattr(config, section), data.get(section), (section,), Axes(states, inputs))
    if config.goal is not None:
        config = replace(config, goal=_goal(config.goal, states, inputs, config.domain or {}, problems))
    return config, problems


def _split_domain(config: Config, known: Mapping[str, str]) -> tuple[Mapping[str, tuple[Any, Any]] | None, HiddenConfig | None]:
    """(domain, hidden): with `augment`, ranges of names that the model does not have are those of hidden states."""
    hidden: HiddenConfig | None = config.hidden
    if config.domain is None or hidden is None or hidden.mode != "augment" or not known:
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


def axes(config: Any, section: Any) -> tuple[Units, Units]:
    """Names and units of a model's states and inputs: what its config's `axes()` says, else what its section declares.

    A coordinate `q` stands for the states `q` and `q_dot`. Empty where the section does not tell.
    """
    if (told := of_config(config, "axes")) is not None:
        return dict(told[0]), dict(told[1])
    if not isinstance(section, Mapping):
        return {}, {}
    coordinates = _units(section.get("coordinates"))
    speeds = {f"{q}_dot": "1/s" if unit == "1" else f"{grouped(unit)}/s" for q, unit in coordinates.items()}
    return {**coordinates, **speeds, **_units(section.get("states"))}, _units(section.get("inputs"))


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
    have_states, have_inputs = axes(config, section)
    for key, have, want in (("states", have_states, of_model.states), ("inputs", have_inputs, of_model.inputs)):
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
        for name, value in have.items() if key.values == "quantities" else ():
            try:
                magnitude(value, units.get(name, "1")) if name in units else None
            except ValueError as error:
                found.append(Problem((*path, name), str(error)))
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


def _box(box: Mapping[str, tuple[Any, Any]], path: At, units: Units, problems: list[Problem]) -> Ranges:
    """A box in the model's units; an unknown unit is checked for finiteness and order only."""
    out: Ranges = {}
    for name, (low, high) in box.items():
        bounds = []
        for i, value in enumerate((low, high)):
            if name not in units and isinstance(value, str):
                continue
            try:
                bounds.append(magnitude(value, units.get(name, "1")))
            except ValueError as error:
                problems.append(Problem((*path, name, i), str(error)))
        if len(bounds) == 2:
            if bounds[0] >= bounds[1]:
                state = "empty" if bounds[0] == bounds[1] else "inverted"
                problems.append(
                    Problem((*path, name), f"[{_short(low)}, {_short(high)}] is {state}; expected [low, high] with low < high")
                )
            else:  # what is wrong itself is no measure for others
                out[name] = (bounds[0], bounds[1])
    return out


def _short(bound: Any) -> str:
    return bound if isinstance(bound, str) else f"{bound:g}"


def _goal(
    goal: GoalConfig, states: Units, inputs: Units, domain: Mapping[str, tuple[Any, Any]], problems: list[Problem]
) -> GoalConfig:
    """The goal in the model's units; each of its boxes lies in the domain, and obstacles at least touch it."""

    def boxed(box: Mapping[str, Any], path: At, within: bool) -> Ranges:
        return _state_box(box, path, states, inputs, domain, within, problems)

    return in_units(goal, states, inputs, boxed, problems)


def _state_box(
    box: Mapping[str, Any],
    path: At,
    states: Units,
    inputs: Units,
    domain: Mapping[str, Any],
    within: bool,
    problems: list[Problem],
) -> Ranges:
    for name in box if states else ():
        if name in inputs:
            problems.append(
                Problem((*path, name), f"'{name}' is an input; a goal is about states ({', '.join(states)})", where="key")
            )
        elif name not in states:
            problems.append(unknown_key((*path, name), states, "state"))
    ranges = _box(box, path, {**states, **inputs}, problems)
    outside: Callable[[float, float, float, float], bool] = (
        (lambda a, b, low, high: a < low or b > high) if within else (lambda a, b, low, high: b < low or a > high)
    )
    for name, (a, b) in ranges.items():
        if name in domain and not isinstance(domain[name][0], str) and outside(a, b, *domain[name]):
            low, high = domain[name]
            problems.append(
                Problem(
                    (*path, name), f"[{a:g}, {b:g}] is outside the domain [{low:g}, {high:g}]", "shrink it, or widen domain:"
                )
            )
    return ranges
