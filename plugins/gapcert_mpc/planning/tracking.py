"""References that move: schedules by time, and references that a run is given on its way."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import final

import numpy as np

from gapcert import Array, StateSpec, UsageError
from gapcert.plugin import magnitude
from gapcert_mpc.config import Quantity, Schedule
from gapcert_mpc.program.linearise import Frame
from gapcert_mpc.program.program import Program

Reference = Mapping[str, Quantity | Schedule]


@final
@dataclass(frozen=True)
class Course:
    """Steady references (T, n+m) in the frame, each wanted from its `first` (T,) step of a run on; the first of these is 0."""

    first: Array
    references: Array

    def ahead(self, step: int, count: int) -> Array:
        """(count, n+m): what is wanted at this step of a run and at those that follow."""
        return np.asarray(self.references[np.searchsorted(self.first, step + np.arange(count), side="right") - 1])

    def shown(self, frame: Frame, names: Sequence[str], period: float) -> list[dict[str, float]]:
        """JSON-able: each reference in its units, with the time `from` which it is wanted, in s."""
        at = [dict(zip(names, frame.out(z).tolist(), strict=True)) for z in self.references]
        return [{"from": step * period, **z} for step, z in zip(self.first.tolist(), at, strict=True)]


def stated(reference: Mapping[str, object]) -> Reference:
    """Each as a quantity or a schedule."""
    return {n: Schedule.model_validate(v) if isinstance(v, Mapping) else v for n, v in reference.items()}  # type: ignore[misc]


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


def check(reference: Reference, axes: Sequence[StateSpec], period: float) -> None:
    """UsageError for what is no reference: no quantity, or times that do not begin at 0 and grow by a period at least."""
    units = {axis.name: axis.unit for axis in axes}
    for name, value in reference.items():
        where = f"controller.reference.{name}"
        try:
            steps = [step for step, _ in begins(value, period)]
            for part in [value] if not isinstance(value, Schedule) else [at for _, at in value.at]:
                magnitude(part, units[name])
        except ValueError as error:
            raise UsageError(f"{where}: {error}") from None
        if not steps or steps[0] != 0 or any(b <= a for a, b in pairwise(steps)):
            raise UsageError(f"{where}: times begin at 0 s and grow by a period ({period:g} s) at least; found {value}")


def wanted(reference: Mapping[str, Quantity], axes: Sequence[StateSpec], frame: Frame) -> tuple[Array, Array]:
    """z (n+m,) in the frame, 0 where nothing is said, and how much each of it matters; the axes begin those of the frame."""
    z, matter = np.zeros(len(frame.half)), np.full(len(frame.half), 1e-3)
    for j, axis in enumerate(axes):
        if axis.name in reference:
            z[j], matter[j] = (magnitude(reference[axis.name], axis.unit) - frame.middle[j]) / frame.half[j], 1.0
    return z, matter


def another(program: Program, frame: Frame, reference: Mapping[str, Quantity], states: Sequence[StateSpec]) -> Array:
    """(n+m,): the steady pair for states that are wanted; UsageError where one is unknown, or no quantity."""
    names = [axis.name for axis in states]
    if unknown := [name for name in reference if name not in names]:
        raise UsageError(f"aim: '{unknown[0]}' is no state; expected some of {', '.join(names)}")
    try:
        found = program.target(*wanted(reference, states, frame))
    except ValueError as error:
        raise UsageError(f"aim: {error}") from None
    assert found is not None, "a controller that wins has a steady pair"
    return found
