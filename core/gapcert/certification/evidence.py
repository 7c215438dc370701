"""Figures per state of a gap function, over points that its fit has not seen."""

from __future__ import annotations

import numpy as np

from gapcert.certification.authority import overpowered
from gapcert.certification.certificate import StateEvidence
from gapcert.contracts.gaps.gap import GapFunction, GapProblem
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
