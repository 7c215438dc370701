"""Limits of how fast inputs may change."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gapcert import Array, Domain, UsageError
from gapcert.plugin import magnitude


def limits(rates: Mapping[str, float | str], domain: Domain, half: Array | float = 1.0) -> Array | None:
    """(m,): the largest change of each input per step in units of `half`, infinite for those not named; None where none is."""
    out = np.full(len(domain.inputs.names), np.inf)
    for name, value in rates.items():
        if name not in domain.inputs.names:
            raise UsageError(f"controller.rates: '{name}' is no input; expected some of {', '.join(domain.inputs.names)}")
        j = domain.inputs.names.index(name)
        try:
            out[j] = magnitude(value, domain.inputs.axes[j].unit)
        except ValueError as error:
            raise UsageError(f"controller.rates.{name}: {error}") from None
        if not 0 < out[j] < np.inf:
            raise UsageError(f"controller.rates.{name}: found {value}; expected a positive change per period")
    return out / half if rates else None
