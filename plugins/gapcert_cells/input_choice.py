"""Which of the allowed inputs a controller on cells applies, under policies that look at the inputs alone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Policy


def by_order(
    policy: Policy, allowed: npt.NDArray[np.uint8], number: npt.NDArray[np.int64], seed: int, k: int
) -> npt.NDArray[np.int64]:
    """Which input each row takes, under a policy that only counts: allowed (n, m), number (n,) of them."""
    if policy == "first":
        rank = np.zeros_like(number)
    elif policy == "last":
        rank = number - 1
    elif policy == "middle":
        rank = number // 2
    else:
        share = np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, k]))).random(len(number))
        rank = np.minimum((share * number).astype(np.int64), number - 1)
    return np.asarray((np.cumsum(allowed, axis=1) > rank[:, None]).argmax(axis=1))


def efforts(points: Array) -> Array:
    """(m,): ‖u / s‖₂ of each input, s the range of each component; 1 where it does not vary."""
    span = np.ptp(points, axis=0)
    return np.asarray(np.sqrt(((points / np.where(span > 0, span, 1.0)) ** 2).sum(axis=1)))
