"""The `goal:` of a spec as a Goal over a domain."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gapcert.domain import Box, Domain
from gapcert.goal import Goal, Region
from gapcert.spec.sections import GoalConfig


def goal(config: GoalConfig, domain: Domain) -> Goal:
    """Boxes over all states: a state that a box leaves out may be anywhere in the domain."""

    def box(ranges: Mapping[str, Any] | None) -> Box:
        states, chosen = domain.states, ranges or {}
        bounds = [chosen.get(n, (low, high)) for n, low, high in zip(states.names, states.low, states.high, strict=True)]
        return Box(states.axes, tuple(float(b[0]) for b in bounds), tuple(float(b[1]) for b in bounds))

    if config.invariance is not None:
        return Goal("invariance", box(config.invariance))
    if config.reach_avoid is not None:
        avoid = tuple(box(b) for b in config.reach_avoid.avoid)
        target = Region((box(config.reach_avoid.target),))
        return Goal("reach_avoid", box(config.reach_avoid.stay), target, Region(avoid) if avoid else None)
    return Goal("reach_avoid", box(None), Region((box(config.reach),)))
