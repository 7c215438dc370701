"""One instance of an FMU: begun anew before every query, and stepped through one period.

Model exchange has fixed steps of an integrator, and events located by bisection.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from typing import Any, Literal, cast, final

import fmpy
import numpy as np
from fmpy import fmi2, fmi3

from gapcert import Array, UsageError
from gapcert_fmu.thresholds import THRESHOLDS

from .description import INTEGERS, REALS, Description

Restart = Literal["snapshot", "reset", "instantiate"]
_STAGES = {"euler": ((0.0,), (1.0,)), "rk4": ((0.0, 0.5, 0.5, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6))}
"""Where in the step each derivative is taken, along the one before; and its weight."""


def _pointer(array: Array) -> ctypes.Array[ctypes.c_double]:
    """The memory of an array (n,), as C takes it."""
    size, memory = ctypes.c_double * len(array), cast(Any, array)
    return size.from_buffer(memory) if len(array) else size()


@final
class Numbers:
    """Real variables by reference, and the buffer through which they are set and read."""

    def __init__(self, references: Sequence[int]) -> None:
        self.count = len(references)
        self.references = (ctypes.c_uint * self.count)(*references)
        self.values = np.zeros(self.count)
        self.pointer = _pointer(self.values)


@final
class Instance:
    """`begin` puts it into initialization mode as if it were new, `start` ends that. preset: (variable, value) of `set`."""

    def __init__(
        self,
        description: Description,
        restart: Restart,
        *,
        tolerance: float | None,
        time: float,
        preset: Sequence[tuple[Any, float | bool | str]],
    ) -> None:
        self.description, self.restart, self.preset = description, restart, preset
        self.tolerance, self.time = tolerance, time
        self.exchanges = description.interface == "model-exchange"
        self.said: list[str] = []
        self.fmu: Any = None
        self._saved: Any = None

    def begin(self) -> None:
        """Initialization mode, with all start values."""
        if self.fmu is not None and self._saved is not None:
            self.fmu.setFMUState(self._saved)
            return
        if self.fmu is not None and self.restart == "reset":
            self.fmu.reset()
        else:
            self.close()
            self.fmu = self._new()
        if self.description.newer:
            self.fmu.enterInitializationMode(tolerance=self.tolerance, startTime=self.time)
        else:
            self.fmu.setupExperiment(tolerance=self.tolerance, startTime=self.time)
            self.fmu.enterInitializationMode()
        for variable, value in self.preset:
            self._preset(variable, value)
        if self.restart == "snapshot":
            self._saved = self.fmu.getFMUState()

    def set(self, numbers: Numbers) -> None:
        if not numbers.count:
            return
        fmu, n = self.fmu, numbers.count
        if self.description.newer:
            fmu.fmi3SetFloat64(fmu.component, numbers.references, n, numbers.pointer, n)
        else:
            fmu.fmi2SetReal(fmu.component, numbers.references, n, numbers.pointer)

    def get(self, numbers: Numbers) -> None:
        fmu, n = self.fmu, numbers.count
        if self.description.newer:
            fmu.fmi3GetFloat64(fmu.component, numbers.references, n, numbers.pointer, n)
        else:
            fmu.fmi2GetReal(fmu.component, numbers.references, n, numbers.pointer)

    def start(self) -> None:
        """Ends the initialization."""
        self.fmu.exitInitializationMode()

    def start_at(self, numbers: Numbers, values: Array) -> None:
        """As if it were new, with these values of some variables, and initialised."""
        numbers.values[:] = values
        self.begin()
        self.set(numbers)
        self.start()

    def advance(self, time: float, step: float) -> None:
        """One communication step of co-simulation."""
        # With a snapshot the FMU has to be ready to go back.
        onward = self.restart != "snapshot"
        done = self.fmu.doStep(time, step, onward)
        if self.description.newer:
            _, ended, early, last = done
            if ended or early:
                raise UsageError(f"the FMU ended the step from {time:.9g} s at {last:.9g} s; expected {time + step:.9g} s")

    def close(self) -> None:
        """Frees the instance and its library."""
        if self.fmu is None:
            return
        fmu, self.fmu = self.fmu, None
        if self._saved is not None:
            fmu.freeFMUState(self._saved)
            self._saved = None
        fmu.freeInstance()

    def _new(self) -> Any:
        d, here = self.description, os.getcwd()
        kinds = (fmi3.FMU3Slave, fmi3.FMU3Model) if d.newer else (fmi2.FMU2Slave, fmi2.FMU2Model)
        try:
            made = kinds[self.exchanges](
                guid=d.read.guid,
                modelIdentifier=d.of_interface.modelIdentifier,
                unzipDirectory=str(d.folder),
                instanceName=d.of_interface.modelIdentifier,
            )
            self._instantiate(made)
        except Exception as error:  # the library's loader, and fmpy's own refusals, are plain exceptions
            reason = " ".join([" ".join(str(error).split()), *self.said[-3:]])
            raise UsageError(
                f"file: {d.file} cannot be started: {reason}; expected a library that runs on this machine"
            ) from None
        finally:
            os.chdir(here)
        return made

    def _instantiate(self, made: Any) -> None:
        if self.description.newer:
            made.instantiate(logMessage=self._hear)
            return
        callbacks = fmi2.fmi2CallbackFunctions()
        callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(self._hear)
        callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
        callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free)
        made.instantiate(callbacks=callbacks)

    def _hear(self, *told: Any) -> None:
        """A message, whose status, category and text both versions of the standard give last."""
        status, _, message = told[-3:]
        if status and message:
            self.said = [*self.said[-THRESHOLDS.kept_messages :], " ".join(message.decode(errors="replace").split())]

    def _preset(self, variable: Any, value: float | bool | str) -> None:
        kind, newer = variable.type, self.description.newer
        given: Any = str(value)
        if kind in REALS:
            kind, given = kind if newer else "Real", float(value)
        elif kind in INTEGERS:
            kind, given = ("Int64" if kind == "Enumeration" else kind) if newer else "Integer", int(value)
        elif kind == "Boolean":
            given = bool(value)
        else:
            kind = "String"
        getattr(self.fmu, f"set{kind}")([variable.valueReference], [given])


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
        self._px, self._pd, self._pz = (_pointer(a) for a in (self._x, self._d, self._z))
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
