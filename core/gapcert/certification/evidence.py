"""Figures per state of a gap function, over points that its fit has not seen."""

from __future__ import annotations

import numpy as np

from gapcert.certification.certificate import StateEvidence
from gapcert.contracts.gaps.gap import GapFunction, GapProblem
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Model, difference
from gapcert.numerics.arrays import Array


def figures(
    gap: GapFunction, problem: GapProblem, model: Model, z: Array, r: Array, constant: Array, envelope: Array | None = None
) -> dict[str, StateEvidence]:
    """By name of the state: z (n, nz), r (n, nx); constant, envelope (nx,): the constant bound, and the envelope's mean."""
    gamma, mean_gap = gap.gamma(z), np.abs(r).mean(axis=0)
    x, u = problem.domain.split(z)
    still = np.abs(difference(model.states, model.step(x, u).x, x) + r).mean(axis=0)
    power = overpowered(gamma, model, problem.domain, z)
    out = {}
    for i, state in enumerate(model.states):
        resolved = bool(mean_gap[i] >= 10 * problem.arithmetic[i])
        mean = float(gamma[:, i].mean())
        out[state.name] = StateEvidence(
            gap_mean=float(mean_gap[i]),
            gamma_mean=mean,
            gamma_max=float(gamma[:, i].max()),
            constant_bound=float(constant[i]),
            safety_factor=problem.lipschitz.safety,
            resolved=resolved,
            vacuous=resolved and bool(mean > constant[i] * (1 + 1e-9) or mean >= still[i]),
            envelope_mean=None if envelope is None else float(envelope[i]),
            tightness=mean / float(mean_gap[i]) if resolved else None,
            tightness_vs_envelope=None if envelope is None or not resolved else mean / float(envelope[i]),
            overpowered=power[i],
        )
    return out


def overpowered(gamma: Array, model: Model, domain: Domain, z: Array) -> list[float | None]:
    """Per state, the share of points where γ_i exceeds half the range of f_i over U's corners, or over what relations leave of
    the way there from the point's own input; None where f_i ignores u.
    """
    if not model.nu:
        return [None] * model.nx
    x, _ = domain.split(z)
    corners = np.stack(np.meshgrid(*zip(domain.inputs.low, domain.inputs.high, strict=True)), axis=-1).reshape(-1, model.nu)
    ends = [domain.reach(z, np.hstack([x, np.broadcast_to(c, (len(x), model.nu))])) for c in corners]
    images = np.stack([model.step(*domain.split(end)).x for end in ends])
    span = np.ptp(images, axis=0)
    # A range at rounding level means that the input does not reach the state within one step.
    moved = span.max(axis=0) > 1e-12 * np.maximum(np.abs(images).max(axis=(0, 1)), 1e-300)
    return [float((gamma[:, i] > span[:, i] / 2).mean()) if moved[i] else None for i in range(gamma.shape[1])]
