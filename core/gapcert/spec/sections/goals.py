"""The `goal:` of a spec as a Goal over a domain."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gapcert.contracts.controllers.goal import Automaton, Goal
from gapcert.contracts.data.inequality import parse
from gapcert.contracts.systems.domain import Box, Domain
from gapcert.contracts.systems.region import Ellipsoid, Polytope, Region
from gapcert.numerics.errors import UsageError
from gapcert.spec.relations import read_automaton
from gapcert.spec.sections.sections import Cut, GoalConfig, Round


def goal(config: GoalConfig, domain: Domain, folder: Path) -> Goal:
    """Regions over all states: a state that one leaves out may be anywhere in the domain. folder: where paths start."""
    if config.invariance is not None:
        return Goal("invariance", _box(config.invariance, domain))
    if config.reach is not None:
        return Goal("reach_avoid", domain.states, region(config.reach, domain))
    for kind in ("reach_avoid", "reach_and_stay", "recurrence"):
        if (part := getattr(config, kind)) is not None:
            avoid = region(part.avoid, domain) if part.avoid else None
            return Goal(kind, _box(part.stay or {}, domain), region(part.target, domain), avoid)
    automaton = read_automaton("ltl", config.ltl) if config.ltl is not None else _read(folder, config.automaton)
    regions = config.regions or {}
    for name in automaton.propositions:
        if name not in regions:
            raise UsageError(f"controller.goal: the automaton reads '{name}', and there is no such region; add it to regions")
    own = tuple(region(regions[name], domain) for name in automaton.propositions)
    avoid = region(config.avoid, domain) if config.avoid else None
    return Goal("automaton", _box(config.stay or {}, domain), None, avoid, automaton, own)


def _read(folder: Path, path: Path | None) -> Automaton:
    assert path is not None, "a checked spec has a goal"
    try:
        return read_automaton("hoa", (folder / path).read_text(), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: cannot be read ({error})") from None


def region(given: Any, domain: Domain) -> Region:
    """A union, of one shape or of a list."""
    shapes = given if isinstance(given, list) else [given]
    boxes = [_box(s, domain) for s in shapes if not isinstance(s, Cut | Round)]
    units = {a.name: a.unit for a in domain.states.axes}
    cuts = [
        Polytope(_box(s.box, domain), tuple(r for text in s.where for r in parse(text, units)))
        for s in shapes
        if isinstance(s, Cut)
    ]
    rounds = [
        Ellipsoid.of(domain.states, *({n: float(v) for n, v in part.items()} for part in (s.centre, s.radii)))
        for s in shapes
        if isinstance(s, Round)
    ]
    return Region(tuple(boxes), tuple(cuts), tuple(rounds))


def _box(ranges: Mapping[str, Any], domain: Domain) -> Box:
    states = domain.states
    bounds = [ranges.get(n, (low, high)) for n, low, high in zip(states.names, states.low, states.high, strict=True)]
    return Box(states.axes, tuple(float(b[0]) for b in bounds), tuple(float(b[1]) for b in bounds))
