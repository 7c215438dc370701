"""Whether the ingredients of a question fit together: names, units, kinds and period of two Systems, routes and claims."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from gapcert.certification.routes import Route
from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.data.units import same_unit
from gapcert.contracts.gaps.gap import GapFamily
from gapcert.contracts.gaps.lipschitz import LipschitzEstimator
from gapcert.contracts.systems.system import Model, StateSpec, System
from gapcert.numerics.errors import UsageError


def unpaired(one: System, other: System) -> str:
    """Why steps of `other` cannot be laid beside those of `one`, or nothing: `its states are …, the model's …; …`."""
    for what in ("states", "inputs"):
        if said := unmatched(what, getattr(one, what), getattr(other, what)):
            return said
    if abs(one.period - other.period) > THRESHOLDS.same_period * one.period:
        return f"its period is {other.period:g} s, the model's {one.period:g} s; set them equal"
    return ""


def unmatched(what: str, want: Sequence[StateSpec], have: Sequence[StateSpec]) -> str:
    """Why axes `have` do not carry the numbers of the model's axes `want`, or nothing."""
    if [s.name for s in want] != [s.name for s in have]:
        return f"its {what} are {_names(have)}, the model's {_names(want)}; they must agree"
    for w, h in zip(want, have, strict=True):
        if w.unit != h.unit and not same_unit(w.unit, h.unit):
            said = f"its {what[:-1]} '{h.name}' is in '{h.unit}', the model's in '{w.unit}'"
            return f"{said}; numbers are compared as they are; declare one unit on both sides, and answer in it"
        if (w.kind, h.kind) in _APART:
            said = f"its {what[:-1]} '{h.name}' is of kind {h.kind}, the model's of kind {w.kind}"
            return f"{said}; the difference of their values would have no meaning; declare one kind on both sides"
    return ""


_APART = {(a, b) for a, b in pairwise(("real", "quaternion", "angle", "quaternion", "real"))}
"""Kinds of a pair that cannot be subtracted. An angle and a number can: in the geometry of the model's."""


def _names(specs: Sequence[StateSpec]) -> str:
    return ", ".join(s.name for s in specs)


def refuse(
    model: Model,
    backend: System,
    family: GapFamily,
    lipschitz: LipschitzEstimator,
    route: Route,
    claim: str,
    extremes: bool = False,
) -> None:
    """Raise UsageError for questions whose ingredients do not fit together."""
    if said := unpaired(model, backend):
        raise UsageError(f"certify: the backend does not fit the model: {said}")
    if route.name not in family.routes:
        raise UsageError(
            f"certificate.route: family '{family.name}' certifies by {' or '.join(family.routes)}, not by {route.name}"
        )
    if (claim == "assumed") != (route.claim == "assumed"):
        stated = route.claim == "assumed"
        said = "is declared, and no check makes that more than assumed" if stated else "is found, and not declared"
        raise UsageError(f"certificate.claim: found {claim}, and γ {said}; ask for another claim, or take another gap family")
    if extremes and route.cover and not family.extremes:
        raise UsageError(
            f"sampling.keep: family '{family.name}' on route {route.name} needs every sample, not only the extremes of coarse "
            f"cells; use keep: all, or family constant"
        )
    if claim == "deterministic" and lipschitz.provenance == "estimated":
        raise UsageError(
            "certificate.claim: deterministic needs Lipschitz constants that are declared or proved by intervals, and an "
            "estimate is neither; ask for a statistical claim, or choose another lipschitz.residual"
        )
    if model.hidden:
        declaration = f"hidden: {{sample: {{ranges: {{{model.hidden[0].name}: [low, high]}}}}}}"
        raise UsageError(
            f"certify: the model has hidden state ({_names(model.hidden)}), so its gap is no function of (x, u); declare "
            f"a range for each ({declaration}), measure them, or certify a model without them"
        )
    for role, system in (("model", model), ("backend", backend)):
        if "seed" in system.capabilities:
            raise UsageError(
                f"certify: the {role} is stochastic (capability 'seed'), so its gap is no function of (x, u); "
                f"certify a {role} whose noise is switched off, or whose draws are inputs"
                + ("; or take route: calibrate, whose claim counts the noise" if role == "backend" else "")
            )
