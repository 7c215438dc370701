"""Where samples come from: rounds of points, chunks computed by any executor, shards that survive a kill.

The points of a round are a pure function of the spec and of earlier rounds; a chunk is a pure function of (residual, points,
index). So neither the number nor the order of workers can change a bit, and a killed run resumes to the same digests.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import json
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from types import ModuleType
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert.domain import Cover, Domain, Points
from gapcert.errors import Interrupted, UsageError
from gapcert.events import Emit, Event, silent
from gapcert.lipschitz import Residual
from gapcert.system import Array

PointSet = Points | Cover

_AGAIN = "run the same command again to go on from there"


def processes(workers: int | None = None) -> Executor:
    """Worker processes of this machine (started afresh, so that no engine state is inherited)."""
    return ProcessPoolExecutor(workers or os.cpu_count(), _Afresh(), initializer=_ignore_interrupt)


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


def threads(workers: int | None = None) -> Executor:
    """Threads of this process, for Systems that release the interpreter lock and keep no state per process."""
    return ThreadPoolExecutor(workers or os.cpu_count())


def _ignore_interrupt() -> None:
    # Ctrl-C reaches the whole process group; only the main process answers it, after the shards in flight are written.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def write_atomic(path: Path, content: bytes) -> None:
    """Write by temporary file, flush and rename: a reader sees the whole content or none of it."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise _no_room(path, error) from error


def _no_room(path: Path, error: OSError) -> UsageError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return UsageError(
            f"{path.parent}: the disk is full; free some room and run the same command again (finished shards are kept)"
        )
    return UsageError(f"{path.parent}: cannot write ({error.strerror}); choose another folder with --out")


def npz_bytes(arrays: Mapping[str, npt.NDArray[Any]], *, compress: bool = False) -> bytes:
    """The content of an .npz file, for `write_atomic`."""
    buffer = io.BytesIO()
    (np.savez_compressed if compress else np.savez)(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _array_bytes(array: Array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return buffer.getvalue()


_residuals: dict[str, Residual] = {}


def compute_chunk(payload: bytes, points: PointSet, start: int, stop: int, target: Path) -> str:
    """Evaluate points [start, stop) of a round and write the shard; returns its SHA-256. Runs in any worker."""
    key = hashlib.sha256(payload).hexdigest()
    if key not in _residuals:
        _residuals[key] = pickle.loads(payload)
    r = _residuals[key](points.chunk(start, stop))
    if not np.isfinite(r).all():
        row = int(np.flatnonzero(~np.isfinite(r).all(axis=1))[0])
        z = points.chunk(start + row, start + row + 1)[0]
        raise UsageError(
            f"sampling: the residual at (x, u) = {z.tolist()} is {r[row].tolist()}; shrink the domain or mend the system"
        )
    content = _array_bytes(r)
    write_atomic(target, content)
    return hashlib.sha256(content).hexdigest()


@final
@dataclass
class Store:
    """The sample rounds of one run, in `folder`/<round>: `manifest.jsonl`, one `chunk-000000.npy` per shard, and `points.npy`
    where the points are no grid.

    `key` is the digest of what determines the answers (model, backend, domain): a folder of another key is refused.
    """

    folder: Path
    residual: Residual
    key: str
    executor: Callable[[], Executor] = processes
    chunk: int = 100_000
    emit: Emit = silent
    digests: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)

    def collect(self, name: str, points: PointSet) -> Array:
        """r (n, nx) at all points of round `name`, computing only the shards that are not there yet."""
        folder = self.folder / name
        header = {"round": name, "key": self.key, "points": points.digest(), "count": len(points), "chunk": self.chunk}
        self._prepare(folder, header, points)
        done = _finished(folder)
        lines = [header, *({"chunk": i, "sha256": done[i]} for i in sorted(done))]
        write_atomic(folder / "manifest.jsonl", "".join(json.dumps(line) + "\n" for line in lines).encode())
        spans = [(i, s, min(s + self.chunk, len(points))) for i, s in enumerate(range(0, len(points), self.chunk))]
        todo = [span for span in spans if span[0] not in done]
        completed = sum(stop - start for i, start, stop in spans if i in done)
        try:
            for i, digest in self._compute(folder, points, todo):
                done[i] = digest
                with open(folder / "manifest.jsonl", "a", encoding="utf-8") as manifest:
                    manifest.write(json.dumps({"chunk": i, "sha256": digest}) + "\n")
                completed += spans[i][2] - spans[i][1]
                self.emit(Event("progress", f"sampling {name}", {"done": completed, "total": len(points)}))
        except KeyboardInterrupt:
            raise Interrupted(f"interrupted in round '{name}'; {_AGAIN}") from None
        total = hashlib.sha256(json.dumps([header, [done[i] for i in range(len(spans))]]).encode()).hexdigest()
        self.digests[name], self.counts[name] = total, len(points)
        if not spans:
            return np.empty((0, self.residual.model.nx))
        return np.concatenate([np.load(_shard(folder, i)) for i, _, _ in spans])

    def _prepare(self, folder: Path, header: dict[str, Any], points: PointSet) -> None:
        manifest = folder / "manifest.jsonl"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise _no_room(folder, error) from error
        if manifest.exists():
            lines = manifest.read_text(encoding="utf-8").splitlines()
            if lines and _parse(lines[0]) == header:
                return
            raise UsageError(
                f"{folder}: this run folder was written for another spec (its round '{header['round']}' has other points or "
                f"another system); choose another folder with --out, or delete it"
            )
        if isinstance(points, Points):
            write_atomic(folder / "points.npy", _array_bytes(points.z))
        write_atomic(manifest, (json.dumps(header) + "\n").encode())

    def _compute(self, folder: Path, points: PointSet, todo: list[tuple[int, int, int]]) -> Iterator[tuple[int, str]]:
        payload = pickle.dumps(self.residual)
        # One chunk is not worth a pool, and a system of the running script cannot be sent to one; the bits are the same.
        alone = len(todo) <= 1 or b"__main__" in payload
        done: set[int] = set()
        for lost in (0, 1):
            left = [span for span in todo if span[0] not in done]
            pool = None if alone else self.executor()
            try:
                computed = (
                    _in_turn(payload, points, folder, left) if pool is None else _in_pool(pool, payload, points, folder, left)
                )
                for i, digest in computed:
                    done.add(i)
                    yield i, digest
                return
            except BrokenExecutor as error:
                if lost:
                    why = "an engine that crashes, or too little memory (try a smaller sampling.chunk)"
                    raise Interrupted(f"workers died twice in round '{folder.name}': {why}; {_AGAIN}") from error
                self.emit(
                    Event("warning", f"sampling {folder.name}", {"message": f"workers were lost and are replaced: {error}"})
                )
            finally:
                if pool is not None:
                    pool.shutdown(wait=True, cancel_futures=True)


def _in_turn(payload: bytes, points: PointSet, folder: Path, todo: list[tuple[int, int, int]]) -> Iterator[tuple[int, str]]:
    for i, start, stop in todo:
        yield i, compute_chunk(payload, points, start, stop, _shard(folder, i))


def _in_pool(
    pool: Executor, payload: bytes, points: PointSet, folder: Path, todo: list[tuple[int, int, int]]
) -> Iterator[tuple[int, str]]:
    """Keep a few chunks per worker in flight, so that memory does not grow with the number of chunks."""
    queue, running = iter(todo), dict[Future[str], int]()
    limit = 4 * (os.cpu_count() or 1)
    while True:
        while len(running) < limit and (span := next(queue, None)) is not None:
            i, start, stop = span
            # Only the chunk's own points travel; grid points are recomputed by the worker.
            part, a, b = (
                (points, start, stop) if isinstance(points, Cover) else (Points(points.chunk(start, stop)), 0, stop - start)
            )
            running[pool.submit(compute_chunk, payload, part, a, b, _shard(folder, i))] = i
        if not running:
            return
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            yield running.pop(future), future.result()


def _shard(folder: Path, i: int) -> Path:
    return folder / f"chunk-{i:06d}.npy"


def _parse(line: str) -> Any:
    try:
        return json.loads(line)
    except ValueError:
        return None  # a line cut off by a kill


def _finished(folder: Path) -> dict[int, str]:
    """Chunks whose shard is there with the digest that the manifest states; all others are computed again."""
    done: dict[int, str] = {}
    for entry in map(_parse, (folder / "manifest.jsonl").read_text(encoding="utf-8").splitlines()[1:]):
        if not isinstance(entry, dict):
            continue
        path = _shard(folder, entry["chunk"])
        if path.exists() and hashlib.sha256(path.read_bytes()).hexdigest() == entry["sha256"]:
            done[entry["chunk"]] = entry["sha256"]
    return done


@final
@dataclass(frozen=True)
class GridSampling:
    """All cell centres of a uniform grid: `counts` cells per axis."""

    counts: tuple[int, ...]
    chunk: int = 100_000

    @classmethod
    def covering(cls, domain: Domain, states: float, inputs: float, chunk: int = 100_000) -> GridSampling:
        """The coarsest cubic grid whose Euclidean cover radius is at most εx in the states and εu in the inputs."""
        counts: list[int] = []
        for radius, axes in ((states, slice(None, domain.nx)), (inputs, slice(domain.nx, None))):
            width = domain.width[axes]
            counts += [max(1, int(np.ceil(w * np.sqrt(len(width)) / (2 * radius)))) for w in width]
        return cls(tuple(counts), chunk)

    def first(self, domain: Domain) -> Cover:
        if len(self.counts) != len(domain.low):
            raise UsageError(
                f"sampling.counts: {len(self.counts)} numbers for {len(domain.low)} axes; give one per state and input"
            )
        return Cover(domain, self.counts)

    def further(self, domain: Domain, z: Array, r: Array, lipschitz: Array) -> Array | None:
        return None


@final
@dataclass(frozen=True)
class AdaptiveSampling:
    """Trisected cells: each cell is sampled at its centre, and cells where the certified band is loosest are split in three.

    A split keeps the centre for the middle child, so it costs two samples. The first round trisects every axis once (3^nz
    points), or samples the centre alone where the budget is smaller than that.
    """

    budget: int = 300
    chunk: int = 100_000

    def first(self, domain: Domain) -> Points:
        n = 3 if 3 ** len(domain.low) <= self.budget else 1
        return Points(Cover(domain, (n,) * len(domain.low)).chunk(0, n ** len(domain.low)))

    def further(self, domain: Domain, z: Array, r: Array, lipschitz: Array) -> Array | None:
        """The points of all later rounds (m, nz), given the first round and the constants; None when the budget is spent.

        A cell with half-widths h leaves a band of about Σ_j L_ij h_j in state i; its cost is that, relative to the mean gap of
        the state and weighted by the cell's volume. The costliest cell is split along its costliest axis, until the budget is
        spent.
        """
        import heapq

        scale = np.maximum(np.abs(r).mean(axis=0), np.finfo(float).tiny)
        weight = (lipschitz / scale[:, None]).sum(axis=0)
        n = round(len(z) ** (1 / z.shape[1]))
        half = domain.width / (2 * n)
        # A stable tie-break by age keeps the order, and so the points, independent of the heap's internals.
        heap = [(-float(np.prod(half) * (weight @ half)), k, c, half) for k, c in enumerate(z)]
        heapq.heapify(heap)
        points: list[Array] = []
        age = len(heap)
        while len(z) + len(points) + 2 <= self.budget and weight.any():
            _, _, centre, h = heapq.heappop(heap)
            j = int(np.argmax(weight * h))
            third = h.copy()
            third[j] /= 3
            cost = -float(np.prod(third) * (weight @ third))
            for side in (-1, 0, 1):
                child = centre.copy()
                child[j] += 2 * third[j] * side
                heapq.heappush(heap, (cost, age, child, third))
                age += 1
                if side:
                    points.append(child)
        return np.array(points) if points else None


Sampling = GridSampling | AdaptiveSampling
