"""Company in a measurement: an audit asks in small calls as well, and at the end some of all rows are asked once more.

The gates ask few rows. Whether the many of a measurement got what a user gets shows only afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapcert.certification.gates.purity import agreed, allowed
from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.gaps.lipschitz import Residual
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import System, difference
from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError


def in_calls(residual: Residual, z: Array) -> Array:
    """r(z): at first f̂ is asked in calls of 1, 2, …, 64, 1, … rows, then a quarter in growing ones, and the rest in one."""
    nx, most = residual.model.nx, min(len(z) // 2, THRESHOLDS.small_calls_rows)
    small = np.cumsum(np.resize(np.arange(1, THRESHOLDS.small_call + 1), most))
    grown = most + np.cumsum(THRESHOLDS.small_call * 1.4 ** np.arange(40)).astype(int)
    cuts = [*small[small <= most], *grown[grown <= most + len(z) // 4]]
    x, u = np.ascontiguousarray(z[:, :nx]), np.ascontiguousarray(z[:, nx:])
    after = [residual.backend.step(x[rows], u[rows]).x for rows in np.split(np.arange(len(z)), cuts)]
    return difference(residual.model.states, np.concatenate(after), residual.model.step(x, u).x)


def again(measured: Sequence[tuple[Residual, Array, Array]], domain: Domain, e: Array, seed: int) -> str:
    """What was asked again, in words: rows z (n, nz) with their r (n, nx), alone and in another order, of systems that have
    answered nothing of it. UsageError where answers differ by more than e (nx,).
    """
    rng, d, count = np.random.default_rng([seed, 0xA6A1]), 0.0, 0
    for residual, z, r in measured:
        rows = rng.permutation(len(z))[: THRESHOLDS.again_rows]
        z, r, count = z[rows], r[rows], count + len(rows)
        alone = difference(residual.model.states, _alone(residual.backend, z, domain), residual.model.step(*domain.split(z)).x)
        d = max(d, _agree("alone", alone, r, z, e), _agree("in another order", residual(z[::2]), r[::2], z[::2], e))
    how = "asked again alone, some after a close neighbour, and half of them in another order"
    return f"{count} measured rows, {how}, {agreed(d)}"


def _alone(backend: System, z: Array, domain: Domain) -> Array:
    """x⁺ of each row in a call of its own; one in four follows a row that is close, as in a closed loop."""
    after = []
    for k, row in enumerate(z):
        near = row + 3.0 ** -(1 + k // 4 % THRESHOLDS.purity_rungs) * (domain.centre - row)
        asked = [backend.step(*domain.split(one[None])).x for one in ((row,) if k % 4 else (near, row))]
        after.append(asked[-1])
    return np.concatenate(after)


def _agree(how: str, answers: Array, r: Array, z: Array, e: Array) -> float:
    d = np.abs(answers - r)
    if (d <= allowed(e, d)).all():
        return float(d.max(initial=0.0))
    k = int(np.argmax((d / np.maximum(allowed(e, d), np.finfo(float).tiny)).max(axis=1)))
    count = int((d > allowed(e, d)).any(axis=1).sum())
    raise UsageError(
        f"certify: f̂ − f is not a function of (x, u): {count} of {len(d)} measured rows, asked again {how}, differ by up to "
        f"{d.max():.3g}, and rounding allows {e.max():.2g}; worst at (x, u) = {z[k].tolist()}: measured {r[k].tolist()}, now "
        f"{answers[k].tolist()}; make the backend restore its whole state before every query, and answer a row alike alone and "
        f"beside others"
    )
