"""The `goal:` of a spec as a Goal over a domain."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gapcert.domain import Box, Domain
from gapcert.goal import Goal
from gapcert.region import Ellipsoid, Polytope, Region
from gapcert.spec.areas import Cut, GoalConfig, Round
from gapcert.spec.inequality import parse


def goal(config: GoalConfig, domain: Domain) -> Goal:
    """Regions over all states: a state that one leaves out may be anywhere in the domain."""
    if config.invariance is not None:
        return Goal("invariance", _box(config.invariance, domain))
    if config.reach is not None:
        return Goal("reach_avoid", domain.states, region(config.reach, domain))
    for kind in ("reach_avoid", "reach_and_stay", "recurrence"):
        if (part := getattr(config, kind)) is not None:
            avoid = region(part.avoid, domain) if part.avoid else None
            return Goal(kind, _box(part.stay or {}, domain), region(part.target, domain), avoid)
    raise AssertionError("a checked spec has a goal")


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
