"""One instance of an FMU: begun anew before every query, and stepped through one period."""

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


def pointer(array: Array) -> ctypes.Array[ctypes.c_double]:
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
        self.pointer = pointer(self.values)


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
        kinds = {
            (False, False): fmi2.FMU2Slave,
            (False, True): fmi2.FMU2Model,
            (True, False): fmi3.FMU3Slave,
            (True, True): fmi3.FMU3Model,
        }
        try:
            made = kinds[d.newer, self.exchanges](
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
            made.instantiate(logMessage=self._hear3)
            return
        callbacks = fmi2.fmi2CallbackFunctions()
        callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(self._hear2)
        callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
        callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free)
        made.instantiate(callbacks=callbacks)

    def _hear2(self, _environment: Any, _name: Any, status: int, _category: Any, message: bytes | None) -> None:
        self._hear(status, message)

    def _hear3(self, _environment: Any, status: int, _category: Any, message: bytes | None) -> None:
        self._hear(status, message)

    def _hear(self, status: int, message: bytes | None) -> None:
        if status and message:
            self.said = [*self.said[-THRESHOLDS.kept_messages :], " ".join(message.decode(errors="replace").split())]

    def _preset(self, variable: Any, value: float | bool | str) -> None:
        references, kind = [variable.valueReference], variable.type
        if kind in REALS:
            number = [float(value)]
            self.fmu.setReal(references, number) if not self.description.newer else getattr(self.fmu, f"set{kind}")(
                references, number
            )
        elif kind in INTEGERS:
            name = "Integer" if not self.description.newer else ("Int64" if kind == "Enumeration" else kind)
            getattr(self.fmu, f"set{name}")(references, [int(value)])
        elif kind == "Boolean":
            self.fmu.setBoolean(references, [bool(value)])
        else:
            self.fmu.setString(references, [str(value)])
