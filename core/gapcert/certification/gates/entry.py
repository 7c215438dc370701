"""What every certificate passes before its first sample."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

import numpy as np

from gapcert.certification.gates.hidden_distribution import HiddenDraws, Paired
from gapcert.certification.gates.hidden_state import Gate, HiddenPlan, open_gate
from gapcert.certification.gates.purity import purity
from gapcert.certification.gates.response import responses
from gapcert.certification.samples.store import Store
from gapcert.contracts.gaps.lipschitz import Residual
from gapcert.contracts.plugins.events import Emit, Event, Pulse
from gapcert.contracts.systems.domain import Domain, Points
from gapcert.contracts.systems.system import Model, System
from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError


def contain(model: Model, domain: Domain) -> None:
    """UsageError where a domain goes to where the model no longer holds."""
    for s, low, high in zip(domain.axes, domain.low.tolist(), domain.high.tolist(), strict=True):
        first, last = model.within.get(s.name, (-np.inf, np.inf))
        # An effort is cut beyond its end, a joint is held at it.
        if not (first <= low and high <= last) or (s in domain.states.axes and not (first < low and high < last)):
            raise UsageError(
                f"domain.{s.name}: reaches from {low:.6g} to {high:.6g} {s.unit}, and the joint's range is {first:.6g} to "
                f"{last:.6g} in the robot file; the equations of the bodies know no ends; expected a domain inside"
            )


def enter(
    model: Model,
    backend: System,
    domain: Domain,
    plan: HiddenPlan,
    claim: str,
    executor: Callable[[], Executor],
    seed: int,
    emit: Emit,
) -> Gate:
    """Both systems are functions of their arguments, hidden state is dealt with, inputs arrive; UsageError otherwise."""
    pulse, probes = Pulse(emit, "gates", unit="probes"), itertools.count(1)
    for role, system in (("model", model), ("backend", backend)):
        probed = purity(role, system, domain, executor, seed, lambda what, r=role: pulse(next(probes), text=f"{r} {what}"))  # type: ignore[misc]
    gate = open_gate(model, backend, domain, plan, seed, lambda what: pulse(next(probes), text=f"hidden state, {what}"))
    pulse(next(probes), text="do inputs arrive?")
    if claim == "deterministic" and gate.distribution:
        raise UsageError(
            f"certificate.claim: deterministic cannot be had with hidden: {gate.plan.mode}, which estimates or leaves out what "
            f"hidden state does ({', '.join(gate.names)}); use hidden: augment, or ask for a statistical claim"
        )
    warnings = tuple(responses(Residual(gate.system, model), domain, seed))
    for warning in warnings:
        emit(Event("warning", "gates", {"message": warning}))
    return replace(gate, purity=probed, warnings=warnings)


def paired(store: Store, gate: Gate) -> Callable[[str, Array], Array] | None:
    """`LipschitzProblem.paired` where hidden state is drawn: pairs under common hidden states, in rounds of their own."""
    if not isinstance(gate.system, HiddenDraws):
        return None
    residual: Any = Paired(store.residual.model, gate.system)
    beside = replace(store, residual=residual)
    return lambda name, both: beside.collect(name, Points(both))
