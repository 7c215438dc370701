"""Declares the observer, and wakes it for runs that asked for a recording; imports nothing but gapcert."""

from __future__ import annotations

import warnings
from contextlib import suppress
from contextvars import ContextVar
from typing import TYPE_CHECKING

import gapcert

if TYPE_CHECKING:
    from gapcert_rerun.stream import Stream

# One stream per thread of execution: events between start and finish do not name their run.
_STREAM: ContextVar[Stream | None] = ContextVar("gapcert_rerun_stream", default=None)


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [RERUN]


@gapcert.hookimpl
def gapcert_event(event: gapcert.Event) -> None:
    """Open a stream when a run with `rerun` or `view` starts, feed it, close it when the run ends."""
    try:
        if event.name == "run-started":
            _end()
            if event.data.get("rerun") or event.data.get("view"):
                _STREAM.set(RERUN.load()(event.data))
        if (stream := _STREAM.get()) is not None:
            stream.receive(event)
        if event.name == "run-finished":
            _end()
    except Exception as error:  # no viewer, and no recording of a run, may stop the run
        with suppress(Exception):
            _end()
        warnings.warn(f"no Rerun recording: {type(error).__name__}: {error}", RuntimeWarning, stacklevel=2)


def _end() -> None:
    stream = _STREAM.get()
    _STREAM.set(None)
    if stream is not None:
        stream.close()


RERUN = gapcert.Component(
    "observer",
    "rerun",
    "streams a run to a Rerun recording or a live viewer",
    "gapcert_rerun.stream:Stream",
    requires=("rerun",),
    extra="rerun",
)
