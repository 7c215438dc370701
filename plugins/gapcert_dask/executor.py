"""A Dask cluster as a `concurrent.futures` executor."""

from __future__ import annotations

import asyncio
import logging
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from threading import Lock
from typing import Any, ParamSpec, TypeVar, final

import dask as dask_config
from distributed import Client, KilledWorker
from distributed.comm.core import CommClosedError, connect
from distributed.utils import silence_logging_cmgr

from gapcert import UsageError

P = ParamSpec("P")
T = TypeVar("T")
WAIT = 10.0
"""Seconds within which a scheduler must answer."""
EVERY = 0.1
"""Seconds between two looks at the connection: nobody notices the wait, and a look only compares two attributes."""
GONE = "the connection to Dask's scheduler was lost"

LOST = (KilledWorker, CommClosedError)


def dask(workers: int | None = None, address: str | None = None) -> Executor:
    """A cluster of this machine with so many workers (default: one per processor), or that of the scheduler at `address`."""
    return DaskExecutor(workers, address)


@final
class DaskExecutor(Executor):
    """Submits to a cluster through its client. Lost workers are replaced by Dask; a chunk that lost too many, or a lost
    scheduler, is a BrokenExecutor. `remote`: workers of a given address need not see this machine's files.
    """

    def __init__(self, workers: int | None, address: str | None) -> None:
        self.remote, self._lost = address is not None, False
        self._open = ExitStack()
        try:
            self._open.enter_context(dask_config.config.set({"distributed.admin.large-graph-warning-threshold": "1GB"}))
            self._open.enter_context(silence_logging_cmgr(logging.CRITICAL))
            self._client = self._open.enter_context(_client(address or self._host(workers or _cores())))
            self.workers = workers or sum(self._client.nthreads().values()) or 1
        except BaseException:
            self._open.close()
            raise
        self._inner = self._client.get_executor(pure=False)
        self._running, self._lock = set[Future[Any]](), Lock()
        self._client.loop.add_callback(self._watch, self._client.scheduler_comm)

    def _host(self, workers: int) -> str:
        """Start the local cluster, which ends with this executor; its address."""
        paths = os.pathsep.join(p or os.getcwd() for p in sys.path)
        # Its own, so that it can be tidied up after a host that was killed.
        scratch = tempfile.mkdtemp(prefix="gapcert-dask-")
        self._open.callback(shutil.rmtree, scratch, ignore_errors=True)
        command = [sys.executable, "-m", "gapcert_dask.host", str(workers), scratch]
        host = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": paths}
        )
        self._open.callback(_end, host)
        self._host_process = host
        assert host.stdout is not None
        if address := host.stdout.readline().strip():
            return address
        raise BrokenExecutor(f"the local Dask cluster ended with code {host.wait()}")

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        future: Future[T] = Future()
        with self._lock:
            if self._lost:
                raise BrokenExecutor(GONE)
            self._running.add(future)
        self._inner.submit(fn, *args, **kwargs).add_done_callback(partial(self._ended, future))
        return future

    async def _watch(self, connection: Any) -> None:
        """A client that has lost its scheduler looks for it for a while, and then leaves unanswered what it is given."""
        while self._client.status == "running" and self._client.scheduler_comm is connection:
            await asyncio.sleep(EVERY)
        with self._lock:
            self._lost, left = True, list(self._running)
            self._running.clear()
        for future in left:
            if future.set_running_or_notify_cancel():
                future.set_exception(BrokenExecutor(GONE))

    def _ended(self, future: Future[Any], inner: Future[Any]) -> None:
        with self._lock:
            if future not in self._running:
                return
            self._running.remove(future)
        _hand_on(future, inner)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        if not cancel_futures:
            self._inner.shutdown(wait=wait)
        self._open.close()


def _cores() -> int:
    return len(os.sched_getaffinity(0))


def _client(address: str) -> Any:
    make: Any = Client
    try:
        with ThreadPoolExecutor(1) as thread:  # a notebook has an event loop of its own in this one
            thread.submit(asyncio.run, _answer(address)).result()
        return make(address, set_as_default=False, timeout=WAIT)
    except (OSError, ValueError) as error:
        what = f"executor dask: no scheduler answers at {address} ({error})"
        raise UsageError(f"{what}; start one with `dask scheduler`, or leave the address out") from None


async def _answer(address: str) -> None:
    # A client that finds no scheduler keeps trying to reach it when it is thrown away.
    reach: Any = connect
    comm = await reach(address, timeout=WAIT)
    await comm.close()


def _hand_on(future: Future[Any], inner: Future[Any]) -> None:
    """The outcome of Dask's future, in the words of `concurrent.futures`."""
    if not future.set_running_or_notify_cancel():
        return
    if inner.cancelled():
        future.set_exception(BrokenExecutor(GONE))
    elif (error := inner.exception()) is None:
        future.set_result(inner.result())
    elif isinstance(error, LOST):
        future.set_exception(BrokenExecutor(" ".join(str(error).split())))
    else:
        future.set_exception(error)


def _end(host: subprocess.Popen[str]) -> None:
    assert host.stdin is not None
    assert host.stdout is not None
    host.stdin.close()
    try:
        host.wait(WAIT)
    except subprocess.TimeoutExpired:
        host.kill()
        host.wait()
    host.stdout.close()
