"""Ranges that are preferred, and may be left at a cost: one slack per stage, and no hard row is another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert import Array, Domain, UsageError
from gapcert.plugin import magnitude
from gapcert_mpc.config import Soft

from .linearise import Frame


@final
@dataclass(frozen=True)
class Preferred:
    """low ≤ z_j ≤ high is preferred for the j in `axis`, each (q,), in the frame; an excess e costs linear·e + quadratic·e²."""

    axis: Array
    low: Array
    high: Array
    linear: Array
    quadratic: Array


def preferred(soft: Mapping[str, Soft], domain: Domain, frame: Frame, scale: float) -> Preferred | None:
    """In the frame, with costs that are multiplied by `scale`; None where nothing is preferred. UsageError for no range."""
    names, rows = [axis.name for axis in domain.axes], []
    for name, given in soft.items():
        if name not in names:
            raise UsageError(f"controller.soft: '{name}' is unknown; expected some of {', '.join(names)}")
        j = names.index(name)
        try:
            low, high = (magnitude(value, domain.axes[j].unit) for value in given.range)
        except ValueError as error:
            raise UsageError(f"controller.soft.{name}: {error}") from None
        if not low <= high:
            raise UsageError(f"controller.soft.{name}: found {list(given.range)}; expected [low, high]")
        ends = (np.array([low, high]) - frame.middle[j]) / frame.half[j]
        rows.append((j, *ends, given.linear * scale, given.quadratic * scale))
    if not rows:
        return None
    axis, *rest = np.array(rows).T
    return Preferred(axis.astype(np.int64), *rest)
