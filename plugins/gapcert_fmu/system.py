"""Backend `fmu`: a Functional Mock-up Unit, asked one period at a time as a function of its states."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import threading
import weakref
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Literal, final

import fmpy
import numpy as np
from fmpy.fmi1 import FMICallException

from gapcert import Array, Backend, Context, System, UsageError
from gapcert.plugin import Step
from gapcert_engines import check_ranges, muted, step_period
from gapcert_fmu.thresholds import THRESHOLDS

from .archive import unpack
from .config import FmuConfig
from .description import Description, wire
from .instance import Exchange, Instance, Numbers, Restart

_Option = Literal["hidden", "parameters"]


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
        self.period = step_period(config.period, model)
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
        check_ranges(type(self).__name__, self.parameters, given)
        table = np.concatenate(
            [x, options.get("hidden", np.zeros((len(x), 0))), u, *(v[:, None] for v in given.values())], axis=1
        )
        with self._lock, muted():
            if self._instance is None:
                self._instance = self._make(self._restart)
            return self._split(self._answers(self._instance, table, list(given)))

    def _split(self, out: Array) -> Step:
        return Step(out[:, : self.nx], np.ascontiguousarray(out[:, self.nx :]) if self.hidden else None)

    def _answers(self, instance: Instance, table: Array, names: Sequence[str], periods: int = 1) -> Array:
        """(n, states and hidden states) after one period from rows of states, hidden states, inputs and parameters."""
        numbers = Numbers([*self._wiring.writes, *(self._wiring.references[n] for n in names)])
        found, out = Numbers(self._wiring.reads), np.empty((len(table), len(self._wiring.reads)))
        for k, row in enumerate(table):
            try:
                instance.start_at(numbers, row)
                self._through(instance, self.config.time, periods)
                instance.get(found)
            except (FMICallException, UsageError) as error:
                raise self._failed(instance, row, error) from None
            out[k] = found.values
        if not np.isfinite(out).all():
            bad = table[int(np.argmax(~np.isfinite(out).all(axis=1)))]
            raise self._failed(instance, bad, "its answer is not finite")
        return out

    def _through(self, instance: Instance, time: float, periods: int = 1) -> None:
        """One period, or one of so many times its length and sub-steps, of an instance whose initialization has ended."""
        period, substeps = self.period * periods, self.substeps * periods
        if instance.exchanges:
            Exchange(instance, len(self.description.continuous()), self.config.integrator).run(time, period, substeps)
            return
        step = period / substeps
        for k in range(substeps):
            instance.advance(time + k * step, step)

    def _failed(self, instance: Instance, row: Array, error: object) -> UsageError:
        start = dict(zip((s.name for s in self.states), row.tolist(), strict=False))
        said = "".join(f"; it said: {s}" for s in instance.said[-2:])
        instance.close()
        return UsageError(
            f"FmuBackend: {self.file}, from {start}: {str(error).rstrip('.')}{said}; expected it to answer everywhere"
        )

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
        few = self._few()
        other = {p.name: p.value * 1.01 for p in self.parameters if p.value and p.low <= p.value * 1.01 <= p.high}
        changed = np.concatenate([few[:1], np.array([list(other.values())])], axis=1)
        with closing(self._make(restart)) as instance:
            first = self._answers(instance, few, [])
            return np.concatenate([first, self._answers(instance, changed, list(other)), self._answers(instance, few[:2], [])])

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
                instance.start_at(Numbers(self._wiring.writes), row)
                instance.get(found)
                wanted = row[: len(self._wiring.reads)]
                if (off := np.abs(found.values - wanted) > 1e-12 * np.maximum(np.abs(wanted), 1.0)).any():
                    j = int(np.argmax(off))
                    name = (*self.states, *self.hidden)[j].name
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
        row, width = self._few()[0], len(self._wiring.reads)
        held = row[width:]
        pushed = held + 0.1 * (np.abs(held) + (0.0 if held.any() else 1.0))
        # The inputs of model exchange stay: it is asked for one long period.
        inputs = [
            held if k % 2 or self.description.interface == "model-exchange" else pushed
            for k in range(THRESHOLDS.memory_periods)
        ]
        on = self._going_on(row[:width], inputs)
        scale, limit = np.maximum(np.abs(row[:width]), 1e-6), THRESHOLDS.memory_change + 100 * (self._tolerance or 0.0)
        state = row[:width]
        with closing(self._make(self._restart)) as instance:
            for k, u in enumerate(inputs):
                (state,) = self._answers(instance, np.concatenate([state, u])[None], [])
                scale = np.maximum(scale, np.abs(state))
                if k in on:
                    self._compare(on[k], state, scale, limit, k + 1)

    def _going_on(self, state: Array, inputs: Sequence[Array]) -> dict[int, Array]:
        """States and hidden states after some of the periods (from 0), without a new start between them."""
        instance, found = self._make("instantiate"), Numbers(self._wiring.reads)
        pushes = Numbers(self._wiring.writes[len(state) :])
        try:
            if instance.exchanges:
                row = np.concatenate([state, inputs[0]])
                return {len(inputs) - 1: self._answers(instance, row[None], [], len(inputs))[0]}
            seen = dict[int, Array]()
            instance.start_at(Numbers(self._wiring.writes), np.concatenate([state, inputs[0]]))
            for k, u in enumerate(inputs):
                pushes.values[:] = u
                instance.set(pushes)
                self._through(instance, self.config.time + k * self.period)
                instance.get(found)
                seen[k] = found.values.copy()
            return seen
        except FMICallException as error:
            raise self._failed(instance, state, error) from None
        finally:
            instance.close()

    def _compare(self, on: Array, anew: Array, scale: Array, limit: float, periods: int) -> None:
        miss = np.abs(on - anew) / scale
        if (miss <= limit).all():
            return
        j = int(np.argmax(miss))
        name = (*self.states, *self.hidden)[j].name
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
