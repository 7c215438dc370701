"""What stages emit and observers (terminal, Rerun, report) receive."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, final

EventName = Literal["run-started", "stage-started", "progress", "stage-finished", "warning", "run-finished"]


@final
@dataclass(frozen=True)
class Event:
    """One thing that happened. `data` holds result objects (e.g. `certificate`), or those of a progress: `done`, and where they
    are known `total`, `unit` (what is counted), `part` (of the stage), `text` (what is tried), `best` (name → value, so far).
    """

    name: EventName
    stage: str
    data: Mapping[str, Any] = field(default_factory=dict)


Emit = Callable[[Event], None]
Best = Mapping[str, Any] | Callable[[], Mapping[str, Any]]
"""The best result so far, or what computes it where it is told."""

BEAT = 0.2
"""Seconds between two events of a `Pulse`: what a person can follow, and so few that telling costs nothing."""


@final
class Pulse:
    """Tells how far a stage is, from a loop of any speed: pulse(done, best); at most one event per BEAT, always the last."""

    def __init__(self, emit: Emit, stage: str, total: int | None = None, unit: str = "", part: str = "") -> None:
        self.emit, self.stage, self.total = emit, stage, total
        self._fixed = {k: v for k, v in (("unit", unit), ("part", part)) if v}
        self._last = -BEAT

    def __call__(self, done: int, best: Best | None = None, *, text: str = "", total: int | None = None) -> None:
        self.total = self.total if total is None else total
        now = time.monotonic()
        if now - self._last < BEAT and done != self.total:
            return
        self._last = now
        data: dict[str, Any] = {"done": done, **({} if self.total is None else {"total": self.total}), **self._fixed}
        if text:
            data["text"] = text
        if best is not None:
            data["best"] = dict(best() if callable(best) else best)
        self.emit(Event("progress", self.stage, data))


@final
@dataclass
class Stages:
    """The clock of a run, and its voice."""

    emit: Emit
    timings: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self.emit(Event("stage-started", name))
        begin = time.perf_counter()
        yield
        self.timings[name] = round(time.perf_counter() - begin, 3)

    def finished(self, name: str, **results: Any) -> None:
        self.emit(Event("stage-finished", name, {**results, "seconds": self.timings.get(name)}))


@final
class Heart:
    """As a context, calls `beat` every `pause` seconds from a thread of its own: what is done at once may take long."""

    def __init__(self, pause: float, beat: Callable[[], None]) -> None:
        self._over = threading.Event()
        self._pause, self._beat = pause, beat
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        while not self._over.wait(self._pause):
            self._beat()

    def __enter__(self) -> Heart:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()


def silent(event: Event) -> None:
    """An Emit that tells nobody."""


def broadcast(*observers: Emit) -> Emit:
    """An Emit that tells all observers; one that raises is dropped with a warning, since no viewer may kill a run."""
    alive = list(observers)

    def emit(event: Event) -> None:
        for observer in list(alive):
            try:
                observer(event)
            except Exception as error:
                alive.remove(observer)
                warnings.warn(f"an observer was dropped after {type(error).__name__}: {error}", RuntimeWarning, stacklevel=2)

    return emit
