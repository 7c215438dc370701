"""Declares the observer, and wakes it for runs that asked for a recording; imports nothing but gapcert."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import TYPE_CHECKING

import gapcert

if TYPE_CHECKING:
    from .stream import Stream

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
                with _unlogged():
                    made = RERUN.load()
                _STREAM.set(made(event.data))
        if (stream := _STREAM.get()) is not None:
            stream.receive(event)
        if event.name == "run-finished":
            _end()
    except Exception as error:  # no viewer, and no recording of a run, may stop the run
        with suppress(Exception):
            _end()
        warnings.warn(f"no Rerun recording: {type(error).__name__}: {error}", RuntimeWarning, stacklevel=2)


@contextmanager
def _unlogged() -> Iterator[None]:
    """The SDK reads once, at its import, what it may write to stderr: nothing of a lost viewer, which we tell in our words."""
    before = os.environ.get("RUST_LOG")
    os.environ["RUST_LOG"] = before or "warn,re_grpc_client=off,re_sdk=off"
    try:
        yield
    finally:
        if before is None:
            del os.environ["RUST_LOG"]
        else:
            os.environ["RUST_LOG"] = before


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
