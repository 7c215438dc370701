"""What stages emit and observers (terminal, Rerun, report) receive."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, final

EventName = Literal["run-started", "stage-started", "progress", "stage-finished", "warning", "run-finished"]


@final
@dataclass(frozen=True)
class Event:
    """One thing that happened. `data` holds result objects (e.g. `certificate`), or `done`, `total` of a progress."""

    name: EventName
    stage: str
    data: Mapping[str, Any] = field(default_factory=dict)


Emit = Callable[[Event], None]


class Stages(Protocol):
    """The clock of a run, and its voice."""

    timings: dict[str, float]

    @property
    def emit(self) -> Emit: ...

    def stage(self, name: str) -> AbstractContextManager[None]: ...

    def finished(self, name: str, **results: Any) -> None: ...


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
