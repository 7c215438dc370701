"""A run folder as others see it: in which state it is, and what it has found."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, final

from gapcert.contracts.plugins import registry
from gapcert.contracts.plugins.component import load
from gapcert.numerics.errors import INTERRUPTED
from gapcert.run import journal
from gapcert.run.folder import SPEC, alive, is_run, marked, owner, stored
from gapcert.run.journal import Line
from gapcert.run.progress_rate import Pace
from gapcert.run.thresholds import THRESHOLDS
from gapcert.run.verdict import code_of

State = Literal["running", "finished", "interrupted", "failed"]
STATES: tuple[State, ...] = ("running", "finished", "interrupted", "failed")


@final
@dataclass(frozen=True)
class Standing:
    """Where a run stands: its state, the last report of progress, and how it ended if it did."""

    state: State
    lines: tuple[Line, ...]
    owner: Mapping[str, Any] | None = None
    verdict: str | None = None
    exit_code: int | None = None
    reason: str = ""

    @cached_property
    def progress(self) -> Line | None:
        """The last report of the last beginning."""
        return next((line for line in reversed(self.session) if line["event"] == "progress"), None)

    @cached_property
    def session(self) -> tuple[Line, ...]:
        """Lines since the run was last begun."""
        begun = [k for k, line in enumerate(self.lines) if line["event"] == "run-started"]
        return self.lines[begun[-1] if begun else 0 :]

    @property
    def stage(self) -> str:
        """What it does, or did when it was cut off: the part where it tells of parts, else the stage."""
        told = next((line for line in reversed(self.session) if line["event"] in ("progress", "stage-started")), None)
        if told is None:
            return ""
        return f"{told['stage']}: {told['part']}" if told.get("part") else str(told["stage"])

    @property
    def share(self) -> float | None:
        """Done of total of that stage, from 0 to 1."""
        p = self.progress
        return (
            min(1.0, p["done"] / p["total"]) if p is not None and p.get("total") and self.stage.startswith(p["stage"]) else None
        )

    @property
    def seconds(self) -> float:
        """Of all beginnings together, as far as reports go; a running one's up to now."""
        total, last = 0.0, 0.0
        for line in self.lines:
            total, last = (total + last, 0.0) if line["event"] == "run-started" else (total, float(line["s"]))
        if self.state == "running" and self.lines:
            last = max(last, last + time.time() - self.lines[-1]["t"])
        return total + last

    def pace(self) -> Pace:
        """That of the part which the last report is about."""
        pace, last = Pace(), self.progress
        for line in self.session:
            if last is not None and line["event"] == "progress" and _part(line) == _part(last):
                pace.saw(line["s"], line["done"], line.get("total"))
        return pace


def _part(line: Line) -> tuple[str, str]:
    return line["stage"], line.get("part", "")


def standing(folder: Path) -> Standing:
    """Looks at what the lock says and at the journal; takes no lock."""
    holder, lines = owner(folder), tuple(journal.read(folder / journal.NAME))
    last = lines[-1] if lines else None
    ended = last is not None and last["event"] == "run-ended"
    seen = alive(holder) if holder is not None else False
    # Elsewhere nobody can see the process: a fresh report speaks for it.
    if seen or (seen is None and last is not None and not ended and time.time() - last["t"] < THRESHOLDS.lost_run):
        return Standing("running", lines, holder)
    if last is not None and ended:
        state: State = last["how"] if last.get("how") in STATES else "failed"
        return Standing(state, lines, None, last.get("verdict"), last.get("exit_code"), str(last.get("reason", "")))
    if last is None and (summary := stored(folder, "summary.json")) is not None:
        code = code_of(summary) if "verdict" in summary else None
        return Standing("finished", lines, None, summary.get("verdict"), code)
    return Standing("interrupted", lines, None, None, INTERRUPTED)


@final
@dataclass(frozen=True)
class RunFolder:
    """A run folder; `RunFolder.at` refuses what is none."""

    path: Path
    mark: Mapping[str, Any]

    @classmethod
    def at(cls, path: Path | str) -> RunFolder:
        """UsageError unless the folder is that of a run."""
        return cls(Path(path), marked(Path(path)))

    @cached_property
    def spec(self) -> Mapping[str, Any]:
        return stored(self.path, SPEC) or {}

    @cached_property
    def summary(self) -> Mapping[str, Any]:
        """What `summary.json` holds; nothing where the run has not finished."""
        return stored(self.path, "summary.json") or {}

    @cached_property
    def standing(self) -> Standing:
        return standing(self.path)

    @property
    def name(self) -> str:
        return str(self.mark["name"])

    @property
    def kind(self) -> str:
        """What the spec asks for: a study that answers alone, or `certify`."""
        for study in registry.installed().of("study"):
            if self.spec.get(study.name) is not None:
                with suppress(Exception):  # a plugin's module may fail in any way, and a list of runs goes on
                    if load(study.config).alone:
                        return study.name
        return "certify"

    @cached_property
    def size(self) -> int:
        """Bytes of all files in it; links are not followed."""
        return sum(entry.stat(follow_symlinks=False).st_size for entry in walk(self.path))

    @cached_property
    def changed(self) -> float:
        """When something last happened in it, in seconds since 1970."""
        lines = self.standing.lines
        if lines:
            return float(lines[-1]["t"])
        return max((e.stat(follow_symlinks=False).st_mtime for e in walk(self.path)), default=self.path.stat().st_mtime)

    @property
    def seconds(self) -> float | None:
        """How long it has run; None where it left no report."""
        return self.standing.seconds if self.standing.lines else None


def walk(folder: Path) -> Iterator[os.DirEntry[str]]:
    """All files below a folder, without following links; what vanishes meanwhile is left out."""
    try:
        with os.scandir(folder) as entries:
            found = list(entries)
    except OSError:
        return
    for entry in found:
        if entry.is_dir(follow_symlinks=False):
            yield from walk(Path(entry.path))
        elif entry.is_file(follow_symlinks=False) and os.path.lexists(entry.path):
            yield entry


def folders(out: Path) -> list[RunFolder]:
    """The run folders in a folder, in the order of their names."""
    found = sorted(p for p in out.iterdir() if is_run(p)) if out.is_dir() else []
    return [RunFolder.at(p) for p in found]
