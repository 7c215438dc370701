"""The question of a diagnosis with all its data, and what answers it."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from gapcert.plugin import BEAT, Effect, Emit, Event, Model, Recording

from .results import Diagnosis


@final
class Clock:
    """Wall time per part in s, and progress for observers."""

    def __init__(self, emit: Emit) -> None:
        self.emit, self.count, self.last, self.told = emit, 0, time.perf_counter(), 0.0
        self.laps: dict[str, float] = {}
        self.best: Mapping[str, Any] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name], self.last = round(now - self.last, 3), now

    def tell(self, text: str, best: Mapping[str, Any] | None = None, *, fitted: bool = True) -> None:
        """What is tried next: a hypothesis that is fitted, or one of many that are only screened, of which few are told."""
        now = time.perf_counter()
        self.count += fitted
        if fitted or now - self.told > BEAT:
            self.told = now
            # A search that begins anew, on other windows, has no best of its own yet.
            self.best = best or self.best
            more = {"best": self.best} if self.best else {}
            self.emit(Event("progress", "diagnosis", {"done": self.count, "unit": "hypotheses", "text": text, **more}))


@final
@dataclass(frozen=True)
class DiagnosisProblem:
    """Why does a model differ from a recording? The arguments of `diagnose`, with defaults made and effects built.

    fitted, held_out: the parts of the recording. clock: times the parts of the work, and tells its progress.
    """

    model: Model
    recording: Recording
    fitted: Recording
    held_out: Recording
    effects: Sequence[Effect]
    horizons: Sequence[float]
    window: float | None
    experiment: Mapping[str, Any]
    seed: int
    folder: Path | None
    clock: Clock


class Diagnoser(ABC):
    """A component of kind `diagnoser`: another way to a diagnosis, for models that no search with equations suits."""

    @abstractmethod
    def accepts(self, model: Model) -> bool:
        """Is it for this model? The first that accepts one, by name, answers; the search with equations where none does."""

    @abstractmethod
    def diagnose(self, problem: DiagnosisProblem) -> Diagnosis:
        """The answer, without its timings: these are the laps of the problem's clock."""
