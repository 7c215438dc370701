"""Backend `fmu`: a Functional Mock-up Unit, asked one period at a time as a function of its states."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import threading
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, final

import fmpy
import numpy as np
import numpy.typing as npt
from fmpy.fmi1 import FMICallException

from gapcert import Backend, Context, Step, System, UsageError, magnitude, muted
from gapcert_fmu.archive import unpack
from gapcert_fmu.config import FmuConfig
from gapcert_fmu.description import Description
from gapcert_fmu.exchange import Exchange
from gapcert_fmu.instance import Instance, Numbers, Restart
from gapcert_fmu.wiring import wire

Array = npt.NDArray[np.float64]
_Option = Literal["hidden", "parameters"]
_PERIODS = 4
"""Through which an FMU is asked whether it remembers more than its states."""
_REMEMBERS = 1e-9
"""Relative; a smaller difference is rounding."""


@final
class FmuBackend(Backend):
    """x⁺ of the variables that `states` names, under inputs that are held for one period.

    Hidden state are the other continuous and discrete states that the FMU declares; `parameters` its real parameters by their
    own names.
    `restarting` says how a query begins anew, and why so.
    """

    def __init__(self, config: FmuConfig, folder: Path | None = None, *, model: System | None = None) -> None:
        self.config, self.file = config, str((folder or Path()) / config.file)
        self._lock = threading.Lock()
        self._sha = _sha(self.file)
        self._open()
        self.period = magnitude(config.period, "s") if config.period is not None else _period(model)
        self.substeps = config.substeps
        self._wiring = w = wire(config, self.description, model)
        self.states, self.inputs, self.hidden, self.parameters = w.states, w.inputs, w.hidden, w.parameters
        self.hidden_default = w.hidden_default
        able: dict[_Option, object] = {"hidden": self.hidden, "parameters": self.parameters}
        self.capabilities = frozenset(name for name, what in able.items() if what)
        tolerance = self.description.read.defaultExperiment.tolerance if self.description.read.defaultExperiment else None
        self._tolerance = config.tolerance if config.tolerance is not None else (float(tolerance) if tolerance else None)
        self._instance: Instance | None = None
        with muted():
            self._restart, self.restarting = self._choose()
            self._check_starts()
            if config.memory == "refuse":
                self._check_memory()

    @classmethod
    def from_config(cls, config: FmuConfig, context: Context) -> FmuBackend:
        """UsageError unless the user allowed code."""
        if not context.allow_code:
            raise UsageError(
                f"backend.file: {config.file} holds native code, which a spec may not run by itself; pass --allow-code if you "
                f"trust it"
            )
        return cls(config, context.folder, model=context.model)

    def close(self) -> None:
        """Frees the instance; the next query makes a new one."""
        with self._lock:
            if self._instance is not None:
                self._instance.close()
            self._instance = None

    def digest(self) -> str:
        physics = self.config.model_dump(mode="json", exclude={"file", "period", "megabytes", "memory", "restart"})
        axes = [[s.name, s.unit, s.kind] for s in (*self.states, *self.inputs)]
        parts = [fmpy.__version__, self._sha, physics, self._restart, self.period, axes]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()

    def resolution(self, magnitude: Array) -> Array:
        """4 ulp, and what the tolerance of a solver of the FMU's own leaves."""
        rounding = self.rounding(magnitude)
        if self._tolerance is None or self.description.interface != "co-simulation":
            return rounding
        return np.asarray(np.maximum(rounding, self._tolerance * np.maximum(np.abs(magnitude), self._wiring.nominal)))

    def rounding(self, magnitude: Array) -> Array:
        return super().resolution(magnitude)

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_instance", "_lock", "_folder", "description")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock, self._instance = threading.Lock(), None
        self._open()

    # What there is

    def _open(self) -> None:
        if _sha(self.file) != self._sha:
            raise UsageError(f"file: {self.file} has changed since it was read; run again")
        folder = Path(tempfile.mkdtemp(prefix="gapcert-fmu-"))
        self._folder = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        unpack(Path(self.file), folder, self.config.megabytes)
        self.description = Description.of(self.file, folder, self.config.interface)

    # Steps

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        given: dict[str, Array] = dict(options.get("parameters", {}))
        self._check_range(given)
        table = np.concatenate(
            [x, options.get("hidden", np.zeros((len(x), 0))), u, *(v[:, None] for v in given.values())], axis=1
        )
        with self._lock, muted():
            if self._instance is None:
                self._instance = self._make(self._restart)
            return self._split(self._answers(self._instance, table, list(given)))

    def _split(self, out: Array) -> Step:
        return Step(out[:, : self.nx], np.ascontiguousarray(out[:, self.nx :]) if self.hidden else None)

    def _answers(self, instance: Instance, table: Array, names: Sequence[str]) -> Array:
        """(n, states and hidden states) after one period from rows of states, hidden states, inputs and parameters."""
        numbers = Numbers([*self._wiring.writes, *(self._wiring.references[n] for n in names)])
        found, out = Numbers(self._wiring.reads), np.empty((len(table), len(self._wiring.reads)))
        for k, row in enumerate(table):
            try:
                instance.begin()
                numbers.values[:] = row
                instance.set(numbers)
                instance.start()
                self._through(instance, self.config.time)
                instance.get(found)
            except (FMICallException, UsageError) as error:
                raise self._failed(instance, row, error) from None
            out[k] = found.values
        if not np.isfinite(out).all():
            bad = table[int(np.argmax(~np.isfinite(out).all(axis=1)))]
            raise self._failed(instance, bad, "its answer is not finite")
        return out

    def _through(self, instance: Instance, time: float) -> None:
        """One period of an instance whose initialization has ended."""
        if instance.exchanges:
            Exchange(instance, len(self.description.continuous()), self.config.integrator).run(time, self.period, self.substeps)
            return
        step = self.period / self.substeps
        for k in range(self.substeps):
            instance.advance(time + k * step, step)

    def _failed(self, instance: Instance, row: Array, error: object) -> UsageError:
        start = dict(zip((s.name for s in self.states), row.tolist(), strict=False))
        said = "".join(f"; it said: {s}" for s in instance.said[-2:])
        instance.close()
        return UsageError(
            f"FmuBackend: {self.file}, from {start}: {str(error).rstrip('.')}{said}; expected it to answer everywhere"
        )

    def _check_range(self, given: dict[str, Array]) -> None:
        for p in self.parameters:
            if (value := given.get(p.name)) is not None and ((value < p.low) | (value > p.high)).any():
                bad = float(value[(value < p.low) | (value > p.high)][0])
                raise UsageError(f"FmuBackend: parameter {p.name} = {bad}; expected a number in [{p.low}, {p.high}]")

    def _make(self, restart: Restart) -> Instance:
        return Instance(self.description, restart, tolerance=self._tolerance, time=self.config.time, preset=self._wiring.preset)

    # Is it a function of its states?

    def _choose(self) -> tuple[Restart, str]:
        """How a query begins anew: as asked for, or the quickest that a new instance confirms."""
        if self.config.restart != "auto":
            return self.config.restart, f"{self.config.restart}, as asked for"
        new = self._asked("instantiate")
        able = bool(self.description.of_interface.canGetAndSetFMUstate)
        reasons = [] if able else ["the FMU saves no snapshots"]
        candidates: tuple[Restart, ...] = ("snapshot", "reset") if able else ("reset",)
        for restart in candidates:
            try:
                if self._asked(restart).tobytes() == new.tobytes():
                    return restart, "; ".join([*reasons, f"{restart}, bit-equal to a new instance"])
                reasons.append(f"after a {restart} it answers otherwise than when new")
            except UsageError as error:
                reasons.append(f"{restart} fails: {error}")
        return "instantiate", "; ".join([*reasons, "a new instance per query"])

    def _asked(self, restart: Restart) -> Array:
        """Answers to a few queries, and to some of them again after one with other parameters."""
        instance, few = self._make(restart), self._few()
        other = {p.name: p.value * 1.01 for p in self.parameters if p.value and p.low <= p.value * 1.01 <= p.high}
        changed = np.concatenate([few[:1], np.array([list(other.values())])], axis=1)
        try:
            first = self._answers(instance, few, [])
            return np.concatenate([first, self._answers(instance, changed, list(other)), self._answers(instance, few[:2], [])])
        finally:
            instance.close()

    def _few(self) -> Array:
        """The start values, and two states beside them under other inputs."""
        wide = np.concatenate([self._wiring.starts, self.hidden_default, np.zeros(len(self.inputs))])
        for j, s in enumerate(self.inputs):
            found = self.description.variable("inputs", self.config.inputs[s.name])
            wide[len(wide) - len(self.inputs) + j] = float(found.start or 0.0)
        return np.stack([wide, wide + 1e-3 * np.maximum(np.abs(wide), 1e-3), wide * (1 + 1e-2)])

    def _check_starts(self) -> None:
        """Refuses a variable that does not keep its start value through the initialization."""
        instance, found = self._make(self._restart), Numbers(self._wiring.reads)
        try:
            for row in self._few():
                numbers = Numbers(self._wiring.writes)
                instance.begin()
                numbers.values[:] = row
                instance.set(numbers)
                instance.start()
                instance.get(found)
                wanted = row[: len(self._wiring.reads)]
                if (off := np.abs(found.values - wanted) > 1e-12 * np.maximum(np.abs(wanted), 1.0)).any():
                    j = int(np.argmax(off))
                    name = (*(s.name for s in self.states), *(h.name for h in self.hidden))[j]
                    raise UsageError(
                        f"backend.states: {name} was started at {wanted[j]:.9g}, and is {found.values[j]:.9g} when the FMU is "
                        f"initialised; expected a variable that keeps its start value"
                    )
        except FMICallException as error:
            raise self._failed(instance, self._few()[0], error) from None
        finally:
            instance.close()

    def _check_memory(self) -> None:
        """Refuses an FMU that goes on otherwise than from its states: it remembers something else, or looks at the clock."""
        instance, found = self._make("instantiate"), Numbers(self._wiring.reads)
        row, width = self._few()[0], len(self._wiring.reads)
        inputs = Numbers(self._wiring.writes[width:])
        push = np.array([np.abs(v) + 1.0 if v else 1.0 for v in row[width:]])
        sequence = [
            row[width:] * (1 + 0.1 * (k % 2)) + (0.0 if row[width:].any() else 0.1) * push * (k % 2) for k in range(_PERIODS)
        ]
        scale = np.maximum(np.abs(row[:width]), 1e-6)
        limit = _REMEMBERS + 100 * (self._tolerance or 0.0)
        try:
            numbers = Numbers(self._wiring.writes)
            instance.begin()
            numbers.values[:] = row
            instance.set(numbers)
            instance.start()
            if instance.exchanges:
                return self._compare_exchange(row, sequence, limit)
            for k, u in enumerate(sequence):
                inputs.values[:] = u
                instance.set(inputs)
                self._through(instance, self.config.time + k * self.period)
                instance.get(found)
                kept = found.values.copy()
                row = self._restarted(np.concatenate([row[:width], u]))
                scale = np.maximum(scale, np.abs(row[:width]))
                self._compare(kept, row[:width], scale, limit, k + 1)
        except FMICallException as error:
            raise self._failed(instance, row, error) from None
        finally:
            instance.close()

    def _restarted(self, row: Array) -> Array:
        """A row one period later, by a query of its own."""
        instance = self._make(self._restart)
        try:
            return np.concatenate([self._answers(instance, row[None], [])[0], row[len(self._wiring.reads) :]])
        finally:
            instance.close()

    def _compare_exchange(self, row: Array, sequence: Sequence[Array], limit: float) -> None:
        """Of model exchange: one long period against as many short ones, with sub-steps of the same length."""
        width, n = len(self._wiring.reads), len(sequence)
        kept, self.period, self.substeps = (self.period, self.substeps), self.period * n, self.substeps * n
        try:
            long = self._restarted(np.concatenate([row[:width], sequence[0]]))
        finally:
            self.period, self.substeps = kept
        short = np.concatenate([row[:width], sequence[0]])
        for _ in sequence:
            short = self._restarted(short)
        scale = np.maximum(np.maximum(np.abs(row[:width]), np.abs(long[:width])), 1e-6)
        self._compare(long[:width], short[:width], scale, limit, n)

    def _compare(self, on: Array, anew: Array, scale: Array, limit: float, periods: int) -> None:
        miss = np.abs(on - anew) / scale
        if (miss <= limit).all():
            return
        j = int(np.argmax(miss))
        name = (*(s.name for s in self.states), *(h.name for h in self.hidden))[j]
        raise UsageError(
            f"backend.states: the FMU remembers more than its states, or looks at the clock: after {periods} periods it has "
            f"{name} = {on[j]:.9g} when it goes on, and {anew[j]:.9g} when it starts again from its states; name what "
            f"it remembers in states, or say memory: forget"
        )


def _sha(file: str) -> str:
    path = Path(file)
    if not path.is_file():
        raise UsageError(f"file: there is no file {path}; give the path of an FMU, relative to the spec")
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _period(model: System | None) -> float:
    if model is None:
        raise UsageError("backend.period: there is no model to take it from; add for instance period: 5 ms")
    return model.period
