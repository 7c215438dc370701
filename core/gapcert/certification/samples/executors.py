"""What computes chunks on this machine: worker processes, or threads. Plugins add others (kind `executor`).

An executor component is a function `make(workers)`, or `make(workers, address)` where it can go to other machines, that
returns a `concurrent.futures.Executor`. It may have two further attributes: `workers`, how many chunks it computes at once, and
`remote`, true where its workers need not see this machine's files.
"""

from __future__ import annotations

import inspect
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import parent_process
from multiprocessing.connection import wait
from multiprocessing.context import SpawnContext, SpawnProcess
from types import ModuleType
from typing import Any, final

from gapcert.contracts.plugins.registry import registry
from gapcert.numerics.errors import UsageError


def processes(workers: int | None = None) -> Executor:
    """Worker processes of this machine (started afresh, so that no engine state is inherited)."""
    return _sized(ProcessPoolExecutor(workers or cores(), _Afresh(), initializer=_begin), workers)


def threads(workers: int | None = None) -> Executor:
    """Threads of this process, each with its own copy of the system: they gain where the engine releases the interpreter."""
    return _sized(ThreadPoolExecutor(workers or cores()), workers)


@final
class Kept:
    """Makes one pool for all who ask within a `with` block, until it breaks: its workers load a model and an engine once."""

    def __init__(self, make: Callable[[], Executor]) -> None:
        self._make = make
        self._pool: Executor | None = None

    def __call__(self) -> Executor:
        if self._pool is None:
            self._pool = self._make()
        return self._pool

    def __enter__(self) -> Kept:
        return self

    def __exit__(self, *error: object) -> None:
        self.end()

    def end(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
        self._pool = None


def done_with(pool: Executor, make: Callable[[], Executor], whole: bool) -> None:
    """Ends a pool that was made for one round, or whose round did not come to its end."""
    if not isinstance(make, Kept):
        pool.shutdown(wait=True, cancel_futures=True)
    elif not whole:
        make.end()


def abandon(pool: Executor, patience: float = 10.0) -> None:
    """End a pool for someone who wants to stop: chunks in flight have a while to finish, and what hangs is killed.

    A thread cannot be killed: one that hangs keeps its process.
    """
    workers = list((getattr(pool, "_processes", None) or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    end = time.monotonic() + patience
    for worker in workers:
        worker.join(max(0.0, end - time.monotonic()))
        if worker.is_alive():
            worker.kill()


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def named(text: str) -> Callable[[int | None], Executor]:
    """Makes, for a number of workers, the executor that a spec or `--executor` names: NAME, or NAME:ADDRESS."""
    name, _, address = text.partition(":")
    make: Callable[..., Executor] = registry().get("executor", name).load()
    if not address:
        return make
    if "address" not in inspect.signature(make).parameters:
        raise UsageError(f"executor '{text}': {name} works on this machine alone and takes no address; write '{name}'")
    return partial(make, address=address)


def _sized(pool: Any, workers: int | None) -> Executor:
    pool.workers = workers or cores()
    made: Executor = pool
    return made


def _start(process: Any) -> Any:
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        return SpawnProcess._Popen(process)
    finally:
        sys.modules["__main__"] = main


@final
class _Worker(SpawnProcess):
    """A worker that does not run the user's script again: a script without a main guard, or a notebook, must just work."""

    _Popen: Any = staticmethod(_start)


@final
class _Afresh(SpawnContext):
    Process = _Worker


def _begin() -> None:
    # Ctrl-C reaches the whole process group; only the main process answers it, after the shards in flight are written.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A killed main process closes no queue: its workers would wait for ever.
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    if (parent := parent_process()) is not None:
        wait([parent.sentinel])
        os._exit(1)
