"""Which of the allowed inputs is applied.

`first`, `middle`, `last`: by the order of the inputs. `random`: any, a pure function of (seed, step, row). `least-effort`: the
smallest ‖u / s‖₂ with s the range of each input among all inputs, the first of equals. `adversarial`: the one that leads
closest to losing. Of each allowed input the corners of its promised box of successor cells are looked at, and the largest
height among them counts: the value on the way to a target, and in a set that is kept for ever minus the depth, the distance in
cells to the nearest cell outside it, along the axis where it is farthest. Ties go to the larger mean over the corners, then to
the first input. It looks one step ahead.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError

Policy = Literal["first", "middle", "last", "random", "least-effort", "adversarial"]
POLICIES: tuple[Policy, ...] = get_args(Policy)
ANYWHERE: tuple[Policy, ...] = ("first", "middle", "last", "random")


def known(policy: str) -> None:
    if policy not in POLICIES:
        raise UsageError(f"controller: policy '{policy}' is unknown; use one of {', '.join(POLICIES)}")


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
