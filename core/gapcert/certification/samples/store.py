"""Where samples come from: rounds of points, chunks computed by any executor, shards that survive a kill.

The points of a round are a pure function of the spec and of earlier rounds; a chunk is a pure function of (residual, points,
index). So neither the number nor the order of workers can change a bit, and a killed run resumes to the same digests.
"""

from __future__ import annotations

import hashlib
import json
import pickle
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np
import numpy.typing as npt

from gapcert.certification.gates.again import in_calls
from gapcert.certification.samples.executors import abandon, cores, done_with, processes
from gapcert.certification.samples.extremes import Extremes
from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.gaps.lipschitz import Residual
from gapcert.contracts.gaps.predictor import Samples
from gapcert.contracts.plugins.events import Emit, Event, silent
from gapcert.contracts.plugins.fault_owner import culprit
from gapcert.contracts.systems.domain import Cover, Points
from gapcert.numerics.arrays import Array
from gapcert.numerics.atomic_files import damage_told, no_room, npy_parts, write_atomic
from gapcert.numerics.errors import GapcertError, Interrupted, UsageError, clipped

PointSet = Points | Cover

_AGAIN = "run the same command again to go on from there"
_BLOCK = 1 << 16
"""Points that are evaluated at once: what a step needs of them stays in a core's cache, and memory is that of a block."""


@final
class Task(NamedTuple):
    """One chunk, as a worker receives it: points [start, stop) of `points`, point `start` being number `first` of its round."""

    number: int
    residual: bytes
    points: PointSet
    start: int
    stop: int
    first: int
    extremes: Extremes | None
    target: Path | None
    in_calls: bool = False


@final
class Done(NamedTuple):
    """What comes back: SHA-256 of the shard and, where it holds extremes only, of all residuals; the shard, if not written."""

    digests: tuple[str, ...]
    content: bytes | None
    largest: tuple[float, ...] = ()  # max |r_i| of the chunk


_local = threading.local()


def _residual(payload: bytes) -> Residual:
    """The residual that a payload holds: the last one of each thread is kept, so that no engine is shared between threads."""
    key = hashlib.sha256(payload).digest()
    if getattr(_local, "key", None) != key:
        _local.residual, _local.key = pickle.loads(payload), key
    residual: Residual = _local.residual
    return residual


def compute_chunk(task: Task) -> Done:
    """Evaluate a chunk, and write its shard where there is a target. Runs in any worker."""
    residual = _residual(task.residual)
    r = np.empty((task.stop - task.start, residual.model.nx))
    header, data = npy_parts(r)
    sha256 = hashlib.sha256(header if task.extremes is None else b"")
    cell, largest = None if task.extremes is None else np.empty(len(r), np.int64), np.zeros(r.shape[1])
    for a in range(0, len(r), _BLOCK):
        z = task.points.chunk(task.start + a, min(task.start + a + _BLOCK, task.stop))
        part = r[a : a + len(z)]
        part[:] = _asked(residual, z, task.in_calls)
        if not np.isfinite(part).all():
            row = int(np.flatnonzero(~np.isfinite(part).all(axis=1))[0])
            raise UsageError(
                f"sampling: the residual at (x, u) = {z[row].tolist()} is {part[row].tolist()}; "
                f"shrink the domain or mend the system"
            )
        sha256.update(part.data)
        largest = np.maximum(largest, np.abs(part).max(axis=0, initial=0.0))
        if task.extremes is not None and cell is not None:
            cell[a : a + len(z)] = task.extremes.cell(z)
    if task.extremes is None or cell is None:
        return _deliver(task, (sha256.hexdigest(),), largest, header, data)
    header, data = npy_parts(task.extremes.of_chunk(task.first, cell, r))
    return _deliver(task, (hashlib.sha256(header + data).hexdigest(), sha256.hexdigest()), largest, header, data)


def _asked(residual: Residual, z: Array, apart: bool) -> Array:
    """r at points z; what a system raises on its own becomes a sentence that says where."""
    try:
        return in_calls(residual, z) if apart else residual(z)
    except (GapcertError, MemoryError):
        raise
    except Exception as error:  # a third party's system may fail in any way
        what, where = f"{type(error).__name__}: {clipped(' '.join(str(error).split()))[0]}", culprit(error)
        system, at = f"plugin {where}" if where else "a system", f"{len(z)} points (x, u) from {z[0].tolist()}"
        raise UsageError(
            f"sampling: {system} failed ({what}) among {at}; expected a state; mend the system, or shrink the domain (finished "
            "shards are kept)"
        ) from error


_MEANT = {
    "key": "model, backend or domain have another digest (of one and the same spec: a plugin or a file behind it has changed)",
    "points": "the points are others",
    "count": "there are {stated} points, now {now}",
    "chunk": "sampling.chunk was {stated}, now {now}",
    "extremes": "what is kept of the samples is another choice",
}


def _changed(stated: Mapping[str, Any], header: Mapping[str, Any]) -> str:
    """What differs between the headers of two rounds, in words."""
    differ = [k for k in (*_MEANT, *stated) if stated.get(k) != header.get(k)]
    told = (_MEANT.get(k, f"{k} is another").format(stated=stated.get(k), now=header.get(k)) for k in dict.fromkeys(differ))
    return ", and ".join(told)


def _deliver(task: Task, digests: tuple[str, ...], largest: Array, *content: bytes | memoryview) -> Done:
    if task.target is None:
        return Done(digests, b"".join(content), tuple(largest.tolist()))
    # A shard that a power cut tore has not the digest of its manifest, and is computed again.
    write_atomic(task.target, *content, flush=False)
    return Done(digests, None, tuple(largest.tolist()))


@final
@dataclass
class Store:
    """The sample rounds of one run, in `folder`/<round>: `manifest.jsonl`, one `chunk-000000.npy` per shard, and `points.npy`
    where the points are no grid.

    `key` is the digest of what determines the answers (model, backend, domain): a folder of another key is refused.
    `in_calls`: f̂ is asked in calls of many sizes.
    """

    folder: Path
    residual: Residual
    key: str
    executor: Callable[[], Executor] = processes
    chunk: int = 100_000
    emit: Emit = silent
    digests: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    in_calls: bool = False

    def collect(self, name: str, points: PointSet) -> Array:
        """r (n, nx) at all points of round `name`, computing only the shards that are not there yet."""
        r = np.empty((len(points), self.residual.model.nx))
        for i, start, stop in self._round(name, points, None):
            r[start:stop] = _loaded(_shard(self.folder / name, i), (stop - start, r.shape[1]))
        return r

    def samples(self, name: str, points: PointSet, kept: Extremes | None = None) -> Samples:
        """Points and residuals of round `name`: all, or those that have the smallest or largest r_i of their coarse cell."""
        cover = points if isinstance(points, Cover) else None
        if kept is None:
            return Samples(points.chunk(0, len(points)), self.collect(name, points), cover)
        parts = (_loaded(_shard(self.folder / name, i)) for i, _, _ in self._round(name, points, kept))
        merged = kept.merge(points, parts, self.residual.model.nx)
        return Samples(points.at(merged["index"]), np.ascontiguousarray(merged["r"]), cover, len(points))

    def _round(self, name: str, points: PointSet, extremes: Extremes | None) -> list[tuple[int, int, int]]:
        """Make all shards of a round; returns its chunks as (number, start, stop)."""
        folder = self.folder / name
        header = {"round": name, "key": self.key, "points": points.digest(), "count": len(points), "chunk": self.chunk}
        header |= {} if extremes is None else {"extremes": list(extremes.cells)}
        self._prepare(folder, header, points)
        done = _finished(folder)
        lines = [header, *(_line(i, done[i]) for i in sorted(done))]
        write_atomic(folder / "manifest.jsonl", "".join(json.dumps(line) + "\n" for line in lines).encode())
        spans = [(i, s, min(s + self.chunk, len(points))) for i, s in enumerate(range(0, len(points), self.chunk))]
        completed = sum(stop - start for i, start, stop in spans if i in done)
        largest, told = np.zeros(self.residual.model.nx), {"total": len(points), "unit": "points"}
        # What is no residual, such as x⁺ itself, has no states whose gaps could be told.
        names = [s.name for s in getattr(self.residual.model, "states", ())]
        if completed < len(points):
            self.emit(Event("progress", f"sampling {name}", {"done": completed, **told}))
        try:
            for i, digests, most in self._compute(folder, points, extremes, [span for span in spans if span[0] not in done]):
                done[i] = digests
                _append(folder / "manifest.jsonl", _line(i, digests))
                completed += spans[i][2] - spans[i][1]
                largest = np.maximum(largest, most)
                best = {f"largest gap of {n}": v for n, v in zip(names, largest.tolist(), strict=False)}
                self.emit(Event("progress", f"sampling {name}", {"done": completed, **told, "best": best}))
        except KeyboardInterrupt:
            raise Interrupted(f"interrupted in round '{name}'; {_AGAIN}") from None
        entries = [done[i][0] if extremes is None else done[i] for i in range(len(spans))]
        self.digests[name] = hashlib.sha256(json.dumps([header, entries]).encode()).hexdigest()
        self.counts[name] = len(points)
        return spans

    def _prepare(self, folder: Path, header: dict[str, Any], points: PointSet) -> None:
        manifest = folder / "manifest.jsonl"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise no_room(folder, error) from error
        stated = _lines(manifest)[0] if manifest.exists() else header
        # What is no header at all is damage, as of a disk, and the shards that it cannot vouch for are computed again.
        if isinstance(stated, dict) and stated != header:
            run = folder.parent.parent if folder.parent.name == "samples" else folder
            raise UsageError(
                f"{folder}: this round was begun for another question: {_changed(stated, header)}; choose another folder with "
                f"--out, or delete {run} to start anew"
            )
        if isinstance(points, Points):
            own = npy_parts(points.z)
            if _digest(folder / "points.npy") != hashlib.sha256(b"".join(own)).hexdigest():
                write_atomic(folder / "points.npy", *own)
        if not manifest.exists() or stated != header:
            write_atomic(manifest, (json.dumps(header) + "\n").encode())

    def _compute(
        self, folder: Path, points: PointSet, extremes: Extremes | None, todo: list[tuple[int, int, int]]
    ) -> Iterator[tuple[int, tuple[str, ...], tuple[float, ...]]]:
        payload = pickle.dumps(self.residual)

        def task(i: int, start: int, stop: int) -> Task:
            calls = self.in_calls and start < 2 * THRESHOLDS.small_calls_rows  # of which half are asked in small calls
            return Task(i, payload, points, start, stop, start, extremes, _shard(folder, i), calls)

        # One chunk is not worth a pool, and a system of the running script cannot be sent to one; the bits are the same.
        if len(todo) <= 1 or b"__main__" in payload:
            for i, start, stop in todo:
                made = compute_chunk(task(i, start, stop))
                yield i, made.digests, made.largest
            return
        left, idle = {span[0]: span for span in todo}, False
        while left:
            before, pool, whole = len(left), self.executor(), False
            try:
                for i, done in _in_pool(pool, (task(*span) for span in list(left.values()))):
                    del left[i]
                    yield i, done.digests, done.largest
                whole = True
            except KeyboardInterrupt:
                abandon(pool)
                raise
            except BrokenExecutor as error:
                if idle and len(left) == before:
                    why = "an engine that crashes, or too little memory (try a smaller sampling.chunk)"
                    raise Interrupted(f"workers died twice in round '{folder.name}': {why}; {_AGAIN}") from error
                idle = len(left) == before
                message = f"workers were lost and are replaced: {error}"
                self.emit(Event("warning", f"sampling {folder.name}", {"message": message}))
            finally:
                done_with(pool, self.executor, whole)


def _in_pool(pool: Executor, todo: Iterator[Task]) -> Iterator[tuple[int, Done]]:
    """Keep a few chunks per worker in flight, so that memory does not grow with the number of chunks."""
    running = dict[Future[Done], Task]()
    limit, remote = 3 * int(getattr(pool, "workers", cores())), bool(getattr(pool, "remote", False))
    while True:
        for task in islice(todo, limit - len(running)):
            running[pool.submit(compute_chunk, _travelling(task, remote))] = task
        if not running:
            return
        # What has ended well comes first: it is kept where a pool that breaks fails the others.
        for future in sorted(wait(running, return_when=FIRST_COMPLETED).done, key=lambda f: f.exception() is not None):
            task, done = running.pop(future), future.result()
            if done.content is not None and task.target is not None:
                write_atomic(task.target, done.content, flush=False)
            yield task.number, done


def _travelling(task: Task, remote: bool) -> Task:
    """Only the chunk's own points travel (grid points are recomputed by the worker), and a remote shard comes back."""
    if isinstance(task.points, Points):
        own = Points(task.points.chunk(task.start, task.stop))
        task = task._replace(points=own, start=0, stop=len(own))
    return task._replace(target=None) if remote else task


def _shard(folder: Path, i: int) -> Path:
    return folder / f"chunk-{i:06d}.npy"


def _loaded(shard: Path, shape: tuple[int, int] | None = None) -> npt.NDArray[Any]:
    """The array of a shard. What its manifest vouches for may still be none: a run folder may come from anywhere."""
    with damage_told(shard, "is no shard of this round", "delete its folder, and run the same command again"):
        with open(shard, "rb") as file:
            found: npt.NDArray[Any] = np.load(file, allow_pickle=False)
        if shape is not None and (found.shape != shape or found.dtype != np.float64):
            raise ValueError(f"it holds {found.dtype} of shape {found.shape}; expected {shape}")
        return found


def _line(i: int, digests: tuple[str, ...]) -> dict[str, Any]:
    """A line of the manifest: SHA-256 of the shard and, where it holds extremes only, of all residuals of the chunk."""
    return {"chunk": i, **dict(zip(("sha256", "residuals"), digests, strict=False))}


def _append(manifest: Path, line: dict[str, Any]) -> None:
    try:
        with open(manifest, "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
    except OSError as error:
        raise no_room(manifest, error) from error


def _lines(manifest: Path) -> list[Any]:
    """What stands in the lines of a manifest, the header first; None for one that a kill cut off, or a disk has damaged."""

    def read(line: bytes) -> Any:
        try:
            return json.loads(line)
        except (ValueError, RecursionError):
            return None

    try:
        return [read(line) for line in manifest.read_bytes().split(b"\n")]
    except OSError as error:
        raise UsageError(f"{manifest}: cannot be read ({error.strerror}); see to its folder, or delete that") from None


def _digest(path: Path) -> str | None:
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None


def _finished(folder: Path) -> dict[int, tuple[str, ...]]:
    """Chunks whose shard is there with the digest that the manifest states; all others are computed again."""
    done: dict[int, tuple[str, ...]] = {}
    for entry in _lines(folder / "manifest.jsonl")[1:]:
        match entry:
            case {"chunk": int(i), "sha256": str(sha256)} if i >= 0 and _digest(_shard(folder, i)) == sha256:
                done[i] = tuple(str(entry[k]) for k in ("sha256", "residuals") if k in entry)
    return done
