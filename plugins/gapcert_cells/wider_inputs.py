"""Inputs that are too weak: the ranges that would suffice, found by trying wider ones, and the words for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.plugin import Array, Box, chosen


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    widenings: int = chosen(4, "by 1/4, 1, 4, 16 times its width: of an input's range, to learn what would suffice")
    halvings: int = chosen(5, "of the last widening: what suffices is known to 1/32 of it")


THRESHOLDS = Thresholds()
FAR = 1 + 2 * 4 ** (THRESHOLDS.widenings - 1) // 4
"""How many times as wide the widest inputs are that `sufficient` asks."""


def sufficient(
    enough: Callable[[Box], bool], inputs: Box, wider: Box | None = None, halvings: int = THRESHOLDS.halvings
) -> Box | None:
    """Ranges that are `enough`, the inputs' own widened at both ends or, where that is so, at one alone; None if none is found.

    They are widened by their width times 1/4, 1, 4, …, or by what `wider` adds, and from there bisected.
    """
    low, high = np.asarray(inputs.low), np.asarray(inputs.high)
    added = np.stack([high - low] * 2) / 4 if wider is None else np.stack([low - wider.low, np.asarray(wider.high) - high])

    def box(share: Array | float) -> Box:
        a, b = low - added[0] * np.asarray(share), high + added[1] * np.asarray(share)
        # Shown with three digits: what is tried is what is shown.
        a, b = (np.where(v == own, v, [float(f"{e:.3g}") for e in v]) for v, own in ((a, low), (b, high)))
        return Box(inputs.axes, tuple(np.minimum(a, low).tolist()), tuple(np.maximum(b, high).tolist()))

    scales = [4.0**k for k in range(THRESHOLDS.widenings)]
    if (most := next((s for s in scales if enough(box(s))), None)) is None:
        return None
    least = most / 4 if most > 1 else 0.0
    for _ in range(halvings):
        middle = (least + most) / 2
        least, most = (least, middle) if enough(box(middle)) else (middle, most)
    for end, j in np.argwhere(added > 0) if np.count_nonzero(added) > 1 else ():
        dropped = added[end, j]
        added[end, j] = 0.0
        if not added.any() or not enough(box(most)):
            added[end, j] = dropped
    return box(most)


def ranges(inputs: Box, other: Box) -> str:
    """Those that differ from the other's, in words."""
    rows = zip(inputs.axes, inputs.low, inputs.high, other.low, other.high, strict=True)
    told = [
        f"{axis.name} in [{a:.3g}, {b:.3g}] {axis.unit}".removesuffix(" 1") for axis, a, b, c, d in rows if (a, b) != (c, d)
    ]
    return " and ".join(told)
