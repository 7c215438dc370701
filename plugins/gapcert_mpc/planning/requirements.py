"""What is asked of plans besides the domain: references, which may move, limits of rates, and ranges that are preferred."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from gapcert.plugin import Array, Domain, StateSpec, UsageError, magnitude
from gapcert_mpc.config import Quantity, Schedule, Soft
from gapcert_mpc.program.linearise import Frame
from gapcert_mpc.program.program import Preferred

Reference = Mapping[str, Quantity | Schedule]


def begins(value: Quantity | Schedule, period: float) -> list[tuple[int, Quantity]]:
    """(step, value) of a reference: each holds from the first period that does not begin before its time."""
    if not isinstance(value, Schedule):
        return [(0, value)]
    # What is written in decimals is a multiple of the period but for rounding.
    return [(math.ceil(magnitude(t, "s") / period - 1e-6), at) for t, at in value.at]


def moments(reference: Reference, period: float) -> list[int]:
    """The steps from which a reference is another one; the first is 0."""
    return sorted({0} | {step for value in reference.values() for step, _ in begins(value, period)})


def at(reference: Reference, step: int, period: float) -> dict[str, Quantity]:
    """What is wanted at a step of a run."""
    return {name: [at for first, at in begins(value, period) if first <= step][-1] for name, value in reference.items()}


def check_reference(reference: Reference, axes: Sequence[StateSpec], period: float) -> None:
    """UsageError for what is no reference: no quantity, or times that do not begin at 0 and grow by a period at least."""
    units = {axis.name: axis.unit for axis in axes}
    for name, value in reference.items():
        where = f"controller.reference.{name}"
        try:
            steps = [(step, magnitude(at, units[name])) for step, at in begins(value, period)]
        except ValueError as error:
            raise UsageError(f"{where}: {error}") from None
        if not steps or steps[0][0] != 0 or any(b <= a for (a, _), (b, _) in pairwise(steps)):
            raise UsageError(f"{where}: times begin at 0 s and grow by a period ({period:g} s) at least; found {value}")


def wanted(reference: Mapping[str, Quantity], axes: Sequence[StateSpec], frame: Frame) -> tuple[Array, Array]:
    """z (n+m,) in the frame, 0 where nothing is said, and how much each of it matters; the axes begin those of the frame."""
    z, matter = np.zeros(len(frame.half)), np.full(len(frame.half), 1e-3)
    for j, axis in enumerate(axes):
        if axis.name in reference:
            z[j], matter[j] = (magnitude(reference[axis.name], axis.unit) - frame.middle[j]) / frame.half[j], 1.0
    return z, matter


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
