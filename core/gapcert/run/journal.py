"""What a run tells, kept in its folder as one JSON object a line, for whoever looks from outside or afterwards.

Lines are only appended, each by one write, so that a kill leaves at most the last one in pieces; where there are too many,
the file is replaced by one with every other report of progress. No result depends on it.
"""

from __future__ import annotations

import json
import math
import os
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, final

from gapcert.contracts.plugins.events import Event, Heart
from gapcert.numerics.errors import INTERRUPTED, GapcertError, exit_code
from gapcert.run.folder import myself
from gapcert.run.thresholds import THRESHOLDS
from gapcert.version import __version__

NAME = "progress.jsonl"
LIMIT = 256 * 1024  # bytes
LONGEST = 600  # characters of a text

Line = dict[str, Any]


@final
class Journal:
    """An observer that writes `progress.jsonl` of a run folder. As a context, it also tells how the run ended."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME
        self.begin, self.last, self.stage = time.monotonic(), float("-inf"), ""
        self._told = self.begin
        self._waiting: Event | None = None
        self._lock = threading.Lock()
        self._heart = Heart(THRESHOLDS.silence, self._beat)
        self._file: int | None = None
        self._ended = False

    def __enter__(self) -> Journal:
        with suppress(OSError):
            known = read(self.path)
            self._number = known[-1]["n"] + 1 if known else 0
            torn = bool(self.path.exists() and (text := self.path.read_bytes()) and not text.endswith(b"\n"))
            self._file = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)
            if torn:
                os.write(self._file, b"\n")
            self._write("run-started", "run", {**myself(), "version": __version__, "again": bool(known)})
        self._heart.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._heart.__exit__()
        # Whatever becomes of the journal, the run's own end is what counts.
        with suppress(OSError):
            if error is not None and not self._ended:
                self._flush()
                self._write("run-ended", "run", ending(error))
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def __call__(self, event: Event) -> None:
        if event.name == "run-started":
            return None
        with self._lock:
            if event.name != "progress":
                self._flush()
                return self._tell(event)
            now = time.monotonic()
            if now - self.last < (THRESHOLDS.stage_pause if event.stage == self.stage else THRESHOLDS.short_pause):
                self._waiting = event
                return None
            self._waiting, self.last, self.stage = None, now, event.stage
            return self._write("progress", event.stage, _shown(event.data))

    def _beat(self) -> None:
        """A sign of life where a stage has nothing to tell."""
        with self._lock, suppress(OSError):
            if time.monotonic() - self._told >= THRESHOLDS.silence:
                self._write("alive", self.stage, {})

    def finished(self, summary: Mapping[str, Any], code: int) -> None:
        """The run has its answer."""
        with self._lock:
            self._flush()
            self._write("run-ended", "run", {"how": "finished", "verdict": summary.get("verdict"), "exit_code": code})
            self._ended = True

    def _tell(self, event: Event) -> None:
        if event.name == "warning":
            self._write("warning", event.stage, {"message": str(event.data.get("message", event.data))[:LONGEST]})
        elif event.name in ("stage-started", "stage-finished"):
            seconds = event.data.get("seconds")
            self._write(event.name, event.stage, {} if seconds is None else {"seconds": seconds})

    def _flush(self) -> None:
        """How far a stage came is known, though it was too soon to tell it."""
        if self._waiting is not None:
            waiting, self._waiting = self._waiting, None
            self._write("progress", waiting.stage, _shown(waiting.data))

    def _write(self, name: str, stage: str, data: Mapping[str, Any]) -> None:
        if self._file is None:
            return
        now = {"t": round(time.time(), 3), "s": round(time.monotonic() - self.begin, 3)}
        line = {"n": self._number, **now, "event": name, "stage": stage, **data}
        os.write(self._file, _encoded(line))
        self._told = time.monotonic()
        self._number += 1
        if os.fstat(self._file).st_size > LIMIT:
            self._thin()

    def _thin(self) -> None:
        """Every other report goes, and of other kinds the oldest where there are many; readers see one file or the other."""
        lines = read(self.path)
        progress = [k for k, line in enumerate(lines) if line["event"] in ("progress", "alive")]
        gone = set(progress[-2::-2])
        kept = [_encoded(line) for k, line in enumerate(lines) if k not in gone]
        while len(kept) > 2 and sum(map(len, kept)) > 3 * LIMIT // 4:
            kept = kept[len(kept) // 4 + 1 :]
        temporary = self.path.with_name(f"{NAME}.{os.getpid()}.tmp")
        temporary.write_bytes(b"".join(kept))
        os.replace(temporary, self.path)
        assert self._file is not None, "only an open journal grows"
        os.close(self._file)
        self._file = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)


def ending(error: BaseException) -> dict[str, Any]:
    """How an error ends a run: interrupted where the same spec goes on from there, else failed; with exit code and reason."""
    code, own = exit_code(error), isinstance(error, GapcertError)
    text = str(error) if own else "" if isinstance(error, KeyboardInterrupt) else f"{type(error).__name__}: {error}"
    return {"how": "interrupted" if code == INTERRUPTED else "failed", "exit_code": code, "reason": text[:LONGEST]}


def read(path: Path) -> list[Line]:
    """All whole lines of a journal, oldest first; none where there is no file."""
    try:
        return list(parsed(path.read_bytes()))
    except OSError:
        return []


def parsed(text: bytes) -> Iterator[Line]:
    """The lines that can be read: one that a kill cut off is none."""
    for one in text.split(b"\n"):
        try:
            line = json.loads(one)
        except ValueError:
            continue
        if isinstance(line, dict) and {"n", "t", "s", "event", "stage"} <= line.keys():
            yield line


def _shown(data: Mapping[str, Any]) -> dict[str, Any]:
    """What a progress tells, without objects."""
    kept = {k: data[k] for k in ("done", "total", "unit", "part", "text", "best") if data.get(k) is not None}
    if "best" in kept:
        # JSON has no infinite numbers.
        kept["best"] = {n: str(v) if isinstance(v, float) and not math.isfinite(v) else v for n, v in kept["best"].items()}
    return {k: v[:LONGEST] if isinstance(v, str) else v for k, v in kept.items()}


def _encoded(line: Mapping[str, Any]) -> bytes:
    """With NumPy's numbers as Python's; anything else as text."""
    return json.dumps(line, default=lambda v: v.item() if hasattr(v, "item") else str(v), ensure_ascii=False).encode() + b"\n"
