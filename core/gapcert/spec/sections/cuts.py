"""The sections `relations`, `coordinates` and `symmetries` against the model."""

from __future__ import annotations

from typing import Literal

from gapcert.numerics.errors import UsageError
from gapcert.spec.models import unknown_key
from gapcert.spec.sections.config import Config
from gapcert.spec.text.source import At, Problem

Axes = dict[str, str]


def cut_problems(config: Config, states: Axes, inputs: Axes) -> list[Problem]:
    """What is wrong with relations, coordinates and symmetries. Nothing can be said of a model whose axes are not known."""
    units = {**states, **inputs}
    if not units or not (config.relations or config.symmetries or config.coordinates):
        return []
    from gapcert.contracts.data.inequality import MalformedError, parse, substitution
    from gapcert.numerics.constraint_zone import Relation, Zone

    problems, found = list[Problem](), list[Relation]()
    for k, text in enumerate(config.relations):
        try:
            found += parse(text, units)
        except MalformedError as error:
            problems.append(Problem(("relations", k), str(error), error.hint, offset=error.offset))
    for name, fault in substitution(config.coordinates, states, inputs)[1] if config.coordinates else ():
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
