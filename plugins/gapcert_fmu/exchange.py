"""Model exchange: fixed steps of an integrator, and events located by bisection."""

from __future__ import annotations

from typing import final

import numpy as np

from gapcert import Array, UsageError
from gapcert_fmu.thresholds import THRESHOLDS

from .instance import Instance, pointer

_STAGES = {"euler": ((0.0,), (1.0,)), "rk4": ((0.0, 0.5, 0.5, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6))}
"""Where in the step each derivative is taken, along the one before; and its weight."""


@final
class Exchange:
    """Steps an instance whose initialization has ended through one period."""

    def __init__(self, instance: Instance, states: int, integrator: str) -> None:
        self.instance, self.fmu, self.n = instance, instance.fmu, states
        self.at, self.weights = _STAGES[integrator]
        read = instance.description.read
        newer = instance.description.newer
        self.indicators = int(instance.fmu.getNumberOfEventIndicators() if newer else read.numberOfEventIndicators)
        self._x, self._d, self._z = np.zeros(states), np.zeros(states), np.zeros(self.indicators)
        self._px, self._pd = (pointer(a) for a in (self._x, self._d))
        self._pz = pointer(self._z)
        self._derive = self.fmu.getContinuousStateDerivatives if newer else self.fmu.getDerivatives

    def run(self, time: float, period: float, substeps: int) -> None:
        """Leaves the instance at the end of the period, so that its variables can be read."""
        following = self._discrete()
        self.fmu.enterContinuousTimeMode()
        x, t, events = self._states(), time, 0
        for k in range(substeps):
            stop = time + period * (k + 1) / substeps
            while t < stop:
                to = min(stop, following) if following is not None and following > t else stop
                before = self._signs(t, x)
                to, x, crossed = self._located(t, x, to, before)
                t = to
                asked, ended = self.fmu.completedIntegratorStep()
                if ended:
                    raise UsageError(f"the FMU ended the simulation at {t:.9g} s; expected it to go on for the whole period")
                if asked or crossed or (following is not None and t >= following):
                    if (events := events + 1) > THRESHOLDS.events:
                        raise UsageError(f"more than {THRESHOLDS.events} events within {period:.9g} s; expected fewer")
                    self.fmu.enterEventMode()
                    following = self._discrete()
                    self.fmu.enterContinuousTimeMode()
                    x = self._states()
        self._put(t, x)

    def _located(self, t: float, x: Array, to: float, before: Array) -> tuple[float, Array, bool]:
        """The end of a step, or just behind the first event in it."""
        after = self._step(t, x, to - t)
        if not self.indicators or (self._signs(to, after) == before).all():
            self._put(to, after)
            return to, after, False
        low, high = t, to
        for _ in range(THRESHOLDS.event_halvings):
            middle = 0.5 * (low + high)
            if not low < middle < high:
                break
            there = self._step(t, x, middle - t)
            if (self._signs(middle, there) == before).all():
                low = middle
            else:
                high, after = middle, there
        self._put(high, after)
        return high, after, True

    def _step(self, t: float, x: Array, h: float) -> Array:
        total, last = np.zeros(self.n), np.zeros(self.n)
        for at, weight in zip(self.at, self.weights, strict=True):
            self._put(t + at * h, x + at * h * last)
            self._derive(self._pd, self.n)
            last = self._d.copy()
            total += weight * last
        return np.asarray(x + h * total)

    def _signs(self, t: float, x: Array) -> Array:
        if not self.indicators:
            return np.zeros(0)
        self._put(t, x)
        self.fmu.getEventIndicators(self._pz, self.indicators)
        return np.asarray(self._z > 0)

    def _put(self, t: float, x: Array) -> None:
        self.fmu.setTime(t)
        if self.n:
            self._x[:] = x
            self.fmu.setContinuousStates(self._px, self.n)

    def _states(self) -> Array:
        if self.n:
            self.fmu.getContinuousStates(self._px, self.n)
        return self._x.copy()

    def _discrete(self) -> float | None:
        """Events until nothing changes; the time of the next one, if it is known."""
        update = self.fmu.updateDiscreteStates if self.instance.description.newer else self.fmu.newDiscreteStates
        for _ in range(THRESHOLDS.events):
            again, ended, _, _, known, when = update()
            if ended:
                raise UsageError("the FMU ended the simulation at an event; expected it to go on for the whole period")
            if not again:
                return float(when) if known else None
        raise UsageError(
            f"the FMU's discrete states change more than {THRESHOLDS.events} times at one event; expected that it settles"
        )
