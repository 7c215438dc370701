"""A local cluster in a process of its own: `python -m gapcert_dask.host WORKERS SCRATCH`.

It prints its address and ends when its standard input does, however its owner ended, and the folder SCRATCH with it. In a
process of its own, neither its logs nor its exit handlers meet the user's program, and its workers, lost ones' successors
included, do not run the user's script.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import shutil
import signal
import sys
from multiprocessing import resource_tracker
from typing import Any

import dask
from distributed import LocalCluster

QUIET = {
    "distributed.worker.profile.enabled": False,
    "distributed.scheduler.worker-ttl": None,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "10s",
    # Without Dask's MALLOC_TRIM_THRESHOLD_, which hands memory back to the system after each block and doubles a chunk's time.
    "distributed.nanny.pre-spawn-environ": dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), 1),
}


def serve(workers: int, scratch: str) -> None:
    """Workers are processes of one thread each, without a memory limit of Dask's own (`processes` has none, either)."""
    start: Any = LocalCluster
    with dask.config.set(QUIET):
        cluster = start(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address="127.0.0.1:0",  # some port, where None would claim 8787
            scheduler_kwargs={"dashboard": False},
            memory_limit=None,
            local_directory=scratch,
            silence_logs=logging.CRITICAL,
        )
    print(cluster.scheduler_address, flush=True)
    sys.stdin.read()
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
    # Whatever the workers are doing: what they have finished is with the owner, or on disk.
    children = multiprocessing.active_children()
    for child in children:
        child.kill()
    for child in children:
        child.join()


def quiet_tracker() -> None:
    """Start the process that tidies up after multiprocessing, so that it does not tell of it on our standard error."""
    said, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    resource_tracker.ensure_running()
    os.dup2(said, 2)
    os.close(said)
    os.close(nowhere)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the owner to answer
    quiet_tracker()
    count, scratch = sys.argv[1:]
    try:
        serve(int(count), scratch)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    os._exit(0)  # Dask's own ways to close wait for tasks that nobody wants any more
