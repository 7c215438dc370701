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
from gapcert.certification.gates.purity import answered, purity
from gapcert.certification.samples.store import Store
from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.gaps.lipschitz import Residual
from gapcert.contracts.plugins.events import Emit, Event, Pulse
from gapcert.contracts.systems.arithmetic import Arithmetic
from gapcert.contracts.systems.domain import Domain, Points
from gapcert.contracts.systems.system import Model, System, difference
from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError

_ULPS = np.array([-1e6, -400.0, -64.0, -4.0, -1.0, 0.0, 1.0, 4.0, 64.0, 400.0, 1e6])
_EVEN = np.array([-10.0, -7.0, -5.0, -3.0, 0.0, 3.0, 5.0, 7.0, 10.0])


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

    def told(of: str) -> Callable[[str], None]:
        return lambda what: pulse(next(probes), text=f"{of} {what}")

    first = answered(backend, domain, seed)
    for role, system in (("model", model), ("backend", backend)):
        probed = purity(role, system, domain, executor, seed, told(role))
    gate = open_gate(model, backend, domain, plan, seed, told("hidden state,"))
    pulse(next(probes), text="do inputs arrive?")
    if claim == "deterministic" and gate.probe is not None and not gate.probe.harmless:
        raise UsageError(
            f"certificate.claim: deterministic cannot be had with hidden: {gate.plan.mode}, which estimates or leaves out what "
            f"hidden state does ({', '.join(gate.names)}); use hidden: augment, or ask for a statistical claim"
        )
    warnings = tuple(responses(Residual(gate.system, model), domain, seed))
    for warning in warnings:
        emit(Event("warning", "gates", {"message": warning}))
    return replace(gate, purity=probed, warnings=warnings, first=first, jitter=jitter(backend, domain, seed))


def jitter(system: System, domain: Domain, seed: int) -> Array | None:
    """(nx,): how far x⁺ is from the best parabola in z, at most, at points of Z; None where e is proved, or of rotations.

    Over 1 to 10⁶ ulp, where f̂ itself is one; and over 2e-7 of Z or of z, since single precision takes steps that long. A bend
    leaves 1/64 as much over a quarter of that way, and does not count.
    """
    if Arithmetic.of(system, domain).proved or "quaternion" in [s.kind for s in system.states]:
        return None
    z = domain.draw(THRESHOLDS.repeat_rows, np.random.default_rng([seed, 0x177E]))
    ulp, inwards = np.spacing(np.abs(z)), np.where(z < domain.centre, 1.0, -1.0)
    wide = np.minimum(2e-7 * np.maximum(np.abs(z), domain.width), 0.001 * domain.width) / _EVEN[-1]
    # Powers of two, so that floats are where they are said to be.
    wide = np.maximum(2.0 ** np.floor(np.log2(wide)), 4 * ulp)[::2] * inwards[::2]
    fine, outer, inner = (
        _unlike_parabola(system, domain, *given)
        for given in ((z, _ULPS, ulp * inwards), (z[::2], _EVEN, wide), (z[::2], _EVEN, wide / 4))
    )
    bends = (inner > outer / 160) & (inner < outer / 16)
    # Where most points bend, others are inflections.
    most = np.where(bends.mean(axis=0) > 0.5, np.where(bends, outer, 0.0).max(axis=0), 0.0)
    return np.asarray(np.concatenate([fine, np.where(bends | (outer < most), 0.0, outer)]).max(axis=0))


def _unlike_parabola(system: System, domain: Domain, z: Array, t: Array, step: Array) -> Array:
    """(n, nx), at z + t · step: errors within e leave |Σ w_k y_k| ≤ e Σ |w_k|, w the weights of the third divided difference of
    any four answers y.
    """
    near = (z[:, None] + t[:, None] * step[:, None]).reshape(-1, z.shape[1])
    x = system.step(*domain.split(near)).x
    y = difference(system.states, x, x[:: len(t)].repeat(len(t), axis=0)).reshape(len(z), len(t), -1)
    fours = np.array([*itertools.combinations(range(len(t)), 4)])
    w = 1 / (t[fours][:, :, None] - t[fours][:, None] + np.eye(4)).prod(axis=2)
    return np.asarray((np.abs((y[:, fours] * w[..., None]).sum(axis=2)) / np.abs(w).sum(axis=1)[:, None]).max(axis=1))


def responses(residual: Residual, domain: Domain, seed: int) -> list[str]:
    """One sentence per input and state where f̂ moves by other than 0.9 to 1.1 times what f does, from end to end of what
    Z leaves of U.

    Ratio ρ = Σ Δf̂ Δf / Σ Δf² over 16 random states. ρ = 0: a motor or a lock holds the joint; else most often another period,
    inertia or gain. A certificate stays true then, and its γ is large.
    """
    model, said = residual.model, []
    z = domain.draw(THRESHOLDS.response_rows, np.random.default_rng([seed, 0x2E5]))
    if not domain.relations:
        z[:, domain.nx :] = (domain.low + domain.high)[domain.nx :] / 2
    resolution = residual.resolution(domain)
    for j, spec in enumerate(model.inputs, domain.nx):
        at = [domain.split(np.where(np.arange(z.shape[1]) == j, b[:, None], z)) for b in domain.chord(z, j)]
        ends = [[s.step(*end).x for s in (residual.backend, model)] for end in at]
        there, here = (difference(model.states, high, low) for low, high in zip(*ends, strict=True))
        for i, state in enumerate(model.states):
            # What f does not move within one step beyond rounding has no ratio.
            if np.abs(here[:, i]).mean() <= 100 * resolution[i]:
                continue
            ratio = float((there[:, i] * here[:, i]).sum() / (here[:, i] ** 2).sum())
            if np.abs(there[:, i]).max() <= 4 * resolution[i]:
                said.append(
                    f"{state.name} of f̂ does not answer to {spec.name} at all, and that of f does; look for a motor or a lock "
                    f"that holds the joint, or a wrong joint name"
                )
            elif abs(ratio - 1) > THRESHOLDS.response_error:
                said.append(
                    f"{spec.name} moves {state.name} of f̂ {ratio:.2g} times as far as that of f; look for another time step, "
                    f"inertia or gain, unless that is the question"
                )
    return said


def paired(store: Store, gate: Gate) -> Callable[[str, Array], Array] | None:
    """`LipschitzProblem.paired` where hidden state is drawn: pairs under common hidden states, in rounds of their own."""
    if not isinstance(gate.system, HiddenDraws):
        return None
    residual: Any = Paired(store.residual.model, gate.system)
    beside = replace(store, residual=residual)
    return lambda name, both: beside.collect(name, Points(both))
