"""Does f̂ answer to its inputs as f does? The usual set-up errors of engines show here before a sample is paid for."""

from __future__ import annotations

import numpy as np

from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.gaps.lipschitz import Residual
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import difference


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
    for j, spec in enumerate(model.inputs):
        ends = []
        for bound in domain.chord(z, domain.nx + j):
            at = z.copy()
            at[:, domain.nx + j] = bound
            x, u = (np.ascontiguousarray(part) for part in domain.split(at))
            ends.append([s.step(x, u).x for s in (residual.backend, model)])
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
