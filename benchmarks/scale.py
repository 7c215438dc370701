"""Collecting samples at scale: the path around an engine, executors killed and exchanged, memory, and cores kept busy.

First the published grid (129 × 161 × 100 points), collected, checked and stored, against the bare engine stepping copies of
the pendulum in one model and writing as many bytes. Then grids of up to `--samples` points of which the extremes of coarse
cells are kept: each run is a process of its own, so that its peak memory and processor time are its own.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from engines.case import PENDULUM
from harness import Row, alternate, main, row

import gapcert as gc
import gapcert_engines
from gapcert.certification.samples.executors import cores, named
from gapcert.certification.samples.extremes import Extremes
from gapcert.certification.samples.store import Store

SPEC = Path(__file__).parents[1] / "specs/pendulum.yaml"
PAPER, CELLS, CHUNK, BLOCK = (129, 161, 100), (43, 54, 34), 500_000, 1 << 15
BACKENDS = ("pybullet", "dart", "mujoco", "equations")
SCALED = ("pybullet", "mujoco")


def question(name: str) -> tuple[gc.plugin.Residual, gc.Domain]:
    """The pendulum of specs/pendulum.yaml against an engine, or against its own equations with another integrator."""
    spec = gc.load_spec(SPEC, () if name != "equations" else ("model.integrator=semi_implicit",))
    model = gc.load_spec(SPEC).build("model")
    if name == "equations":
        return gc.plugin.Residual(spec.build("model"), model), gc.Domain.of(model, spec.config.domain)
    config: Any = gc.registry().config("backend", name)
    engine = importlib.import_module(f"engines.{name}_").ENGINE
    backend = gc.registry().build("backend", name, config(**PENDULUM | engine.options | {"tiles": engine.tiles}))
    return gc.plugin.Residual(backend, model), gc.Domain.of(model, spec.config.domain)


def counts(samples: int) -> tuple[int, ...]:
    """A grid of about so many points, in the proportions of the published one."""
    return tuple(round(n * (samples / np.prod(PAPER)) ** (1 / 3)) for n in PAPER)


def bare(residual: gc.plugin.Residual, cover: gc.plugin.Cover) -> Callable[[], None]:
    """The engine alone, on inputs that lie ready, and then writing as many bytes as there are residuals."""
    z, n = cover.chunk(0, len(cover)), len(cover)
    x, u, backend = np.ascontiguousarray(z[:, :2]), np.ascontiguousarray(z[:, 2:]), residual.backend
    content = np.empty((n, 2))
    if isinstance(backend, gapcert_engines.EngineBackend):
        copies = backend.config.tiles
        world = backend.engine.open(copies, backend.period, None)
        world.set({p.name: p.value for p in backend.parameters})
        rows = np.minimum(np.arange(-(-n // copies) * copies), n - 1)
        joints, effort = np.ascontiguousarray(x[rows, None]), np.ascontiguousarray(u[rows, None])

        def step(a: int) -> None:
            world.advance(joints[a : a + BLOCK], effort[a : a + BLOCK])
    else:

        def step(a: int) -> None:
            backend._step(x[a : a + BLOCK], u[a : a + BLOCK])

    def run() -> None:
        for a in range(0, n, BLOCK):
            step(a)
        with tempfile.TemporaryDirectory() as folder, open(Path(folder) / "residuals", "wb") as file:
            file.write(content.data)

    return run


def path(name: str, options: argparse.Namespace) -> list[Row]:
    """The published grid, on one core and as it is run."""
    residual, domain = question(name)
    cover = gc.plugin.Cover(domain, tuple(n // 2 for n in PAPER) if options.quick else PAPER)
    peer = bare(residual, cover)

    def collect(executor: str, workers: int) -> Callable[[], None]:
        def run() -> None:
            with tempfile.TemporaryDirectory() as folder:
                Store(Path(folder), residual, "scale", lambda: named(executor)(workers)).collect("grid", cover)

        return run

    repeats = 3 if options.quick else 5
    what = f"{name} pendulum, grid of {len(cover):,} points collected, checked, stored"
    alone = "bare engine, tiled, and writing as many bytes, on one core"
    rows = []
    for case, executor, workers, clock, quantity in (
        ("processor time of one thread", "threads", 1, time.process_time, "CPU time"),
        (f"as run by {cores()} threads", "threads", cores(), time.perf_counter, "time"),
        (f"as run by {cores()} processes, their start included", "processes", cores(), time.perf_counter, "time"),
    ):
        seconds = alternate(collect(executor, workers), peer, repeats=repeats, clock=clock)
        rows.append(row(f"{what}: {case}", quantity, "s", *seconds, alone))
    return rows


def one(name: str, executor: str, samples: int, folder: Path) -> None:
    """One collection in this process: prints its digest, time, processor time and peak memory."""
    begin = time.perf_counter()
    residual, domain = question(name)
    store = Store(folder, residual, "scale", lambda: named(executor)(cores()), CHUNK)
    kept = store.samples("grid", gc.plugin.Cover(domain, counts(samples)), Extremes(domain, CELLS))
    wall, (own, theirs) = time.perf_counter() - begin, map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    answer = {
        "digest": [store.digests["grid"], np.abs(kept.r).max(axis=0).tolist()],
        "taken": kept.total,
        "kept": len(kept),
        "bytes": sum(p.stat().st_size for p in (folder / "grid").iterdir()),
        "wall": wall,
        "cpu": own.ru_utime + own.ru_stime + theirs.ru_utime + theirs.ru_stime,
        "main": own.ru_maxrss / 1024,
        "worker": theirs.ru_maxrss / 1024,
    }
    print(json.dumps(answer))


def start(name: str, executor: str, samples: int, folder: Path) -> subprocess.Popen[str]:
    command = [sys.executable, __file__, "--one", name, executor, str(samples), str(folder)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)


def whole(name: str, executor: str, samples: int, folder: Path) -> dict[str, Any]:
    process = start(name, executor, samples, folder)
    answer = process.communicate()[0]
    if process.returncode:
        raise SystemExit(f"scale: {name} on {executor} ended with code {process.returncode}")
    found: dict[str, Any] = json.loads(answer)
    return found


def killed(name: str, samples: int, folder: Path) -> tuple[dict[str, Any], list[int]]:
    """Killed on processes and on dask with about a third and two thirds of the chunks done, finished on processes."""
    chunks, done = -(-int(np.prod(counts(samples))) // CHUNK), []
    for share, executor in ((1 / 3, "processes"), (2 / 3, "dask")):
        process = start(name, executor, samples, folder)
        while process.poll() is None and len(list(folder.glob("grid/chunk-*.npy"))) < share * chunks:
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        done.append(len(list(folder.glob("grid/chunk-*.npy"))))
    return whole(name, "processes", samples, folder), [*done, chunks]


def scale(name: str, options: argparse.Namespace) -> list[Row]:
    """Executors side by side at the largest size; memory at that size and at a hundredth of it."""
    rows, found = [], {}
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        for samples, executor in (
            *((options.samples // k, "processes") for k in (100, 10, 1)),
            *((options.samples // k, "dask") for k in (100, 1)),
        ):
            found[samples, executor] = whole(name, executor, samples, Path(folder) / f"{executor}-{samples}")
        resumed, done = killed(name, options.samples, Path(folder) / "killed")
    n = options.samples
    ours, dask = found[n, "processes"], found[n, "dask"]
    if not ours["digest"] == dask["digest"] == resumed["digest"]:
        raise SystemExit(f"scale: {name}: the digests differ")
    case = f"{name} pendulum, {ours['taken']:,} samples"
    rows.append(row(f"{case} on dask", "time", "s", dask["wall"], ours["wall"], "processes"))
    rows.append(row(f"{case} on dask", "CPU time", "s", dask["cpu"], ours["cpu"], "processes"))
    for executor in ("processes", "dask"):
        big, small = found[n, executor], found[n // 100, executor]
        busy = big["cpu"] / (big["wall"] * cores())
        rows.append(row(f"{case} on {executor}", "busy cores", "share", busy, None, "goal 0.9", less_is_better=False))
        for part in ("worker", "main"):
            peer = f"the same with {small['taken']:,} samples"
            rows.append(row(f"{case} on {executor}, {part}", "peak memory", "MiB", big[part], small[part], peer))
    kills = f"{case}, killed after {done[0]} and {done[1]} of {done[2]} chunks: processes, dask, processes"
    rows.append(row(kills, "equal digests", "of 3", 3, 3, "uninterrupted on processes and on dask", less_is_better=False))
    kept = f"{case}, {ours['kept']:,} kept"
    rows.append(row(kept, "bytes on disk", "MB", ours["bytes"] / 1e6, None, "all chunks and manifest"))
    return rows


def measure(options: argparse.Namespace) -> list[Row]:
    options.samples = options.samples or (2_000_000 if options.quick else 100_000_000)
    rows = []
    for name in options.backend or BACKENDS:
        reason = None if name == "equations" else gc.registry().get("backend", name).missing()
        if reason is not None:
            if options.backend:
                raise SystemExit(f"scale: {reason}")
            continue
        if options.part != "scale":
            rows += path(name, options)
        if options.part != "path" and name in (options.backend or SCALED):
            rows += scale(name, options)
    return rows


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        one(sys.argv[2], sys.argv[3], int(sys.argv[4]), Path(sys.argv[5]))
        raise SystemExit(0)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--backend", nargs="+", metavar="NAME", help=f"of {', '.join(BACKENDS)}; all that are installed")
    parser.add_argument("--samples", type=int, metavar="N", help="of the largest grid (10^8; with --quick 2·10^6)")
    parser.add_argument("--part", choices=("path", "scale"), help="only the first or the second half")
    parser.add_argument("--folder", help="where shards go for the time being (the system's temporary folder)")
    main(measure, parser)
