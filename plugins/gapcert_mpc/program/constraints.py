"""What is asked of plans besides the domain: how fast inputs may change, and ranges that are preferred."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert import Array, Domain, UsageError
from gapcert.plugin import magnitude
from gapcert_mpc.config import Quantity, Soft

from .linearise import Frame


def limits(rates: Mapping[str, Quantity], domain: Domain, half: Array | float = 1.0) -> Array | None:
    """(m,): the largest change of each input per step in units of `half`, infinite for those not named; None where none is."""
    out = np.full(len(domain.inputs.names), np.inf)
    for name, value in rates.items():
        if name not in domain.inputs.names:
            raise UsageError(f"controller.rates: '{name}' is no input; expected some of {', '.join(domain.inputs.names)}")
        j = domain.inputs.names.index(name)
        (out[j],) = _in_units(f"controller.rates.{name}", domain.inputs.axes[j].unit, value)
        if not 0 < out[j] < np.inf:
            raise UsageError(f"controller.rates.{name}: found {value}; expected a positive change per period")
    return out / half if rates else None


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
        low, high = _in_units(f"controller.soft.{name}", domain.axes[j].unit, *given.range)
        if not low <= high:
            raise UsageError(f"controller.soft.{name}: found {list(given.range)}; expected [low, high]")
        ends = (np.array([low, high]) - frame.middle[j]) / frame.half[j]
        rows.append((j, *ends, given.linear * scale, given.quadratic * scale))
    if not rows:
        return None
    axis, *rest = np.array(rows).T
    return Preferred(axis.astype(np.int64), *rest)


def _in_units(where: str, unit: str, *values: Quantity) -> list[float]:
    try:
        return [magnitude(value, unit) for value in values]
    except ValueError as error:
        raise UsageError(f"{where}: {error}") from None
